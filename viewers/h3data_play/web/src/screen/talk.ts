/** What agents say to each other: a log, bubbles over their heads, a box for one's own words and ready-made messages. */

import { called, type Manifest } from "../link/manifest.ts";
import { heard, say } from "../words.ts";

/** A message that this player has said or heard, in the order of the recording. */
export interface Said {
  /** Its number among all messages of the episode. */
  n: number;
  agent: number;
  /** Who it is for; empty: all. */
  to: string;
  text: string;
  /** Whether these are somebody's own words, which nobody translates. */
  own: boolean;
}

/** A bubble stays for this long, and longer for long texts, ms. */
const BUBBLE_MS = 5000;
const LETTER_MS = 60;

const $ = <T extends HTMLElement>(id: string): T => document.getElementById(id) as T;

export class Talk {
  /** The last message of each agent, and until when it is shown over their head. */
  readonly bubbles = new Map<number, { text: string; until: number }>();
  private readonly words = $<HTMLInputElement>("words");
  private last = -1;

  constructor(
    private readonly manifest: Manifest,
    private readonly send: (text: string) => void,
    signal: AbortSignal,
  ) {
    const { phrases } = manifest;
    const plays = manifest.me >= 0;
    $("log").replaceChildren();
    this.show(phrases.length > 0 && innerWidth > 900);
    $("button-talk").hidden = !phrases.length;
    $("talk-form").hidden = !plays;
    const first = new Option(say("phrases"), "");
    $("phrases").replaceChildren(first, ...phrases.map(({ label, text }) => new Option(label, text)));
    $("phrases").addEventListener("change", () => this.phrase(), { signal });
    $("talk-form").addEventListener("submit", (event) => this.submit(event), { signal });
    this.words.addEventListener("keydown", (event) => this.key(event), { signal });
  }

  get shown(): boolean {
    return !$("talk").hidden;
  }

  /** Opens the box and puts the focus there, or closes it. */
  toggle(open = !this.shown): void {
    this.show(open);
    if (open) this.words.focus();
    else $("view").focus({ preventScroll: true });
  }

  /** Notes messages; after a lost connection some come again. */
  hear(said: Said[]): void {
    for (const { n, agent, to, text, own } of said) {
      if (n <= this.last) continue;
      this.last = n;
      const words = own ? text : heard(text);
      this.bubbles.set(agent, { text: words, until: performance.now() + Math.max(BUBBLE_MS, words.length * LETTER_MS) });
      const row = document.createElement("li");
      const name = document.createElement("b");
      // as text: nobody's markup is run
      const other = this.manifest.agents.findIndex((one) => one.name === to);
      name.textContent = other < 0 ? this.name(agent) : say("to_name", { name: this.name(agent), other: this.name(other) });
      row.append(name, ` ${words}`);
      $("log").append(row);
      $("log").scrollTop = $("log").scrollHeight;
      if (agent !== this.manifest.me && !this.shown) $("button-talk").dataset.news = "";
    }
  }

  private name(agent: number): string {
    return called(this.manifest, agent);
  }

  private show(open: boolean): void {
    $("talk").hidden = !open;
    $("button-talk").setAttribute("aria-pressed", String(open));
    if (open) delete $("button-talk").dataset.news;
  }

  private phrase(): void {
    const choice = $<HTMLSelectElement>("phrases");
    if (choice.value) this.send(choice.value);
    choice.selectedIndex = 0;
    $("view").focus({ preventScroll: true });
  }

  private submit(event: Event): void {
    event.preventDefault();
    const text = this.words.value.trim();
    if (text) this.send(text);
    this.words.value = "";
    $("view").focus({ preventScroll: true });
  }

  private key(event: KeyboardEvent): void {
    if (event.code === "Escape") this.toggle(false);
  }
}
