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
}

/** Labels stay this far inside the picture: px at the sides, shares of the height at the top and the bottom. */
const EDGE_PX = 12;
const LABEL_PX = 18;
const EDGE_TOP = 0.7;
const EDGE_BOTTOM = -0.7;

export class Labels {
  private readonly pool: HTMLElement[] = [];
  private readonly at = new Vector3();

  constructor(private readonly layer: HTMLElement) {}

  /** `free` is the corner of the picture that labels leave to the map: its left and upper border, px. */
  show(marks: Mark[], camera: PerspectiveCamera, width: number, height: number, free: { x: number; y: number }): void {
    while (this.pool.length < marks.length) this.pool.push(this.make());
    this.pool.forEach((label, k) => {
      const mark = marks[k];
      label.hidden = !mark;
      if (mark) this.place(label, mark, camera, width, height, free);
    });
  }

  private place(
    label: HTMLElement, mark: Mark, camera: PerspectiveCamera, width: number, height: number, free: { x: number; y: number },
  ): void {
    const at = this.at.copy(mark.point).project(camera);
    if (at.z > 1) at.set(-at.x * 9, -9, 0); // behind: at the lower border, on its side
    const [chip, name, far, arrow] = label.children as unknown as HTMLElement[];
    setText(chip!, mark.chip ?? thingLetter(mark.thing));
    setText(name!, mark.text);
    setText(far!, mark.far === null ? "" : `${mark.far.toFixed(mark.far < 10 ? 1 : 0)} m`);
    const half = label.offsetWidth / 2 + EDGE_PX;
    const left = ((at.x + 1) / 2) * width;
    const x = Math.min(Math.max(left, half), width - half);
    const y = Math.min(Math.max(at.y, EDGE_BOTTOM), EDGE_TOP);
    const outside = at.x < -1 || at.x > 1 || y !== at.y;
    label.classList.toggle("outside", outside);
    label.classList.toggle("near", mark.near);
    label.style.setProperty("--tone", mark.tone ?? thingColor(mark.thing));
    const top = ((1 - y) / 2) * height;
    const down = x + half > free.x ? Math.min(top, free.y - LABEL_PX) : top;
    label.style.transform = `translate(${x}px, ${down}px) translate(-50%, -50%)`;
    if (outside) arrow!.style.transform = `rotate(${Math.atan2(((y - at.y) / 2) * height, left - x)}rad)`;
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
