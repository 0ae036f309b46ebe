/** One step of a driven body: `sim_kinematic.motion.step.drive_base`, statement for statement, so that prediction and
 * server agree to the precision of the distance grid. */

import { clamp, type Sdf } from "./sdf.ts";

const APART_ITERATIONS = 4;
const APART_TOLERANCE_M = 1e-6;

export interface Base {
  x: number;
  z: number;
  /** Counter-clockwise from +x, seen from above, rad. */
  heading: number;
}

/** How an agent drives; the manifest has it. */
export interface Driving {
  /** m/s and rad/s at a command of 1. */
  speed: number;
  turn: number;
  /** m/s sideways at a command of 1; 0: it cannot. */
  lateral: number;
  backwards: boolean;
  /** Discs that keep clear of obstacles: centres along x, and their radius, m. */
  offsets: number[];
  radius: number;
  iterations: number;
  tolerance: number;
  /** The farthest that a step gets, m; null: as far as obstacles push it. */
  farthest: number | null;
  /** It slides along the discs of other agents as along walls. */
  solid?: boolean;
}

/** A disc of another agent on the floor, m. */
export interface Disc {
  x: number;
  z: number;
  radius: number;
}

/** The discs of an agent where it is. */
export function discsOf(base: Base, how: Driving): Disc[] {
  const [c, s] = [Math.cos(base.heading), Math.sin(base.heading)];
  return how.offsets.map((offset) => ({ x: base.x + c * offset, z: base.z - s * offset, radius: how.radius }));
}

export interface Velocity {
  forward: number;
  turn: number;
  lateral?: number;
}

/** Where a base is after `dt` seconds under a command, -1..1 each, beside the discs of others; slower on stairs. */
export function drive(sdf: Sdf, base: Base, command: Velocity, how: Driving, dt: number, others: Disc[] = []): Base {
  const target = driveAlone(sdf, base, onStairs(sdf, base, command), how, dt);
  return how.solid && others.length ? keepApart(sdf, base, target, others, how) : target;
}

/** `sim_kinematic.motion.step.stairs_speeds`. */
function onStairs(sdf: Sdf, base: Base, command: Velocity): Velocity {
  const pace = sdf.floor.pace(base.x, base.z);
  return { forward: command.forward * pace, turn: command.turn, lateral: (command.lateral ?? 0) * pace };
}

/** `sim_kinematic.motion.step.keep_apart`: slides along others; who is too near already may leave, and gets no nearer. */
function keepApart(sdf: Sdf, from: Base, to: Base, others: Disc[], how: Driving): Base {
  const least = others.map((disc) => Math.min(how.radius + disc.radius, Math.hypot(from.x - disc.x, from.z - disc.z)));
  let { x, z } = to;
  let touched = false;
  for (let n = 0; n < APART_ITERATIONS; n++) {
    let free = true;
    others.forEach((disc, k) => {
      const far = Math.hypot(x - disc.x, z - disc.z);
      if (far <= 1e-9 || far >= least[k]! - APART_TOLERANCE_M) return;
      [x, z] = [disc.x + ((x - disc.x) / far) * least[k]!, disc.z + ((z - disc.z) / far) * least[k]!];
      free = false;
      touched = true;
    });
    if (free) break;
  }
  if (!touched) return to;
  const stays = { x: from.x, z: from.z, heading: to.heading };
  if (others.some((disc, k) => Math.hypot(x - disc.x, z - disc.z) < least[k]! - 2 * APART_TOLERANCE_M)) return stays;
  if (Math.hypot(x - from.x, z - from.z) > Math.hypot(to.x - from.x, to.z - from.z) + APART_TOLERANCE_M) return stays;
  return sdf.at(x, z) < how.radius - how.tolerance ? stays : { x, z, heading: to.heading };
}

function driveAlone(sdf: Sdf, base: Base, command: Velocity, how: Driving, dt: number): Base {
  const speed = clamp(command.forward, how.backwards ? -1 : 0, 1) * how.speed;
  const lateral = clamp(command.lateral ?? 0, -1, 1) * how.lateral;
  const turn = clamp(command.turn, -1, 1) * how.turn;
  if (speed === 0 && lateral === 0 && turn === 0) return { ...base };
  const { x, z } = base;
  const c = Math.cos(base.heading);
  const s = Math.sin(base.heading);
  const tx = x + (c * speed - s * lateral) * dt;
  const tz = z - (s * speed + c * lateral) * dt;
  const turned = base.heading + turn * dt;
  const reach = Math.hypot(speed, lateral) * dt + 2 * how.radius * Math.abs(turn) * dt + how.tolerance;
  const most = how.farthest ?? Infinity;
  for (const heading of [turned, base.heading]) {
    let [sx, sz, clearance] = pushOut(sdf, tx, tz, heading, how);
    if (heading === turned && clearance >= how.radius && sx === tx && sz === tz) return { x: tx, z: tz, heading };
    const far = Math.hypot(sx - x, sz - z);
    if (most < far && far <= reach) {
      [sx, sz] = [x + (sx - x) * (most / far), z + (sz - z) * (most / far)];
      clearance = leastClearance(sdf, sx, sz, heading, how.offsets);
    }
    if (clearance >= how.radius - how.tolerance && far <= reach) return { x: sx, z: sz, heading };
  }
  const clear = leastClearance(sdf, x, z, turned, how.offsets) >= how.radius - how.tolerance;
  return { x, z, heading: clear ? turned : base.heading };
}

function leastClearance(sdf: Sdf, x: number, z: number, heading: number, offsets: number[]): number {
  const c = Math.cos(heading);
  const s = Math.sin(heading);
  return Math.min(...offsets.map((offset) => sdf.at(x + c * offset, z - s * offset)));
}

/** The position moved until its discs, if possible, keep their radius, and the least clearance there. */
function pushOut(sdf: Sdf, x: number, z: number, heading: number, how: Driving): [number, number, number] {
  const c = Math.cos(heading);
  const s = Math.sin(heading);
  for (let k = 0; k < how.iterations; k++) {
    let free = true;
    let least = Infinity;
    for (const offset of how.offsets) {
      const cx = x + c * offset;
      const cz = z - s * offset;
      const distance = sdf.at(cx, cz);
      least = Math.min(least, distance);
      if (distance >= how.radius) continue;
      const [gx, gz] = sdf.gradient(cx, cz);
      const length = Math.hypot(gx, gz);
      if (length > 1e-9) {
        x += (gx / length) * (how.radius - distance);
        z += (gz / length) * (how.radius - distance);
        free = false;
      }
    }
    if (free) return [x, z, least];
  }
  return [x, z, leastClearance(sdf, x, z, heading, how.offsets)];
}
