/** From the address of the page to a seat: what the server hands out before anything moves. */

import type { Manifest } from "./manifest.ts";
import { Floor } from "../motion/floor.ts";
import { Sdf } from "../motion/sdf.ts";
import { heard, say } from "../words.ts";

export interface Seat {
  manifest: Manifest;
  glb: ArrayBuffer;
  sdf: Sdf;
  socket: string;
}

/** The server's answer was no; the text is for the player. */
export class Refused extends Error {
  constructor(
    text: string,
    readonly status: number,
  ) {
    super(text);
  }
}

const BUSY = 503;
const BUSY_TRIES = 40;
const BUSY_MS = 3000;

export async function takeSeat(asked: object, progress: (text: string) => void): Promise<Seat> {
  progress(say("setting_up"));
  const answer = await seat(asked, progress);
  const manifest = answer.manifest as Manifest;
  for (const phrase of manifest.phrases) if (phrase.text === phrase.label) phrase.text = heard(phrase.label);
  for (const named of [...manifest.objects, ...manifest.goals, ...manifest.joints, ...manifest.phrases, ...manifest.spots]) named.label = heard(named.label);
  for (const spot of manifest.spots) spot.room = heard(spot.room);
  progress(say("on_its_way"));
  const [glb, grid] = await Promise.all([bytes(answer.glb as string), bytes(manifest.sdf.url)]);
  const url = new URL(answer.socket as string, location.href);
  url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  const floor = new Floor(manifest.heights, manifest.floor_y);
  return { manifest, glb, sdf: new Sdf(manifest.sdf, grid, floor), socket: url.href };
}

/** Tries again while the machine is busy with others. */
async function seat(asked: object, progress: (text: string) => void): Promise<Record<string, unknown>> {
  for (let k = 1; ; k++) {
    try {
      return await post("api/session", asked);
    } catch (error) {
      if (!(error instanceof Refused) || error.status !== BUSY || k === BUSY_TRIES) throw error;
      progress(say("tries", { text: error.message }));
      await new Promise((resolve) => setTimeout(resolve, BUSY_MS));
    }
  }
}

export async function post(path: string, body: unknown, more: RequestInit = {}): Promise<Record<string, unknown>> {
  const headers = { "Content-Type": "application/json" };
  const response = await fetch(path, { method: "POST", headers, body: JSON.stringify(body), ...more });
  if (!response.ok) throw new Refused(heard(await response.text()), response.status);
  return response.status === 204 ? {} : ((await response.json()) as Record<string, unknown>);
}

async function bytes(path: string): Promise<ArrayBuffer> {
  const response = await fetch(path);
  if (!response.ok) throw new Refused(say("no_file", { path, status: response.status }), response.status);
  return response.arrayBuffer();
}
