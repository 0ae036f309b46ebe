/** Dialogs in which things and places are chosen by name, the task is ended, a problem is reported, and a question answered. */

import type { Manifest } from "../link/manifest.ts";
import type { State } from "../link/wire.ts";
import { heard, say } from "../words.ts";
import type { Hud } from "./hud.ts";
import { thingLetter } from "./palette.ts";

export type Send = (message: Record<string, unknown>) => void;

const $ = <T extends HTMLElement>(id: string): T => document.getElementById(id) as T;
const dialog = (id: string): HTMLDialogElement => $<HTMLDialogElement>(id);
const value = (id: string): string => $<HTMLSelectElement | HTMLTextAreaElement>(id).value;

export class Deeds {
  /** For each thing what this player can do to it in place; empty: nothing. */
  uses: string[] = [];

  constructor(
    private readonly manifest: Manifest,
    private readonly send: Send,
    private readonly hud: Hud,
    signal: AbortSignal,
  ) {
    const plays = manifest.me >= 0;
    hud.show("button-do", plays && manifest.spots.length > 0);
    hud.show("button-finish", plays && manifest.asks);
    const things = manifest.objects.map((thing, k) => new Option(`${thingLetter(k)}  ${thing.label}`, String(k)));
    $("do-thing").replaceChildren(...things);
    const none = new Option(say("do_anywhere"), "");
    $("do-beside").replaceChildren(none, ...manifest.objects.map((thing, k) => new Option(`${thingLetter(k)}  ${thing.label}`, thing.name)));
    const rooms = [...new Set(manifest.spots.map((spot) => spot.room))];
    $("do-place").replaceChildren(
      ...rooms.map((room) => {
        const group = Object.assign(document.createElement("optgroup"), { label: room });
        group.append(...manifest.spots.filter((spot) => spot.room === room).map((spot) => new Option(spot.label, spot.name)));
        return group;
      }),
    );
    const on = (id: string, press: () => void): void => $(id).addEventListener("click", press, { signal });
    $("do-thing").addEventListener("change", () => this.offer(), { signal });
    on("do-take", () => this.act({ k: "pick", o: Number(value("do-thing")), lead: true }));
    on("do-use", () => this.act({ k: "use", o: Number(value("do-thing")), lead: true }));
    on("do-bring", () => this.act({ k: "bring", place: value("do-place"), next_to: value("do-beside") }));
    on("finish-done", () => this.end("finished"));
    on("finish-skip", () => this.end("skipped"));
    on("finish-problem", () => this.report());
    for (const button of $("ask").querySelectorAll("button")) button.addEventListener("click", () => this.answer(button.value), { signal });
    // a question is answered, not closed: the recording waits for it
    $("ask").addEventListener("cancel", (event) => event.preventDefault(), { signal });
    signal.addEventListener("abort", () => dialog("ask").close());
  }

  /** Opens the list of things and places; what is held, or is near, is chosen first. */
  open(thing: number): void {
    if (!this.manifest.spots.length) return;
    if (thing >= 0) $<HTMLSelectElement>("do-thing").value = String(thing);
    this.offer();
    dialog("do").showModal();
  }

  askToFinish(): void {
    $<HTMLTextAreaElement>("problem").value = "";
    dialog("finish").showModal();
  }

  ask(question: string): void {
    const texts = $("ask-heading");
    texts.textContent = heard(question);
    for (const id of ["do", "finish", "leave", "help"]) dialog(id).close();
    if (!dialog("ask").open) dialog("ask").showModal();
  }

  /** The thing that "use" means: what is held, or else the nearest one; -1: none. */
  useful(state: State, held: number, base: { x: number; z: number }, near: number): number {
    if (held >= 0) return this.uses[held] ? held : -1;
    const gaps = state.things.map((thing, k) =>
      this.uses[k] && thing.held < 0 ? Math.hypot(thing.pose[0]! - base.x, thing.pose[2]! - base.z) : Infinity,
    );
    const least = Math.min(...gaps, near);
    return least < near ? gaps.indexOf(least) : -1;
  }

  private offer(): void {
    const k = Number(value("do-thing"));
    const use = this.uses[k];
    $("do-use").hidden = !use;
    if (use) $("do-use").textContent = say(`use_${use}`, { thing: this.manifest.objects[k]!.label });
  }

  private act(message: Record<string, unknown>): void {
    dialog("do").close();
    this.send(message);
  }

  private end(why: "finished" | "skipped"): void {
    dialog("finish").close();
    this.send({ k: "end", why });
  }

  private report(): void {
    const text = value("problem").trim();
    if (!text) {
      $("problem").focus();
      return;
    }
    dialog("finish").close();
    this.send({ k: "problem", text });
    this.hud.toast(say("problem_sent"), "good");
  }

  private answer(answer: string): void {
    dialog("ask").close();
    this.send({ k: "answer", answer, text: value("ask-more").trim() });
    $<HTMLTextAreaElement>("ask-more").value = "";
  }
}
