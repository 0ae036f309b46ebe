/** What is said to the player: task, time, reasons, hints, covers. All of it is DOM, so that it can be read aloud and zoomed. */

import { setText } from "./markers.ts";
import { thingColor, thingLetter } from "./palette.ts";

export type Phase = "loading" | "playing" | "lost" | "paused" | "over" | "refused" | "study";

export interface TodoItem {
  /** Index of the thing: its letter and colour. */
  thing: number;
  name: string;
  state: string;
  done: boolean;
}

const KEYS: [string[], string][] = [
  [["W", "A", "S", "D"], "walk and turn (or the arrow keys)"],
  [["Shift"], "slowly"],
  [["E"], "take what is near, put down what you hold"],
  [["F"], "walk to the next thing and take it, or to its place and put it there"],
  [["O"], "open or close the nearest door or drawer"],
  [["Q"], "drop what you hold"],
  [["G"], "give it to the robot"],
  [["V"], "over the shoulder, or through your own eyes"],
  [["Esc"], "stop walking there"],
  [["M"], "map"],
  [["N"], "sound"],
  [["H"], "this help"],
];
const TOAST_MS = 4200;

const $ = <T extends HTMLElement = HTMLElement>(id: string): T => document.getElementById(id) as T;

export class Hud {
  readonly canvas = $<HTMLCanvasElement>("view");
  readonly map = $<HTMLCanvasElement>("map");
  readonly marks = $("marks");
  readonly ring = $("stick");
  readonly knob = $("knob");
  private readonly help = $<HTMLDialogElement>("help");
  private toastTimer = 0;
  private left: { seconds: number; at: number } | null = null;
  private lastTodo = "";
  private hinted = "";

  constructor() {
    for (const [keys, text] of KEYS) {
      const term = document.createElement("dt");
      term.append(...keys.map(key));
      const what = document.createElement("dd");
      what.textContent = text;
      $("keys").append(term, what);
    }
  }

  on(button: string, press: () => void, signal: AbortSignal): void {
    $(button).addEventListener("click", press, { signal });
  }

  show(button: string, shown: boolean): void {
    $(button).hidden = !shown;
  }

  phase(phase: Phase, title = "", text = "", button = "", press?: () => void): void {
    document.body.dataset.state = phase;
    setText($("cover-title"), title);
    setText($("cover-text"), text);
    const action = $<HTMLButtonElement>("cover-button");
    action.hidden = !button;
    action.textContent = button;
    action.onclick = press ?? null;
    if (button) action.focus();
    else if (phase === "playing") this.canvas.focus({ preventScroll: true });
  }

  /** What is to be done, more of it in lines, and how long there is for it [s]. */
  task(text: string, lines: string[], left: number | null): void {
    setText($("title"), text);
    if ($("lines").textContent !== lines.join(""))
      $("lines").replaceChildren(...lines.map((line) => Object.assign(document.createElement("p"), { textContent: line })));
    this.left = left === null ? null : { seconds: left, at: performance.now() };
  }

  /** Only changes are written: the region is read aloud when it changes. */
  todo(items: TodoItem[]): void {
    const now = JSON.stringify(items);
    if (now === this.lastTodo) return;
    this.lastTodo = now;
    $("todo").replaceChildren(
      ...items.map((item) => {
        const row = document.createElement("li");
        row.classList.toggle("done", item.done);
        row.append(chip(item.thing, item.done), span("name", item.name), span("state", item.state));
        return row;
      }),
    );
  }

  /** Time that has passed, or that is left where there is a limit. */
  time(seconds: number): void {
    const gone = this.left && document.body.dataset.state === "playing" ? (performance.now() - this.left.at) / 1000 : 0;
    setText($("timer"), this.left ? `${clock(this.left.seconds - gone)} left` : clock(seconds));
  }

  link(rttMs: number, statesPerSecond: number): void {
    const quality = rttMs > 250 || statesPerSecond < 15 ? "poor" : rttMs > 120 || statesPerSecond < 25 ? "fair" : "good";
    $("link").dataset.quality = quality;
    setText($("link"), `${rttMs.toFixed(0)} ms`);
  }

  /** A reason or a result, in a sentence. */
  toast(text: string, tone: "good" | "plain" = "plain"): void {
    const toast = $("toast");
    toast.textContent = "";
    toast.dataset.tone = tone;
    toast.textContent = text;
    clearTimeout(this.toastTimer);
    this.toastTimer = window.setTimeout(() => (toast.textContent = ""), Math.max(TOAST_MS, text.length * 75));
  }

  /** What could be done now: pairs of a key and what it does. */
  hint(parts: [string, string][]): void {
    const now = JSON.stringify(parts);
    if (now === this.hinted) return;
    this.hinted = now;
    $("hint").replaceChildren(
      ...parts.flatMap(([name, text], k) => [...(k ? [" · "] : []), ...(name ? [key(name)] : []), ` ${text}`]),
    );
  }

  thumb(act: string, go: string): void {
    setText($("thumb-act"), act);
    setText($("thumb-goto"), go);
  }

  pressed(button: string, on: boolean): void {
    $(button).setAttribute("aria-pressed", String(on));
  }

  toggleMap(): void {
    this.pressed("button-map", !document.body.classList.toggle("no-map"));
  }

  /** Presses the button of a cover, if it has one. */
  pressCover(): void {
    if (!$("cover-button").hidden) $("cover-button").click();
  }

  /** What the page says, for a headset. */
  words(): string[] {
    const rows = [...document.querySelectorAll("#todo li")].map((row) => [...row.children].map((cell) => cell.textContent));
    const todo = rows.map(([letter, name, state]) => `${letter}  ${name}: ${state}`);
    const cover = this.playing ? [] : [$("cover-title"), $("cover-text")].map((node) => node.textContent!);
    if (!this.playing && !$("cover-button").hidden) cover.push(`Trigger: ${$("cover-button").textContent}`);
    if (!this.playing) return cover.filter(Boolean);
    return [$("title").textContent!, ...todo, $("toast").textContent!].filter(Boolean);
  }

  get playing(): boolean {
    return document.body.dataset.state === "playing";
  }

  /** Other words for the dialog that asks before leaving. */
  leaveWords(button: string, title: string, text: string, stay: string): void {
    setText($("button-leave"), button);
    setText($("leave-title"), title);
    setText($("leave").querySelector("p")!, text);
    const [back, out] = $("leave").querySelectorAll("button");
    setText(back!, stay);
    setText(out!, button);
  }

  /** Asks before what cannot be taken back. */
  askToLeave(leave: () => void): void {
    const dialog = $<HTMLDialogElement>("leave");
    dialog.onclose = () => dialog.returnValue === "leave" && leave();
    dialog.returnValue = "";
    dialog.showModal();
  }

  toggleHelp(): void {
    if (this.help.open) this.help.close();
    else this.help.showModal();
  }

  device(device: string): void {
    if (document.body.dataset.device !== device) document.body.dataset.device = device;
  }

  view(view: string): void {
    document.body.dataset.view = view;
  }
}

function clock(seconds: number): string {
  const whole = Math.max(0, Math.floor(seconds));
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

function key(name: string): HTMLElement {
  const node = document.createElement("kbd");
  node.textContent = name;
  return node;
}

function span(name: string, text: string): HTMLElement {
  const node = document.createElement("span");
  node.className = name;
  node.textContent = text;
  return node;
}

function chip(thing: number, done: boolean): HTMLElement {
  const node = span("chip", done ? "✓" : thingLetter(thing));
  node.style.setProperty("--tone", thingColor(thing));
  return node;
}
