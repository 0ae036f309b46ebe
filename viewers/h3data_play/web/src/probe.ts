/** What tests and the device check read of a session: `window.probe`. It changes nothing, but `drop` cuts the
 * connection. */

import type { Game } from "./game.ts";

export function installProbe(game: Game): void {
  const stats = (): Record<string, unknown> => ({
    firstFrameMs: performance.getEntriesByName("first-frame")[0]?.startTime ?? null,
    frameMs: [share(game.frameMs, 0.5), share(game.frameMs, 0.95)],
    keyMs: [share(game.keyMs, 0.5), share(game.keyMs, 0.95)],
    ackMs: [share(game.net.ackDelays, 0.5), share(game.net.ackDelays, 0.95)],
    errorM: [share(game.predictor?.errors ?? [], 0.5), share(game.predictor?.errors ?? [], 0.95)],
    errors: game.predictor?.errors.length ?? 0,
    rttMs: game.net.rtt,
    states: game.net.received,
    bytes: game.net.bytes,
    connects: game.net.connects,
    bones: game.world.bonesFound,
  });
  Object.assign(window, { probe: { game, stats, over: null, drop: () => game.net.drop() } });
}

/** Notes how the episode has ended. */
export function noteOver(over: unknown): void {
  Object.assign((window as unknown as { probe: object }).probe, { over });
}

function share(values: number[], part: number): number | null {
  if (!values.length) return null;
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.min(sorted.length - 1, Math.floor(sorted.length * part))]!;
}
