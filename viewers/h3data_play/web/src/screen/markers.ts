/** Cues in the home: rings where things go, labels on things and goals, the preview of a place, the point walked to. */

import {
  Color,
  DoubleSide,
  Group,
  Mesh,
  MeshBasicMaterial,
  RingGeometry,
  Vector3,
  type Object3D,
  type PerspectiveCamera,
  type Scene,
} from "three";
import { BAD, thingColor, thingLetter, YOU } from "./palette.ts";

export interface Mark {
  /** Point in the world that the label floats over. */
  point: Vector3;
  text: string;
  /** Index of the thing that it is about, or `MARKER`. */
  thing: number;
  /** Whether it would be taken, or is the goal of what is held. */
  near: boolean;
  /** From the player, m; null: there is none. */
  far: number | null;
  /** In place of the thing's letter and colour. */
  chip?: string;
  tone?: string;
  /** Whether it is what somebody says: in several lines. */
  speech?: boolean;
}

/** Labels stay this far inside the picture, px. */
const EDGE_PX = 12;
/** Between labels that were moved apart, px. */
const GAP_PX = 3;

/** A part of the picture, px. */
export interface Box {
  left: number;
  top: number;
  width: number;
  height: number;
}

const overlap = (a: Box, b: Box): boolean =>
  a.left < b.left + b.width && b.left < a.left + a.width && a.top < b.top + b.height && b.top < a.top + a.height;

/** Where boxes go so that none lies on another or on what is taken: each as near to its place as those before it allow, above or
 * below. Null: there is no room for it between 0 and `height`. */
export function spread(wanted: Box[], taken: Box[], height: number): (number | null)[] {
  const placed: Box[] = [...taken];
  return wanted.map((box) => {
    // right above or below something is as near as a free place can be
    const column = placed.filter((other) => other.left < box.left + box.width && box.left < other.left + other.width);
    const tops = [box.top, ...column.flatMap((other) => [other.top - box.height - GAP_PX, other.top + other.height + GAP_PX])];
    const free = tops
      .filter((top) => top >= 0 && top + box.height <= height && !column.some((other) => overlap({ ...box, top }, other)))
      .sort((a, b) => Math.abs(a - box.top) - Math.abs(b - box.top))[0];
    if (free === undefined) return null;
    placed.push({ ...box, top: free });
    return free;
  });
}

export class Labels {
  private readonly pool: HTMLElement[] = [];
  private readonly at = new Vector3();

  /** `lift`: how far labels are above what they name, in their heights. */
  constructor(
    private readonly layer: HTMLElement,
    private readonly lift = 0,
  ) {}

  /** `taken` are the parts of the picture where something else is. */
  show(marks: Mark[], camera: PerspectiveCamera, width: number, height: number, taken: Box[]): void {
    while (this.pool.length < marks.length) this.pool.push(this.make());
    for (const label of this.pool.slice(marks.length)) label.hidden = true;
    // what is within reach keeps its place, others make room
    const order = marks.map((_, k) => k).sort((a, b) => +marks[b]!.near - +marks[a]!.near || a - b);
    const wanted = order.map((k) => this.aim(this.pool[k]!, marks[k]!, camera, width, height));
    spread(wanted, taken, height).forEach((top, k) => {
      const label = this.pool[order[k]!]!;
      const box = wanted[k]!;
      label.classList.toggle("squeezed", top === null);
      label.style.transform = `translate(${box.left}px, ${top ?? box.top}px)`;
    });
  }

  /** Fills a label in; where it wants to be. */
  private aim(label: HTMLElement, mark: Mark, camera: PerspectiveCamera, width: number, height: number): Box {
    label.hidden = false;
    const at = this.at.copy(mark.point).project(camera);
    if (at.z > 1) at.set(-at.x * 9, -9, 0); // behind: at the lower border, on its side
    const [chip, name, far, arrow] = label.children as unknown as HTMLElement[];
    setText(chip!, mark.chip ?? thingLetter(mark.thing));
    setText(name!, mark.text);
    setText(far!, mark.far === null ? "" : `${mark.far.toFixed(mark.far < 10 ? 1 : 0)} m`);
    const [halfWide, halfHigh] = [label.offsetWidth / 2, label.offsetHeight / 2];
    const x = ((at.x + 1) / 2) * width;
    const y = ((1 - at.y) / 2) * height - 2 * this.lift * halfHigh;
    const shownX = Math.min(Math.max(x, halfWide + EDGE_PX), width - halfWide - EDGE_PX);
    const shownY = Math.min(Math.max(y, halfHigh + EDGE_PX), height - halfHigh - EDGE_PX);
    const outside = x < 0 || x > width || shownY !== y;
    label.classList.toggle("outside", outside);
    label.classList.toggle("near", mark.near);
    label.classList.toggle("speech", !!mark.speech);
    label.style.setProperty("--tone", mark.tone ?? thingColor(mark.thing));
    if (outside) arrow!.style.transform = `rotate(${Math.atan2(y - shownY, x - shownX)}rad)`;
    return { left: shownX - halfWide, top: shownY - halfHigh, width: 2 * halfWide, height: 2 * halfHigh };
  }

  private make(): HTMLElement {
    const label = document.createElement("div");
    label.className = "mark";
    for (const name of ["chip", "name", "far", "arrow"]) {
      const part = document.createElement("span");
      part.className = name;
      if (name === "arrow") part.textContent = "➤";
      label.append(part);
    }
    this.layer.append(label);
    return label;
  }
}

export function setText(node: Element, text: string): void {
  if (node.textContent !== text) node.textContent = text;
}

/** A flat ring, seen through furniture faintly so that nobody searches for it. */
export class FloorRing {
  readonly group = new Group();
  private readonly materials: MeshBasicMaterial[] = [];

  constructor(scene: Scene, color: string, inner: number, outer: number) {
    for (const hidden of [true, false]) {
      const material = new MeshBasicMaterial({
        color,
        side: DoubleSide,
        transparent: true,
        opacity: hidden ? 0.28 : 0.95,
        depthTest: !hidden,
        depthWrite: false,
      });
      const ring = new Mesh(new RingGeometry(inner, outer, 48), material);
      ring.rotation.x = -Math.PI / 2;
      ring.renderOrder = hidden ? 1 : 2;
      this.materials.push(material);
      this.group.add(ring);
    }
    scene.add(this.group);
  }

  color(color: string): void {
    for (const material of this.materials) material.color.set(color);
  }

  show(x: number, y: number, z: number, size = 1): void {
    this.group.visible = true;
    this.group.position.set(x, y, z);
    this.group.scale.setScalar(size);
  }

  hide(): void {
    this.group.visible = false;
  }
}

/** A see-through copy of a thing where it would be put. */
export class Ghost {
  private copy: Object3D | null = null;
  private of: Object3D | null = null;
  private readonly material = new MeshBasicMaterial({ transparent: true, opacity: 0.5, depthWrite: false });

  constructor(private readonly scene: Scene) {}

  /** `fits`: null while the server has not answered. */
  show(thing: Object3D, point: Vector3, fits: boolean | null): void {
    if (this.of !== thing) {
      this.hide();
      this.of = thing;
      this.copy = thing.clone(true);
      this.copy.traverse((node) => {
        if ((node as Mesh).isMesh) (node as Mesh).material = this.material;
      });
      this.copy.rotation.set(0, 0, 0);
      this.scene.add(this.copy);
    }
    this.material.color = new Color(fits === null ? "#ffffff" : fits ? YOU : BAD);
    this.copy!.position.copy(point);
  }

  hide(): void {
    if (this.copy) this.scene.remove(this.copy);
    this.copy = this.of = null;
  }
}
