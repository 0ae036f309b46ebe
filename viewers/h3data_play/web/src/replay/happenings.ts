/** The list of what happens; a click goes there. */

import { make } from "../study/dom.ts";
import type { Episode, EventKind, Happening } from "./episode.ts";

/** With more events than this, actions are hidden until they are asked for. */
const MANY = 40;
const SIGNS: Record<EventKind, string> = { event: "•", good: "✓", bad: "▲", skill: "▸", "skill-bad": "✕" };

export class Happenings {
  private readonly items: { happening: Happening; item: HTMLLIElement; button: HTMLButtonElement }[];
  private now: HTMLButtonElement | null = null;

  constructor(
    private readonly episode: Episode,
    private readonly list: HTMLElement,
    actions: HTMLInputElement,
    seek: (row: number) => void,
  ) {
    this.items = episode.about.events.map((happening) => {
      const button = make("button", { type: "button" });
      button.append(
        make("span", { className: "sign", textContent: SIGNS[happening.kind] }),
        make("time", { textContent: `${episode.times[happening.step]!.toFixed(1)} s` }),
        make("span", { textContent: happening.text }),
      );
      button.addEventListener("click", () => seek(happening.step));
      const item = make("li", {}, button);
      item.dataset.kind = happening.kind;
      return { happening, item, button };
    });
    const skills = this.items.filter(({ happening }) => isAction(happening)).length;
    actions.checked = this.items.length <= MANY || skills === this.items.length;
    actions.parentElement!.hidden = skills === 0;
    const apply = (): void => {
      for (const { happening, item } of this.items) item.hidden = isAction(happening) && !actions.checked;
    };
    actions.addEventListener("change", apply);
    apply();
    list.replaceChildren(...this.items.map(({ item }) => item));
    if (!this.items.length) list.replaceChildren(make("li", { className: "none", textContent: "The recording has no events." }));
  }

  /** Marks the latest event. */
  show(row: number): void {
    let latest: HTMLButtonElement | null = null;
    for (const { happening, item, button } of this.items) {
      if (happening.step > row) break;
      if (!item.hidden) latest = button;
    }
    if (latest === this.now) return;
    this.now?.removeAttribute("aria-current");
    latest?.setAttribute("aria-current", "true");
    this.now = latest;
    if (latest && !this.list.contains(document.activeElement))
      this.list.scrollTop = latest.offsetTop - this.list.offsetTop - this.list.clientHeight / 2;
  }

  /** The step of the next event that is listed, or of the one before. */
  next(row: number, forwards: boolean): number | null {
    const steps = this.items.filter(({ item }) => !item.hidden).map(({ happening }) => happening.step);
    const found = forwards ? steps.find((step) => step > row) : steps.filter((step) => step < row).pop();
    return found ?? null;
  }

  /** Places of events along the scrub bar, 0 to 1. */
  places(): { at: number; kind: EventKind }[] {
    const { times, seconds } = this.episode;
    return this.episode.about.events
      .filter((happening) => !isAction(happening))
      .map(({ step, kind }) => ({ at: times[step]! / Math.max(seconds, 1e-9), kind }));
  }
}

function isAction(happening: Happening): boolean {
  return happening.kind.startsWith("skill");
}
