/** What is drawn over the home: paths travelled, names, goals, contacts. */

import { BufferAttribute, BufferGeometry, DoubleSide, Mesh, MeshBasicMaterial, Vector3, type PerspectiveCamera } from "three";
import type { World } from "../scene/world.ts";
import { FloorRing, Labels, type Box, type Mark } from "../screen/markers.ts";
import { BAD, OTHER, ROBOT, thingColor, thingLetter, YOU } from "../screen/palette.ts";
import type { Episode } from "./episode.ts";
import { Fan } from "./scans.ts";

export type Overlay = "paths" | "names" | "goals" | "contacts" | "scans";

const ROBOTS = [ROBOT, "#f0e442", "#e69f00"];
const PEOPLE = ["#56b4e9", OTHER, "#009e73", YOU];
const SCANS = ["#c2188f", "#5b2ec7"];
const OVER_FLOOR_M = 0.03;
const PATH_M = 0.07;
/** Points of a path are this far apart; a person's path is dashed, two points on, one off. */
const APART_M = 0.06;
/** A contact is named for this long, s. */
const NAMED_S = 1.2;
/** What somebody says is shown for this long, and longer for long texts, s. */
const SPOKEN_S = 4;
const LETTER_S = 0.06;
const MOST_RINGS = 80;
const AT_GOAL_M = 0.3;
/** Width of bodies that labels keep off, m; bodies higher than this share of the picture can be seen beside them. */
const BODY_M = { robot: 0.8, human: 0.5 };
const CLOSE = 0.4;

/** A colour for each agent that people with any colour vision tell apart. */
export function agentColors(kinds: ("robot" | "human")[]): string[] {
  const count = { robot: 0, human: 0 };
  return kinds.map((kind) => {
    const colors = kind === "robot" ? ROBOTS : PEOPLE;
    return colors[count[kind]++ % colors.length]!;
  });
}

export class Marks {
  readonly shown: Record<Overlay, boolean> = { paths: true, names: true, goals: true, contacts: true, scans: true };
  private readonly labels: Labels;
  private readonly paths: Path[];
  private readonly goals: FloorRing[];
  private readonly walks: FloorRing[];
  private readonly contacts: FloorRing[];
  private readonly scans: Fan[];
  private readonly carried: number[];

  constructor(
    private readonly episode: Episode,
    private readonly world: World,
    layer: HTMLElement,
    private readonly colors: string[],
  ) {
    const { about } = episode;
    this.labels = new Labels(layer, 0.55);
    this.paths = episode.bases.map((base, k) => {
      const path = new Path(base.values, about.stage.agents[k]!.kind === "human", OVER_FLOOR_M + 0.004 * k, colors[k]!);
      world.scene.add(path.ahead, path.behind);
      return path;
    });
    this.goals = about.goals.map((_, k) => new FloorRing(world.scene, thingColor(k), 0.13, 0.17));
    this.walks = about.walks.map((walk) => new FloorRing(world.scene, colors[walk.agent]!, 0.2, 0.27));
    this.contacts = about.contacts.slice(0, MOST_RINGS).map(() => new FloorRing(world.scene, BAD, 0.3, 0.36));
    this.scans = about.scans.map((scan, k) => new Fan(episode, scan, world, SCANS[k % SCANS.length]!));
    this.carried = about.goals.map((goal) => about.stage.objects.findIndex((thing) => thing.name === goal.object));
  }

  draw(row: number, seconds: number, viewed: number, camera: PerspectiveCamera, width: number, height: number): void {
    const { about } = this.episode;
    const marks: Mark[] = [];
    const add = (point: Vector3, text: string, chip: string, tone: string): void => {
      // what is beside or behind the picture is not pointed at, as it would be for a player
      const at = point.clone().project(camera);
      if (at.z < 1 && Math.abs(at.x) < 1 && at.y > -0.7 && at.y < 0.7)
        marks.push({ point, text, thing: 0, near: false, far: null, chip, tone });
    };
    for (const path of this.paths) path.show(row, this.shown.paths);
    for (const scan of this.scans) scan.show(row, this.shown.scans);
    about.stage.agents.forEach((agent, k) => {
      const { x, y, z } = this.episode.base(k, row);
      if (this.shown.names && k !== viewed && Number.isFinite(x))
        add(new Vector3(x, y + agent.height + 0.1, z), agent.name, agent.kind === "robot" ? "■" : "●", this.colors[k]!);
    });
    this.drawGoals(add);
    about.walks.forEach((walk, k) => {
      const now = walk.steps.reduce((last, step, at) => (step <= row ? at : last), 0);
      const [x, y, z] = walk.points[now]!;
      if (!this.shown.goals) return this.walks[k]!.hide();
      this.walks[k]!.show(x, y + 0.02, z);
      add(new Vector3(x, y + 0.25, z), `${about.stage.agents[walk.agent]!.name} walks here`, "◎", this.colors[walk.agent]!);
    });
    this.contacts.forEach((ring, k) => {
      const contact = about.contacts[k]!;
      if (!this.shown.contacts || contact.step > row) return ring.hide();
      const [x, y, z] = contact.point;
      ring.show(x, y + 0.025, z);
      if (seconds - this.episode.times[contact.step]! < NAMED_S) add(new Vector3(x, y + 1.1, z), contact.text, "!", BAD);
    });
    if (this.shown.names) marks.unshift(...this.speech(row, seconds, camera));
    this.labels.show(marks, camera, width, height, this.bodies(row, viewed, camera, width, height));
  }

  /** The parts of the picture in which agents are, which no label covers. */
  bodies(row: number, viewed: number, camera: PerspectiveCamera, width: number, height: number): Box[] {
    return this.episode.about.stage.agents.flatMap((agent, k): Box[] => {
      const { x, y, z } = this.episode.base(k, row);
      const [feet, head] = [y, y + agent.height].map((at) => new Vector3(x, at, z).project(camera));
      const high = ((head!.y - feet!.y) / 2) * height;
      if (k === viewed || !Number.isFinite(x) || feet!.z > 1 || !(high > 0 && high < CLOSE * height)) return [];
      const wide = (high * BODY_M[agent.kind]) / agent.height;
      return [{ left: ((head!.x + 1) * width - wide) / 2, top: ((1 - head!.y) / 2) * height, width: wide, height: high }];
    });
  }

  /** Bubbles over the heads of those who have just said something. */
  private speech(row: number, seconds: number, camera: PerspectiveCamera): Mark[] {
    const { about, times } = this.episode;
    const latest = new Map(about.says.filter((said) => said.step <= row).map((said) => [said.agent, said]));
    return [...latest.values()].flatMap((said): Mark[] => {
      const { x, y, z } = this.episode.base(said.agent, row);
      const over = seconds - times[said.step]! > Math.max(SPOKEN_S, said.text.length * LETTER_S);
      const point = new Vector3(x, y + about.stage.agents[said.agent]!.height + 0.3, z);
      if (over || !Number.isFinite(x) || point.clone().project(camera).z > 1) return [];
      return [{ point, text: said.text, thing: 0, near: true, far: null, chip: "“", tone: "#fff", speech: true }];
    });
  }

  private drawGoals(add: (point: Vector3, text: string, chip: string, tone: string) => void): void {
    const { goals } = this.episode.about;
    goals.forEach((goal, k) => {
      const [x, y, z] = goal.position;
      if (!this.shown.goals) return this.goals[k]!.hide();
      const thing = this.world.things[this.carried[k]!];
      const done = thing !== undefined && Math.hypot(thing.position.x - x, thing.position.z - z) < AT_GOAL_M;
      this.goals[k]!.show(x, y + 0.01, z);
      add(new Vector3(x, y + 0.3, z), done ? `${goal.label}, done` : goal.label, done ? "✓" : thingLetter(k), thingColor(k));
      if (!thing?.visible || done) return;
      add(thing.position.clone().setY(thing.position.y + 0.22), goal.name, thingLetter(k), thingColor(k));
    });
  }
}

/** A ribbon on the floor along a path: bright where it has been, faint, and seen through walls, where it is going to be. */
class Path {
  readonly behind: Mesh;
  readonly ahead: Mesh;
  /** Row and number of indices at each point. */
  private readonly ends: [number, number][] = [];

  constructor(base: Float64Array, dashed: boolean, height: number, color: string) {
    const points: number[] = [];
    const faces: number[] = [];
    let [lastX, lastY, lastZ, number] = [NaN, NaN, NaN, 0];
    for (let row = 0; 3 * row < base.length; row++) {
      const [x, y, z] = [base[3 * row]!, base[3 * row + 1]!, base[3 * row + 2]!];
      const [dx, dz] = [x - lastX, z - lastZ];
      const far = Math.hypot(dx, dz);
      if (far < APART_M) continue;
      if (far < 1 && (!dashed || number++ % 3 < 2)) {
        const [nx, nz] = [(-dz / far) * (PATH_M / 2), (dx / far) * (PATH_M / 2)];
        const at = points.length / 3;
        points.push(lastX + nx, lastY + height, lastZ + nz, lastX - nx, lastY + height, lastZ - nz);
        points.push(x + nx, y + height, z + nz, x - nx, y + height, z - nz);
        faces.push(at, at + 1, at + 2, at + 2, at + 1, at + 3);
      }
      [lastX, lastY, lastZ] = [x, y, z];
      this.ends.push([row, faces.length]);
    }
    const mesh = (opacity: number, depthTest: boolean): Mesh => {
      const shape = new BufferGeometry();
      shape.setAttribute("position", new BufferAttribute(new Float32Array(points), 3));
      shape.setIndex(faces);
      const paint = new MeshBasicMaterial({ color, opacity, transparent: true, side: DoubleSide, depthWrite: false, depthTest });
      const node = new Mesh(shape, paint);
      node.frustumCulled = false;
      return node;
    };
    this.ahead = mesh(0.28, false);
    this.behind = mesh(0.95, true);
  }

  show(row: number, shown: boolean): void {
    this.ahead.visible = this.behind.visible = shown;
    let count = 0;
    for (const [at, end] of this.ends) {
      if (at > row) break;
      count = end;
    }
    this.behind.geometry.setDrawRange(0, count);
  }
}
