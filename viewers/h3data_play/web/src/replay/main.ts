/** A recording that plays from a file: its data are in the page, and nothing is loaded. */

import { Plane, Vector3, WebGLRenderer } from "three";
import { unpacked } from "../link/packed.ts";
import { World } from "../scene/world.ts";
import "../screen/base.css";
import { make } from "../study/dom.ts";
import { Charts } from "./charts.ts";
import { Clock } from "./clock.ts";
import { Controls, element } from "./controls.ts";
import { Episode, type About } from "./episode.ts";
import { Happenings } from "./happenings.ts";
import { homeFile } from "./home.ts";
import { agentColors, Marks } from "./marks.ts";
import { Payload } from "./payload.ts";
import "./replay.css";
import { CUT_M, Views } from "./views.ts";

/** A frame that comes later than this after the last one does not make the replay jump. */
const LONGEST_S = 0.25;

async function open(): Promise<void> {
  const data = element("data");
  const payload = new Payload<About>(await unpacked(data.textContent ?? ""));
  data.remove();
  const episode = new Episode(payload.about, payload);
  const world = await World.load(homeFile(payload), payload.about.stage);
  new Player(episode, world).start();
}

class Player {
  readonly clock: Clock;
  readonly views: Views;
  frames = 0;
  private readonly canvas = element<HTMLCanvasElement>("view");
  private readonly renderer: WebGLRenderer;
  private readonly marks: Marks;
  private readonly charts: Charts;
  private readonly happenings: Happenings;
  private readonly cut: Plane;
  private readonly colors: string[];
  private before = performance.now();
  private dirty = true;

  constructor(
    readonly episode: Episode,
    readonly world: World,
  ) {
    const { stage, facts } = episode.about;
    this.colors = agentColors(stage.agents.map((agent) => agent.kind));
    this.renderer = new WebGLRenderer({ canvas: this.canvas, antialias: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.cut = new Plane(new Vector3(0, -1, 0), stage.floor_y + CUT_M);
    this.clock = new Clock(episode);
    this.views = new Views(episode, world);
    this.marks = new Marks(episode, world, element("marks"), this.colors);
    this.charts = new Charts(episode, element("charts"), this.colors, (seconds) => this.clock.seek(seconds));
    element("charts").addEventListener("laid-out", () => this.charts.show(this.clock.row, this.clock.seconds));
    this.happenings = new Happenings(episode, element("events"), element<HTMLInputElement>("actions"), (row) => this.clock.toRow(row));
    element("facts").replaceChildren(
      ...Object.entries(facts).flatMap(([name, value]) => [make("dt", { textContent: name }), make("dd", { textContent: value })]),
    );
    this.clock.onChange(() => (this.dirty = true));
    new Controls(episode, this.clock, this.views, this.happenings, this.marks, () => (this.dirty = true));
    new ResizeObserver(() => this.resize()).observe(element("picture"));
    this.resize();
    Object.assign(window, { player: this });
  }

  start(): void {
    document.body.dataset.state = "ready";
    // who asks for less motion starts the replay themselves
    this.clock.play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
    this.before = performance.now();
    this.renderer.setAnimationLoop((now) => this.frame(now));
  }

  private frame(now: number): void {
    const seconds = Math.min(Math.max((now - this.before) / 1000, 0), LONGEST_S);
    this.before = now;
    this.clock.tick(seconds);
    // a camera that follows glides on for a moment
    if (this.dirty || this.clock.playing) this.draw(seconds);
  }

  private draw(seconds: number): void {
    const { clock, episode, views, world } = this;
    const { row, share } = episode.at(clock.seconds);
    this.dirty = false;
    views.update(row, share, seconds);
    world.pose(episode.state(row), episode.state(Math.min(row + 1, episode.rows - 1)), share, -1, null);
    this.renderer.clippingPlanes = views.above && !world.hasLids ? [this.cut] : [];
    const { clientWidth, clientHeight } = this.canvas;
    views.camera.updateMatrixWorld();
    this.marks.draw(row, clock.seconds, views.view.agent, views.camera, clientWidth, clientHeight);
    this.renderer.render(world.scene, views.camera);
    this.charts.show(row, clock.seconds);
    this.happenings.show(row);
    this.frames++;
  }

  private resize(): void {
    const { clientWidth, clientHeight } = element("picture");
    if (!clientWidth || !clientHeight) return;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.views.resize(clientWidth, clientHeight);
    this.dirty = true;
  }
}

open().catch((error: unknown) => {
  document.body.dataset.state = "failed";
  element("loading").textContent =
    `This replay could not be shown: ${String(error)}. It needs a browser of 2023 or later with WebGL 2.`;
});
