import assert from "node:assert/strict";
import { test } from "node:test";
import { decodePong, decodeState, FLAG, unpackQuat, type RobotState } from "../src/link/wire.ts";

const ROBOT = { kind: "robot", joints: 2 } as const;

/** A state of one robot with two joints, and of the things given. */
function message(step: number, things: [number, number, number][]): ArrayBuffer {
  const view = new DataView(new ArrayBuffer(16 + 12 + 4 + 32 * things.length));
  [1, FLAG.busy, 1, things.length].forEach((byte, at) => view.setUint8(at, byte));
  view.setUint32(4, step, true);
  view.setInt32(8, -1, true);
  view.setFloat32(12, 33.5, true);
  [1.5, -2.5, 0.25].forEach((value, k) => view.setFloat32(16 + 4 * k, value, true));
  view.setInt16(28, 5000, true);
  view.setInt16(30, -5000, true);
  things.forEach(([index, held, x], k) => {
    view.setUint16(32 + 32 * k, index, true);
    view.setInt16(34 + 32 * k, held, true);
    view.setFloat32(36 + 32 * k, x, true);
  });
  return view.buffer;
}

test("a state is read by the layout of the manifest", () => {
  const state = decodeState(message(7, [[0, -1, 4]]), [ROBOT], undefined);
  assert.equal(state.step, 7);
  assert.equal(state.ack, -1);
  assert.equal(state.clockMs, 33.5);
  assert.equal(state.flags & FLAG.busy, FLAG.busy);
  const robot = state.agents[0] as RobotState;
  assert.deepEqual([robot.x, robot.z, robot.heading], [1.5, -2.5, 0.25]);
  assert.ok(Math.abs(robot.joints[0]! - 1) < 1e-6 && Math.abs(robot.joints[1]! + 1) < 1e-6);
});

test("things that a state leaves out stay where they were", () => {
  const before = decodeState(message(7, [[0, -1, 4], [1, -1, 5]]), [ROBOT], undefined);
  const after = decodeState(message(8, [[1, 0, 6]]), [ROBOT], before);
  assert.equal(after.things[0]!.pose[0], 4);
  assert.deepEqual([after.things[1]!.held, after.things[1]!.pose[0]], [0, 6]);
  assert.equal(before.things[1]!.held, -1);
});

test("a message of another kind or of other agents is refused", () => {
  assert.throws(() => decodeState(message(7, []), [ROBOT, ROBOT], undefined), /2 agents, got one of 1/);
  assert.throws(() => decodeState(new Uint8Array([9, 0, 0, 0]).buffer, [ROBOT], undefined), /kind 9/);
});

test("a pong gives both clocks", () => {
  const view = new DataView(new ArrayBuffer(24));
  view.setUint8(0, 2);
  view.setFloat64(8, 12.5, true);
  view.setFloat64(16, 99, true);
  assert.deepEqual(decodePong(view.buffer), { clientMs: 12.5, serverMs: 99 });
  assert.equal(decodePong(message(1, [])), null);
});

test("a rotation in 32 bits is a unit quaternion whose largest component is positive", () => {
  const out = new Float32Array(8);
  unpackQuat(((3 << 30) | (1023 << 20) | (511 << 10) | 512) >>> 0, out, 4);
  assert.ok(Math.abs(out[4]! - Math.SQRT1_2) < 1e-6);
  assert.ok(Math.abs(Math.hypot(...out.subarray(4)) - 1) < 1e-6);
  assert.ok(out[7]! > 0.7);
});
