/** Cameras of a replay: the whole home at a slant or from above, behind each agent, and through its eyes. */

import { Box3, PerspectiveCamera, Vector3 } from "three";
import { clamp } from "../motion/sdf.ts";
import { CameraRig } from "../scene/camera.ts";
import type { World } from "../scene/world.ts";
import type { Episode } from "./episode.ts";

export interface View {
  label: string;
  kind: "overview" | "plan" | "follow" | "eyes";
  /** Index of the agent; -1: none. */
  agent: number;
}

const EYE_M = { human: 1.55, robot: 0.85 } as const;
/** Shown around the paths of the agents, m. */
const AROUND_M = 2.5;
/** Homes without ceilings of their own are cut at this height in views from above, m. */
export const CUT_M = 2.2;

export class Views {
  readonly list: View[];
  current = 0;
  private readonly rigs: CameraRig[];
  private readonly orbit: Orbit;

  constructor(
    private readonly episode: Episode,
    private readonly world: World,
  ) {
    const { agents, floor_y } = episode.about.stage;
    this.list = [
      { label: "Overview", kind: "overview", agent: -1 },
      { label: "From above", kind: "plan", agent: -1 },
      ...agents.map((agent, k) => ({ label: `Follow ${agent.name}`, kind: "follow" as const, agent: k })),
      ...agents.map((agent, k) => ({ label: `Through the eyes of ${agent.name}`, kind: "eyes" as const, agent: k })),
    ];
    const box = focus(episode, world);
    const room: [number, number, number, number] = [box.min.x, box.min.z, box.max.x, box.max.z];
    this.rigs = agents.map((agent) => new CameraRig(floor_y, EYE_M[agent.kind], room));
    this.orbit = new Orbit(box, floor_y);
  }

  get view(): View {
    return this.list[this.current]!;
  }

  get camera(): PerspectiveCamera {
    return this.rig?.camera ?? this.orbit.camera;
  }

  /** Whether the camera is above the home, so that ceilings are in the way. */
  get above(): boolean {
    return this.view.agent < 0;
  }

  private get rig(): CameraRig | undefined {
    return this.rigs[this.view.agent];
  }

  choose(index: number): void {
    this.current = (index + this.list.length) % this.list.length;
    this.orbit.reset(this.view.kind === "plan");
    if (this.rig) {
      this.rig.view = this.view.kind === "eyes" ? "first" : "third";
      this.rig.yaw = 0;
      this.rig.pitch = this.view.kind === "eyes" ? -0.1 : -0.25;
    }
  }

  look(dyaw: number, dpitch: number): void {
    if (this.rig) this.rig.look(dyaw, dpitch);
    else this.orbit.look(dyaw, dpitch);
  }

  zoom(factor: number): void {
    if (this.rig) this.rig.zoom(factor);
    else this.orbit.zoom(factor);
  }

  resize(width: number, height: number): void {
    for (const rig of this.rigs) rig.resize(width, height);
    this.orbit.resize(width, height);
  }

  /** Moves the camera, and hides whom it looks through and what would be in the way. */
  update(row: number, share: number, seconds: number): void {
    const { agent, kind } = this.view;
    this.world.showLids(!this.above);
    this.episode.about.stage.agents.forEach((_, k) => {
      const inside = k === agent && kind === "eyes";
      this.world.showAgent(k, !inside && !(k === agent && (this.rig?.hidesBody ?? false)));
    });
    if (!this.rig) return this.orbit.update();
    const a = this.episode.base(agent, row);
    const b = this.episode.base(agent, Math.min(row + 1, this.episode.rows - 1));
    const mix = (u: number, v: number): number => (Number.isFinite(v) ? u + (v - u) * share : u);
    const body = { x: mix(a.x, b.x), z: mix(a.z, b.z), heading: mix(a.heading, b.heading) };
    if (!Number.isFinite(body.x)) return;
    this.rig.floorY = mix(a.y, b.y);
    this.rig.follow(body, this.world.solid, seconds);
  }
}

/** The part of the home that the agents' paths are in. */
function focus(episode: Episode, world: World): Box3 {
  const home = new Box3();
  for (const node of world.home) home.expandByObject(node);
  const paths = new Box3();
  for (const { values } of episode.bases)
    for (let k = 0; k + 2 < values.length; k += 3)
      if (Number.isFinite(values[k])) paths.expandByPoint(new Vector3(values[k], values[k + 1], values[k + 2]));
  if (paths.isEmpty()) return home.isEmpty() ? new Box3(new Vector3(-3, 0, -3), new Vector3(3, 2, 3)) : home;
  paths.expandByVector(new Vector3(AROUND_M, 1, AROUND_M));
  return home.isEmpty() ? paths : paths.intersect(home);
}

/** A camera around a point: dragged, zoomed, or straight from above. */
class Orbit {
  readonly camera = new PerspectiveCamera(45, 1, 0.1, 400);
  private readonly target = new Vector3();
  private readonly size = new Vector3();
  private yaw = 0;
  private pitch = 0;
  private factor = 1;
  private plan = false;

  constructor(box: Box3, floorY: number) {
    box.getCenter(this.target).setY(floorY + 0.4);
    box.getSize(this.size);
    this.reset(false);
  }

  reset(plan: boolean): void {
    this.plan = plan;
    this.yaw = plan ? 0 : 0.6;
    this.pitch = plan ? Math.PI / 2 - 1e-3 : 0.95;
    this.factor = 1;
  }

  look(dyaw: number, dpitch: number): void {
    this.yaw += dyaw;
    if (!this.plan) this.pitch = clamp(this.pitch - dpitch, 0.15, Math.PI / 2 - 1e-3);
  }

  zoom(factor: number): void {
    this.factor = clamp(this.factor * factor, 0.15, 3);
  }

  resize(width: number, height: number): void {
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }

  update(): void {
    const half = Math.tan((this.camera.fov * Math.PI) / 360);
    // what the floor plan measures across and along the picture when the camera is turned
    const [sin, cos] = [Math.abs(Math.sin(this.yaw)), Math.abs(Math.cos(this.yaw))];
    const wide = this.size.x * cos + this.size.z * sin;
    const deep = (this.size.x * sin + this.size.z * cos) * Math.sin(this.pitch) + this.size.y * Math.cos(this.pitch);
    const far = this.factor * (Math.max(deep / half, wide / (half * this.camera.aspect)) * 0.56 + 0.5 * deep * Math.cos(this.pitch) + 1);
    const flat = Math.cos(this.pitch) * far;
    this.camera.position.set(Math.sin(this.yaw) * flat, Math.sin(this.pitch) * far, Math.cos(this.yaw) * flat).add(this.target);
    this.camera.lookAt(this.target);
  }
}
