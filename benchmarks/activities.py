"""Contact and pops of all bodies in everything that people of routines do: a line for each activity.

Each body is alone in one home that opens, and does one activity after the other: it takes something out of a fridge and puts it
down, lifts a tray and puts it down, looks at a phone, waves, knocks at a door, washes dishes, sits and reads, and lies down.
All figures are the worst of all bodies.

``penetration.activity.<name>``
    Depth of any capsule of the body in the home, as in `benchmarks.penetration`, from the moment the person has come to the
    place until they leave. Doors that they open are left out; `benchmarks.chores` looks at these with the skin. So is the bed
    on which somebody lies (`benchmarks.lying`), and what a hand knocks at (the next line).
``penetration.activity.knuckles``
    Depth of the skin of the right hand in the door at which the person knocks; below 0, the least distance from it.
``penetration.walk``
    The same depth on the way from one activity to the next.
``motion.activity.<name>.pops``
    Steps in which a joint moves as far as in `benchmarks.motion`.
``motion.activity.<name>.undone``
    Bodies that do not do it: no place allows it, or nobody of their size can use the seat.

    python -m benchmarks activities
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import h3data
from benchmarks.chores import HOME, SEED, STOPS
from benchmarks.motion import motion_of
from h3data.bodies import Humanoid, humanoid_names
from h3data.geometry import pose_to_matrix
from h3data.recording import Recording
from h3data.replay import Replay
from h3data.scene.records import Box, instance_matrix
from h3data_crowds.chores import HAND, ChoreRoutine
from h3data_crowds.routines import Stop
from h3data_pipelines.validation.penetration import penetrations
from sim_kinematic.policies.crowd.people import CrowdPolicy

DOOR = "front_door"
OTHERS = (
    Stop("window_0", "wave", 5.0),
    Stop(DOOR, "knock", 5.0),
    Stop("kitchen_counter_4", "dishes", 8.0),
    Stop("sofa_0", "read", 6.0),
    Stop("bed_0", "rest", 6.0),
)
"""Activities in addition to the chores of `benchmarks.chores`, near each other."""
SECONDS = 175
NAMES = {"knocking": "knock", "read": "sit", "rest": "lie"}
"""Names of activities in figures, by their names in events."""
SEATED = ("sit", "lie")


class Figures(NamedTuple):
    """Figures of one activity of one body: depths, pops and completion."""

    depth_m: float
    pops: int
    part: str
    """Part of the body that is deepest, and the thing in which it is."""


def resident(task: object, episode: Any, number: int) -> CrowdPolicy:
    """Return the policy of the person."""
    own, start = episode.roster[number].body, episode.starts[number, :2]
    routine = ChoreRoutine(episode.scene, episode.free, (*STOPS, *OTHERS), own, start=start)
    return CrowdPolicy("orca", episode.free, episode.seed, number, episode.spec.human, routine=routine)  # pyright: ignore[reportArgumentType]


def played(body: str) -> Recording:
    """Return the recording of a body that does everything."""
    agents = {"human": f"{__name__}:resident"}
    return h3data.simulate("wander", HOME, roster=[body], agents=agents, seed=SEED, max_steps=30 * SECONDS)


def spans(recording: Recording) -> dict[str, list[tuple[int, int]]]:
    """Return first and last step of each activity of the only person, by name."""
    turns = [event for event in recording.events if event.kind in ("activity", "walks_to")]
    found = dict[str, list[tuple[int, int]]]()
    sits = [event.step for event in recording.events if event.kind == "sits_down"]
    for event, after in pairwise(turns):
        name = NAMES.get(event.target, event.target)
        # who finds no seat that fits stands beside it
        stands = name in SEATED and not any(event.step <= step < after.step for step in sits)
        if event.kind == "activity" and not stands:
            found.setdefault(name, []).append((event.step, after.step))
    return found


def figures_of(recording: Recording) -> dict[str, Figures]:
    """Return the figures of each activity, of walking in between (``walk``), and of the knuckles (``knuckles``)."""
    replay, steps = Replay(recording), np.arange(len(recording))
    body = replay.model(0)
    assert isinstance(body, Humanoid)
    base = recording.columns["agent_0.base_pose"].astype(np.float64)
    pops = motion_of(body, base, replay.joint_matrices(0, steps).astype(np.float64))["pops"]
    (found,) = penetrations(recording, moved=False)
    depth = found.unintended_m.copy()
    own, idle = spans(recording), np.ones(len(recording), np.bool_)
    rows = {name: np.concatenate([np.arange(*span) for span in parts]) for name, parts in own.items()}
    for part in rows.values():
        idle[part] = False
    out = dict[str, Figures]()
    for name, part in (*rows.items(), ("walk", np.flatnonzero(idle))):
        row, k = np.unravel_index(depth[part].argmax(), depth[part].shape)
        where = f"{found.parts[k]} in {found.thing[part[row], k]} at {part[row]}"
        out[name] = Figures(float(depth[part].max()), int(pops[part[part < len(pops)]].sum()), where)
    if "knock" in rows:
        out["knuckles"] = Figures(knuckles_m(replay, rows["knock"]), 0, f"skin in {DOOR}")
    return out


def knuckles_m(replay: Replay, rows: NDArray[np.intp]) -> float:
    """Return how deep [m] the skin of the right hand gets into the door in steps ``rows``; below 0: it stays that far away."""
    body, scene = replay.model(0), replay.scene
    assert isinstance(body, Humanoid)
    assert scene is not None
    door = next(instance for instance in scene.instances if instance.name == DOOR)
    skin = body.skin(replay.joint_matrices(0, rows))[:, np.isin(body.lod.owners, HAND)].astype(np.float64)
    deepest = -np.inf
    for shape in scene.assets[door.asset].shapes:
        assert isinstance(shape, Box)
        back = np.linalg.inv(instance_matrix(door) @ pose_to_matrix(shape.pose))
        points = skin @ back[:3, :3].T + back[:3, 3]
        deepest = max(deepest, float((shape.half_extents - np.abs(points)).min(2).max()))
    return deepest


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit the worst figures over all bodies, for each activity."""
    all_of = {name: figures_of(played(name)) for name in humanoid_names()}
    for name, own in all_of.items():
        print(f"  {name}: {', '.join(f'{key} {1000 * each.depth_m:.1f} mm' for key, each in own.items())}", flush=True)
    for key in dict.fromkeys(key for own in all_of.values() for key in own):
        there = {name: own[key] for name, own in all_of.items() if key in own}
        body = max(there, key=lambda name: there[name].depth_m)
        print(f"  {key}: deepest of {body}, {there[body].part}")
        name = "penetration.walk" if key == "walk" else f"penetration.activity.{key}"
        emit(name, 1000 * there[body].depth_m, f"mm, worst of {len(there)} bodies")
        if key not in ("knuckles", "walk"):
            emit(f"motion.activity.{key}.pops", sum(each.pops for each in there.values()), "steps")
            emit(f"motion.activity.{key}.undone", len(all_of) - len(there), f"of {len(all_of)} bodies")
