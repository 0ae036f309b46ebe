"""Contact and motion of people who do chores: all bodies empty a fridge, carry a tray and look at a phone.

Each body does all of it in one home that opens, alone. Skin is that of the light mesh; all figures are the worst of all bodies.

``motion.chores.handle``, ``motion.chores.grip``
    Distance of the palm from the handle while it leads the door, and of the palms from the ends of the tray.
``motion.chores.slide``, ``motion.chores.joint``
    Displacement of an ankle during a chore, and the fastest joint but those of the legs.
``motion.chores.undone``
    Chores that a body refuses or cannot do from where it came to stand.
``penetration.chores.home``
    Depth of any capsule of the body in the home during chores, and of arms at any time, as in `benchmarks.penetration`, without
    the door.
``penetration.chores.door``, ``penetration.chores.tray``
    Depth of any skin but that of hands in the leaf of the door, and in the tray.

    python -m benchmarks chores
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

import h3data
from h3data.bodies import JOINT_INDEX, Humanoid, humanoid_names
from h3data.bodies.people.reach import hand_points
from h3data.bodies.people.skeleton import JOINT_NAMES, PARENTS
from h3data.geometry import Array, pose_to_matrix, quat_from_matrix
from h3data.recording import Recording
from h3data.recording.records import JOINTS
from h3data.replay import Replay
from h3data.scene.articulation import handle_points, joints_of
from h3data.scene.records import Box, instance_matrix
from h3data_crowds.chores import CHORES, FINGERS, GRIP_BACK_M, TRAY_M, ChoreRoutine
from h3data_crowds.routines import Stop
from h3data_pipelines.validation.penetration import penetrations
from sim_kinematic.policies.crowd.people import CrowdPolicy

HOME, SECONDS, SEED = "medium-open:3", 72, 3
STOPS = (
    Stop("fridge_0", "take", 12.5),
    Stop("kitchen_counter_0", "put", 9.0),
    Stop("dining_table_0", "lift", 8.5),
    Stop("kitchen_counter_2", "put", 9.0),
    Stop("window_0", "phone", 8.0),
)
HANDS = [k for k, name in enumerate(JOINT_NAMES) if any(part in name for part in FINGERS)]
TURNS = [
    k for k, name in enumerate(JOINT_NAMES[1:]) if not any(part in name for part in ("hip", "knee", "ankle", "foot"))
]
"""Joints but those of the legs, which turn faster in every walk."""
ANKLES = [JOINT_INDEX["left_ankle"], JOINT_INDEX["right_ankle"]]


def resident(task: object, episode: object, number: int) -> CrowdPolicy:
    """Return the policy of the person."""
    own, start = episode.roster[number].body, episode.starts[number, :2]  # pyright: ignore[reportAttributeAccessIssue]
    routine = ChoreRoutine(episode.scene, episode.free, STOPS, own, start=start)  # pyright: ignore[reportAttributeAccessIssue]
    return CrowdPolicy("orca", episode.free, episode.seed, number, episode.spec.human, routine=routine)  # pyright: ignore[reportAttributeAccessIssue]


def played(body: str) -> Recording:
    """Return a recording of a body that does all chores."""
    agents = {"human": "benchmarks.chores:resident"}
    return h3data.simulate("wander", HOME, roster=[body], agents=agents, seed=SEED, max_steps=30 * SECONDS)


def figures_of(recording: Recording) -> dict[str, float]:
    """Return figures of one recording."""
    replay = Replay(recording)
    body, steps = replay.model(0), np.arange(len(recording))
    assert isinstance(body, Humanoid)
    assert replay.scene is not None
    frames = replay.joint_matrices(0, steps)
    palms = np.stack([hand_points(frames, body, hand) for hand in ("left", "right")], 1)
    out = {"handle_mm": 0.0, "grip_mm": 0.0, "slide_mm": 0.0, "door_mm": 0.0, "tray_mm": 0.0}
    joints, positions = joints_of(replay.scene), recording.columns[JOINTS].astype(np.float64)
    skin = body.skin(frames)[:, ~np.isin(body.lod.owners, HANDS)].astype(np.float64)
    for k in np.flatnonzero(np.ptp(positions, axis=0) > 0).tolist():
        moves = np.flatnonzero(np.abs(np.diff(positions[:, k])) > 1e-4)
        motions = joints.motions(positions[moves])[:, k]
        handle = motions[:, :3, :3] @ handle_points(replay.scene)[k] + motions[:, :3, 3]
        out["handle_mm"] = 1000 * float(np.linalg.norm(palms[moves] - handle[:, None], axis=2).min(1).max())
        leaf = next(each for each in replay.scene.instances if joints.owner.get(each.name) == k)
        own = positions[:, k] > 1e-4
        back = np.linalg.inv(joints.motions(positions[own])[:, k])
        # the panel alone, without the handle that is held
        (panel,) = replay.scene.assets[leaf.asset].shapes
        assert isinstance(panel, Box)
        back = np.linalg.inv(instance_matrix(leaf) @ pose_to_matrix(panel.pose)) @ back
        box = np.stack([-panel.half_extents, panel.half_extents])
        out["door_mm"] = 1000 * _deepest(skin[own], back, box)
    for thing in recording.moving_bodies:
        track = recording.columns["object_pose"][:, thing.moving].astype(np.float64)
        if "tray" not in thing.name:
            continue
        moves = np.flatnonzero(np.linalg.norm(np.diff(track[:, :3], axis=0), axis=1) > 1e-6)
        ends = np.array([[-GRIP_BACK_M, 0, -TRAY_M[2]], [-GRIP_BACK_M, 0, TRAY_M[2]]])
        there = pose_to_matrix(track[moves])
        grips = np.stack([there[:, :3, :3] @ end + there[:, :3, 3] for end in ends], 1)
        out["grip_mm"] = 1000 * float(np.linalg.norm(palms[moves] - grips, axis=2).max())
        box = np.stack([-TRAY_M, TRAY_M])
        out["tray_mm"] = 1000 * _deepest(skin[moves], np.linalg.inv(there), box)
    turns = [event for event in recording.events if event.kind in ("activity", "walks_to")]
    spans = [
        (event.step, after.step)
        for event, after in pairwise(turns)
        if event.kind == "activity" and event.target in CHORES and event.target != "phone"
    ]
    for begin, end in spans:
        # from the first step in which the body leans, after those of arriving, until the first of going on
        led = recording.columns["agent_0.motion_hands"][begin:end, 2:, 3].any(1)
        rows = slice(begin + int(led.argmax()), end - 5)
        ankles = frames[rows][:, ANKLES][..., :3, 3]
        out["slide_mm"] = max(out["slide_mm"], 1000 * float(np.linalg.norm(ankles - ankles[:1], axis=-1).max()))
    turned = frames[..., :3, :3].astype(np.float64)
    quats = quat_from_matrix(turned[:, PARENTS[1:]].swapaxes(2, 3) @ turned[:, 1:])
    dots = np.minimum(np.abs(np.sum(quats[1:, TURNS] * quats[:-1, TURNS], axis=-1)), 1)
    out["joint_deg"] = float(np.degrees(2 * np.arccos(dots)).max())
    done = [event.kind for event in recording.events if event.kind in ("takes", "puts")]
    out["undone"] = float(4 - min(len(done), 4))
    (found,) = penetrations(recording, every=3, moved=False)
    busy = np.zeros(len(recording), np.bool_)
    for begin, end in spans:
        busy[begin + 30 : end] = True
    depth = np.where(busy[found.steps, None] | found.arm, found.unintended_m, 0.0)
    out["home_mm"] = 1000 * float(depth.max())
    row, part = np.unravel_index(depth.argmax(), depth.shape)
    print(f"  deepest: {found.parts[part]} in {found.thing[row, part] or 'nothing'} at step {found.steps[row]}")
    return out


def _deepest(skin: Array, back: Array, box: Array) -> float:
    """Return greatest depth [m] of points [T, V, 3] in a box [2, 3] in frames whose inverses are ``back`` [T, 4, 4]."""
    points = np.einsum("tab,tvb->tva", back[:, :3, :3], skin) + back[:, None, :3, 3]
    return max(float(np.minimum(points - box[0], box[1] - points).min(2).max()), 0.0)


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit the worst figures over all bodies."""
    figures = []
    for name in humanoid_names():
        figures.append(own := figures_of(played(name)))
        print(f"  {name}: {', '.join(f'{key} {value:.3g}' for key, value in own.items())}", flush=True)
    worst = {key: max(own[key] for own in figures) for key in figures[0]}
    for key in ("handle", "grip", "slide"):
        emit(f"motion.chores.{key}", worst[f"{key}_mm"], "mm")
    emit("motion.chores.joint", worst["joint_deg"], "degrees in a step of 1/30 s")
    emit("motion.chores.undone", sum(own["undone"] for own in figures), f"of {4 * len(figures)}")
    for key in ("home", "door", "tray"):
        emit(f"penetration.chores.{key}", worst[f"{key}_mm"], "mm")
