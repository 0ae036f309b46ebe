/** States as the server packs them (`h3data_play.wire`): little-endian, laid out by the manifest. */

export interface RobotState {
  x: number;
  z: number;
  /** Height of the floor under it; none: that of the home. */
  y?: number;
  heading: number;
  joints: Float32Array;
}

export interface PersonState {
  x: number;
  z: number;
  y?: number;
  heading: number;
  /** Pelvis in the world: position [m], quaternion xyzw. */
  root: Float32Array;
  /** Rotations of the joints after the pelvis, four numbers each. */
  quats: Float32Array;
}

export type AgentState = RobotState | PersonState;

export interface ThingState {
  /** Agent that holds it; -1: none. */
  held: number;
  /** Position [m], quaternion xyzw. */
  pose: Float32Array;
}

/** One step of the world. */
export interface State {
  flags: number;
  step: number;
  /** Number of the last input that has acted; -1: none. */
  ack: number;
  clockMs: number;
  agents: AgentState[];
  things: ThingState[];
  /** Positions of doors and drawers, rad or m. */
  joints: Float32Array;
}

export const FLAG = { touch: 1, wall: 2, ended: 4, busy: 8, sits: 16, lies: 32, seated: 64, gestures: 128 } as const;

/** What of the manifest lays out a state. */
export interface AgentLayout {
  kind: "robot" | "human";
  /** Robot: joints. */
  joints: number;
}

const STATE = 1;
const PONG = 2;
const HEAD_BYTES = 16;
/** Joints of a person that move, after the pelvis. */
export const BODY_JOINTS = 21;
const JOINT_UNIT = 2e-4;
/** Of a door or drawer. */
const JOINT_BYTES = 6;
/** The three components that are sent, by the index of the one that is not: the largest. */
const SENT = [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]] as const;

export function decodePong(data: ArrayBuffer): { clientMs: number; serverMs: number } | null {
  const view = new DataView(data);
  if (view.getUint8(0) !== PONG) return null;
  return { clientMs: view.getFloat64(8, true), serverMs: view.getFloat64(16, true) };
}

/** A state. Things and joints that it leaves out are where `before` has them. */
export function decodeState(data: ArrayBuffer, agents: AgentLayout[], before: State | undefined): State {
  const view = new DataView(data);
  if (view.getUint8(0) !== STATE) throw new Error(`Expected a state, got a message of kind ${view.getUint8(0)}.`);
  if (view.getUint8(2) !== agents.length)
    throw new Error(`Expected a state of ${agents.length} agents, got one of ${view.getUint8(2)}.`);
  const read = new Reader(view, HEAD_BYTES);
  const state: State = {
    flags: view.getUint8(1),
    step: view.getUint32(4, true),
    ack: view.getInt32(8, true),
    clockMs: view.getFloat32(12, true),
    agents: agents.map((agent) => (agent.kind === "robot" ? read.robot(agent.joints) : read.person())),
    things: before ? [...before.things] : [],
    joints: before?.joints ?? new Float32Array(0),
  };
  for (let left = view.getUint8(3); left > 0; left--) {
    const [index, thing] = read.thing();
    state.things[index] = thing;
  }
  const joints = read.joints();
  if (joints.length) {
    state.joints = new Float32Array(Math.max(state.joints.length, joints.length)); // the first state has all of them
    state.joints.set(before?.joints ?? []);
    for (const [index, position] of joints) state.joints[index] = position;
  }
  return state;
}

class Reader {
  constructor(
    private readonly view: DataView,
    private at: number,
  ) {}

  robot(joints: number): RobotState {
    const [x, z, heading] = this.floats(3) as unknown as [number, number, number];
    const values = new Float32Array(joints);
    for (let k = 0; k < joints; k++, this.at += 2) values[k] = this.view.getInt16(this.at, true) * JOINT_UNIT;
    return { x, z, heading, joints: values };
  }

  person(): PersonState {
    const [x, z, heading] = this.floats(3) as unknown as [number, number, number];
    const root = this.floats(7);
    const quats = new Float32Array(4 * BODY_JOINTS);
    for (let k = 0; k < BODY_JOINTS; k++, this.at += 4) unpackQuat(this.view.getUint32(this.at, true), quats, 4 * k);
    return { x, z, heading, root, quats };
  }

  thing(): [number, ThingState] {
    const index = this.view.getUint16(this.at, true);
    const held = this.view.getInt16(this.at + 2, true);
    this.at += 4;
    return [index, { held, pose: this.floats(7) }];
  }

  /** Indices and positions up to the end. */
  joints(): [number, number][] {
    const joints: [number, number][] = [];
    for (; this.at < this.view.byteLength; this.at += JOINT_BYTES)
      joints.push([this.view.getUint16(this.at, true), this.view.getFloat32(this.at + 2, true)]);
    return joints;
  }

  private floats(count: number): Float32Array {
    const values = new Float32Array(count);
    for (let k = 0; k < count; k++, this.at += 4) values[k] = this.view.getFloat32(this.at, true);
    return values;
  }
}

/** A rotation in 32 bits: the index of its largest component, the three others in 10 bits each. */
export function unpackQuat(bits: number, out: Float32Array, at: number): void {
  const largest = bits >>> 30;
  let rest = 1;
  SENT[largest]!.forEach((axis, k) => {
    const value = (((bits >>> (20 - 10 * k)) & 1023) / 511.5 - 1) * Math.SQRT1_2;
    out[at + axis] = value;
    rest -= value * value;
  });
  out[at + largest] = Math.sqrt(Math.max(rest, 0));
}
