import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { decodePong, decodeState, type PersonState, type RobotState, type State } from "../src/link/wire.ts";

interface Golden {
  joints: number;
  states: { bytes: string; said: Said }[];
  pong: { bytes: string; said: [number, number] };
}

interface Said {
  flags: number;
  step: number;
  ack: number;
  clock_ms: number;
  robot: { base: number[]; joints: number[] };
  person: { base: number[]; root: number[]; quats: number[][] };
  joints: number[];
  things: { index: number; held: number; pose: number[] }[];
}

/** Written by the Python side: the bytes that it packs, and what it has packed into them. */
const GOLDEN = JSON.parse(readFileSync("../../../tests/play/golden_states.json", "utf8")) as Golden;
const LAYOUT = [
  { kind: "robot", joints: GOLDEN.joints },
  { kind: "human", joints: 0 },
] as const;

test("states that Python has packed are read as it has written them", () => {
  let before: State | undefined;
  for (const { bytes, said } of GOLDEN.states) {
    const state = decodeState(buffer(bytes), [...LAYOUT], before);
    assert.deepEqual([state.flags, state.step, state.ack], [said.flags, said.step, said.ack]);
    near([state.clockMs], [said.clock_ms], 0.01);
    const [robot, person] = state.agents as [RobotState, PersonState];
    near([robot.x, robot.z, robot.heading], said.robot.base, 1e-6);
    near([...robot.joints], said.robot.joints, 1.01e-4);
    near([person.x, person.z, person.heading], said.person.base, 1e-6);
    near([...person.root], said.person.root, 1e-6);
    said.person.quats.forEach((quat, k) => {
      const read = [...person.quats.subarray(4 * k, 4 * k + 4)];
      const cosine = Math.abs(read.reduce((sum, value, i) => sum + value * quat[i]!, 0));
      assert.ok(2 * Math.acos(Math.min(cosine, 1)) < 0.003, `rotation ${k}: ${read} for ${quat}`);
    });
    for (const { index, held, pose } of said.things) {
      assert.equal(state.things[index]!.held, held);
      near([...state.things[index]!.pose], pose, 1e-6);
    }
    near([...state.joints], said.joints, 1e-7);
    before = state;
  }
  assert.ok(GOLDEN.states.length > 4);
});

test("a pong that Python has packed is read", () => {
  const pong = decodePong(buffer(GOLDEN.pong.bytes));
  assert.deepEqual([pong?.clientMs, pong?.serverMs], GOLDEN.pong.said);
});

function buffer(hex: string): ArrayBuffer {
  return Uint8Array.from(hex.match(/../g)!, (pair) => parseInt(pair, 16)).buffer;
}

function near(read: number[], said: number[], within: number): void {
  assert.equal(read.length, said.length);
  read.forEach((value, k) => assert.ok(Math.abs(value - said[k]!) <= within, `${value} for ${said[k]}`));
}
