import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { Group, Object3D, Quaternion } from "three";
import { isOpen, JointRig, type Joint } from "../src/scene/joints.ts";

interface Frame {
  positions: number[];
  poses: Record<string, number[]>;
  handles: number[][];
}

/** Written by the Python side: a cabinet with a box that slides out of its door. A cup lies in the box, with a pose of its own. */
const { opening } = JSON.parse(readFileSync("../../../tests/play/golden_states.json", "utf8")) as {
  opening: { joints: Joint[]; frames: Frame[] };
};
const [CLOSED] = opening.frames as [Frame];

function cabinet(): { nodes: Map<string, Object3D>; rig: JointRig } {
  const nodes = new Map<string, Object3D>();
  for (const [name, pose] of Object.entries(CLOSED.poses)) {
    const node = new Group();
    node.position.fromArray(pose);
    node.quaternion.fromArray(pose, 3);
    node.scale.set(2, 1, 3);
    nodes.set(name, node);
  }
  return { nodes, rig: new JointRig(opening.joints, (name) => nodes.get(name)) };
}

const floats = (values: number[]): Float32Array => Float32Array.from(values);

test("doors and drawers move as Python moves them, and what has a pose of its own stays", () => {
  const { nodes, rig } = cabinet();
  for (const frame of opening.frames) {
    rig.pose(floats(CLOSED.positions), floats(frame.positions), 1);
    for (const name of ["body", "door", "box"]) {
      const [node, pose] = [nodes.get(name)!, frame.poses[name]!];
      near(node.position.toArray(), pose.slice(0, 3), 1e-5);
      const sign = Math.sign(node.quaternion.dot(new Quaternion().fromArray(pose, 3)));
      near(node.quaternion.toArray().map((value) => sign * value), pose.slice(3), 1e-5);
      near(node.scale.toArray(), [2, 1, 3], 1e-5);
    }
    rig.handles.forEach((handle, k) => near(handle.toArray(), frame.handles[k]!, 1e-4));
    near(nodes.get("cup")!.position.toArray(), CLOSED.poses.cup!.slice(0, 3), 1e-9);
  }
});

test("between two states a joint is between its positions", () => {
  const half = cabinet();
  const there = cabinet();
  half.rig.pose(floats([0.3, 0]), floats([1.3, -0.4]), 0.5);
  there.rig.pose(floats([0.8, -0.2]), floats([0.8, -0.2]), 0);
  near(half.nodes.get("box")!.position.toArray(), there.nodes.get("box")!.position.toArray(), 1e-6);
});

test("a joint is found by what it moves, and by parts of that", () => {
  const { nodes, rig } = cabinet();
  const knob = new Object3D();
  nodes.get("box")!.add(knob);
  assert.deepEqual(["body", "door", "box"].map((name) => rig.of(nodes.get(name)!)), [-1, 0, 1]);
  assert.equal(rig.of(knob), 1);
});

test("hands get in from 60% on, whichever end is the open one", () => {
  const [door, box] = opening.joints as [Joint, Joint];
  assert.deepEqual([0, 1.1, 1.3, 2].map((position) => isOpen(door, position)), [false, false, true, true]);
  assert.deepEqual([0, -0.2, -0.3, -0.4].map((position) => isOpen(box, position)), [false, false, true, true]);
});

function near(read: number[], said: number[], within: number): void {
  assert.equal(read.length, said.length);
  read.forEach((value, k) => assert.ok(Math.abs(value - said[k]!) <= within, `${read} for ${said}`));
}
