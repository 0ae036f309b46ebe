/** One step of a driven body: `sim_kinematic.motion.step.drive_base`, statement for statement, so that prediction and
 * server agree to the precision of the distance grid. */

import { clamp, type Sdf } from "./sdf.ts";

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
}

export interface Velocity {
  forward: number;
  turn: number;
  lateral?: number;
}

/** Where a base is after `dt` seconds under a command, -1..1 each. */
export function drive(sdf: Sdf, base: Base, command: Velocity, how: Driving, dt: number): Base {
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
