/** Where the player looks from: through the person's eyes, over the shoulder, or, for spectators, from above. */

import { Euler, PerspectiveCamera, Raycaster, Vector3, type Object3D } from "three";
import { clamp, wrapAngle } from "../motion/sdf.ts";
import type { Base } from "../motion/drive.ts";

export type View = "third" | "first" | "above";

const BOOM_M = 2.1;
/** Nearer than this the person would fill the picture and is hidden. */
const HIDE_M = 0.45;
/** Kept between the camera and a wall: the corners of the near plane are this far out at a field of view of 65 degrees. */
const MARGIN_M = 0.18;
/** A second look goes this much lower: what reaches up to just below the camera would fill the lower half of the picture. */
const LOW = 0.2;

export class CameraRig {
  readonly camera = new PerspectiveCamera(62, 1, 0.05, 80);
  view: View = "third";
  /** Of the view from the direction that the body faces, and downwards if negative, rad. */
  yaw = 0;
  pitch = -0.2;
  private boom = BOOM_M;
  private wanted = BOOM_M;
  private orbit = { x: 0, z: 0, height: 9, yaw: 0, ready: false };
  private heldAt: number | null = null;
  private readonly ray = new Raycaster();
  private readonly eye = new Vector3();
  private readonly back = new Vector3();
  private readonly low = new Vector3();
  private readonly turn = new Euler(0, 0, 0, "YXZ");

  /** `floorY` is the height of the floor, `eyeM` that of the eyes above it, `room` [x0, z0, x1, z1] the floor plan. */
  constructor(
    public floorY: number,
    private readonly eyeM: number,
    private readonly room: [number, number, number, number],
  ) {}

  /** Whether the player's own body would be in the way of the picture. */
  get hidesBody(): boolean {
    return this.view === "third" && this.boom < HIDE_M;
  }

  look(dyaw: number, dpitch: number): void {
    if (this.view === "above") {
      this.orbit.yaw += dyaw;
      return;
    }
    this.yaw += dyaw;
    this.pitch = clamp(this.pitch + dpitch, -1.25, 0.75);
  }

  zoom(factor: number): void {
    this.wanted = clamp(this.wanted * factor, 0.9, 3.5);
    this.orbit.height = clamp(this.orbit.height * factor, 3, 25);
  }

  resize(width: number, height: number): void {
    this.camera.aspect = width / height;
    // a phone held upright would show a slit: keep 50 degrees across
    const across = Math.tan((25 * Math.PI) / 180) / this.camera.aspect;
    this.camera.fov = Math.max(62, (2 * Math.atan(across) * 180) / Math.PI);
    this.camera.updateProjectionMatrix();
  }

  /** Follows a body; `solid` is what the camera stays in front of. */
  follow(body: Base, solid: Object3D[], seconds: number): void {
    if (this.view === "above") {
      this.above(body, seconds);
      return;
    }
    const eye = this.eye.set(body.x, this.floorY + this.eyeM, body.z);
    this.turn.set(this.pitch, body.heading - Math.PI / 2 + this.yaw, 0);
    this.camera.quaternion.setFromEuler(this.turn);
    if (this.view === "first") {
      const ahead = 0.12;
      this.camera.position.copy(eye);
      this.camera.position.x += Math.cos(body.heading) * ahead;
      this.camera.position.z -= Math.sin(body.heading) * ahead;
      return;
    }
    this.back.set(0.22, 0.12, 1).normalize().applyEuler(this.turn);
    const room = Math.min(this.clearance(eye, this.back, solid), this.clearance(eye, this.low.copy(this.back).setY(this.back.y - LOW), solid));
    // in at once, or the wall would be seen from inside; out gently, or door posts would make the picture jump
    this.boom = room < this.boom ? room : this.boom + (room - this.boom) * Math.min(1, seconds * 3);
    this.camera.position.copy(eye).addScaledVector(this.back, this.boom);
  }

  /** How far the camera can go back from the eyes along a direction. */
  private clearance(eye: Vector3, back: Vector3, solid: Object3D[]): number {
    this.ray.set(eye, back);
    this.ray.far = this.wanted + MARGIN_M;
    const wall = this.ray.intersectObjects(solid, true)[0];
    return wall ? Math.max(wall.distance - MARGIN_M, 0.15) : this.wanted;
  }

  /** A spectator sees the whole home at a slant, or whom they follow. */
  private above(_body: Base, seconds: number): void {
    const [x0, z0, x1, z1] = this.room;
    if (!this.orbit.ready) {
      const tall = (z1 - z0) / (2 * Math.tan((this.camera.fov * Math.PI) / 360));
      const wide = (x1 - x0) / (2 * Math.tan((this.camera.fov * Math.PI) / 360) * this.camera.aspect);
      this.orbit = { x: (x0 + x1) / 2, z: (z0 + z1) / 2, height: 1.12 * Math.max(tall, wide) + 1, yaw: 0, ready: true };
    }
    const { x, z, height, yaw } = this.orbit;
    const slant = 0.3;
    this.camera.position.lerp(
      this.back.set(x + Math.sin(yaw) * height * slant, this.floorY + height, z + Math.cos(yaw) * height * slant),
      Math.min(1, seconds * 6),
    );
    this.camera.lookAt(x, this.floorY, z);
  }

  /** Whether the view is the player's own, so that the body follows it. */
  get steers(): boolean {
    return this.view !== "above";
  }

  /** While held, the view keeps its direction and the body turns under it. */
  hold(on: boolean, heading: number): void {
    if (on && this.heldAt !== null) this.yaw = wrapAngle(this.yaw + this.heldAt - heading);
    this.heldAt = on ? heading : null;
  }
}
