/** Curves and lanes over time, with a cursor that goes with the replay. */

import { make } from "../study/dom.ts";
import type { Chart, Episode, Lane } from "./episode.ts";

const SVG = "http://www.w3.org/2000/svg";
const HEIGHT = 84;
const LANE_HEIGHT = 16;
const LEFT = 34;
const RIGHT = 6;
const CURVES = ["#56b4e9", "#e69f00", "#cc79a7", "#009e73"];
const DASHES = ["", "6 3", "2 3", "8 3 2 3"];
const STATES = ["#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#f0e442", "#0072b2", "#d55e00", "#999999"];
/** States of an encounter have the same colours in all replays. */
const KNOWN: Record<string, string> = { contact: "#d55e00", following: "#009e73", "too close": "#e69f00", near: "#f0e442", apart: "#566573" };

interface Panel {
  cursor: SVGElement;
  width: number;
  tell(row: number): void;
}

export class Charts {
  private panels: Panel[] = [];
  private width = 0;

  constructor(
    private readonly episode: Episode,
    private readonly host: HTMLElement,
    private readonly agentColors: string[],
    private readonly seek: (seconds: number) => void,
  ) {
    new ResizeObserver(() => this.layout()).observe(host);
  }

  /** Moves the cursors and writes the values at a state. */
  show(row: number, seconds: number): void {
    for (const panel of this.panels) {
      const x = String(this.x(seconds, panel.width));
      panel.cursor.setAttribute("x1", x);
      panel.cursor.setAttribute("x2", x);
      panel.tell(row);
    }
  }

  private x(seconds: number, width: number): number {
    return LEFT + (seconds / Math.max(this.episode.seconds, 1e-9)) * (width - LEFT - RIGHT);
  }

  private layout(): void {
    const width = Math.floor(this.host.clientWidth);
    if (width === this.width || width < 80) return;
    this.width = width;
    this.panels = [];
    const { charts, lanes } = this.episode.about;
    this.host.replaceChildren(
      ...charts.map((chart) => this.chart(chart, width)),
      ...(lanes.length ? [make("figure", {}, ...lanes.map((lane) => this.lane(lane, width)))] : []),
    );
    if (!this.host.children.length) this.host.append(make("p", { className: "note", textContent: "The recording has no values over time." }));
    this.host.dispatchEvent(new Event("laid-out"));
  }

  private chart(chart: Chart, width: number): HTMLElement {
    const tables = chart.curves.map((curve) => this.episode.payload.table(curve.array).values);
    let [low, high] = [Infinity, -Infinity];
    for (const values of tables)
      for (const value of values) {
        if (value < low) low = value;
        if (value > high) high = value;
      }
    if (!(low <= high)) [low, high] = [0, 1];
    low = Math.min(low, 0);
    high = Math.max(high, low + 1e-6, chart.stairs ? 1 : 0);
    const y = (value: number): number => HEIGHT - 14 - ((value - low) / (high - low)) * (HEIGHT - 22);
    const svg = drawing(width, HEIGHT, `${chart.title} over time, from ${said(low)} to ${said(high)} ${chart.unit}`);
    if (chart.band) {
      const [from, to] = chart.band;
      const top = y(Math.min(to, high));
      if (from < high) add(svg, "rect", { class: "band", x: LEFT, y: top, width: width - LEFT - RIGHT, height: y(from) - top });
    }
    for (const value of ticks(low, high)) {
      if (chart.stairs && !Number.isInteger(value)) continue;
      add(svg, "line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) });
      add(svg, "text", { x: LEFT - 5, y: y(value) + 4, "text-anchor": "end" }).textContent = said(value);
    }
    this.timeAxis(svg, width, HEIGHT - 2);
    tables.forEach((values, k) => {
      const color = this.color(chart, k);
      add(svg, "path", { d: this.path(values, y, width, !!chart.stairs), stroke: color, "stroke-dasharray": DASHES[k % 4]!, class: "curve" });
    });
    const values = chart.curves.map((curve, k) => {
      const readout = make("output");
      const key = make("span", { className: "key" });
      key.style.setProperty("--tone", this.color(chart, k));
      key.dataset.dash = String(k % 4);
      const one = chart.curves.length === 1 && curve.name === chart.title;
      return { readout, label: make("span", {}, key, one ? "" : `${curve.name} `, readout) };
    });
    this.listen(svg, width, (row) => {
      tables.forEach((table, k) => {
        const value = table[row]!;
        values[k]!.readout.textContent = Number.isFinite(value) ? `${said(value)} ${chart.unit}`.trim() : "none";
      });
    });
    const caption = make("figcaption", {}, make("b", { textContent: chart.title }), ...values.map((value) => value.label));
    const notes = chart.band ? make("p", { className: "note", textContent: "Shaded: 1 to 2 m, the distance for following" }) : null;
    return make("figure", {}, caption, svg as unknown as HTMLElement, notes);
  }

  private lane(lane: Lane, width: number): HTMLElement {
    const svg = drawing(width, LANE_HEIGHT + 2, `${lane.name} over time`);
    const { times, seconds } = this.episode;
    lane.runs.forEach(([row, state], k) => {
      const name = lane.states[state]!;
      if (!name) return;
      const end = lane.runs[k + 1]?.[0];
      const from = this.x(times[row]!, width);
      const to = this.x(end === undefined ? seconds : times[end]!, width);
      const box = add(svg, "rect", { x: from, y: 1, width: Math.max(to - from, 0.6), height: LANE_HEIGHT, fill: stateColor(lane, state) });
      add(box, "title", {}).textContent = name;
    });
    const now = make("output");
    const key = make("span", { className: "key block" });
    this.listen(svg, width, (row) => {
      const state = lane.runs.reduce((last, [step, value]) => (step <= row ? value : last), 0);
      now.textContent = lane.states[state] || "none";
      key.style.setProperty("--tone", lane.states[state] ? stateColor(lane, state) : "transparent");
    });
    return make("div", { className: "lane" }, make("div", {}, make("b", { textContent: lane.name }), key, now), svg as unknown as HTMLElement);
  }

  private color(chart: Chart, k: number): string {
    return chart.agents ? this.agentColors[k]! : CURVES[k % CURVES.length]!;
  }

  /** A point or two for each pixel: the least and the greatest value there. */
  private path(values: Float64Array, y: (value: number) => number, width: number, stairs: boolean): string {
    let text = "";
    let pen = false;
    const every = Math.max(1, Math.floor(values.length / (width - LEFT)));
    for (let start = 0; start < values.length; start += every) {
      let [least, most] = [start, start];
      for (let row = start; row < Math.min(start + every, values.length); row++) {
        if (values[row]! < values[least]!) least = row;
        if (values[row]! > values[most]!) most = row;
      }
      for (const row of every > 1 ? [Math.min(least, most), Math.max(least, most)] : [start]) {
        if (!Number.isFinite(values[row]!)) {
          pen = false;
          continue;
        }
        const x = this.x(this.episode.times[row]!, width).toFixed(1);
        const up = y(values[row]!).toFixed(1);
        text += pen ? (stairs ? `H${x}V${up}` : `L${x} ${up}`) : `M${x} ${up}`;
        pen = true;
      }
    }
    return text;
  }

  private timeAxis(svg: SVGElement, width: number, y: number): void {
    for (const value of ticks(0, this.episode.seconds).slice(1))
      add(svg, "text", { x: this.x(value, width), y, "text-anchor": "middle" }).textContent = `${said(value)} s`;
  }

  private listen(svg: SVGElement, width: number, tell: (row: number) => void): void {
    const cursor = add(svg, "line", { class: "cursor", y1: 0, y2: "100%" });
    this.panels.push({ cursor, width, tell });
    const go = (event: PointerEvent): void => {
      const box = svg.getBoundingClientRect();
      const place = ((event.clientX - box.left) * (width / box.width) - LEFT) / (width - LEFT - RIGHT);
      this.seek(Math.min(Math.max(place, 0), 1) * this.episode.seconds);
    };
    svg.addEventListener("pointerdown", (event) => {
      svg.setPointerCapture(event.pointerId);
      go(event);
    });
    svg.addEventListener("pointermove", (event) => event.buttons & 1 && go(event));
  }
}

function stateColor(lane: Lane, state: number): string {
  return KNOWN[lane.states[state]!] ?? STATES[state % STATES.length]!;
}

function drawing(width: number, height: number, label: string): SVGElement {
  const svg = document.createElementNS(SVG, "svg");
  for (const [name, value] of Object.entries({ width, height, viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label }))
    svg.setAttribute(name, String(value));
  return svg;
}

function add(parent: SVGElement, tag: string, attributes: Record<string, string | number>): SVGElement {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, String(value));
  parent.append(node);
  return node;
}

/** Two to five round values. */
function ticks(low: number, high: number): number[] {
  const rough = (high - low) / 4;
  const unit = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * unit).find((size) => size >= rough) ?? rough;
  const values = [];
  for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + 1e-9; value += step) values.push(Math.abs(value) < step / 1e6 ? 0 : value);
  return values;
}

function said(value: number): string {
  const text = (Math.abs(value) < 0.005 ? 0 : value).toFixed(Math.abs(value) >= 100 ? 0 : Math.abs(value) >= 10 ? 1 : 2);
  return text.includes(".") ? text.replace(/\.?0+$/, "") : text;
}
