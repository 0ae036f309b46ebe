/** A questionnaire: every question by keys alone, nothing chosen beforehand. */

import { make } from "./dom.ts";
import type { Item } from "./view.ts";

/** Scales with more points than this are sliders. */
const MOST_POINTS = 11;

export interface Questions {
  node: HTMLFormElement;
  /** The answers; null, and the first open question is shown, where one is missing. */
  answers(): Record<string, number | string> | null;
}

export function questions(items: Item[], missing: string): Questions {
  const fields = items.map(field);
  const warning = make("p", { className: "warning", role: "alert" });
  const node = make("form", { noValidate: true }, ...fields.map(({ node }) => node), warning);
  node.addEventListener("submit", (event) => event.preventDefault());
  node.addEventListener("input", (event) => {
    (event.target as HTMLElement).closest(".question")?.classList.remove("open");
    if (!node.querySelector(".open")) warning.textContent = "";
  });
  return {
    node,
    answers() {
      const answers: Record<string, number | string> = {};
      let open: Field | null = null;
      for (const [k, item] of items.entries()) {
        const value = fields[k]!.value();
        const lacks = value === null || (item.required && value === "");
        fields[k]!.node.classList.toggle("open", lacks && item.required);
        if (!lacks) answers[item.id] = value;
        else if (item.required) open ??= fields[k]!;
      }
      warning.textContent = open ? missing : "";
      open?.focus();
      return open ? null : answers;
    },
  };
}

interface Field {
  node: HTMLElement;
  value(): number | string | null;
  focus(): void;
}

function field(item: Item): Field {
  if (item.kind === "text") return written(item, make("textarea", { rows: 3, maxLength: 4000 }), (text) => text);
  if (item.kind === "number") {
    const input = make("input", { type: "number", min: String(item.min), max: String(item.max), step: String(item.step) });
    const number = (text: string): number | null => {
      const value = Number(text);
      return text.trim() !== "" && value >= item.min && value <= item.max ? value : null;
    };
    return written(item, input, number);
  }
  if (item.kind === "choice") return choice(item, item.options.map((text, k) => [k, text]), false);
  const points = Math.round((item.max - item.min) / item.step) + 1;
  if (points > MOST_POINTS) return slider(item);
  return choice(item, Array.from({ length: points }, (_, k) => [item.min + k * item.step, String(item.min + k * item.step)]), true);
}

function written(
  item: Item,
  input: HTMLInputElement | HTMLTextAreaElement,
  read: (text: string) => number | string | null,
): Field {
  const node = make("label", { className: "question" }, make("span", { textContent: item.text }), input);
  return { node, value: () => read(input.value), focus: () => input.focus() };
}

function choice(item: Item, options: [number, string][], row: boolean): Field {
  const inputs = options.map(([value]) => make("input", { type: "radio", name: item.id, value: String(value) }));
  const labels = options.map(([, text], k) => make("label", {}, inputs[k]!, make("span", { textContent: text })));
  const ends = item.low || item.high;
  const node = make(
    "fieldset",
    { className: row ? "question points" : "question choices" },
    make("legend", { textContent: item.text }),
    make(
      "div",
      { className: "options" },
      row && ends && make("span", { className: "low", textContent: item.low }),
      ...labels,
      row && ends && make("span", { className: "high", textContent: item.high }),
    ),
  );
  const chosen = (): HTMLInputElement | undefined => inputs.find((input) => input.checked);
  return { node, value: () => (chosen() ? Number(chosen()!.value) : null), focus: () => inputs[0]!.focus() };
}

/** Without a mark until it is touched: a mark in the middle would be an answer. */
function slider(item: Item): Field {
  const { min, max, step } = item;
  const input = make("input", { type: "range", min: String(min), max: String(max), step: String(step), className: "unset" });
  const shown = make("output", { textContent: "–" });
  const set = (): void => {
    input.classList.remove("unset");
    input.closest(".question")?.classList.remove("open");
    shown.textContent = input.value;
  };
  for (const event of ["input", "pointerdown", "keydown"])
    input.addEventListener(event, (pressed) => {
      const key = (pressed as KeyboardEvent).key;
      if (key === undefined || !["Tab", "Shift"].includes(key)) setTimeout(set);
    });
  const node = make(
    "label",
    { className: "question slider" },
    make("span", { textContent: item.text }),
    make("span", { className: "low", textContent: item.low }),
    input,
    make("span", { className: "high", textContent: item.high }),
    shown,
  );
  return { node, value: () => (input.classList.contains("unset") ? null : Number(input.value)), focus: () => input.focus() };
}
