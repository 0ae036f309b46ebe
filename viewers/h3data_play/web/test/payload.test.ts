import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { unpacked } from "../src/link/packed.ts";
import { Payload } from "../src/replay/payload.ts";

interface Golden {
  block: string;
  about: object;
  arrays: Record<string, (number | null)[][]>;
}

/** Written by the Python side: a block that it has packed, and what is in it. */
const GOLDEN = JSON.parse(readFileSync("../../../tests/viewers/replays/golden_payload.json", "utf8")) as Golden;
const HALF_STEP = 2.5e-4 + 1e-9;

test("a block that Python has packed is read as it has written it", async () => {
  const payload = new Payload<object>(await unpacked(GOLDEN.block));
  assert.deepEqual(payload.about, GOLDEN.about);
  assert.deepEqual([...new Uint8Array(payload.file("file"))], Array.from({ length: 256 }, (_, k) => k));
  for (const [name, rows] of Object.entries(GOLDEN.arrays)) {
    const table = payload.table(name);
    assert.equal(table.rows, rows.length);
    rows.flat().forEach((value, k) => {
      if (value === null) assert.ok(Number.isNaN(table.values[k]));
      else assert.ok(Math.abs(table.values[k]! - value) <= HALF_STEP, `${name} ${k}`);
    });
  }
});

test("a part that is missing is named", async () => {
  const payload = new Payload<object>(await unpacked(GOLDEN.block));
  assert.throws(() => payload.table("gone"), /no part called gone/);
});
