/** The home's GLB, put together from its JSON and the buffer views that `h3data_viewers.html_replay.home` has packed. */

import type { Payload, Table } from "./payload.ts";

interface View {
  byteOffset: number;
  byteLength: number;
  /** Type of the numbers of a view that is packed as an array. */
  numbers?: keyof typeof NUMBERS;
}

const NUMBERS = { f4: Float32Array, u4: Uint32Array, u2: Uint16Array } as const;
const [MAGIC, JSON_CHUNK, BIN_CHUNK] = [0x46546c67, 0x4e4f534a, 0x004e4942];

export function homeFile<About>(payload: Payload<About>): ArrayBuffer {
  const document = JSON.parse(new TextDecoder().decode(payload.file("home"))) as { bufferViews: View[]; buffers: object[] };
  const parts: Uint8Array[] = [];
  let size = 0;
  document.bufferViews.forEach((view, k) => {
    const name = `home.${k}`;
    const part = view.numbers ? bytes(payload.table(name), view.numbers) : new Uint8Array(payload.file(name));
    delete view.numbers;
    view.byteOffset = size;
    view.byteLength = part.length;
    parts.push(part);
    size += aligned(part.length);
  });
  document.buffers = [{ byteLength: size }];
  return glb(new TextEncoder().encode(JSON.stringify(document)), parts, size);
}

function bytes(table: Table, kind: keyof typeof NUMBERS): Uint8Array {
  return new Uint8Array(NUMBERS[kind].from(table.values).buffer);
}

function glb(json: Uint8Array, parts: Uint8Array[], size: number): ArrayBuffer {
  const start = 20 + aligned(json.length) + 8;
  const file = new Uint8Array(start + size).fill(0x20, 20, start - 8); // JSON is padded with spaces
  const view = new DataView(file.buffer);
  [MAGIC, 2, file.length, aligned(json.length), JSON_CHUNK].forEach((word, k) => view.setUint32(4 * k, word, true));
  [size, BIN_CHUNK].forEach((word, k) => view.setUint32(start - 8 + 4 * k, word, true));
  file.set(json, 20);
  let at = start;
  for (const part of parts) {
    file.set(part, at);
    at += aligned(part.length);
  }
  return file.buffer;
}

const aligned = (size: number): number => (size + 3) & ~3;
