/** Buttons, the scrub bar and keys. */

import { make } from "../study/dom.ts";
import type { Clock } from "./clock.ts";
import type { Episode } from "./episode.ts";
import type { Happenings } from "./happenings.ts";
import type { Marks, Overlay } from "./marks.ts";
import type { Views } from "./views.ts";

const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];
const TURN = 0.12;
const DRAG = 0.005;
const KEYS: [string, string][] = [
  ["Space", "play or pause"],
  ["← →", "one step back or forwards"],
  ["Shift + ← →", "one second back or forwards"],
  ["Home, End", "start, end"],
  ["P, N", "previous event, next event"],
  ["↑ ↓", "faster, slower"],
  ["C, Shift + C", "next camera, previous camera"],
  ["1 to 9", "a camera"],
  ["A, D, W, S", "turn and tilt the camera; or drag the picture"],
  ["+ −", "zoom; or scroll over the picture"],
  ["?", "this list"],
];

export class Controls {
  private readonly play = element<HTMLButtonElement>("play");
  private readonly scrub = element<HTMLInputElement>("scrub");
  private readonly clockText = element("clock");
  private readonly speed = element<HTMLSelectElement>("speed");
  private readonly camera = element<HTMLSelectElement>("camera");
  private readonly help = element<HTMLDialogElement>("help");

  constructor(
    private readonly episode: Episode,
    private readonly clock: Clock,
    private readonly views: Views,
    private readonly happenings: Happenings,
    marks: Marks,
    private readonly changed: () => void,
  ) {
    this.scrub.max = String(episode.rows - 1);
    this.scrub.addEventListener("input", () => clock.toRow(this.scrub.valueAsNumber));
    this.play.addEventListener("click", () => this.toggle());
    element("first").addEventListener("click", () => clock.toRow(0));
    element("last").addEventListener("click", () => clock.toRow(episode.rows - 1));
    element("back").addEventListener("click", () => clock.step(-1));
    element("forwards").addEventListener("click", () => clock.step(1));
    element("button-help").addEventListener("click", () => this.help.showModal());
    this.speed.replaceChildren(...SPEEDS.map((speed) => new Option(`${speed}×`, String(speed), speed === 1, speed === 1)));
    this.speed.addEventListener("change", () => clock.setSpeed(Number(this.speed.value)));
    this.camera.replaceChildren(...views.list.map((view, k) => new Option(view.label, String(k))));
    this.camera.addEventListener("change", () => this.look(Number(this.camera.value)));
    for (const overlay of Object.keys(marks.shown) as Overlay[]) {
      const box = element<HTMLInputElement>(`show-${overlay}`);
      box.checked = marks.shown[overlay];
      box.parentElement!.hidden = overlay === "scans" && !episode.about.scans.length;
      box.addEventListener("change", () => {
        marks.shown[overlay] = box.checked;
        changed();
      });
    }
    element("keys").replaceChildren(
      ...KEYS.flatMap(([keys, what]) => [make("dt", {}, make("kbd", { textContent: keys })), make("dd", { textContent: what })]),
    );
    this.drawTicks();
    this.listenToPicture();
    addEventListener("keydown", (event) => this.key(event));
    clock.onChange(() => this.show());
    this.show();
  }

  private look(view: number): void {
    this.views.choose(view);
    this.camera.value = String(this.views.current);
    this.changed();
  }

  private toggle(): void {
    this.clock.play(!this.clock.playing);
  }

  private show(): void {
    const { clock, episode } = this;
    const row = clock.row;
    this.scrub.value = String(row);
    const text = `${clock.seconds.toFixed(1)} s of ${episode.seconds.toFixed(1)} s`;
    this.scrub.setAttribute("aria-valuetext", `${text}, step ${episode.steps[row]}`);
    this.clockText.textContent = `${clock.seconds.toFixed(1)} / ${episode.seconds.toFixed(1)} s · step ${episode.steps[row]}`;
    const label = clock.playing ? "Pause" : clock.atEnd ? "Play again" : "Play";
    if (this.play.getAttribute("aria-label") !== label) {
      this.play.setAttribute("aria-label", label);
      this.play.title = `${label} (Space)`;
      this.play.dataset.playing = String(clock.playing);
    }
  }

  private drawTicks(): void {
    element("ticks").replaceChildren(
      ...this.happenings.places().map(({ at, kind }) => {
        const tick = make("i");
        tick.dataset.kind = kind;
        tick.style.left = `${100 * at}%`;
        return tick;
      }),
    );
  }

  private listenToPicture(): void {
    const view = element("view");
    view.addEventListener("pointerdown", (event) => view.setPointerCapture(event.pointerId));
    view.addEventListener("pointermove", (event) => {
      if (!(event.buttons & 1)) return;
      this.views.look(-event.movementX * DRAG, -event.movementY * DRAG);
      this.changed();
    });
    view.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.views.zoom(Math.exp(event.deltaY * 0.001));
        this.changed();
      },
      { passive: false },
    );
  }

  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey || this.help.open) return;
    const target = event.target as HTMLElement;
    if (target instanceof HTMLSelectElement) return;
    const pressed = target instanceof HTMLButtonElement || (target instanceof HTMLInputElement && target.type === "checkbox");
    if (event.key === " " && pressed) return;
    if (this.act(event.key, event.shiftKey)) {
      event.preventDefault();
      this.changed();
    }
  }

  /** Does what a key says; false: nothing. */
  private act(key: string, shift: boolean): boolean {
    const { clock, views } = this;
    const actions: Record<string, () => void> = {
      " ": () => this.toggle(),
      ArrowLeft: () => (shift ? clock.seek(clock.seconds - 1) : clock.step(-1)),
      ArrowRight: () => (shift ? clock.seek(clock.seconds + 1) : clock.step(1)),
      ArrowUp: () => this.faster(1),
      ArrowDown: () => this.faster(-1),
      Home: () => clock.toRow(0),
      End: () => clock.toRow(this.episode.rows - 1),
      n: () => this.jump(true),
      p: () => this.jump(false),
      c: () => this.look(views.current + (shift ? -1 : 1)),
      a: () => views.look(TURN, 0),
      d: () => views.look(-TURN, 0),
      w: () => views.look(0, TURN),
      s: () => views.look(0, -TURN),
      "+": () => views.zoom(0.9),
      "=": () => views.zoom(0.9),
      "-": () => views.zoom(1.1),
      "?": () => this.help.showModal(),
    };
    const number = Number(key);
    if (number >= 1 && number <= views.list.length) this.look(number - 1);
    else {
      const action = actions[key.length === 1 ? key.toLowerCase() : key];
      if (!action) return false;
      action();
    }
    return true;
  }

  private faster(by: number): void {
    const at = SPEEDS.indexOf(this.clock.speed);
    const speed = SPEEDS[Math.min(Math.max(at + by, 0), SPEEDS.length - 1)]!;
    this.speed.value = String(speed);
    this.clock.setSpeed(speed);
  }

  private jump(forwards: boolean): void {
    const row = this.happenings.next(this.clock.row, forwards);
    if (row !== null) this.clock.toRow(row);
  }
}

export function element<T extends HTMLElement = HTMLElement>(id: string): T {
  return document.getElementById(id) as T;
}
