/** The pages of a study: the server says where the participant is, a page shows it, what they do is sent, and so on to the end.
 * A reload asks the server again and shows the same page. */

import { post, Refused } from "../link/flow.ts";
import type { Hud } from "../screen/hud.ts";
import { play } from "../session.ts";
import { say, speak } from "../words.ts";
import { deviceReport } from "./device.ts";
import { button, make, paragraphs } from "./dom.ts";
import { logFocus } from "./focus.ts";
import { questions } from "./form.ts";
import { word, type Stage, type View } from "./view.ts";

const IDS = ["PROLIFIC_PID", "STUDY_ID", "SESSION_ID"];
const SETTLED_MS = 600;
const page = document.getElementById("study")!;

/** Leads through the study. */
export async function takePart(hud: Hud): Promise<void> {
  const study = new Study(hud);
  const rejoin = new URLSearchParams(location.search).get("rejoin") ?? "";
  await study.ask("api/study", { ids: study.ids, rejoin });
}

/** The episode that a page is about: the server refuses what comes from an old tab. */
interface Asked {
  block: number;
  trial?: number;
}

/** Ids and codes of the link leave the address bar once they are no longer needed. */
function cleanAddress(): void {
  const query = new URLSearchParams(location.search);
  const before = query.size;
  for (const name of [...IDS, "rejoin"]) query.delete(name);
  if (query.size !== before) history.replaceState(null, "", `${location.pathname}${query.size ? `?${query}` : ""}`);
}

class Study {
  readonly ids: Record<string, string> = {};
  private view: View | null = null;
  /** Ends the wait for a larger window. */
  private turned: AbortController | null = null;

  constructor(private readonly hud: Hud) {
    const query = new URLSearchParams(location.search);
    for (const name of IDS) if (query.get(name)) this.ids[name] = query.get(name)!;
  }

  /** Sends something and shows what comes next; what the server refuses is said above the page. */
  async ask(path: string, body: unknown): Promise<void> {
    try {
      this.show((await post(path, body)) as unknown as View);
    } catch (error) {
      this.complain(error instanceof Refused ? error.message : say("unreachable"));
      if (!this.view) throw error;
    }
  }

  private complain(text: string): void {
    page.hidden = false;
    document.body.dataset.state = "study";
    page.querySelector(".refused")?.remove();
    const again = button(say("try_again"), () => location.reload());
    page.prepend(make("div", { className: "card refused", role: "alert" }, make("p", { textContent: text }), again));
    page.scrollTop = 0;
  }

  private show(view: View): void {
    this.view = view;
    this.turned?.abort();
    if (view.participant && view.stage.kind !== "device") cleanAddress();
    if (view.participant && view.stage.kind !== "end") logFocus();
    speak(view.words);
    document.title = view.title;
    document.documentElement.lang = view.language;
    document.body.dataset.state = "study";
    page.hidden = false;
    const { done, of } = view.progress;
    const head = make("header", {}, make("p", { className: "study-title", textContent: view.title }));
    if (of) {
      const bar = make("progress", { max: of, value: done });
      bar.setAttribute("aria-label", word(view, "progress", { done, of }));
      head.append(bar);
    }
    const body = make("section", { className: "card" }, ...this.stage(view, view.stage));
    body.dataset.stage = view.stage.kind;
    page.replaceChildren(head, body, this.foot(view));
    page.scrollTop = 0;
    const heading = body.querySelector("h1");
    if (heading) Object.assign(heading, { tabIndex: -1 }).focus();
  }

  private stage(view: View, stage: Stage): (Node | string)[] {
    switch (stage.kind) {
      case "consent":
        return this.consent(view, stage);
      case "device":
        return this.device(view, stage.again);
      case "tutorial":
        return [title(word(view, "tutorial_title")), ...paragraphs(stage.text), this.playButton(view, { block: 0 })];
      case "episode": {
        const { block, blocks, trial, trials } = stage;
        const part = word(view, "block_title", { block, blocks });
        const above = make("p", { className: "above", textContent: part });
        return [above, title(word(view, "episode_title", { trial, trials })), ...paragraphs(stage.text), this.playButton(view, { block, trial })];
      }
      case "form":
        return this.form(view, stage);
      case "end":
        return this.end(view, stage);
    }
  }

  private consent(view: View, stage: Extract<Stage, { kind: "consent" }>): Node[] {
    const { language } = view;
    const reply = (accept: boolean) => async (): Promise<void> => {
      await this.ask("api/study/consent", { accept, hash: stage.hash, ids: this.ids, language });
    };
    const nodes: Node[] = [title(view.title), ...paragraphs(stage.about)];
    if (view.languages.length > 1) nodes.push(this.languages(view));
    const text = make("div", { className: "consent", tabIndex: 0 }, ...paragraphs(stage.text));
    text.setAttribute("role", "document");
    nodes.push(text, make("ul", {}, ...stage.facts.map((fact) => make("li", { textContent: fact }))));
    const actions = [button(word(view, "agree"), reply(true), true), button(word(view, "decline"), reply(false))];
    return [...nodes, make("p", { className: "actions" }, ...actions)];
  }

  /** Checks the computer; where the window was too small, once it has another size or somebody asks for it. */
  private device(view: View, again: string): Node[] {
    const check = async (final = false): Promise<void> => {
      await this.ask("api/study/device", { ...(await deviceReport()), final });
    };
    const nodes: Node[] = [title(word(view, "device_title"))];
    if (!again) {
      void check();
      return [...nodes, make("p", { textContent: word(view, "device") })];
    }
    this.turned = new AbortController();
    const { signal } = this.turned;
    let settled = 0;
    addEventListener("resize", () => {
      clearTimeout(settled);
      settled = setTimeout(() => void (signal.aborted || check()), SETTLED_MS);
    }, { signal });
    const actions = [
      button(word(view, "try_again"), () => check(), true),
      button(word(view, "cannot_enlarge"), () => check(true)),
    ];
    return [...nodes, make("p", { textContent: again }), make("p", { className: "actions" }, ...actions)];
  }

  private languages(view: View): Node {
    const names = new Intl.DisplayNames([view.language], { type: "language" });
    const options = view.languages.map((code) => {
      const option = make("option", { value: code, textContent: names.of(code) ?? code });
      option.selected = code === view.language;
      return option;
    });
    const select = make("select", {}, ...options);
    select.addEventListener("change", () => void this.ask("api/study", { ids: this.ids, language: select.value }));
    return make("label", { className: "language" }, word(view, "language"), " ", select);
  }

  private form(view: View, stage: Extract<Stage, { kind: "form" }>): Node[] {
    const asked = questions(stage.items, word(view, "required"));
    const send = async (): Promise<void> => {
      const answers = asked.answers();
      if (answers) await this.ask("api/study/form", { form: stage.form, block: stage.block, trial: stage.trial, answers });
    };
    const again = stage.again ? [make("p", { className: "warning", textContent: stage.again })] : [];
    again[0]?.setAttribute("role", "alert");
    return [
      ...(stage.heading ? [title(stage.heading)] : []),
      ...again,
      ...paragraphs(stage.text),
      asked.node,
      make("p", { className: "actions" }, button(word(view, "send"), send, true)),
    ];
  }

  private end(view: View, stage: Extract<Stage, { kind: "end" }>): Node[] {
    const nodes: Node[] = [title(stage.heading), ...paragraphs(stage.text)];
    if (stage.code)
      nodes.push(make("p", {}, `${word(view, "code")}: `, make("strong", { className: "code", textContent: stage.code })));
    if (stage.url) {
      const link = make("a", { href: stage.url, textContent: word(view, "return"), className: "main" });
      nodes.push(make("p", { className: "actions" }, link));
    }
    if (view.participant) nodes.push(make("p", { className: "small", textContent: word(view, "id", { id: view.participant }) }));
    return nodes;
  }

  private foot(view: View): Node {
    const { kind } = view.stage;
    const foot = make("footer", {}, make("p", { textContent: word(view, "contact", { contact: view.contact }) }));
    if (kind !== "consent" && kind !== "end")
      foot.append(
        button(word(view, "withdraw"), () => this.hud.askToLeave(() => void this.ask("api/study/withdraw", {}))),
      );
    this.leaveWords(view);
    return foot;
  }

  private leaveWords(view: View): void {
    const [button, title, text, stay] = ["withdraw", "withdraw_title", "withdraw_text", "stay"].map((name) => word(view, name));
    this.hud.leaveWords(button!, title!, text!, stay!);
  }

  /** Begins or goes on with the episode in this page. */
  private playButton(view: View, first: Asked): Node {
    let asked = first;
    const begin = button(
      word(view, "begin"),
      () => {
        page.hidden = true;
        page.replaceChildren();
        void play(this.hud, {
          next: word(view, "next"),
          asked: () => asked,
          followed: async () => {
            const { stage } = (await post("api/study", { ids: this.ids })) as unknown as View;
            if (stage.kind === "episode") asked = { block: stage.block, trial: stage.trial };
            return stage.kind === "episode";
          },
          began: (net, hud, signal) => {
            const resume = (): void => {
              void post("api/study/pause", { paused: false, ...asked });
              hud.phase("lost", word(view, "paused_title"), "");
              net.resume();
            };
            hud.show("button-pause", true);
            hud.on("button-pause", () => {
              if (!hud.playing) return;
              net.pause();
              void post("api/study/pause", { paused: true, ...asked });
              hud.phase("paused", word(view, "paused_title"), word(view, "paused"), word(view, "go_on"), resume);
            }, signal);
          },
        });
      },
      true,
    );
    return make("p", { className: "actions" }, begin);
  }
}

function title(text: string): HTMLElement {
  return make("h1", { textContent: text });
}
