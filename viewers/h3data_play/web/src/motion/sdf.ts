/** Signed distance to the nearest obstacle on the floor plan, as `h3data.scene.FreeSpace` samples it. */

import { Floor } from "./floor.ts";

export interface SdfShape {
  /** Cells along x and along z. */
  shape: [number, number];
  /** Lower corner (x, z) of cell [0, 0], m. */
  origin: [number, number];
  /** Edge of a cell, m. */
  cell: number;
  /** Metres per unit of the stored integers. */
  unit: number;
  /** How they are stored, little-endian. */
  type?: "int8" | "int16";
}

export class Sdf {
  map!: SdfShape;
  nx = 0;
  nz = 0;
  /** How often the grid has been replaced. */
  version = -1;
  private values = new Float32Array(0);

  /** The cells row by row along z. */
  constructor(map: SdfShape, bytes: ArrayBuffer, readonly floor = new Floor([], 0)) {
    this.replace(map, bytes);
  }

  /** Takes another grid: something has opened or closed that stands on the floor. */
  replace(map: SdfShape, bytes: ArrayBuffer): void {
    const [nx, nz] = map.shape;
    const size = nx * nz * (map.type === "int16" ? 2 : 1);
    if (bytes.byteLength !== size)
      throw new Error(`Expected a distance grid of ${nx} x ${nz} cells in ${size} bytes, got ${bytes.byteLength}.`);
    this.map = map;
    [this.nx, this.nz] = map.shape;
    this.version++;
    const cells = map.type === "int16" ? new Int16Array(bytes) : new Int8Array(bytes);
    this.values = Float32Array.from(cells, (value) => value * map.unit);
  }

  /** Distance at a point, bilinear between centres of cells; off the grid less the distance to it. */
  at(x: number, z: number): number {
    const { origin, cell } = this.map;
    const fx = (x - origin[0]) / cell - 0.5;
    const fz = (z - origin[1]) / cell - 0.5;
    const cx = clamp(fx, 0, this.nx - 1);
    const cz = clamp(fz, 0, this.nz - 1);
    const [i, j] = this.corner(cx, cz);
    const a = cx - i;
    const b = cz - j;
    const near = (1 - a) * ((1 - b) * this.cell(i, j) + b * this.cell(i, j + 1));
    const far = a * ((1 - b) * this.cell(i + 1, j) + b * this.cell(i + 1, j + 1));
    return near + far - cell * Math.hypot(fx - cx, fz - cz);
  }

  /** Gradient of the bilinear distance: points away from the nearest obstacle. */
  gradient(x: number, z: number): [number, number] {
    const { origin, cell } = this.map;
    const cx = clamp((x - origin[0]) / cell - 0.5, 0, this.nx - 1);
    const cz = clamp((z - origin[1]) / cell - 0.5, 0, this.nz - 1);
    const [i, j] = this.corner(cx, cz);
    const a = cx - i;
    const b = cz - j;
    const s00 = this.cell(i, j);
    const s01 = this.cell(i, j + 1);
    const s10 = this.cell(i + 1, j);
    const s11 = this.cell(i + 1, j + 1);
    return [((1 - b) * (s10 - s00) + b * (s11 - s01)) / cell, ((1 - a) * (s01 - s00) + a * (s11 - s10)) / cell];
  }

  /** Distance of cell [i, j]. */
  cell(i: number, j: number): number {
    return this.values[i * this.nz + j]!;
  }

  private corner(cx: number, cz: number): [number, number] {
    return [Math.min(Math.floor(cx), this.nx - 2), Math.min(Math.floor(cz), this.nz - 2)];
  }
}

export const clamp = (value: number, low: number, high: number): number => Math.min(Math.max(value, low), high);

/** The same angle in [-pi, pi). */
export const wrapAngle = (angle: number): number => angle - 2 * Math.PI * Math.floor(angle / (2 * Math.PI) + 0.5);
