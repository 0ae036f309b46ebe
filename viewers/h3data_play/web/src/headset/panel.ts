/** Words in a headset, where the page is not to be seen: a board that stays in front of the wearer, lower than the gaze. */

import { CanvasTexture, Mesh, MeshBasicMaterial, PlaneGeometry, SRGBColorSpace, type Object3D } from "three";

const WIDTH_M = 0.8;
const PX_PER_M = 900;
const LINE_PX = 40;
/** Ahead of the wearer and below the eyes, m. */
const AHEAD_M = 1.15;
const BELOW_M = 0.5;
/** It follows a head that turns further than this, rad. */
const ASIDE_RAD = 0.5;

export class Panel {
  private readonly canvas = document.createElement("canvas");
  private readonly texture = new CanvasTexture(this.canvas);
  private readonly board: Mesh;
  private text = "";
  private yaw: number | null = null;

  constructor(rig: Object3D) {
    this.canvas.width = WIDTH_M * PX_PER_M;
    this.canvas.height = this.canvas.width / 2;
    this.texture.colorSpace = SRGBColorSpace;
    const material = new MeshBasicMaterial({ map: this.texture, transparent: true, depthTest: false });
    this.board = new Mesh(new PlaneGeometry(WIDTH_M, WIDTH_M / 2), material);
    this.board.renderOrder = 10;
    this.board.visible = false;
    rig.add(this.board);
  }

  /** Shows lines, the first as a title, in front of a head at `eye` that looks to `yaw`, both in the wearer's room. */
  show(lines: string[], eye: { x: number; y: number; z: number }, yaw: number, seconds: number): void {
    this.board.visible = true;
    if (this.yaw === null) this.yaw = yaw;
    const aside = Math.atan2(Math.sin(yaw - this.yaw), Math.cos(yaw - this.yaw));
    if (Math.abs(aside) > ASIDE_RAD) this.yaw += aside * Math.min(1, seconds * 4);
    const at = { x: Math.cos(this.yaw), z: -Math.sin(this.yaw) };
    this.board.position.set(eye.x + at.x * AHEAD_M, eye.y - BELOW_M, eye.z + at.z * AHEAD_M);
    this.board.rotation.set(-0.4, this.yaw - Math.PI / 2, 0, "YXZ");
    const text = lines.join("\n");
    if (text === this.text) return;
    this.text = text;
    this.write(lines);
  }

  hide(): void {
    this.board.visible = false;
    this.yaw = null;
  }

  private write(lines: string[]): void {
    const { canvas } = this;
    const brush = canvas.getContext("2d")!;
    brush.clearRect(0, 0, canvas.width, canvas.height);
    brush.fillStyle = "rgba(15, 23, 32, 0.85)";
    brush.beginPath();
    brush.roundRect(0, 0, canvas.width, canvas.height, 28);
    brush.fill();
    brush.fillStyle = "#f4f7fa";
    brush.textBaseline = "top";
    let y = 26;
    lines.forEach((line, k) => {
      brush.font = `${k ? 400 : 600} ${k ? 30 : 33}px system-ui, sans-serif`;
      for (const part of wrap(brush, line, canvas.width - 56)) {
        brush.fillText(part, 28, y);
        y += LINE_PX;
      }
      y += 6;
    });
    this.texture.needsUpdate = true;
  }
}

function wrap(brush: CanvasRenderingContext2D, text: string, width: number): string[] {
  const lines = [""];
  for (const word of text.split(" ")) {
    const longer = `${lines.at(-1)} ${word}`.trim();
    if (brush.measureText(longer).width <= width) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines;
}
