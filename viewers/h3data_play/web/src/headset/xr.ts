/** A headset: head and hands drive the person, the thumbsticks walk and turn, the triggers take and put down. */

import { Group, Quaternion, Vector3, type PerspectiveCamera, type WebGLRenderer } from "three";
import type { Base, Velocity } from "../motion/drive.ts";
import type { Floor } from "../motion/floor.ts";
import { clamp, wrapAngle } from "../motion/sdf.ts";
import { Panel } from "./panel.ts";

/** Faster walking makes people sick who stand in a room, m/s. */
const COMFORT_MPS = 1.4;
const SNAP_RAD = Math.PI / 6;
const DEAD = 0.2;
const PUSHED = 0.7;
/** Two hands, a head and the walk must stay below the 90 messages a second that the server takes. */
const SEND_MS = 50;
const HEAD_RAD = 0.02;
/** The body follows a head that looks further aside than this, rad: at once while walking, else as people turn their feet. */
const WALK_ASIDE = 0.06;
const STAND_ASIDE = 0.7;
/** A cover is read for so long before a trigger goes on from it. */
const COVERED_MS = 800;
/** The wearer may lean this far before the body counts as moved with them, m. */
const LEAN_M = 0.25;
/** The eyes are this far ahead of the middle of the body, m. */
const EYES_M = 0.1;
/** Buttons of `xr-standard` gamepads. */
const TRIGGER = 0;
const SQUEEZE = 1;
const LOWER = 4;

export interface XrPlayer {
  /** Takes the next thing or puts down what is held, walking there if it is out of reach. */
  act(): void;
  drop(): void;
  /** Goes on from a cover, such as that of the end of an episode. */
  goOn(): void;
  send(message: Record<string, unknown>): void;
}

export type HandSide = "left" | "right";

export class Headset {
  /** Moves the wearer's room through the home. */
  readonly rig = new Group();
  command: Velocity = { forward: 0, turn: 0 };
  /** Where head and hands are in the home; for tests. */
  readonly head = new Vector3();
  readonly hands: Record<HandSide, Vector3> = { left: new Vector3(), right: new Vector3() };
  private readonly panel: Panel;
  private room = 0;
  private anchor = new Vector3();
  private fresh = true;
  private readonly down: Record<HandSide, boolean[]> = { left: [], right: [] };
  private readonly sent = { left: false, right: false };
  private snapped = false;
  private sentAt = 0;
  private ticks = 0;
  /** When the episode was last under way. */
  private playedAt = 0;
  private lastHead = { yaw: 0, pitch: 0 };

  constructor(
    private readonly renderer: WebGLRenderer,
    camera: PerspectiveCamera,
    private readonly floor: Floor,
    private readonly speed: { forward: number; turn: number; step: number },
    private readonly player: XrPlayer,
    private readonly life: AbortSignal,
  ) {
    this.rig.add(camera);
    this.panel = new Panel(this.rig);
  }

  static async supported(): Promise<boolean> {
    return (await navigator.xr?.isSessionSupported("immersive-vr").catch(() => false)) ?? false;
  }

  get on(): boolean {
    return this.renderer.xr.isPresenting;
  }

  async enter(ended: () => void): Promise<void> {
    const session = await navigator.xr!.requestSession("immersive-vr", { optionalFeatures: ["local-floor", "hand-tracking"] });
    this.renderer.xr.enabled = true;
    await this.renderer.xr.setSession(session);
    this.wear(ended);
  }

  /** Goes on in the session that is there, such as that of the episode before. */
  wear(ended: () => void): void {
    this.fresh = true;
    const leaves = (): void => {
      for (const side of ["left", "right"] as const) this.release(side);
      this.player.send({ k: "head", yaw: 0, pitch: 0 });
      this.command = { forward: 0, turn: 0 };
      this.rig.position.set(0, 0, 0);
      this.rig.rotation.set(0, 0, 0);
      this.panel.hide();
      ended();
    };
    this.renderer.xr.getSession()!.addEventListener("end", leaves, { signal: this.life });
  }

  /** Puts the wearer's room where the body is, and reads head, hands and controllers. `busy`: a skill moves the body; `plays`:
   * the episode is under way, else the trigger goes on from what covers it; `words` are to be read by the wearer. */
  frame(frame: XRFrame, body: Base, busy: boolean, plays: boolean, words: string[], seconds: number): void {
    const space = this.renderer.xr.getReferenceSpace();
    const session = this.renderer.xr.getSession();
    const view = space && frame.getViewerPose(space)?.transform;
    if (!space || !session || !view) return;
    const eye = new Vector3(view.position.x, view.position.y, view.position.z);
    const gaze = new Vector3(0, 0, -1).applyQuaternion(toQuaternion(view.orientation));
    const facing = Math.atan2(-gaze.z, gaze.x);
    if (this.fresh) {
      this.room = body.heading - facing;
      this.anchor.copy(eye);
      this.fresh = false;
    }
    this.lean(eye);
    this.rig.rotation.set(0, this.room, 0);
    const offset = new Vector3(this.anchor.x, 0, this.anchor.z).applyAxisAngle(UP, this.room);
    const [ahead, aside] = [Math.cos(body.heading) * EYES_M, -Math.sin(body.heading) * EYES_M];
    this.rig.position.set(body.x + ahead - offset.x, this.floor.height(body.x, body.z), body.z + aside - offset.z);
    this.rig.updateMatrixWorld(true);
    this.rig.localToWorld(this.head.copy(eye));
    this.panel.show(words, eye, facing, seconds);
    let stick = { x: 0, y: 0 };
    if (plays) this.playedAt = performance.now();
    else {
      this.wait(session);
      return;
    }
    for (const source of session.inputSources) {
      const side = source.handedness;
      if (side !== "left" && side !== "right") continue;
      stick = this.buttons(source, side, stick, busy);
      this.hand(frame, space, source, side, busy);
    }
    const yaw = wrapAngle(this.room + facing - body.heading);
    this.walk(stick, yaw, busy);
    if (performance.now() - this.sentAt < SEND_MS) return;
    this.sentAt = performance.now();
    if (this.ticks++ % 2 === 0) this.look(yaw, -Math.asin(clamp(gaze.y, -1, 1)));
    for (const side of ["left", "right"] as const) if (this.sent[side]) this.player.send(this.handMessage(side, body));
  }

  /** Nothing is played: a trigger that is pulled after a moment goes on. */
  private wait(session: XRSession): void {
    for (const { handedness, gamepad } of session.inputSources) {
      if (!gamepad || handedness === "none") continue;
      const down = gamepad.buttons.map((button) => button.pressed);
      const pulls = down[TRIGGER] && !this.down[handedness][TRIGGER];
      this.down[handedness] = down;
      if (pulls && performance.now() - this.playedAt > COVERED_MS) this.player.goOn();
    }
  }

  private look(yaw: number, pitch: number): void {
    if (Math.hypot(yaw - this.lastHead.yaw, pitch - this.lastHead.pitch) < HEAD_RAD) return;
    this.lastHead = { yaw, pitch };
    this.player.send({ k: "head", yaw: round(yaw, 3), pitch: round(pitch, 3) });
  }

  /** Keeps the body under the wearer: a step in the room beyond a lean moves the room, not the body. */
  private lean(eye: Vector3): void {
    const aside = new Vector3(eye.x - this.anchor.x, 0, eye.z - this.anchor.z);
    const far = aside.length();
    if (far > LEAN_M) this.anchor.addScaledVector(aside, (far - LEAN_M) / far);
  }

  /** Left stick walks, right stick turns in snaps; a headset with one controller does both with it. */
  private buttons(source: XRInputSource, side: HandSide, stick: Stick, busy: boolean): Stick {
    const pad = source.gamepad;
    if (!pad) return stick;
    const x = pad.axes[2] ?? 0;
    const y = pad.axes[3] ?? 0;
    const down = pad.buttons.map((button) => button.pressed);
    const was = this.down[side];
    this.down[side] = down;
    if (down[TRIGGER] && !was[TRIGGER]) {
      this.release(side);
      this.player.act();
    }
    if (down[LOWER] && !was[LOWER]) this.player.drop();
    if (was[SQUEEZE] && !down[SQUEEZE]) this.release(side);
    if (side === "right" && Math.abs(x) > PUSHED && !this.snapped && !busy) this.snap(-Math.sign(x));
    if (side === "right" && Math.abs(x) < DEAD * 2) this.snapped = false;
    const walks = Math.abs(y) > DEAD ? -y : 0;
    return Math.abs(walks) > Math.abs(stick.y) ? { x: side === "left" ? x : 0, y: walks } : stick;
  }

  private snap(direction: number): void {
    this.snapped = true;
    this.room = wrapAngle(this.room + direction * SNAP_RAD);
  }

  /** While the squeeze is held, the palm follows the hand. */
  private hand(frame: XRFrame, space: XRReferenceSpace, source: XRInputSource, side: HandSide, busy: boolean): void {
    const grip = source.gripSpace && frame.getPose(source.gripSpace, space)?.transform;
    if (!grip) return;
    this.rig.localToWorld(this.hands[side].set(grip.position.x, grip.position.y, grip.position.z));
    const holds = !!this.down[side][SQUEEZE] && !busy;
    if (!holds && this.sent[side]) this.release(side);
    if (holds) this.sent[side] = true;
  }

  private handMessage(side: HandSide, body: Base): Record<string, unknown> {
    const at = this.hands[side];
    const [dx, dz] = [at.x - body.x, at.z - body.z];
    const [c, s] = [Math.cos(body.heading), Math.sin(body.heading)];
    const p = [c * dx - s * dz, at.y - this.floor.height(body.x, body.z), s * dx + c * dz].map((value) => round(value, 4));
    return { k: "hand", side, p, q: null };
  }

  private release(side: HandSide): void {
    if (this.sent[side]) this.player.send({ k: "hand", side, p: null, q: null });
    this.sent[side] = false;
  }

  /** The stick walks where the head looks; the body comes round to it. */
  private walk(stick: Stick, aside: number, busy: boolean): void {
    const forward = clamp(stick.y, -0.6, 1) * Math.min(1, COMFORT_MPS / this.speed.forward);
    const turns = Math.abs(aside) > (forward ? WALK_ASIDE : STAND_ASIDE);
    const turn = turns && !busy ? clamp(aside / (this.speed.turn * this.speed.step * 6), -1, 1) : 0;
    this.command = { forward, turn: round(turn, 2) };
  }
}

interface Stick {
  x: number;
  y: number;
}

const UP = new Vector3(0, 1, 0);
const toQuaternion = (q: DOMPointReadOnly): Quaternion => new Quaternion(q.x, q.y, q.z, q.w);
const round = (value: number, digits: number): number => Math.round(value * 10 ** digits) / 10 ** digits;
