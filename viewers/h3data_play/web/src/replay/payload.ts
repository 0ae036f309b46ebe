/** The data of a replay as `h3data_viewers.html_replay.packing` writes them: one compressed block of arrays and files. */

interface Entry {
  at: number;
  bytes: number;
  /** Of an array: rows and columns, what a level is worth, bytes per number, rows that are absent. */
  shape?: [number, number];
  step?: number;
  planes?: number;
  gaps?: [number, number][];
}

/** Numbers [T, C], row by row; absent rows are NaN. */
export interface Table {
  rows: number;
  columns: number;
  values: Float64Array;
}

export class Payload<About> {
  readonly about: About;
  private readonly entries: Map<string, Entry>;
  private readonly start: number;

  constructor(private readonly block: Uint8Array) {
    const length = new DataView(block.buffer, block.byteOffset).getUint32(0, true);
    this.start = 4 + length;
    const header = JSON.parse(new TextDecoder().decode(block.subarray(4, this.start))) as {
      about: About;
      entries: Record<string, Entry>;
    };
    this.about = header.about;
    this.entries = new Map(Object.entries(header.entries));
  }

  file(name: string): ArrayBuffer {
    return this.bytes(this.entry(name)).slice().buffer as ArrayBuffer;
  }

  has(name: string): boolean {
    return this.entries.has(name);
  }

  table(name: string): Table {
    const entry = this.entry(name);
    const [rows, columns] = entry.shape!;
    const planes = entry.planes!;
    const bytes = this.bytes(entry);
    const size = rows * columns;
    const values = new Float64Array(size);
    for (let column = 0; column < columns; column++)
      for (let row = 0, level = 0; row < rows; row++) {
        let code = 0;
        for (let plane = planes - 1; plane >= 0; plane--) code = code * 256 + bytes[plane * size + column * rows + row]!;
        level += code % 2 ? -(code + 1) / 2 : code / 2;
        values[row * columns + column] = level * entry.step!;
      }
    for (const [from, to] of entry.gaps ?? []) values.fill(NaN, from * columns, to * columns);
    return { rows, columns, values };
  }

  private entry(name: string): Entry {
    const entry = this.entries.get(name);
    if (!entry) throw new Error(`The replay has no part called ${name}.`);
    return entry;
  }

  private bytes(entry: Entry): Uint8Array {
    return this.block.subarray(this.start + entry.at, this.start + entry.at + entry.bytes);
  }
}
