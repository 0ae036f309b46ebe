/** The floor plan in a corner: obstacles, agents, things and where they belong, what the camera sees. */

import type { Base } from "../motion/drive.ts";
import { MARKER, OTHER, ROBOT, thingColor, thingLetter, YOU } from "./palette.ts";
import type { Sdf } from "../motion/sdf.ts";

export interface MapAgent extends Base {
  kind: "robot" | "human";
  me: boolean;
}

export interface MapThing {
  /** Null: the player has to look for it. */
  at: { x: number; z: number } | null;
  goal: { x: number; z: number } | null;
  done: boolean;
  held: boolean;
}

const PX_PER_M = 26;
const FREE: [number, number, number] = [233, 237, 240];
const FURNITURE: [number, number, number] = [138, 149, 160];

export class MiniMap {
  private readonly brush: CanvasRenderingContext2D;
  private plan!: HTMLCanvasElement;
  /** Version of the grid that `plan` shows. */
  private shown = -1;
  private readonly scale: number;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly sdf: Sdf,
  ) {
    this.scale = PX_PER_M * Math.min(devicePixelRatio, 2);
    this.brush = canvas.getContext("2d")!;
    this.draw([], [], null, 0);
  }

  private layout(): void {
    const { canvas, sdf, scale } = this;
    const { shape, cell } = sdf.map;
    canvas.width = Math.round(shape[0] * cell * scale);
    canvas.height = Math.round(shape[1] * cell * scale);
    canvas.style.setProperty("--wide", `${shape[0] * cell * PX_PER_M}px`);
    this.plan = this.drawPlan(canvas.width, canvas.height);
    this.shown = sdf.version;
  }

  draw(agents: MapAgent[], things: MapThing[], marker: { x: number; z: number } | null, yaw: number): void {
    const { brush } = this;
    if (this.shown !== this.sdf.version) this.layout();
    brush.clearRect(0, 0, brush.canvas.width, brush.canvas.height);
    brush.drawImage(this.plan, 0, 0);
    const unit = this.scale;
    const me = agents.find((agent) => agent.me);
    if (me) this.drawView(me, yaw);
    things.forEach((thing, k) => {
      brush.strokeStyle = brush.fillStyle = thingColor(k);
      if (thing.goal && !thing.done) {
        const [x, y] = this.at(thing.goal.x, thing.goal.z);
        brush.lineWidth = unit * 0.09;
        brush.strokeRect(x - unit * 0.17, y - unit * 0.17, unit * 0.34, unit * 0.34);
      }
      if (!thing.held && thing.at) this.chip(thing.at, k, thing.done);
    });
    if (marker) this.drawMarker(marker);
    for (const agent of agents) this.drawAgent(agent);
    // what is in a hand goes on top, or the agent would hide it
    things.forEach((thing, k) => thing.held && thing.at && this.chip(thing.at, k, false));
  }

  private drawMarker(marker: { x: number; z: number }): void {
    const { brush, scale } = this;
    for (const [color, wide] of [["#10171d", 0.15], [thingColor(MARKER), 0.09]] as const) {
      brush.strokeStyle = color;
      brush.lineWidth = scale * wide;
      brush.beginPath();
      brush.arc(...this.at(marker.x, marker.z), scale * 0.3, 0, 7);
      brush.stroke();
    }
  }

  private at(x: number, z: number): [number, number] {
    const { origin } = this.sdf.map;
    return [(x - origin[0]) * this.scale, (z - origin[1]) * this.scale];
  }

  private chip(at: { x: number; z: number }, k: number, done: boolean): void {
    const { brush, scale } = this;
    const [x, y] = this.at(at.x, at.z);
    brush.globalAlpha = done ? 0.55 : 1;
    brush.fillStyle = thingColor(k);
    brush.strokeStyle = "#10171d";
    brush.lineWidth = scale * 0.04;
    brush.beginPath();
    brush.arc(x, y, scale * 0.2, 0, 7);
    brush.fill();
    brush.stroke();
    brush.fillStyle = "#10171d";
    brush.font = `700 ${Math.round(scale * 0.27)}px system-ui, sans-serif`;
    brush.textAlign = "center";
    brush.textBaseline = "middle";
    brush.fillText(done ? "✓" : thingLetter(k), x, y + scale * 0.015);
    brush.globalAlpha = 1;
  }

  /** People are round, robots square, both with a nose: the shape tells them apart without the colour. */
  private drawAgent(agent: MapAgent): void {
    const { brush, scale } = this;
    const [x, y] = this.at(agent.x, agent.z);
    brush.save();
    brush.translate(x, y);
    brush.rotate(-agent.heading);
    brush.fillStyle = agent.kind === "robot" ? ROBOT : agent.me ? YOU : OTHER;
    brush.strokeStyle = agent.me ? "#ffffff" : "#10171d";
    brush.lineWidth = scale * 0.06;
    brush.beginPath();
    if (agent.kind === "robot") brush.rect(-scale * 0.22, -scale * 0.16, scale * 0.44, scale * 0.32);
    else brush.arc(0, 0, scale * 0.22, 0, 7);
    brush.fill();
    brush.stroke();
    brush.fillStyle = brush.strokeStyle;
    brush.beginPath();
    brush.moveTo(scale * 0.4, 0);
    brush.lineTo(scale * 0.2, scale * 0.13);
    brush.lineTo(scale * 0.2, -scale * 0.13);
    brush.fill();
    brush.restore();
  }

  private drawView(me: MapAgent, yaw: number): void {
    const { brush, scale } = this;
    const [x, y] = this.at(me.x, me.z);
    const ahead = -(me.heading + yaw);
    const cone = brush.createRadialGradient(x, y, 0, x, y, scale * 2.2);
    cone.addColorStop(0, "rgba(0,114,178,0.4)");
    cone.addColorStop(1, "rgba(0,114,178,0)");
    brush.fillStyle = cone;
    brush.beginPath();
    brush.moveTo(x, y);
    brush.arc(x, y, scale * 2.2, ahead - 0.6, ahead + 0.6);
    brush.fill();
  }

  private drawPlan(width: number, height: number): HTMLCanvasElement {
    const { shape } = this.sdf.map;
    const small = document.createElement("canvas");
    [small.width, small.height] = shape;
    const brush = small.getContext("2d")!;
    const image = brush.createImageData(...shape);
    for (let i = 0; i < shape[0]; i++)
      for (let j = 0; j < shape[1]; j++) {
        const distance = this.sdf.cell(i, j);
        image.data.set(
          distance > 0 ? [...FREE, 235] : [...FURNITURE, distance > -0.45 ? 235 : 110],
          4 * (j * shape[0] + i),
        );
      }
    brush.putImageData(image, 0, 0);
    const plan = document.createElement("canvas");
    plan.width = width;
    plan.height = height;
    const fine = plan.getContext("2d")!;
    fine.imageSmoothingQuality = "high";
    fine.drawImage(small, 0, 0, width, height);
    return plan;
  }
}
