/** The words of the page. English is built in; a study sends those of the participant's language. */

/** Those of `texts/en.json`, put here by the build. */
declare const ENGLISH: Record<string, string>;

let words: Record<string, string> = typeof ENGLISH === "undefined" ? {} : ENGLISH;
/** What the server says in English, as an expression, and in the participant's language; the longest first. */
let sentences: [RegExp, string][] = [];
let things: Record<string, string> = {};

/** From now on the page says other words, where there are some: its own as `live_NAME`, sentences of the server as `said.TEXT`,
 * words for things as `things.TEXT`. */
export function speak(others: Record<string, string>): void {
  const part = (prefix: string): Record<string, string> =>
    Object.fromEntries(Object.entries(others).flatMap(([key, text]) => (key.startsWith(prefix) ? [[key.slice(prefix.length), text]] : [])));
  words = { ...words, ...part("live_") };
  things = part("things.");
  sentences = Object.entries(part("said."))
    .sort(([a], [b]) => b.length - a.length)
    .map(([english, text]) => [new RegExp(`^${english.split("{}").map(literally).join("(.+?)")}$`), text]);
  fillIn(document);
}

const literally = (text: string): string => text.replace(/[.*+?^${}()|[\]\\]/g, "\\$&");

/** What the server has said, in the participant's language; as it is where nobody has translated it. */
export function heard(text: string): string {
  if (things[text]) return things[text];
  for (const [english, ours] of sentences) {
    const found = english.exec(text)?.slice(1).map(heard);
    if (found) return found.reduce((line, value) => line.replace("{}", value), ours);
  }
  return text;
}

/** A text with its values filled in. */
export function say(name: string, values: Record<string, unknown> = {}): string {
  return Object.entries(values).reduce((text, [key, value]) => text.replace(`{${key}}`, String(value)), words[name] ?? name);
}

/** Writes the words that the page's own elements name. */
export function fillIn(root: ParentNode): void {
  for (const node of root.querySelectorAll<HTMLElement>("[data-say]")) node.textContent = say(node.dataset.say!);
  for (const node of root.querySelectorAll<HTMLElement>("[data-title]")) node.title = say(node.dataset.title!);
  for (const node of root.querySelectorAll<HTMLElement>("[data-label]")) node.ariaLabel = say(node.dataset.label!);
}
