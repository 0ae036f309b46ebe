/** Where the player's own body is by now, before the server has answered. */

import { drive, type Base, type Disc, type Driving, type Velocity } from "./drive.ts";
import { wrapAngle, type Sdf } from "./sdf.ts";

/** A velocity and the step that it is meant to act in. */
export interface SentMove extends Velocity {
  seq: number;
  step: number;
}

/** What the server has told: the base after a step, and the last input that had acted by then. */
export interface Told {
  step: number;
  ack: number;
  base: Base;
}

/** No further than this: a connection that stands still must not let the body run on. */
const MOST_STEPS = 20;
const FADE_S = 0.1;
/** A difference beyond this is no error of prediction but another place. */
const ELSEWHERE_M = 0.6;
const KEPT = 1500;

export class Predictor {
  /** Distances between what was shown for a step and what the server said of it, m. */
  readonly errors: number[] = [];
  /** Discs of the other agents where the latest state has them. */
  others: Disc[] = [];
  private readonly sent: SentMove[] = [];
  private readonly guesses = new Map<number, Base>();
  private active: Velocity = { forward: 0, turn: 0 };
  private slack: Base = { x: 0, z: 0, heading: 0 };
  private last: { target: Base; predicted: boolean } | null = null;

  constructor(
    private readonly sdf: Sdf,
    private readonly how: Driving,
    private readonly dt: number,
  ) {}

  /** Takes note of a command on its way. */
  add(move: SentMove): void {
    this.sent.push(move);
  }

  /** Forgets what is on its way: the connection was lost, or the server has stopped the body. */
  reset(): void {
    this.sent.length = 0;
    this.guesses.clear();
    this.active = { forward: 0, turn: 0 };
  }

  /** Compares a state with what had been guessed, and drops what has acted. */
  hear(told: Told, busy: boolean): void {
    while (this.sent.length && this.sent[0]!.seq <= told.ack) this.active = this.sent.shift()!;
    const guess = this.guesses.get(told.step);
    if (guess && !busy) {
      this.errors.push(Math.hypot(guess.x - told.base.x, guess.z - told.base.z));
      if (this.errors.length > KEPT) this.errors.shift();
    }
    for (const step of this.guesses.keys()) if (step <= told.step || busy) this.guesses.delete(step);
  }

  /** The base `ahead` steps after what was told (a fraction counts), every command acting in its step. */
  at(told: Told, ahead: number): Base {
    const whole = Math.min(Math.max(Math.floor(ahead), 0), MOST_STEPS);
    const share = Math.min(Math.max(ahead - whole, 0), 1);
    let command = this.active;
    let base = told.base;
    let before = base;
    let next = 0;
    for (let step = told.step + 1; step <= told.step + whole + 1; step++) {
      while (next < this.sent.length && this.sent[next]!.step <= step) command = this.sent[next++]!;
      before = base;
      base = drive(this.sdf, base, command, this.how, this.dt, this.others);
      if (step === told.step + whole) this.guesses.set(step, base);
    }
    return mix(before, base, share);
  }

  /** What to show: the target, where a jump of it is taken back within a tenth of a second. */
  smooth(target: Base, command: Velocity, predicted: boolean, seconds: number): Base {
    const was = this.last;
    this.last = { target, predicted };
    if (was && (predicted || was.predicted)) {
      const share = predicted && was.predicted ? seconds / this.dt : 0;
      const scaled = { forward: command.forward * share, turn: command.turn * share };
      const expected = share
        ? drive(this.sdf, was.target, limited(scaled), this.how, this.dt * most(scaled), this.others)
        : was.target;
      this.slack.x += expected.x - target.x;
      this.slack.z += expected.z - target.z;
      this.slack.heading += wrapAngle(expected.heading - target.heading);
    }
    const fade = Math.exp(-seconds / FADE_S);
    this.slack = { x: this.slack.x * fade, z: this.slack.z * fade, heading: this.slack.heading * fade };
    if (Math.hypot(this.slack.x, this.slack.z) > ELSEWHERE_M) this.slack = { x: 0, z: 0, heading: 0 };
    return { x: target.x + this.slack.x, z: target.z + this.slack.z, heading: target.heading + this.slack.heading };
  }
}

/** A frame may last longer than a step: then the command is at its limit and the time is longer. */
const most = (command: Velocity): number => Math.max(1, Math.abs(command.forward), Math.abs(command.turn));
const limited = (command: Velocity): Velocity => ({
  forward: command.forward / most(command),
  turn: command.turn / most(command),
});

function mix(a: Base, b: Base, share: number): Base {
  return {
    x: a.x + (b.x - a.x) * share,
    z: a.z + (b.z - a.z) * share,
    heading: a.heading + (b.heading - a.heading) * share,
  };
}
