/** Small helpers for pages that are built anew for each stage. */

type Child = Node | string | false | null | undefined;

export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Partial<HTMLElementTagNameMap[K]> = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const node = document.createElement(tag);
  Object.assign(node, properties);
  node.append(...children.filter((child): child is Node | string => child !== false && child !== null && child !== undefined));
  return node;
}

/** A button that is off while what it does is under way. */
export function button(text: string, press: () => void | Promise<void>, main = false): HTMLButtonElement {
  const node = make("button", { type: "button", textContent: text, className: main ? "main" : "" });
  node.addEventListener("click", async () => {
    node.disabled = true;
    await press();
    node.disabled = false;
  });
  return node;
}

/** Paragraphs of a text, parted by empty lines. */
export function paragraphs(text: string): HTMLElement[] {
  return text
    .split(/\n\s*\n/)
    .map((part) => part.trim())
    .filter(Boolean)
    .map((part) => make("p", { textContent: part }));
}
