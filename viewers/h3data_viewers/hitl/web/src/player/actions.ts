/** What the player can do from where they stand, and what of it is asked for. */

import type { Base } from "../motion/drive.ts";
import type { Manifest } from "../link/manifest.ts";
import type { State } from "../link/wire.ts";

/** From here a thing is near enough to be offered; whether the hand reaches it, the server says. */
export const NEAR_M = 1.1;
/** A thing this near to its goal is where it belongs, m. */
const AT_GOAL_M = 0.15;

export interface Situation {
  /** Thing in the player's hand; -1: none. */
  held: number;
  /** Thing to take next: the nearest one that is not where it belongs; -1: none. */
  next: number;
  /** From the player to `next`, or to the goal of what is held, m. */
  far: number;
  /** Robot that is near enough to be given something; -1: none. */
  robot: number;
  done: boolean[];
}

export function situation(manifest: Manifest, state: State, me: number, base: Base): Situation {
  const done = manifest.goals.map((goal, k) => {
    const thing = state.things[k]!;
    const [x, y, z] = goal.position;
    return thing.held < 0 && Math.hypot(thing.pose[0]! - x, thing.pose[1]! - y, thing.pose[2]! - z) < AT_GOAL_M;
  });
  const held = me < 0 ? -1 : state.things.findIndex((thing) => thing.held === me);
  let next = -1;
  let far = Infinity;
  if (held >= 0) {
    const goal = manifest.goals[held];
    if (goal) far = Math.hypot(goal.position[0] - base.x, goal.position[2] - base.z);
  } else {
    state.things.forEach((thing, k) => {
      const gap = Math.hypot(thing.pose[0]! - base.x, thing.pose[2]! - base.z);
      if (thing.held < 0 && !done[k] && gap < far) [next, far] = [k, gap];
    });
  }
  const robot = manifest.agents.findIndex((agent, k) => {
    const other = state.agents[k]!;
    return k !== me && agent.kind === "robot" && Math.hypot(other.x - base.x, other.z - base.z) < 1.2;
  });
  return { held, next, far, robot, done };
}

/** Keys and what they do now. `fits`: whether what is held may be put where the preview shows it; null if nobody knows. */
export function hints(now: Situation, manifest: Manifest, device: string, fits: boolean | null): [string, string][] {
  const [act, go] = device === "pad" ? ["A", "X"] : device === "touch" ? ["", ""] : ["E", "F"];
  const name = (k: number): string => `the ${manifest.objects[k]!.label}`;
  if (now.held >= 0) {
    const goal = manifest.goals[now.held];
    const to = goal ? `the ${goal.label}` : "a free place";
    const parts: [string, string][] =
      now.far < NEAR_M && fits !== false ? [[act, `put ${name(now.held)} on ${to}`]] : [[go, `walk to ${to} and put ${name(now.held)} there`]];
    if (now.robot >= 0 && device === "keys") parts.push(["G", "give it to the robot"]);
    return parts;
  }
  if (now.next < 0) return [];
  return now.far < NEAR_M ? [[act, `take ${name(now.next)}`]] : [[go, `walk to ${name(now.next)} and take it`]];
}

/** Who has a thing, for the list; empty: nobody. */
export function holderText(manifest: Manifest, holder: number): string {
  const { agents, me } = manifest;
  if (holder < 0) return "";
  if (holder === me) return "in your hand";
  if (agents[holder]!.kind === "robot") return "the robot has it";
  return agents[me]?.kind === "human" ? "the other person has it" : "the person has it";
}
