import "./english.ts";
import assert from "node:assert/strict";
import { test } from "node:test";
import type { Manifest } from "../src/link/manifest.ts";
import type { State } from "../src/link/wire.ts";
import { busyHints, choreHints, deed, hints, postureHints, situation, turnText, useKey, type Barriers, type Chore, type Seen, type Situation } from "../src/player/actions.ts";

const DOOR = { name: "fridge/door", label: "fridge door", parent: -1, kind: 1, rest: 0, closed: 0, opened: 1.5, nodes: [] };
const MANIFEST = {
  me: 0,
  agents: [{ kind: "human" }],
  objects: [{ label: "mug" }, { label: "pan" }],
  goals: [{ position: [9, 1, 9], label: "shelf" }, { position: [9, 1, 8], label: "desk" }],
  joints: [DOOR, { ...DOOR, name: "counter/drawer", label: "counter drawer" }],
} as unknown as Manifest;
const NONE: Barriers = [[-1, -1], [-1, -1]];
const HANDLES = [{ x: 0.5, z: 0 }, { x: 5, z: 0 }];

/** The player at x = 0; the mug and the pan at the x given, in the hand of an agent. */
function at(mug: number, pan: number, barriers: Barriers, held = -1, joints = [0, 0], handles = HANDLES): [Situation, State] {
  const things = [mug, pan].map((x, k) => ({ held: k ? -1 : held, pose: Float32Array.of(x, 1, 0, 0, 0, 0, 1) }));
  const state = { things, agents: [{ x: 0, z: 0, heading: 0 }], joints: Float32Array.from(joints) } as unknown as State;
  return [situation(MANIFEST, state, 0, { x: 0, z: 0, heading: 0 }, barriers, handles), state];
}

test("where nothing opens, one press takes", () => {
  const [now] = at(3, 4, [], -1, [], []);
  assert.deepEqual([deed(now, false), deed(now, true)], [{ kind: "take", thing: 0 }, { kind: "take", thing: 0 }]);
  assert.equal(now.joint, -1);
});

test("things are offered where they have been seen, and those never seen are not", () => {
  const [all, state] = at(3, 4, []);
  const where = (seen: Seen | null): Situation => situation(MANIFEST, state, 0, { x: 0, z: 0, heading: 0 }, [], [], seen);
  assert.deepEqual([all.next, all.far], [0, 3]);
  const never = where([null, null]);
  assert.deepEqual([never.next, never.known, deed(never, true)], [-1, [null, null], { kind: "none" }]);
  assert.deepEqual(hints(never, MANIFEST, state, "keys", null), []);
  const moved = where([null, [2, 1, 0]]);
  assert.deepEqual([moved.next, moved.far, moved.known[1]], [1, 2, { x: 2, y: 1, z: 0 }]);
  const [, held] = at(3, 4, [], 0);
  assert.deepEqual(situation(MANIFEST, held, 0, { x: 0, z: 0, heading: 0 }, [], [], [null, null]).known[0], { x: 3, y: 1, z: 0 });
});

test("who carries a tray is offered what can be done with it and nothing else", () => {
  const [, state] = at(0.6, 4, NONE);
  const tray = { held: 0, pose: Float32Array.of(0.3, 1, 0, 0, 0, 0, 1) };
  const carrying = { ...state, things: [...state.things, tray] } as State;
  const now = situation(MANIFEST, carrying, 0, { x: 0, z: 0, heading: 0 }, NONE, HANDLES);
  assert.deepEqual([now.held, now.next, deed(now, true)], [-1, -1, { kind: "none" }]);
  assert.deepEqual(hints(now, MANIFEST, carrying, "keys", null), []);
  const chores: Chore[] = [{ name: "put", thing: "tray" }];
  assert.deepEqual(choreHints(chores, "keys"), [["K", "put the tray down"]]);
  assert.deepEqual(choreHints(chores, "touch"), [["Put down", "put the tray down"]]);
  assert.deepEqual(choreHints([{ name: "phone", thing: "phone" }], "mouse"), [["P", "put the phone away"]]);
});

test("keys of postures and gestures are named where they are possible", () => {
  assert.deepEqual(postureHints(16 | 128, "keys", []), [["C", "Sit down"], ["X", "Wave"], ["P", "Phone"]]);
  assert.deepEqual(postureHints(64, "mouse", ["dance"]), [["C", "Get up"]]);
  assert.deepEqual(postureHints(16 | 32 | 128, "touch", ["dance"]), []);
  assert.deepEqual(postureHints(128, "keys", ["dance", "stretch_arms"]).slice(2), [["1", "dance"], ["2", "stretch arms"]]);
});

test("what is shut in is not taken before it is open", () => {
  const [now, state] = at(3, 4, [[1, -1], [-1, -1]]);
  for (const lead of [false, true]) assert.deepEqual(deed(now, lead), { kind: "turn", joint: 1 });
  assert.deepEqual(hints(now, MANIFEST, state, "keys", null)[0], ["F", "open the counter drawer: the mug is in it"]);
  const [open] = at(3, 4, NONE, -1, [0, 1.5]);
  assert.deepEqual(deed(open, true), { kind: "take", thing: 0 });
});

test("a place that is shut is opened before its thing is fetched, but what is near may be taken", () => {
  const [now, state] = at(0.6, 4, [[-1, 1], [-1, -1]]);
  assert.deepEqual(deed(now, true), { kind: "turn", joint: 1 });
  assert.deepEqual(deed(now, false), { kind: "take", thing: 0 });
  const said = hints(now, MANIFEST, state, "keys", null).slice(0, 2);
  assert.deepEqual(said, [["E", "take the mug"], ["F", "open the counter drawer: the mug goes there"]]);
});

test("a door between rooms is opened before what is, or belongs, behind it", () => {
  const rooms = { ...MANIFEST, joints: [DOOR, { ...DOOR, label: "door", passage: true }] } as unknown as Manifest;
  const said = ([[[1, -1], [-1, -1]], [[-1, 1], [-1, -1]]] as Barriers[]).map((barriers) => {
    const [now, state] = at(3, 4, barriers);
    assert.deepEqual(deed(now, true), { kind: "turn", joint: 1 });
    return hints(now, rooms, state, "keys", null)[0]![1];
  });
  assert.deepEqual(said, ["open the door: the mug is behind it", "open the door: the mug belongs behind it"]);
});

test("with nothing to take nearby, the door that is near is opened or closed", () => {
  const [now, state] = at(3, 4, NONE);
  assert.deepEqual(deed(now, false), { kind: "turn", joint: 0 });
  assert.deepEqual(deed(now, true), { kind: "take", thing: 0 });
  assert.deepEqual(hints(now, MANIFEST, state, "pad", null).at(-1), ["LB", "open the fridge door"]);
  const [, open] = at(3, 4, NONE, -1, [1.5, 0]);
  assert.equal(turnText(MANIFEST, open, 0), "close the fridge door");
});

test("who holds something puts it down: doors take an empty hand", () => {
  const [now, state] = at(3, 4, [[-1, 0], [-1, -1]], 0);
  for (const lead of [false, true]) assert.equal(deed(now, lead).kind, "put");
  assert.ok(!JSON.stringify(hints(now, MANIFEST, state, "keys", null)).includes("fridge"));
});

test("who clicks or taps is told of clicks and buttons, not of keys", () => {
  const [far, state] = at(3, 4, NONE, -1, [], []);
  const [held] = at(3, 4, NONE, 0, [], []);
  for (const now of [far, held])
    for (const device of ["mouse", "touch", "pad"])
      for (const [key] of hints(now, MANIFEST, state, device, null)) assert.ok(!["E", "F", "G", "O", "Q"].includes(key), `${device}: ${key}`);
  assert.deepEqual(hints(far, MANIFEST, state, "mouse", null), [["Click", "on the mug to walk there and take it"]]);
  assert.deepEqual(hints(far, MANIFEST, state, "touch", null), [["Fetch", "walk to the mug and take it"]]);
});

test("who is walked by the server is told how to go elsewhere by what they act with", () => {
  const said = ["keys", "mouse", "touch", "pad"].map((device) => busyHints(device));
  const elsewhere = "on the floor to walk there instead";
  assert.deepEqual(said, [[["W", "to steer yourself again"]], [["Click", elsewhere]], [["Tap", elsewhere]], []]);
});

test("what is used is used by a key only by who has keys", () => {
  assert.deepEqual(["keys", "mouse", "touch", "pad"].map(useKey), ["R", "Do", "Do", ""]);
});
