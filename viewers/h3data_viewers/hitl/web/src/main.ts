import { Refused, takeSeat } from "./link/flow.ts";
import { Game } from "./game.ts";
import { Hud } from "./screen/hud.ts";
import { Net, type Link } from "./link/net.ts";
import { installProbe } from "./probe.ts";
import { World } from "./scene/world.ts";

const query = new URLSearchParams(location.search);
const hud = new Hud();

async function play(): Promise<void> {
  const seat = await takeSeat((text) => hud.phase("loading", "Loading the home", text));
  performance.mark("seat");
  const { manifest } = seat;
  const world = await World.load(seat.glb, manifest);
  performance.mark("world");
  let game: Game | null = null;
  const agents = manifest.agents.map((agent) => ({ kind: agent.kind, joints: agent.joints ?? 0 }));
  const options = { url: seat.socket, agents, stepMs: manifest.dt * 1000, lagMs: Number(query.get("lag")) || 0 };
  const net = new Net(options, {
    state: (state) => game?.hear(state),
    told: (message) => game && hear(game, message),
    link: (link, why) => game && linked(game, link, why),
  });
  const plain = query.has("plain");
  game = new Game(manifest, world, seat.sdf, net, hud, {
    antialias: !plain,
    pixelRatio: Math.min(devicePixelRatio, Number(query.get("dpr")) || 2),
  });
  installProbe(game);
  game.renderer.setAnimationLoop((_, frame) => game!.frame(frame));
}

function hear(game: Game, message: Record<string, unknown>): void {
  if (typeof message.why === "string") game.refused(message.why);
  if (message.hud) hud.title((message.hud as { task: string }).task);
  if (message.can) game.answer((message.can as { p: number[] }).p, (message.can as { why: string }).why);
  if (message.over) {
    const over = message.over as { ended: string };
    game.over(over.ended === "success");
    game.net.close("");
    hud.phase("over", over.ended === "success" ? "Done. Thank you!" : "The episode has ended", "");
  }
}

function linked(game: Game, link: Link, why: string): void {
  if (link === "open") {
    game.reconnected();
    hud.phase("playing");
  } else if (link === "lost") hud.phase("lost", "The connection was lost", "Your place is kept. Connecting again …");
  else if (link === "closed" && why) hud.phase("refused", "This session has been closed", why, "Reload", () => location.reload());
}

play().catch((error: unknown) => {
  const text = error instanceof Refused ? error.message : `The page could not start: ${String(error)}`;
  hud.phase("refused", "This did not work", text, "Try again", () => location.reload());
  if (!(error instanceof Refused)) throw error;
});
