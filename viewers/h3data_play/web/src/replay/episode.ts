/** A recorded episode: who and what moves, the states, and what happens. */

import type { Stage, StagedAgent } from "../link/manifest.ts";
import type { AgentState, State } from "../link/wire.ts";
import type { Payload, Table } from "./payload.ts";

export interface Chart {
  title: string;
  unit: string;
  curves: { name: string; array: string }[];
  /** Values between which the robot counts as following. */
  band?: [number, number] | null;
  /** Whether values hold until the next one. */
  stairs?: boolean;
  /** Whether there is a curve for each agent, in their order. */
  agents?: boolean;
}

export interface Lane {
  name: string;
  states: string[];
  /** Step from which on, and index of the state. */
  runs: [number, number][];
}

export type EventKind = "event" | "good" | "bad" | "skill" | "skill-bad";

export interface Happening {
  step: number;
  kind: EventKind;
  text: string;
}

export interface Contact {
  step: number;
  text: string;
  point: [number, number, number];
}

export interface Goal {
  position: [number, number, number];
  label: string;
  /** The thing that belongs there, and what it is called. */
  object: string;
  name: string;
}

export interface Walk {
  agent: number;
  steps: number[];
  points: [number, number, number][];
}

/** A message of an agent, which is shown over their head. */
export interface Speech {
  agent: number;
  step: number;
  text: string;
}

export interface Scan {
  agent: number;
  /** Name of the distances [T, R], m: the first straight ahead, the others to the left. */
  track: string;
  /** Farthest that it measures, and height over the floor, m. */
  most: number;
  height: number;
}

interface Cast extends Stage {
  /** With the height at which their names float, m. */
  agents: (StagedAgent & { height: number })[];
  /** With the name of their poses. */
  objects: { name: string; track: string }[];
}

export interface About {
  stage: Cast;
  facts: Record<string, string>;
  charts: Chart[];
  lanes: Lane[];
  events: Happening[];
  contacts: Contact[];
  goals: Goal[];
  walks: Walk[];
  scans: Scan[];
  says: Speech[];
}

export class Episode {
  /** Seconds since the first state, and the step of the recording, of every state. */
  readonly times: Float64Array;
  readonly steps: Float64Array;
  /** Positions of the agents [T, 3]. */
  readonly bases: Table[];
  private readonly headings: Table[];
  private readonly parts: ((row: number) => Partial<AgentState>)[];
  private readonly things: { position: Table; rotation: Table }[];
  private readonly joints: Table | null;
  private readonly made = new Map<number, State>();

  constructor(
    readonly about: About,
    readonly payload: Payload<About>,
  ) {
    this.times = payload.table("time").values;
    this.steps = payload.table("step").values;
    this.bases = about.stage.agents.map((_, k) => payload.table(`agent_${k}.base`));
    this.headings = about.stage.agents.map((_, k) => payload.table(`agent_${k}.heading`));
    this.parts = about.stage.agents.map((agent, k) => this.part(agent, `agent_${k}`));
    this.joints = about.stage.joints.length ? payload.table("joints") : null;
    this.things = about.stage.objects.map((thing) => this.poses(thing.track));
  }

  get rows(): number {
    return this.times.length;
  }

  get seconds(): number {
    return this.times[this.rows - 1]!;
  }

  /** The last state at or before a time, and how far it is to the next one, 0 to 1. */
  at(seconds: number): { row: number; share: number } {
    let low = 0;
    let high = this.rows - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.times[middle]! <= seconds) low = middle;
      else high = middle - 1;
    }
    const next = this.times[low + 1];
    const share = next === undefined ? 0 : Math.min(Math.max((seconds - this.times[low]!) / (next - this.times[low]!), 0), 1);
    return { row: low, share };
  }

  state(row: number): State {
    const known = this.made.get(row);
    if (known) return known;
    if (this.made.size > 64) this.made.clear();
    const state: State = {
      flags: 0,
      step: this.steps[row]!,
      ack: -1,
      clockMs: this.times[row]! * 1000,
      agents: this.parts.map((part, k) => ({ ...this.base(k, row), ...part(row) }) as AgentState),
      things: this.things.map((thing) => ({ held: -1, pose: this.pose(thing, row) })),
      joints: this.joints ? slice(this.joints, row) : NO_JOINTS,
    };
    this.made.set(row, state);
    return state;
  }

  /** Where an agent is between two states; NaN where it is absent. */
  base(agent: number, row: number): { x: number; y: number; z: number; heading: number } {
    const at = this.bases[agent]!.values;
    return { x: at[3 * row]!, y: at[3 * row + 1]!, z: at[3 * row + 2]!, heading: this.headings[agent]!.values[row]! };
  }

  private part(agent: StagedAgent, name: string): (row: number) => Partial<AgentState> {
    if (agent.kind === "robot") {
      const joints = this.payload.has(`${name}.joints`) ? this.payload.table(`${name}.joints`) : null;
      return (row) => ({ joints: joints ? slice(joints, row) : new Float32Array(0) });
    }
    if (!agent.bones) return () => ({ root: new Float32Array(7), quats: new Float32Array(0) });
    const root = this.poses(`${name}.root`);
    const quats = this.payload.table(`${name}.quats`);
    return (row) => ({ root: this.pose(root, row), quats: slice(quats, row) });
  }

  private poses(name: string): { position: Table; rotation: Table } {
    return { position: this.payload.table(`${name}.position`), rotation: this.payload.table(`${name}.rotation`) };
  }

  private pose(track: { position: Table; rotation: Table }, row: number): Float32Array {
    const pose = new Float32Array(7);
    pose.set(slice(track.position, row));
    pose.set(slice(track.rotation, row), 3);
    const size = Math.hypot(pose[3]!, pose[4]!, pose[5]!, pose[6]!) || 1;
    for (let k = 3; k < 7; k++) pose[k]! /= size;
    return pose;
  }
}

const NO_JOINTS = new Float32Array(0);

function slice(table: Table, row: number): Float32Array {
  return Float32Array.from(table.values.subarray(row * table.columns, (row + 1) * table.columns));
}
