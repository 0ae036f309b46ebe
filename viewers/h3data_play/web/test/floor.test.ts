import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { Matrix4, Object3D, Vector3 } from "three";
import { drive, type Driving } from "../src/motion/drive.ts";
import { Floor, type HeightRow } from "../src/motion/floor.ts";
import { Sdf } from "../src/motion/sdf.ts";
import { RobotRig } from "../src/scene/robot.ts";

/** Written by the Python side: two storeys joined by stairs, and what it says of places (x, z, heading). */
const { stairs } = JSON.parse(readFileSync("../../../tests/play/golden_states.json", "utf8")) as {
  stairs: { heights: HeightRow[]; length: number; places: [number, number, number][]; y: number[]; pace: number[]; poses: number[][] };
};
const FLOOR = new Floor(stairs.heights, 0);

test("floors are as high, and bodies as slow on stairs, as Python says", () => {
  stairs.places.forEach(([x, z], k) => {
    near([FLOOR.height(x, z), FLOOR.pace(x, z)], [stairs.y[k]!, stairs.pace[k]!]);
  });
  assert.ok(stairs.pace.some((pace) => pace === 1) && stairs.pace.some((pace) => pace < 0.5));
});

test("a robot pitches with the stairs as Python has it", () => {
  const link = { name: "base", parent: -1, origin: [0, 0, 0, 0, 0, 0, 1], axis: [0, 0, 1], kind: 0, column: 0, gain: 1, offset: 0 };
  const node = new Object3D();
  const rig = new RobotRig([link as never], [0, 0, 0, 0, 0, 0, 1], [node]);
  const none = new Float32Array(0);
  let pitched = 0;
  stairs.places.forEach(([x, z, heading], k) => {
    const { y, pitch } = FLOOR.slope(x, z, heading, stairs.length);
    rig.pose(new Vector3(x, y, z), heading, pitch, none, none, 0);
    const [px, py, pz, qx, qy, qz, qw] = stairs.poses[k] as [number, number, number, number, number, number, number];
    near(node.position.toArray(), [px, py, pz]);
    node.updateMatrix();
    const expected = new Object3D();
    expected.quaternion.set(qx, qy, qz, qw);
    expected.position.set(px, py, pz);
    expected.updateMatrix();
    near(new Matrix4().copy(node.matrix).elements, expected.matrix.elements);
    pitched += +(Math.abs(pitch) > 0.1);
  });
  assert.ok(pitched > 5);
  assert.deepEqual(FLOOR.slope(5, 1.5, 0, 0).pitch, 0);
});

test("a home without stairs is level everywhere", () => {
  const level = new Floor([], 0.25);
  assert.deepEqual([level.height(3, 4), level.riser(3, 4), level.pace(3, 4)], [0.25, 0, 1]);
  assert.deepEqual([level.highest, FLOOR.highest], [0.25, 2.7]);
  assert.deepEqual(level.slope(3, 4, 1, 0.7), { y: 0.25, pitch: 0 });
});

test("a body under the same command gets on more slowly on stairs", () => {
  const how: Driving = {
    speed: 2.5, turn: 2.5, lateral: 0, backwards: true, offsets: [0], radius: 0.25, iterations: 6, tolerance: 7e-4, farthest: null,
  };
  const cells = new Int16Array(200 * 80).fill(5000);
  const sdf = new Sdf({ shape: [200, 80], origin: [0, 0], cell: 0.05, unit: 0.001, type: "int16" }, cells.buffer, FLOOR);
  const step = (x: number): number => drive(sdf, { x, z: 1.5, heading: 0 }, { forward: 1, turn: 0 }, how, 1 / 30).x - x;
  near([step(1), step(5)], [2.5 / 30, (0.4 * 2.5) / 30]);
  const between = step(3.1);
  assert.ok(between > step(5) && between < step(1), "slower already before them");
});

function near(read: ArrayLike<number>, said: ArrayLike<number>): void {
  assert.equal(read.length, said.length);
  for (let k = 0; k < read.length; k++) assert.ok(Math.abs(read[k]! - said[k]!) < 1e-6, `${Array.from(read)} for ${Array.from(said)}`);
}
