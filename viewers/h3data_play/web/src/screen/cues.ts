/** What is drawn over the home for the player: rings, labels, the map, the preview of a place. */

import { Vector3, type PerspectiveCamera } from "three";
import { NEAR_M, turnText, type Situation } from "../player/actions.ts";
import type { Base } from "../motion/drive.ts";
import { called, type Manifest } from "../link/manifest.ts";
import { FloorRing, Ghost, Labels, type Box, type Mark } from "./markers.ts";
import { MiniMap } from "./minimap.ts";
import { JOINT, MARKER, thingColor } from "./palette.ts";
import type { Sdf } from "../motion/sdf.ts";
import type { State } from "../link/wire.ts";
import type { World } from "../scene/world.ts";
import { say } from "../words.ts";

/** Labels float this high over what they name. */
const OVER_M = 0.22;
/** Of the frames, one in so many draws the map. */
const MAP_FRAMES = 4;

/** What opens doors and drawers, for who has keys or a gamepad; others click or tap. */
const JOINT_KEYS: Record<string, string> = { keys: "O", pad: "LB" };

/** What agents have just said, and until when it is shown. */
type Bubbles = ReadonlyMap<number, { text: string; until: number }>;
/** Bubbles stand this high over the floor, m. */
const HEAD_M = { human: 1.95, robot: 1.5 };
/** Others have a name over their head up to this distance, m; in a home, those farther away are behind walls. */
const NAMES_M = 6;

export class Cues {
  private readonly labels: Labels;
  private readonly ghost: Ghost;
  private readonly goals: FloorRing[];
  private readonly spot: FloorRing;
  private readonly ring: FloorRing;
  private marker: Vector3 | null = null;
  private readonly map: MiniMap;
  private readonly heights: number[];
  private readonly parts = [...document.querySelectorAll("#task, #bar, #map, #hint, #toast, #stick, #postures, #thumbs, #talk")];
  private frame = 0;

  constructor(
    private readonly world: World,
    private readonly manifest: Manifest,
    sdf: Sdf,
    marks: HTMLElement,
    mapCanvas: HTMLCanvasElement,
  ) {
    this.labels = new Labels(marks);
    this.ghost = new Ghost(world.scene);
    this.goals = manifest.goals.map((_, k) => new FloorRing(world.scene, thingColor(k), 0.105, 0.13));
    this.spot = new FloorRing(world.scene, "#ffffff", 0.17, 0.21);
    this.spot.hide();
    this.ring = new FloorRing(world.scene, thingColor(MARKER), 0.34, 0.42);
    this.ring.hide();
    this.map = new MiniMap(mapCanvas, sdf);
    this.heights = world.things.map((thing) => world.lowest(thing));
  }

  /** Where the page has something of its own: labels keep off it. */
  private taken(): Box[] {
    return this.parts.map((part) => part.getBoundingClientRect()).filter((box) => box.width > 0);
  }

  /** The point that the player walks to; null: none. */
  walkingTo(point: Vector3 | null): void {
    if (point) this.spot.show(point.x, point.y + 0.02, point.z);
    else this.spot.hide();
  }

  /** A point of the floor that the app wants to be seen; null: none. */
  mark(point: Vector3 | null): void {
    this.marker = point;
    if (point) this.ring.show(point.x, point.y + 0.015, point.z);
    else this.ring.hide();
  }

  /** Lowest point of a thing below its origin, m. */
  low(thing: number): number {
    return this.heights[thing]!;
  }

  preview(thing: number, point: Vector3 | null, fits: boolean | null): void {
    if (point && thing >= 0) this.ghost.show(this.world.things[thing]!, point, fits);
    else this.ghost.hide();
  }

  draw(state: State, now: Situation, me: number, own: Base, camera: PerspectiveCamera, yaw: number, bubbles: Bubbles): void {
    this.manifest.goals.forEach((goal, k) => {
      const [x, y, z] = goal.position;
      const ring = this.goals[k]!;
      // the goal is where the thing's origin comes to be: the ring lies under it
      if (now.done[k]) ring.hide();
      else ring.show(x, y + this.heights[k]! + 0.004, z, now.held === k ? 1 + 0.12 * Math.sin(performance.now() / 180) : 1);
    });
    const marks = [...this.speech(state, me, own, bubbles), ...this.names(state, me, own, camera, bubbles), ...this.marks(state, now, me < 0 ? null : own)];
    this.labels.show(marks, camera, innerWidth, innerHeight, this.taken());
    if (this.frame++ % MAP_FRAMES) return;
    this.drawMap(state, now, me, own, yaw);
  }

  /** Bubbles over the heads of those who have just said something. */
  private speech(state: State, me: number, own: Base, bubbles: Bubbles): Mark[] {
    return [...bubbles].flatMap(([agent, { text, until }]): Mark[] => {
      if (until < performance.now()) return [];
      const point = this.over(agent, agent === me ? own : state.agents[agent]!);
      return [{ point, text, thing: MARKER, near: true, far: null, chip: "“", speech: true }];
    });
  }

  /** Names over the heads of others, where they are wanted; who says something has a bubble there. */
  private names(state: State, me: number, own: Base, camera: PerspectiveCamera, bubbles: Bubbles): Mark[] {
    if (!this.manifest.names) return [];
    return this.manifest.agents.flatMap((agent, k): Mark[] => {
      const at = state.agents[k]!;
      const far = me < 0 ? 0 : Math.hypot(at.x - own.x, at.z - own.z);
      if (k === me || far > NAMES_M || (bubbles.get(k)?.until ?? 0) > performance.now()) return [];
      const point = this.over(k, at);
      const seen = point.clone().project(camera);
      if (seen.z > 1 || Math.abs(seen.x) > 1 || Math.abs(seen.y) > 1) return [];
      return [{ point, text: called(this.manifest, k), thing: MARKER, near: true, far: null, chip: agent.kind === "robot" ? "⚙" : "●" }];
    });
  }

  /** The point over an agent's head. */
  private over(agent: number, at: { x: number; z: number }): Vector3 {
    return new Vector3(at.x, this.world.floor.height(at.x, at.z) + HEAD_M[this.manifest.agents[agent]!.kind], at.z);
  }

  private marks(state: State, now: Situation, own: Base | null): Mark[] {
    const marks: Mark[] = [];
    const goTo = this.marker;
    if (goTo) {
      const far = own && Math.hypot(goTo.x - own.x, goTo.z - own.z);
      marks.push({ point: goTo.clone().setY(goTo.y + OVER_M), text: say("here"), thing: MARKER, near: false, far });
    }
    const joint = now.first >= 0 ? now.first : now.jointFar < NEAR_M && now.held < 0 ? now.joint : -1;
    if (own && joint >= 0) {
      const handle = this.world.joints.handles[joint]!;
      const far = Math.hypot(handle.x - own.x, handle.z - own.z);
      const text = turnText(this.manifest, state, joint);
      marks.push({ point: handle.clone(), text, thing: MARKER, near: far < NEAR_M, far, chip: JOINT_KEYS[document.body.dataset.device ?? ""] ?? "◧", tone: JOINT });
    }
    state.things.forEach((thing, k) => {
      const goal = this.manifest.goals[k];
      const at = now.known[k];
      if (now.done[k] || !at) return;
      const label = this.manifest.objects[k]!.label;
      if (!goal) {
        // where nobody is told where things go, the labels only name them
        const far = own && Math.hypot(at.x - own.x, at.z - own.z);
        const near = now.next === k && now.far < NEAR_M;
        if (thing.held < 0) marks.push({ point: new Vector3(at.x, at.y + OVER_M, at.z), text: label, thing: k, near, far });
        return;
      }
      const [x, y, z] = goal.position;
      if (thing.held >= 0)
        marks.push({
          point: new Vector3(x, y + OVER_M, z),
          text: goal.label,
          thing: k,
          near: now.held === k && now.far < NEAR_M,
          far: own && Math.hypot(x - own.x, z - own.z),
        });
      else {
        marks.push({
          point: new Vector3(at.x, at.y + OVER_M, at.z),
          text: `${now.shut[k] ? say("shut_in", { thing: label }) : label} → ${goal.label}`,
          thing: k,
          near: now.next === k && now.far < NEAR_M,
          far: own && Math.hypot(at.x - own.x, at.z - own.z),
        });
      }
    });
    return marks;
  }

  private drawMap(state: State, now: Situation, me: number, own: Base, yaw: number): void {
    const agents = this.manifest.agents.map((agent, k) => {
      const at = k === me ? own : state.agents[k]!;
      return { x: at.x, z: at.z, heading: at.heading, kind: agent.kind, me: k === me };
    });
    const things = state.things.map((thing, k) => {
      const goal = this.manifest.goals[k];
      const at = now.known[k] ?? null;
      return {
        at,
        goal: goal ? { x: goal.position[0], z: goal.position[2] } : null,
        done: now.done[k] ?? false,
        held: thing.held >= 0,
      };
    });
    this.map.draw(agents, things, this.marker, yaw);
  }
}
