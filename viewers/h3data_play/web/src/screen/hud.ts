/** What is said to the player: task, time, reasons, hints, covers. All of it is DOM, so that it can be read aloud and zoomed. */

import { FLAG } from "../link/wire.ts";
import { actKeys, choreText, type Chore } from "../player/actions.ts";
import { fillIn, say } from "../words.ts";
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

/** What there is in a home: things to carry, doors and drawers, a robot to give things to, places by name, others to talk to. */
interface Offers {
  things: boolean;
  joints: boolean;
  /** Whether the player is a person, not a robot. */
  person: boolean;
  /** Names of the motions that the person can perform. */
  acts: string[];
  robot: boolean;
  places: boolean;
  talk: boolean;
  /** Whether the person brought things along, such as a tray. */
  chores: boolean;
}

/** What the help lists: keys, and the name of the words that say what they do. */
const KEYS: [string[], string][] = [
  [["W", "A", "S", "D"], "walk"], [["Shift"], "slow"], [["E"], "act"], [["F"], "goto"], [["O"], "turn"], [["Q"], "drop"],
  [["G"], "give"], [["C"], "sit"], [["L"], "lie"], [["X"], "wave"], [["P"], "phone"], [["K"], "chore"], [["R"], "use"], [["B"], "do"], [["T"], "talk"], [["V"], "view"], [["Esc"], "stop"], [["M"], "map"], [["N"], "sound"], [["H"], "help"],
];
/** After so long a live region that was emptied is read again, even where it says the same, ms. */
const REPEAT_MS = 60;
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
  private saidTimer = 0;
  private how: Record<string, string> = {};
  private left: { seconds: number; at: number } | null = null;
  private lastTodo = "";
  private hinted = "";

  constructor() {
    fillIn(document);
    // who has no mouse is told of taps from the beginning
    this.device(matchMedia("(pointer: coarse)").matches ? "touch" : "keys");
  }

  /** What there is to do in this home. */
  offers({ things, joints, person, acts, robot, places, talk, chores }: Offers): void {
    document.body.toggleAttribute("data-hands", things || joints);
    const there: Record<string, boolean> = {
      act: things, goto: things, turn: joints, drop: things && person, give: things && person && robot,
      sit: person, lie: person, wave: person, phone: person, chore: chores, use: places, do: places, talk,
    };
    const rows = KEYS.filter(([, name]) => there[name] ?? true).map(([keys, name]): [string[], string] => [keys, say(`help_${name}`)]);
    const own = actKeys(acts).map(([digit, name]): [string[], string] => [[digit], say("help_perform", { name })]);
    $("keys").replaceChildren(
      ...[...rows, ...own].flatMap(([keys, text]) => {
        const term = document.createElement("dt");
        term.append(...keys.map(key));
        return [term, Object.assign(document.createElement("dd"), { textContent: text })];
      }),
    );
    const told = ["help_pointing", things && "help_things", things && person && "help_places", joints && "help_joints"];
    setText($("help-text"), told.filter((name) => name !== false).map((name) => say(name)).join(" "));
    setText($("help-touch"), [say("help_stick"), things || joints ? say("help_thumbs") : "", person ? say("help_postures") : "", chores ? say("help_chores") : "", acts.length ? say("help_acts") : ""].filter(Boolean).join(" "));
  }

  on(button: string, press: () => void, signal: AbortSignal): void {
    $(button).addEventListener("click", press, { signal });
  }

  show(button: string, shown: boolean): void {
    $(button).hidden = !shown;
  }

  phase(phase: Phase, title = "", text = "", button = "", press?: () => void): void {
    document.body.dataset.state = phase;
    if (phase !== "loading" && phase !== "playing") this.announce(`${title}. ${text}`);
    setText($("cover-title"), title);
    setText($("cover-text"), text);
    const action = $<HTMLButtonElement>("cover-button");
    action.hidden = !button;
    action.textContent = button;
    action.onclick = press ?? null;
    if (button) action.focus();
    else if (phase === "playing") this.canvas.focus({ preventScroll: true });
  }

  /** What is to be done, more of it in lines, how long there is for it [s], and how it is done by what the player acts with, in
   * place of the page's own hints. */
  task(text: string, lines: string[], left: number | null, how: Record<string, string> = {}): void {
    this.how = how;
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
    setText($("timer"), this.left ? say("left", { time: clock(this.left.seconds - gone) }) : clock(seconds));
  }

  link(rttMs: number, statesPerSecond: number): void {
    const quality = rttMs > 250 || statesPerSecond < 15 ? "poor" : rttMs > 120 || statesPerSecond < 25 ? "fair" : "good";
    $("link").dataset.quality = quality;
    setText($("link"), `${rttMs.toFixed(0)} ms`);
  }

  /** A reason or a result, in a sentence. */
  toast(text: string, tone: "good" | "plain" = "plain"): void {
    const toast = $("toast");
    toast.dataset.tone = tone;
    toast.textContent = text;
    this.announce(text);
    clearTimeout(this.toastTimer);
    this.toastTimer = window.setTimeout(() => (toast.textContent = ""), Math.max(TOAST_MS, text.length * 75));
  }

  /** Lets screen readers say a text, which need a region that is there all the time. */
  announce(text: string): void {
    const said = $("said");
    said.textContent = "";
    clearTimeout(this.saidTimer);
    this.saidTimer = window.setTimeout(() => (said.textContent = text), REPEAT_MS);
  }

  /** What could be done now: pairs of a key or button and what it does; what the app says of it comes first. */
  hint(parts: [string, string][], device: string): void {
    const told = this.how[device];
    const shown: [string, string][] = told ? [["", told]] : parts;
    const now = JSON.stringify(shown);
    if (now === this.hinted) return;
    this.hinted = now;
    $("hint").replaceChildren(
      ...shown.flatMap(([name, text], k) => [...(k ? [" · "] : []), ...(name ? [key(name)] : []), ` ${text}`]),
    );
  }

  /** Buttons for the motions that the person can perform. */
  acts(names: string[], press: (number: number) => void): void {
    $("acts").replaceChildren(
      ...actKeys(names).map(([digit, name]) => {
        const button = Object.assign(document.createElement("button"), { type: "button", textContent: name });
        button.addEventListener("click", () => press(Number(digit)));
        return button;
      }),
    );
  }

  /** Buttons for postures and chores, for fingers: those that are possible now. */
  postures(flags: number, chores: Chore[]): void {
    const { sits, lies, seated, gestures } = FLAG;
    for (const [name, shown] of [["sit", sits | seated], ["lie", lies], ["wave", gestures], ["phone", gestures]] as const)
      this.show(`posture-${name}`, (flags & shown) !== 0);
    this.show("acts", (flags & gestures) !== 0 && $("acts").childElementCount > 0);
    const chore = chores.find(({ name }) => name !== "phone");
    this.show("posture-chore", chore !== undefined);
    if (chore) setText($("posture-chore"), choreText(chore));
    if (chores.some(({ name }) => name === "phone")) this.show("posture-phone", true);
    setText($("posture-sit"), say(flags & seated ? "posture_rise" : "posture_sit"));
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
    if (!this.playing && !$("cover-button").hidden) cover.push(say("vr_trigger", { button: $("cover-button").textContent }));
    if (!this.playing) return cover.filter(Boolean);
    return [$("title").textContent!, this.how.headset ?? "", ...todo, $("toast").textContent!].filter(Boolean);
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
