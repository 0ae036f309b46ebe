import assert from "node:assert/strict";
import { test } from "node:test";
import { readFileSync } from "node:fs";
import { discsOf, drive, type Driving } from "../src/motion/drive.ts";
import { Predictor } from "../src/motion/predict.ts";
import { Sdf, wrapAngle } from "../src/motion/sdf.ts";

const HOW: Driving = {
  speed: 2.5, turn: 2.5, lateral: 0, backwards: true, offsets: [0], radius: 0.25, iterations: 6, tolerance: 7e-4, farthest: null,
};
const DT = 1 / 30;
const OPEN = room(8, 6);

/** The distance grid of an empty room of `x` times `z` metres. */
function room(x: number, z: number): Sdf {
  const cell = 0.05;
  const shape: [number, number] = [x / cell, z / cell];
  const values = [];
  for (let i = 0; i < shape[0]; i++)
    for (let j = 0; j < shape[1]; j++) {
      const px = (i + 0.5) * cell;
      const pz = (j + 0.5) * cell;
      values.push(Math.round(Math.min(px, x - px, pz, z - pz) * 1000));
    }
  return new Sdf({ shape, origin: [0, 0], cell, unit: 0.001, type: "int16" }, Int16Array.from(values).buffer);
}

test("distances are bilinear and go on falling off the grid", () => {
  assert.ok(Math.abs(OPEN.at(1.234, 3) - 1.234) < 1e-3);
  assert.ok(OPEN.at(-1, 3) < -0.9);
  const [gx, gz] = OPEN.gradient(0.5, 3);
  assert.ok(gx > 0.99 && Math.abs(gz) < 1e-6);
});

test("a grid of the wrong size is refused", () => {
  assert.throws(() => new Sdf({ shape: [3, 3], origin: [0, 0], cell: 1, unit: 1, type: "int8" }, new ArrayBuffer(2)), /in 9 bytes, got 2/);
});

test("a grid that is replaced is the one that is walked on", () => {
  const there = { shape: [80, 60] as [number, number], origin: [0, 0] as [number, number], cell: 0.1, unit: 0.001, type: "int16" as const };
  const sdf = new Sdf(there, new Int16Array(80 * 60).fill(2000).buffer);
  const go = (): number => drive(sdf, { x: 4, z: 3, heading: 0 }, { forward: 1, turn: 0 }, HOW, DT).x - 4;
  assert.ok(Math.abs(go() - 2.5 / 30) < 1e-9);
  const walls = new Int16Array(40 * 60).fill(2000).fill(-100, 20 * 60); // of another size: closed from x = 4 on
  sdf.replace({ ...there, shape: [40, 60], origin: [2, 0] }, walls.buffer);
  assert.equal(go(), 0);
  assert.equal(sdf.version, 1);
  assert.throws(() => sdf.replace(there, walls.buffer), /Expected a distance grid of 80 x 60/);
  assert.equal(sdf.map.shape[0], 40, "a grid that is refused changes nothing");
});

test("in the open a body moves along its old heading and then turns", () => {
  const base = drive(OPEN, { x: 2, z: 3, heading: 0 }, { forward: 1, turn: 1 }, HOW, DT);
  assert.ok(Math.abs(base.x - (2 + 2.5 / 30)) < 1e-12);
  assert.equal(base.z, 3);
  assert.ok(Math.abs(base.heading - 2.5 / 30) < 1e-12);
});

test("a wall stops what goes into it and lets slide what goes along it", () => {
  let base = { x: 0.4, z: 3, heading: Math.PI - 0.5 };
  for (let k = 0; k < 30; k++) base = drive(OPEN, base, { forward: 1, turn: 0 }, HOW, DT);
  assert.ok(base.x > 0.249 && base.x < 0.26, `x is ${base.x}`);
  assert.ok(base.z < 2.2, "it slid along");
});

test("beside others a body gets where the server's gets", () => {
  const file = readFileSync("../../../tests/play/golden_states.json", "utf8");
  const { room: size, others: rows, start, commands, places } = (JSON.parse(file) as { beside: Beside }).beside;
  const sdf = room(...size);
  const others = rows.map(([x, z, radius]) => ({ x, z, radius }));
  let base = { x: start[0], z: start[1], heading: start[2] };
  let nearest = Infinity;
  commands.forEach(([forward, turn], k) => {
    base = drive(sdf, base, { forward, turn }, { ...HOW, solid: true }, DT, others);
    const [x, z, heading] = places[k]!;
    assert.ok(Math.hypot(base.x - x, base.z - z) < 1e-4 && Math.abs(base.heading - heading) < 1e-6, `step ${k}`);
    nearest = Math.min(nearest, ...others.map((disc) => Math.hypot(base.x - disc.x, base.z - disc.z)));
  });
  assert.ok(nearest > 0.5 - 1e-5 && nearest < 0.51, `nearest ${nearest}`);
  assert.deepEqual(discsOf({ x: 1, z: 2, heading: Math.PI / 2 }, { ...HOW, offsets: [0.5] }).map((disc) => disc.z), [1.5]);
});

type Row = [number, number, number];
interface Beside {
  room: [number, number];
  others: Row[];
  start: Row;
  commands: [number, number][];
  places: Row[];
}

test("a prediction is what the server says later, however long that takes", () => {
  for (const delay of [0, 3, 6]) {
    const predictor = new Predictor(OPEN, HOW, DT);
    const server = [{ x: 4, z: 3, heading: 0 }];
    const moves = [
      { seq: 0, step: 5, forward: 1, turn: 0 }, { seq: 1, step: 12, forward: 1, turn: 1 }, { seq: 2, step: 15, forward: 0, turn: -1 },
      { seq: 3, step: 31, forward: -1, turn: 0 }, { seq: 4, step: 40, forward: 0, turn: 0 },
    ];
    for (let now = 1; now < 60; now++) {
      const acting = moves.filter((move) => move.step <= now).at(-1) ?? { forward: 0, turn: 0 };
      server.push(drive(OPEN, server.at(-1)!, acting, HOW, DT));
      for (const move of moves) if (move.step === now + 2) predictor.add(move); // sent two steps ahead
      const step = Math.max(now - delay, 0);
      const ack = moves.filter((move) => move.step <= step).at(-1)?.seq ?? -1;
      const told = { step, ack, base: server[step]! };
      predictor.hear(told, false);
      predictor.at(told, delay + 1);
    }
    assert.ok(predictor.errors.length > 40);
    assert.ok(Math.max(...predictor.errors) < 1e-9, `delay ${delay}: ${Math.max(...predictor.errors)}`);
  }
});

test("a jump of the target is taken back, not shown", () => {
  const predictor = new Predictor(OPEN, HOW, DT);
  const still = { forward: 0, turn: 0 };
  predictor.smooth({ x: 1, z: 1, heading: 0 }, still, true, DT);
  const first = predictor.smooth({ x: 1.2, z: 1, heading: 0 }, still, true, 1 / 60);
  assert.ok(first.x < 1.05);
  let later = first;
  for (let k = 0; k < 40; k++) later = predictor.smooth({ x: 1.2, z: 1, heading: 0 }, still, true, 1 / 60);
  assert.ok(Math.abs(later.x - 1.2) < 1e-3);
});

test("angles are wrapped", () => {
  assert.ok(Math.abs(wrapAngle(3 * Math.PI + 0.1) - (-Math.PI + 0.1)) < 1e-12);
});
