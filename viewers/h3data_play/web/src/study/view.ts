/** What the server of a study says: where the participant is. */

export interface View {
  title: string;
  contact: string;
  language: string;
  languages: string[];
  participant: string | null;
  progress: { done: number; of: number };
  words: Record<string, string>;
  stage: Stage;
}

export interface Item {
  id: string;
  kind: "scale" | "choice" | "text" | "number";
  text: string;
  low: string;
  high: string;
  min: number;
  max: number;
  step: number;
  options: string[];
  required: boolean;
}

export type Stage =
  | { kind: "consent"; about: string; text: string; facts: string[]; version: string; hash: string }
  | { kind: "device"; again: string }
  | { kind: "tutorial"; attempt: number; of: number; text: string }
  | { kind: "episode"; block: number; blocks: number; trial: number; trials: number; text: string }
  | { kind: "form"; block: number; trial: number; form: string; again: string; heading: string; text: string; items: Item[] }
  | { kind: "end"; status: string; reason: string; heading: string; text: string; code: string; url: string };

/** A text of the page, with its numbers filled in. */
export function word(view: View, name: string, values: Record<string, unknown> = {}): string {
  return Object.entries(values).reduce((text, [key, value]) => text.replace(`{${key}}`, String(value)), view.words[name] ?? name);
}
