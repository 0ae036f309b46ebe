/** A seat, the home, the link: one episode as it is played in this page. */

import { Refused, takeSeat } from "./link/flow.ts";
import { Game } from "./game.ts";
import type { Barriers, Chore, Seen } from "./player/actions.ts";
import { Hud } from "./screen/hud.ts";
import { Net, type Link } from "./link/net.ts";
import { unpacked } from "./link/packed.ts";
import type { SdfShape } from "./motion/sdf.ts";
import { installProbe, noteOver } from "./probe.ts";
import { World } from "./scene/world.ts";
import type { Said } from "./screen/talk.ts";
import { heard, say } from "./words.ts";

const query = new URLSearchParams(location.search);

/** What is around the episode: nothing, or a study. */
export interface Around {
  /** Label of the button that follows the last picture; empty: the server says whether there is a next episode. */
  next: string;
  /** What the server is told about the episode that the page asks for. */
  asked(): object;
  /** A chance to offer more once the link is there, such as a pause; `signal` says when the episode is left. */
  began(net: Net, hud: Hud, signal: AbortSignal): void;
  /** Whether what follows is another episode, so that a headset may be kept on for it. */
  followed(): Promise<boolean>;
}

const ALONE: Around = { next: "", asked: () => ({}), began: () => undefined, followed: () => Promise.resolve(true) };

/** Plays the episode of this browser's seat; what goes wrong is said on the page. */
export async function play(hud: Hud, around: Around = ALONE): Promise<void> {
  try {
    await begin(hud, around);
  } catch (error) {
    const text = error instanceof Refused ? error.message : say("could_not_start", { reason: String(error) });
    hud.phase("refused", say("failed"), text, say("try_again"), () => location.reload());
    if (!(error instanceof Refused)) throw error;
  }
}

async function begin(hud: Hud, around: Around, before?: Game): Promise<void> {
  const seat = await takeSeat(around.asked(), (text) => hud.phase("loading", say("loading"), text));
  performance.mark("seat");
  const { manifest } = seat;
  const world = await World.load(seat.glb, manifest);
  performance.mark("world");
  let game: Game | null = null;
  const agents = manifest.agents.map((agent) => ({ kind: agent.kind, joints: agent.joints ?? 0 }));
  const options = { url: seat.socket, agents, stepMs: manifest.dt * 1000, lagMs: Number(query.get("lag")) || 0 };
  const net = new Net(options, {
    state: (state) => game?.hear(state),
    told: (message) => game && hear(game, hud, around, message as Message),
    link: (link, why) => game && linked(game, hud, link, why),
  });
  const plain = query.has("plain");
  before?.leave();
  game = new Game(manifest, world, seat.sdf, net, hud, {
    antialias: !plain,
    pixelRatio: Math.min(devicePixelRatio, Number(query.get("dpr")) || 2),
    renderer: before?.renderer,
  });
  installProbe(game);
  around.began(net, hud, game.signal);
  game.renderer.setAnimationLoop((_, frame) => game!.frame(frame));
}

/** What follows an episode. A page that is loaded again is as fresh as the first one, but it would take off a headset: there the
 * next home comes into the same page, the one before being shown meanwhile. */
async function goOn(game: Game, hud: Hud, around: Around): Promise<void> {
  if (!game.headset?.on || !(await around.followed())) {
    location.reload();
    return;
  }
  try {
    await begin(hud, around, game);
  } catch (error) {
    const text = error instanceof Refused ? error.message : String(error);
    hud.phase("refused", say("failed"), text, say("try_again"), () => location.reload());
  }
}

/** A text frame of the server; it may say several things. */
interface Message {
  why?: string;
  toast?: string;
  hud?: { task: string; left_s?: number | null; lines?: string[]; how?: Record<string, string>; marker?: [number, number, number] | null; uses?: string[] };
  /** For each thing the door or drawer to be opened before it is taken, and before it is put at its goal: what shuts it in,
   * or a door between rooms; -1: none. */
  barriers?: Barriers;
  seen?: Seen;
  /** What the person can do now with the things that they brought along. */
  chores?: Chore[];
  /** The distance grid of the floor as it is now, its cells as Base64 of zlib data. */
  floor?: SdfShape & { cells: string };
  can?: { p: number[]; why: string };
  /** Messages between agents. */
  said?: Said[];
  /** Question at the end of the episode. */
  question?: string;
  pause?: string;
  over?: { ended: string; text?: string; next?: boolean };
}

function hear(game: Game, hud: Hud, around: Around, message: Message): void {
  if (message.why) game.refused(heard(message.why));
  if (message.toast) hud.toast(heard(message.toast), "good");
  if (message.hud) {
    const how = Object.entries(message.hud.how ?? {}).map(([device, text]) => [device, heard(text)]);
    hud.task(heard(message.hud.task), (message.hud.lines ?? []).map(heard), message.hud.left_s ?? null, Object.fromEntries(how));
    game.mark(message.hud.marker ?? null);
    game.deeds.uses = message.hud.uses ?? [];
  }
  if (message.barriers) game.barriers = message.barriers;
  if (message.seen) game.seen = message.seen;
  if (message.chores) game.chores = message.chores;
  if (message.floor) {
    const { cells, ...map } = message.floor;
    void unpacked(cells).then((bytes) => game.sdf.replace(map, bytes.buffer));
  }
  if (message.said) game.talk.hear(message.said);
  if (message.question) game.deeds.ask(message.question);
  if (message.can) game.answer(message.can.p, heard(message.can.why));
  if (message.pause) hud.phase("paused", say("stands_still"), heard(message.pause));
  else if (message.pause === "") hud.phase("playing");
  if (message.over) over(game, hud, around, message.over);
}

function over(game: Game, hud: Hud, around: Around, message: NonNullable<Message["over"]>): void {
  const { ended, text, next } = message;
  noteOver(message);
  const success = ended === "success";
  game.over(success);
  game.net.close("");
  const [title, said] = success ? [say("well_done"), say("all_done")] : [say("ended"), ""];
  hud.phase("over", title!, text === undefined ? said! : heard(text), around.next || (next ? say("next_episode") : ""), () => void goOn(game, hud, around));
}

function linked(game: Game, hud: Hud, link: Link, why: string): void {
  if (link === "open") {
    game.reconnected();
    hud.phase("playing");
  } else if (link === "lost") hud.phase("lost", say("lost"), say("lost_text"));
  else if (link === "closed" && why) hud.phase("refused", say("closed"), heard(why), say("reload"), () => location.reload());
}
