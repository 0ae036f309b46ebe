/** What the server tells once: who and what is there, the rules of motion, the floor. */

import type { Driving } from "../motion/drive.ts";
import type { HeightRow } from "../motion/floor.ts";
import type { Joint } from "../scene/joints.ts";
import type { Link, Pose7 } from "../scene/robot.ts";
import type { SdfShape } from "../motion/sdf.ts";
import { say } from "../words.ts";

/** Somebody who is shown. */
export interface StagedAgent {
  name: string;
  kind: "robot" | "human";
  /** Robot: from the base on the floor to the frame of its links; the links; how many joints a state has. */
  base?: Pose7;
  links?: Link[];
  joints?: number;
  /** Robot that climbs stairs: how far apart its ends are that stand on them, m; 0: it stays upright. */
  climbs?: number;
  /** Person: names of the joints that states move, the pelvis first. */
  bones?: string[];
}

export interface AgentInfo extends StagedAgent {
  drive: Driving;
  /** Person: names of the motions of files that they can perform. */
  acts?: string[];
}

export interface ThingInfo {
  name: string;
  label: string;
}

export interface JointInfo extends Joint {
  label: string;
  /** Whether it is a door between rooms. */
  passage: boolean;
}

export interface GoalInfo {
  position: [number, number, number];
  /** Where that is, such as "nightstand". */
  label: string;
}

/** The part of a manifest that says how states move the home's file. */
export interface Stage {
  agents: StagedAgent[];
  objects: { name: string }[];
  /** Things that states move after the objects, such as a tray; none: there are no such things. */
  brought?: { name: string }[];
  /** Doors and drawers that states move. */
  joints: Joint[];
  floor_y: number;
  /** How high the floor is at a place, where stairs join storeys; empty: it is level. */
  heights: HeightRow[];
}

export interface Manifest extends Stage {
  version: number;
  agents: AgentInfo[];
  objects: ThingInfo[];
  joints: JointInfo[];
  /** Index of the player's agent; -1: a spectator. */
  me: number;
  /** One for each object that has to be brought somewhere, by the index of the object. */
  goals: GoalInfo[];
  /** Messages that are sent by one press; where there are some, the player can talk. */
  phrases: { label: string; text: string }[];
  /** Places to choose from a list, under their rooms. */
  spots: { name: string; label: string; room: string }[];
  /** Whether a question follows the end, and an episode can be skipped. */
  asks: boolean;
  /** Whether a name stands over the head of every other agent. */
  names: boolean;
  /** Seconds per step. */
  dt: number;
  sdf: SdfShape & { url: string };
}

/** What an agent is called on the page: by its kind, with a number where another one is alike. */
export function called(manifest: Manifest, agent: number): string {
  if (agent === manifest.me) return say("you");
  const { kind } = manifest.agents[agent]!;
  const alike = manifest.agents.flatMap((other, k) => (other.kind === kind && k !== manifest.me ? [k] : []));
  const word = say(kind === "robot" ? "the_robot" : "the_person");
  return alike.length > 1 ? `${word} ${alike.indexOf(agent) + 1}` : word;
}
