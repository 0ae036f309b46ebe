/** What the player can do from where they stand, and what of it is asked for. */

import { say } from "../words.ts";
import type { Base } from "../motion/drive.ts";
import { isOpen } from "../scene/joints.ts";
import type { Manifest } from "../link/manifest.ts";
import { FLAG, type State } from "../link/wire.ts";

/** From here a thing is near enough to be offered; whether the hand reaches it, the server says. */
export const NEAR_M = 1.1;
/** A thing this near to its goal is where it belongs, m. */
const AT_GOAL_M = 0.15;

/** For each thing the joint to be opened before it is taken, and before it is put at its goal: what shuts it in, or a door
 * between rooms; -1: none. Empty: nothing opens. */
export type Barriers = [number, number][];

/** For each thing the point where the player has last seen it; null: not yet, or it is gone from there. */
export type Seen = ([number, number, number] | null)[];

export interface Situation {
  /** Thing in the player's hand; -1: none. */
  held: number;
  /** Thing to take next: the nearest one that is not where it belongs; -1: none. */
  next: number;
  /** Door or drawer to open before `next` is taken, while the hand is free: that of its goal, then its own; -1: none. */
  first: number;
  /** Whether `first` is shut before the goal. */
  forGoal: boolean;
  /** From the player to `next`, or to the goal of what is held, m. */
  far: number;
  /** Nearest door or drawer, and how far its handle is, m; -1: there is none. */
  joint: number;
  jointFar: number;
  /** Robot that is near enough to be given something; -1: none. */
  robot: number;
  /** Of each thing whether it is where it belongs. */
  done: boolean[];
  /** Whether it is in something that is closed, or behind a closed door. */
  shut: boolean[];
  /** Where the player knows it to be; null: they have to look for it. */
  known: ({ x: number; y: number; z: number } | null)[];
}

/** Something that the person can do with a thing that they brought along, as the server offers it. */
export interface Chore {
  name: "take" | "lift" | "put" | "phone";
  thing: "carton" | "tray" | "phone";
}

/** Object of the task in an agent's hand; -1: none. */
export function heldBy(manifest: Manifest, state: State, agent: number): number {
  return state.things.findIndex((thing, k) => thing.held === agent && k < manifest.objects.length);
}

/** Whether an agent holds a thing of a chore. */
export function carries(manifest: Manifest, state: State, agent: number): boolean {
  return state.things.some((thing, k) => thing.held === agent && k >= manifest.objects.length);
}

/** What a button for a chore says. */
export function choreText({ name, thing }: Chore): string {
  return say(name === "put" ? "posture_put" : `posture_${thing}`);
}

/** Keys or buttons of the chores that are possible now; a gamepad has none. */
export function choreHints(chores: Chore[], device: string): [string, string][] {
  if (device === "pad") return [];
  return chores.map((chore) => {
    const key = chore.name === "phone" ? "P" : "K";
    return [device === "touch" ? choreText(chore) : key, say(`chore_${chore.name}_${chore.thing}`)];
  });
}

/** Keys of postures, gestures and motions (`acts`) that are possible now; fingers have buttons for them. */
export function postureHints(flags: number, device: string, acts: string[]): [string, string][] {
  if (device !== "keys" && device !== "mouse") return [];
  const { sits, lies, seated, gestures } = FLAG;
  const keys: [number, string, string][] = [
    [seated, "C", "rise"], [sits, "C", "sit"], [lies, "L", "lie"], [gestures, "X", "wave"], [gestures, "P", "phone"],
  ];
  const own: [string, string][] = flags & gestures ? actKeys(acts) : [];
  return [...keys.filter(([flag]) => flags & flag).map(([, key, name]): [string, string] => [key, say(`posture_${name}`)]), ...own];
}

/** Keys of the motions of files that a person can perform, each with its name. */
export function actKeys(acts: string[]): [string, string][] {
  return acts.slice(0, 9).map((name, k) => [String(k + 1), name.replaceAll("_", " ")]);
}

/** What one press does: puts down, opens or closes a door or drawer, takes. */
export type Deed = { kind: "put" } | { kind: "take"; thing: number } | { kind: "turn"; joint: number } | { kind: "none" };

/** `lead`: whether the player would walk there first, in place of what is near. */
export function deed(now: Situation, lead: boolean): Deed {
  if (now.held >= 0) return { kind: "put" };
  if (now.first >= 0 && (lead || !now.forGoal)) return { kind: "turn", joint: now.first };
  const nearJoint = now.jointFar < NEAR_M;
  if (now.next >= 0 && (lead || now.far < NEAR_M || !nearJoint)) return { kind: "take", thing: now.next };
  return nearJoint ? { kind: "turn", joint: now.joint } : { kind: "none" };
}

export function situation(
  manifest: Manifest, state: State, me: number, base: Base, barriers: Barriers, handles: { x: number; z: number }[],
  seen: Seen | null = null,
): Situation {
  const done = manifest.goals.map((goal, k) => {
    const thing = state.things[k]!;
    const [x, y, z] = goal.position;
    return thing.held < 0 && Math.hypot(thing.pose[0]! - x, thing.pose[1]! - y, thing.pose[2]! - z) < AT_GOAL_M;
  });
  const held = me < 0 ? -1 : heldBy(manifest, state, me);
  // without the things of chores, which come last
  const known = state.things.slice(0, manifest.objects.length).map((thing, k) => {
    const at = seen === null || thing.held === me ? thing.pose : seen[k];
    return at ? { x: at[0]!, y: at[1]!, z: at[2]! } : null;
  });
  let next = -1;
  let far = Infinity;
  // who carries a tray takes and opens nothing else
  const full = me >= 0 && carries(manifest, state, me);
  if (held >= 0) {
    const goal = manifest.goals[held];
    if (goal) far = Math.hypot(goal.position[0] - base.x, goal.position[2] - base.z);
  } else if (!full) {
    state.things.forEach((thing, k) => {
      const at = known[k];
      const gap = at ? Math.hypot(at.x - base.x, at.z - base.z) : Infinity;
      if (thing.held < 0 && !done[k] && gap < far) [next, far] = [k, gap];
    });
  }
  const gaps = handles.map((handle) => Math.hypot(handle.x - base.x, handle.z - base.z));
  const jointFar = full ? Infinity : Math.min(...gaps);
  const [own, ofGoal] = barriers[next] ?? [-1, -1];
  const first = ofGoal >= 0 ? ofGoal : own;
  const robot = manifest.agents.findIndex((agent, k) => {
    const other = state.agents[k]!;
    return k !== me && agent.kind === "robot" && Math.hypot(other.x - base.x, other.z - base.z) < 1.2;
  });
  return { held, next, first, forGoal: ofGoal >= 0, far, joint: gaps.indexOf(jointFar), jointFar, robot, done, shut: barriers.map(([own]) => own >= 0), known };
}

/** Open or close, whichever a door or drawer is not. */
export function turnText(manifest: Manifest, state: State, joint: number, how = ""): string {
  const info = manifest.joints[joint]!;
  return say(`${how}${isOpen(info, state.joints[joint]!) ? "close" : "open"}`, { joint: info.label });
}

/** What opens the way to the next thing, and why: where the thing is, or belongs, as seen from what has to be opened first. */
function openingText(manifest: Manifest, state: State, now: Situation, how: string): string {
  const through = manifest.joints[now.first]!.passage;
  const where = through ? (now.forGoal ? "belongs" : "behind") : now.forGoal ? "goes" : "in";
  const values = { deed: turnText(manifest, state, now.first, how), thing: manifest.objects[now.next]!.label };
  return say(`because_${where}`, values);
}

/** What a button under the thumb does now. */
export function thumbText(manifest: Manifest, state: State, next: Deed, lead: boolean): string {
  if (next.kind === "put") return say(lead ? "thumb_bring" : "thumb_put");
  if (next.kind === "turn") return say(isOpen(manifest.joints[next.joint]!, state.joints[next.joint]!) ? "thumb_close" : "thumb_open");
  return say(lead ? "thumb_fetch" : "thumb_take");
}

/** Keys, buttons or clicks, whatever the player acts with, and what they do now. `fits`: whether what is held may be put where
 * the preview shows it; null if nobody knows. */
export function hints(
  now: Situation, manifest: Manifest, state: State, device: string, fits: boolean | null,
): [string, string][] {
  if (device === "mouse") return clicks(now, manifest, state);
  const touch = device === "touch";
  const [act, go, turn] =
    device === "pad" ? ["A", "X", "LB"]
    : touch ? [thumbText(manifest, state, deed(now, false), false), thumbText(manifest, state, deed(now, true), true), say("tap")]
    : ["E", "F", "O"];
  const name = (k: number): string => manifest.objects[k]!.label;
  if (now.held >= 0) {
    const goal = manifest.goals[now.held];
    const values = { thing: name(now.held), goal: goal?.label };
    const free = goal ? "" : "_free";
    const parts: [string, string][] =
      now.far < NEAR_M && fits !== false ? [[act!, say(`put${free}`, values)]] : [[go!, say(`bring${free}`, values)]];
    if (now.robot >= 0 && touch) parts.push([say("tap"), say("click_give", values)]);
    else if (now.robot >= 0 && device === "keys") parts.push(["G", say("give")]);
    return parts;
  }
  const parts: [string, string][] = [];
  const takes = deed(now, false).kind === "take";
  if (takes && now.far < NEAR_M) parts.push([act!, say("take", { thing: name(now.next) })]);
  if (now.first >= 0) parts.push([go!, openingText(manifest, state, now, "")]);
  else if (now.next >= 0 && now.far >= NEAR_M) parts.push([go!, say("fetch", { thing: name(now.next) })]);
  if (now.jointFar < NEAR_M && now.joint !== now.first)
    parts.push([turn!, turnText(manifest, state, now.joint, touch ? "click_" : "")]);
  return parts;
}

/** What whom the server walks can do about it. */
export function busyHints(device: string): [string, string][] {
  if (device === "keys") return [[say("steer_key"), say("steer_again")]];
  return device === "pad" ? [] : [[say(device === "touch" ? "tap" : "click"), say("click_elsewhere")]];
}

/** The key, or the button of the page, that cleans, fills, pours out or switches what is near; a gamepad has none. */
export function useKey(device: string): string {
  return device === "keys" ? "R" : device === "pad" ? "" : say("do");
}

/** The same for somebody with a mouse. */
function clicks(now: Situation, manifest: Manifest, state: State): [string, string][] {
  const does: string[] = [];
  if (now.held >= 0) {
    const goal = manifest.goals[now.held];
    const values = { thing: manifest.objects[now.held]!.label, goal: goal?.label };
    does.push(say(goal ? "click_put" : "click_put_free", values));
    if (now.robot >= 0) does.push(say("click_give", values));
  } else {
    if (now.first >= 0) does.push(openingText(manifest, state, now, "click_"));
    else if (now.next >= 0) does.push(say("click_take", { thing: manifest.objects[now.next]!.label }));
    if (now.jointFar < NEAR_M && now.joint !== now.first) does.push(turnText(manifest, state, now.joint, "click_"));
  }
  return does.map((text) => [say("click"), text]);
}

/** Who has a thing, for the list; empty: nobody. */
export function holderText(manifest: Manifest, holder: number): string {
  const { agents, me } = manifest;
  if (holder < 0) return "";
  if (holder === me) return say("in_your_hand");
  if (agents[holder]!.kind === "robot") return say("robot_has");
  return say(agents[me]?.kind === "human" ? "other_has" : "person_has");
}
