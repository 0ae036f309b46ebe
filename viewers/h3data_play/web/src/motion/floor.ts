/** How high the floor is at a place of the plan, where stairs join storeys (`h3data.scene.floor_heights`). */

/** A rectangle of the plan and its heights: x0 z0 x1 z1, heights at both ends of its ramp (equal: level) [m], axis of the ramp
 * (0 x, 1 z), coordinates of its ends [m], number of risers (0: nobody climbs there). */
export type HeightRow = [number, number, number, number, number, number, number, number, number, number];

/** Robots and people under commands go at this share of their speed on stairs, and gradually slower from so far before them, m. */
const STAIRS_SHARE = 0.4;
const STAIRS_NEAR_M = 0.6;

export class Floor {
  /** `levelY` is the height where there are no stairs at all, m. */
  constructor(
    private readonly rows: HeightRow[],
    private readonly levelY: number,
  ) {}

  /** Height, with stairs as ramps, m. */
  height(x: number, z: number): number {
    const row = this.nearest(x, z);
    if (!row) return this.levelY;
    const [, , , , low, high] = row;
    return low === high ? low : low + (high - low) * Math.min(Math.max(along(row, x, z), 0), 1);
  }

  /** Height of the highest storey, m. */
  get highest(): number {
    return Math.max(...(this.rows.length ? this.rows.map((row) => row[5]) : [this.levelY]));
  }

  /** Height of a step at a place; 0 where there are no stairs, m. */
  riser(x: number, z: number): number {
    const row = this.nearest(x, z);
    return row && row[9] ? Math.abs(row[5] - row[4]) / row[9] : 0;
  }

  /** Share of its speed at which a body under commands goes. */
  pace(x: number, z: number): number {
    const row = this.nearest(x, z);
    if (!row || !row[9]) return 1;
    const place = along(row, x, z);
    const far = Math.max(-place, place - 1, 0) * Math.abs(row[8] - row[7]);
    return 1 - (1 - STAIRS_SHARE) * (1 - Math.min(far / STAIRS_NEAR_M, 1));
  }

  /** Height and upward pitch [rad] of a body whose ends, so far apart, stand on the floor; 0: it stays upright. */
  slope(x: number, z: number, heading: number, length: number): { y: number; pitch: number } {
    if (!length || !this.rows.length) return { y: this.height(x, z), pitch: 0 };
    const dx = (length / 2) * Math.cos(heading);
    const dz = (-length / 2) * Math.sin(heading);
    const front = this.height(x + dx, z + dz);
    const back = this.height(x - dx, z - dz);
    return { y: (front + back) / 2, pitch: Math.atan2(front - back, length) };
  }

  /** The row whose rectangle is nearest. */
  private nearest(x: number, z: number): HeightRow | undefined {
    let best: HeightRow | undefined;
    let least = Infinity;
    for (const row of this.rows) {
      const dx = Math.max(row[0] - x, x - row[2], 0);
      const dz = Math.max(row[1] - z, z - row[3], 0);
      const far = dx * dx + dz * dz;
      if (far < least) [best, least] = [row, far];
      if (far === 0) break;
    }
    return best;
  }
}

/** Where a place is along the ramp of a row, 0 to 1 from its lower end. */
const along = (row: HeightRow, x: number, z: number): number => ((row[6] === 0 ? x : z) - row[7]) / (row[8] - row[7]);
