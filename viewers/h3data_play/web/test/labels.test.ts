import assert from "node:assert/strict";
import { test } from "node:test";
import { spread, type Box } from "../src/screen/markers.ts";

const HEIGHT = 600;
const overlap = (a: Box, b: Box): boolean =>
  a.left < b.left + b.width && b.left < a.left + a.width && a.top < b.top + b.height && b.top < a.top + a.height;

function places(wanted: Box[], taken: Box[]): Box[] {
  const tops = spread(wanted, taken, HEIGHT);
  return wanted.flatMap((box, k) => (tops[k] === null ? [] : [{ ...box, top: tops[k]! }]));
}

test("labels keep their place where nothing is in the way", () => {
  const far: Box[] = [{ left: 0, top: 10, width: 90, height: 20 }, { left: 0, top: 200, width: 90, height: 20 }];
  assert.deepEqual(spread(far, [{ left: 200, top: 0, width: 90, height: HEIGHT }], HEIGHT), [10, 200]);
});

test("labels lie neither on each other nor on the page's parts", () => {
  let seed = 1;
  const random = (): number => (seed = (seed * 16807) % 2147483647) / 2147483647;
  for (let n = 0; n < 300; n++) {
    const wanted = Array.from({ length: 8 }, () => ({ left: random() * 300, top: random() * (HEIGHT - 24), width: 60 + random() * 150, height: 24 }));
    const taken = [{ left: 0, top: 0, width: 220, height: 140 }, { left: 260, top: 420, width: 240, height: 180 }];
    const shown = [...places(wanted, taken), ...taken];
    for (const [k, a] of shown.entries()) {
      assert.ok(a.top >= 0 && a.top + a.height <= HEIGHT);
      for (const b of shown.slice(k + 1)) assert.ok(!overlap(a, b), JSON.stringify([a, b]));
    }
    assert.ok(shown.length > 8); // there is room for nearly all of them
  }
});

test("a label for which there is no room is not shown", () => {
  assert.deepEqual(spread([{ left: 0, top: 5, width: 50, height: 20 }], [{ left: 0, top: 0, width: 50, height: HEIGHT }], HEIGHT), [null]);
});
