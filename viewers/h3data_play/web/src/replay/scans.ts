/** What laser scanners measured, as fans on the floor: a faint surface that the rays sweep, and a dot where each ray ends. */

import { BufferAttribute, BufferGeometry, DoubleSide, Mesh, MeshBasicMaterial, Points, PointsMaterial } from "three";
import type { World } from "../scene/world.ts";
import type { Episode, Scan } from "./episode.ts";
import type { Table } from "./payload.ts";

/** A fan lies over the paths. */
const OVER_FLOOR_M = 0.05;
const DOT_M = 0.09;

export class Fan {
  private readonly ranges: Table;
  private readonly surface = new BufferGeometry();
  private readonly ends = new BufferGeometry();
  private readonly nodes: [Mesh, Points];

  constructor(
    private readonly episode: Episode,
    private readonly scan: Scan,
    world: World,
    color: string,
  ) {
    this.ranges = episode.payload.table(scan.track);
    const rays = this.ranges.columns;
    this.surface.setAttribute("position", new BufferAttribute(new Float32Array(3 * (rays + 1)), 3));
    this.ends.setAttribute("position", new BufferAttribute(new Float32Array(3 * rays), 3));
    this.surface.setIndex(Array.from({ length: rays }, (_, k) => [0, k + 1, ((k + 1) % rays) + 1]).flat());
    const common = { color, transparent: true, depthWrite: false };
    this.nodes = [
      new Mesh(this.surface, new MeshBasicMaterial({ ...common, opacity: 0.24, side: DoubleSide })),
      new Points(this.ends, new PointsMaterial({ ...common, opacity: 0.95, size: DOT_M, depthTest: false })),
    ];
    for (const node of this.nodes) {
      node.frustumCulled = false;
      world.scene.add(node);
    }
  }

  show(row: number, shown: boolean): void {
    const { x, y, z, heading } = this.episode.base(this.scan.agent, row);
    const visible = shown && Number.isFinite(x);
    for (const node of this.nodes) node.visible = visible;
    if (!visible) return;
    const surface = this.surface.getAttribute("position") as BufferAttribute;
    const ends = this.ends.getAttribute("position") as BufferAttribute;
    const rays = this.ranges.columns;
    surface.setXYZ(0, x, y + OVER_FLOOR_M, z);
    let met = 0;
    for (let k = 0; k < rays; k++) {
      const reach = this.ranges.values[row * rays + k]!;
      const angle = heading + (2 * Math.PI * k) / rays;
      const [px, pz] = [x + reach * Math.cos(angle), z - reach * Math.sin(angle)];
      surface.setXYZ(k + 1, px, y + OVER_FLOOR_M, pz);
      // a ray that met nothing has no end
      if (reach < 0.995 * this.scan.most) ends.setXYZ(met++, px, y + this.scan.height, pz);
    }
    surface.needsUpdate = ends.needsUpdate = true;
    this.ends.setDrawRange(0, met);
  }
}
