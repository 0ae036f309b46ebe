/** From what is pressed to commands on the wire: when they change, at most one for each step. */

import type { CameraRig } from "../scene/camera.ts";
import type { Driving, Velocity } from "./drive.ts";
import type { Predictor } from "./predict.ts";
import { clamp, wrapAngle } from "./sdf.ts";

/** The server steps 30 times a second. */
const SEND_MS = 30;
/** The body comes round to the view within about three steps, and not for less than a degree. */
const ALIGN_STEPS = 3;
const ALIGN_RAD = 0.02;

export interface MoveSink {
  sendMove(forward: number, turn: number): { seq: number; step: number };
}

export class Steering {
  command: Velocity = { forward: 0, turn: 0 };
  private sentAt = 0;

  constructor(
    private readonly sink: MoveSink,
    private readonly predictor: Predictor,
    private readonly how: Driving,
    private readonly stepS: number,
  ) {}

  /** `wanted` is what is pressed. Who walks ahead while they look elsewhere turns there, with the view kept still. */
  steer(wanted: Velocity, camera: CameraRig, heading: number): void {
    let turn = wanted.turn;
    if (camera.steers && wanted.forward > 0 && turn === 0 && Math.abs(camera.yaw) > ALIGN_RAD)
      turn = clamp(wrapAngle(camera.yaw) / (this.how.turn * this.stepS * ALIGN_STEPS), -1, 1);
    camera.hold(turn !== 0 && wanted.turn === 0, heading);
    this.send({ forward: wanted.forward, turn });
  }

  /** The next command is sent even if it is the same: after a reconnect the server knows of none. */
  reset(): void {
    this.command = { forward: 0, turn: 0 };
    this.predictor.reset();
  }

  /** Sends a command that has changed. */
  send(wanted: Velocity): void {
    const now = performance.now();
    const command = { forward: tidy(wanted.forward), turn: tidy(wanted.turn) };
    const same = command.forward === this.command.forward && command.turn === this.command.turn;
    const pressed = Math.sign(command.forward) !== Math.sign(this.command.forward) || (!command.turn && this.command.turn);
    if (same || (!pressed && now - this.sentAt < SEND_MS)) return;
    this.command = command;
    this.sentAt = now;
    const { seq, step } = this.sink.sendMove(command.forward, command.turn);
    this.predictor.add({ ...command, seq, step });
  }
}

/** Hundredths: what is recorded is read by people, and float32 makes no difference. */
const tidy = (value: number): number => Math.round(value * 100) / 100;
