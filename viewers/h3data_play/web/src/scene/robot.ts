/** Forward kinematics of a robot whose links are separate nodes of the home's GLB. */

import { Matrix4, Quaternion, Vector3, type Object3D } from "three";

/** pose7: position [m], quaternion xyzw. */
export type Pose7 = ArrayLike<number>;

export interface Link {
  name: string;
  /** Index of the parent link, which comes first; -1: the base. */
  parent: number;
  origin: Pose7;
  axis: [number, number, number];
  /** 0 fixed, 1 turning, 2 sliding. */
  kind: number;
  /** Joint that moves it: its value is gain * joint + offset. */
  column: number;
  gain: number;
  offset: number;
}

const UP = new Vector3(0, 1, 0);
/** Of the robot. */
const RIGHT = new Vector3(0, 0, 1);
const ONE = new Vector3(1, 1, 1);

export class RobotRig {
  private readonly base: Matrix4;
  private readonly origins: Matrix4[];
  private readonly axes: Vector3[];
  private readonly frames: Matrix4[];
  private readonly motion = new Matrix4();
  private readonly turn = new Quaternion();
  private readonly lean = new Quaternion();

  /** `nodes` are those of the links, in their order; a link without a mesh may have none. */
  constructor(
    private readonly links: Link[],
    base: Pose7,
    readonly nodes: (Object3D | undefined)[],
  ) {
    this.base = matrixOf(base);
    this.origins = links.map((link) => matrixOf(link.origin));
    this.axes = links.map((link) => new Vector3(...link.axis));
    this.frames = links.map(() => new Matrix4());
  }

  /** Places all links for a base on the floor, which may pitch up, and joint values between two states. */
  pose(at: Vector3, heading: number, pitch: number, from: Float32Array, to: Float32Array, share: number): void {
    this.turn.setFromAxisAngle(UP, heading).multiply(this.lean.setFromAxisAngle(RIGHT, pitch));
    const root = this.motion.compose(at, this.turn, ONE);
    const body = root.clone().multiply(this.base);
    this.links.forEach((link, k) => {
      const frame = this.frames[k]!.copy(link.parent < 0 ? body : this.frames[link.parent]!).multiply(this.origins[k]!);
      if (link.kind !== 0) {
        const joint = from[link.column]! + (to[link.column]! - from[link.column]!) * share;
        const value = link.gain * joint + link.offset;
        const axis = this.axes[k]!;
        if (link.kind === 1) frame.multiply(this.motion.makeRotationAxis(axis, value));
        else frame.multiply(this.motion.makeTranslation(axis.x * value, axis.y * value, axis.z * value));
      }
      const node = this.nodes[k];
      if (node) frame.decompose(node.position, node.quaternion, node.scale);
    });
  }
}

export function matrixOf(pose: Pose7): Matrix4 {
  const [x, y, z, qx, qy, qz, qw] = Array.from(pose) as [number, number, number, number, number, number, number];
  return new Matrix4().compose(new Vector3(x, y, z), new Quaternion(qx, qy, qz, qw), ONE);
}
