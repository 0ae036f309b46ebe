/** What the player points at: a thing, a door or drawer, the floor, or a place that could carry something. */

import { Raycaster, Vector2, Vector3, type PerspectiveCamera } from "three";
import type { World } from "./world.ts";

export type Target =
  | { kind: "thing"; thing: number; point: Vector3 }
  | { kind: "joint"; joint: number; point: Vector3 }
  | { kind: "floor"; point: Vector3 }
  | { kind: "top"; point: Vector3 }
  | { kind: "none" };

/** A face counts as one that carries things where its normal is steeper than this. */
const UPRIGHT = 0.7;
/** How far above the floor a place still is the floor: rugs. */
const FLOOR_M = 0.04;

export class Pointing {
  private readonly ray = new Raycaster();
  private readonly at = new Vector2();
  private readonly normal = new Vector3();

  constructor(private readonly world: World) {}

  /** Who is at a place of the picture, not behind furniture or walls; -1: nobody. */
  agent(x: number, y: number, camera: PerspectiveCamera): number {
    this.ray.setFromCamera(this.at.set(x, y), camera);
    const hit = this.ray.intersectObjects(this.world.home, true).find((found) => visible(found.object));
    const reach = hit?.distance ?? Infinity;
    return this.world.bodies.findIndex((nodes) =>
      this.ray.intersectObjects(nodes, true).some((found) => visible(found.object) && found.distance < reach),
    );
  }

  /** What is at a place of the picture, -1..1 each. Things are taken before what they stand on, but not through walls. */
  target(x: number, y: number, camera: PerspectiveCamera, held: number): Target {
    this.ray.setFromCamera(this.at.set(x, y), camera);
    const hit = this.ray.intersectObjects(this.world.home, true).find((found) => visible(found.object));
    const reach = hit ? hit.distance + 0.02 : Infinity;
    const thing = this.world.things.findIndex((node, k) => {
      if (k === held || k >= this.world.pickable) return false;
      const found = this.ray.intersectObject(node, true)[0];
      return found !== undefined && found.distance <= reach;
    });
    if (thing >= 0) return { kind: "thing", thing, point: this.world.things[thing]!.position.clone() };
    if (!hit?.face) return { kind: "none" };
    this.normal.copy(hit.face.normal).transformDirection(hit.object.matrixWorld);
    const joint = this.world.joints.of(hit.object);
    // who has something in the hand may want to put it into an open drawer
    if (joint >= 0 && (held < 0 || this.normal.y < UPRIGHT)) return { kind: "joint", joint, point: hit.point.clone() };
    if (this.normal.y < UPRIGHT) return { kind: "none" };
    const { x: px, y: py, z: pz } = hit.point;
    const high = py - this.world.floor.height(px, pz) - this.world.floor.riser(px, pz);
    return { kind: high < FLOOR_M ? "floor" : "top", point: hit.point.clone() };
  }
}

function visible(node: { visible: boolean; parent: unknown }): boolean {
  for (let at = node as { visible: boolean; parent: unknown } | null; at; at = at.parent as typeof at)
    if (!at.visible) return false;
  return true;
}
