"""Depths by which bodies of a recording penetrate the home, by FCL for all parts of agents and held things.

Doors and drawers are where they are in each step, and things that other people carry, such as trays, count like the
home while they move.

The simulation keeps the base of a robot and the path of a person out of walls and furniture, but does not check arms
and feet. This module checks them afterwards.

Some contact is intended. While an agent picks or places, its hand, the forearm of a person and the held thing may be
inside the furniture on or in which the object lies or will lie, because a thing on a shelf is taken from inside it. The
hand and forearm of an agent that opens or closes a door or drawer, or takes something behind it, may be in it. The
hand of a person who knocks may be inside the surface, because its capsule is thicker than the knuckles
(`benchmarks.activities` measures this). All other contact counts, such as the same hand in the wall next to the shelf,
an upper arm in the shelf, or contact of the object while it is carried.

Contact with the surface on which a person lies does not count either. The capsules of a trunk are as thick as the trunk
is broad, so that they reach deeper into the surface than the skin does (`benchmarks.lying` measures this).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, Array, pose_to_matrix
from h3data.recording import Body, Recording
from h3data.recording.records import JOINTS
from h3data.replay import Replay
from h3data.scene import Shape
from h3data.scene.articulation import joints_of
from h3data.scene.records import Box, Capsule, Instance, instance_matrix
from h3data.scene.shape_bounds import shape_bounds
from h3data_pipelines.validation.recordings import Finding
from sim_kinematic.agents.robots.arm_clearance import arm_links
from sim_kinematic.contact import FclScene, MovingShapes, contacts
from sim_kinematic.contact.clearance import FLOOR_M, supports
from sim_kinematic.contact.frames import body_shapes, shape_frames

CORE_M = 1e-3
"""Radius of the thin core of a capsule, from which depth is measured [m]."""
CHORE_EVENTS = ("activity", "takes", "puts", "walks_to")
"""Kinds of events of people who do chores (`sim_kinematic.crowd.errands.HandWork`)."""
REACHING, TURNING = ("pick", "place", "drop"), ("open", "close")
"""Names of skills in which a hand approaches the surface on which an object lies, or leads a door or drawer."""
MOVES_M = 1e-4
"""Distance from step to step from which on a thing counts as carried [m]."""
HELD = "held object"
"""Name of the part that represents everything that an agent carries."""


class Penetration(NamedTuple):
    """Depths by which one agent penetrates the static things of its home."""

    agent: int
    parts: tuple[str, ...]
    """Names of the parts: capsules of a person, links of a robot (``arm``: those that move its hand), and `HELD`."""
    arm: NDArray[np.bool_]
    """Flags of parts that are arms, hands and held things, bool [P]."""
    reaching: NDArray[np.bool_]
    """Flags of parts that may enter the furniture of an object while it is picked or placed (hands, people's
    forearms and held things), bool [P].
    """
    steps: NDArray[np.intp]
    """Numbers of the checked steps, [T]."""
    depth_m: NDArray[np.float64]
    """Depth of each part, 0 if it touches nothing, [T, P] [m]. For a capsule whose axis is outside, it is the radius
    minus the distance of the axis. Otherwise it is the smaller of FCL's depth, which is too large for deep contact, and
    the shortest displacement along a world axis that ends the contact.
    """
    thing: NDArray[np.object_]
    """Name of the instance that each part enters most deeply, or of a thing that another agent carries; empty for none,
    [T, P]."""
    kind: NDArray[np.object_]
    """Kind of this thing: ``home``, ``door`` (also a drawer, if it ever moves) or ``carried``; empty for none, [T, P]."""
    intended: NDArray[np.bool_]
    """Flags of contacts that the agent intends, bool [T, P]."""

    @property
    def unintended_m(self) -> NDArray[np.float64]:
        """``depth_m`` without intended contact, [T, P] [m]."""
        return np.where(self.intended, 0.0, self.depth_m)


def penetrations(recording: Recording, *, every: int = 1, moved: bool = True) -> list[Penetration]:
    """Measure the penetration of all agents with built-in bodies, at every n-th step.

    Without ``moved``, doors and drawers that ever move, and things that are carried, are left out.

    A robot may stand on things on the floor that are up to `FLOOR_M` high. People have no such allowance, but floors
    have no collision shapes.

    Raises:
        InputError: the recording carries no scene, or ``every`` is not at least 1.
    """
    replay = Replay(recording)
    if replay.scene is None:
        raise InputError(
            "Penetration is measured in the recording's own scene, and it has no attachment scene.glb.",
            code="H3-SIM-011",
        )
    if every < 1:
        raise InputError(f"Expected every so many-th step, at least 1, got {every}.", code="H3-SIM-012")
    steps, scenery = np.arange(0, len(recording), every), _Scenery(replay, moved=moved)
    return [_of_agent(replay, k, steps, scenery) for k, agent in enumerate(recording.agents) if agent.model]


def unintended_depth(measured: Sequence[Penetration]) -> NDArray[np.float64]:
    """Return the depth of the deepest part of any agent in each checked step, without intended contact, [T] [m]."""
    deepest = np.zeros(len(measured[0].steps) if measured else 0)
    for found in measured:
        deepest = np.maximum(deepest, found.unintended_m.max(1))
    return deepest


def penetration_findings(recording: Recording, *, limit_m: float = 0.02) -> list[Finding]:
    """Return a warning for each part of an agent that is deeper than ``limit_m`` in a thing, without intended contact.

    Recordings without a scene, or whose agents have no built-in body, give no warnings.
    """
    if "scene.glb" not in recording.attachments:
        return []
    findings = []
    for found in penetrations(recording):
        depth = found.unintended_m
        for part, deep, things in zip(found.parts, depth.T, found.thing.T, strict=True):
            over = deep > limit_m
            if not over.any():
                continue
            worst = int(deep.argmax())
            share = f"deeper than {100 * limit_m:g} cm in {over.mean():.1%} of the steps"
            text = f"{100 * deep[worst]:.1f} cm deep in {things[worst]}; {share}"
            subject, first = f"{recording.agents[found.agent].name}, {part}", int(found.steps[over.argmax()])
            findings.append(
                Finding(
                    check="penetration",
                    severity="warning",
                    subject=subject,
                    text=text,
                    step=first,
                    count=int(over.sum()),
                )
            )
    return findings


def _supports(recording: Recording, agent: int, steps: NDArray[np.intp], scenery: _Scenery) -> list[frozenset[str]]:
    """Return names of the things on which the object lies, or is to lie, that an agent picks or places in each step."""
    moving = {body.name: body.moving for body in recording.bodies}
    found = [frozenset[str]()] * len(steps)
    spans = [
        (span.name == "pick", span.target, span.start_step, span.end_step)
        for span in recording.skills
        if span.agent == agent and span.name in REACHING
    ]
    for span in recording.skills:
        if span.agent == agent and span.name in TURNING:
            for row in np.flatnonzero((steps >= span.start_step) & (steps <= span.end_step)):
                found[row] = found[row] | {span.target}
    # a chore lasts from the activity to the next way, and what is taken or put down is told in between
    told = [event for event in recording.events if event.agent == agent and event.kind in CHORE_EVENTS]
    for k, event in enumerate(told):
        if event.kind == "activity" and event.target == "knocking":
            ends = told[k + 1].step if k + 1 < len(told) else len(recording)
            for row in np.flatnonzero((steps >= event.step) & (steps < ends)):
                found[row] = frozenset((event.detail,))
        if event.kind in ("takes", "puts"):
            ends = told[k + 1].step if k + 1 < len(told) else len(recording) - 1
            spans.append((event.kind == "takes", event.target, told[max(k - 1, 0)].step, ends))
    for picks, target, start, end in spans:
        if moving.get(target, -1) < 0:
            continue
        lies_at = start if picks else min(end, len(recording) - 1)
        point = recording.columns["object_pose"][lies_at, moving[target], :3].astype(np.float64)
        things = frozenset(scenery.supports(point))
        for row in np.flatnonzero((steps >= start) & (steps <= end)):
            found[row] = found[row] | things
    return found


def _of_agent(replay: Replay, number: int, steps: NDArray[np.intp], scenery: _Scenery) -> Penetration:
    body = replay.model(number)
    if isinstance(body, Robot):
        frames, lift_m = replay.link_matrices(number, steps).astype(np.float64), FLOOR_M
        parts = tuple(link.name for link in body.links)
        of_part = np.array([k for k, link in enumerate(body.links) for _ in link.shapes])
        arm = np.isin(np.arange(len(parts)), arm_links(body)) if body.hand_link >= 0 else np.zeros(len(parts), np.bool_)
        reaching = np.array(
            [link == body.hand_link or body.links[link].parent == body.hand_link for link in range(len(parts))]
        )
        reaching &= body.hand_link >= 0
    else:
        frames, lift_m = replay.joint_matrices(number, steps), 0.0
        parts = tuple(capsule.name for capsule in body.capsules)
        of_part = np.arange(len(parts))
        arm = np.array([name.endswith(("upper_arm", "forearm", "hand")) for name in parts])
        reaching = np.array([name.endswith(("forearm", "hand")) for name in parts])
    shapes = np.array(shape_frames(body, frames), np.float64)
    shapes[..., 1, 3] += lift_m
    own = replay.recording.agents[number].name
    depth, thing = scenery.depths(body_shapes(body), shapes, steps, own)
    depth, thing = _deepest(depth, thing, of_part, len(parts))
    held_depth, held_thing = _held(replay, number, steps, scenery)
    depth, thing = np.column_stack([depth, held_depth]), np.column_stack([thing, held_thing])
    reaching, intended = np.append(reaching, True), np.zeros(depth.shape, np.bool_)
    for row, things in enumerate(_supports(replay.recording, number, steps, scenery)):
        if things:
            # a door counts like its furniture: the hand leads it, or passes it where it reaches behind it
            meant = [name in things or name.partition("/")[0] in things for name in thing[row]]
            intended[row] = reaching & np.array(meant, np.bool_)
    seat = replay.recording.columns.get(f"agent_{number}.motion_seat")
    beds = [event for event in replay.recording.events if event.agent == number and event.kind == "sits_down"]
    if seat is not None and beds:
        last = np.searchsorted([event.step for event in beds], steps, "right") - 1
        names = np.array([event.target.partition(":")[0] for event in beds], object)[np.maximum(last, 0)]
        intended |= (thing == names[:, None]) & (seat[steps, 1] > 1)[:, None]
    return Penetration(
        agent=number,
        parts=(*parts, HELD),
        arm=np.append(arm, True),
        reaching=reaching,
        steps=steps,
        depth_m=depth,
        thing=thing,
        kind=scenery.kinds(thing, steps),
        intended=intended,
    )


def _deepest(
    depth: NDArray[np.float64], thing: NDArray[np.object_], of_part: NDArray[np.intp], parts: int
) -> tuple[NDArray[np.float64], NDArray[np.object_]]:
    """Return the greatest depth [T, P] of the shapes [T, S] of each part, and the thing in which that shape is."""
    best, where = np.zeros((len(depth), parts)), np.full((len(depth), parts), "", object)
    for shape, part in enumerate(of_part):
        deeper = depth[:, shape] > best[:, part]
        best[deeper, part], where[deeper, part] = depth[deeper, shape], thing[deeper, shape]
    return best, where


def _held(
    replay: Replay, number: int, steps: NDArray[np.intp], scenery: _Scenery
) -> tuple[NDArray[np.float64], NDArray[np.object_]]:
    """Return the depth [T] and thing [T] of what the agent holds."""
    recording, scene = replay.recording, replay.scene
    assert scene is not None
    depth, thing = np.zeros(len(steps)), np.full(len(steps), "", object)
    held = recording.columns.get(f"agent_{number}.grasp_body")
    if held is None:
        return depth, thing
    for index in np.unique(held[steps][held[steps] >= 0]):
        body = recording.bodies[index]
        shapes = tuple(scene.assets[body.asset].shapes) if body.asset in scene.assets else ()
        rows = np.flatnonzero(held[steps] == index)
        if body.moving < 0 or not shapes:
            continue
        poses = pose_to_matrix(recording.columns["object_pose"][steps[rows], body.moving].astype(np.float64))
        frames = np.tile(poses[:, None], (1, len(shapes), 1, 1)).astype(np.float64)
        of_shapes, where = scenery.depths(shapes, frames, steps[rows], recording.agents[number].name)
        best, names = _deepest(of_shapes, where, np.zeros(len(shapes), np.intp), 1)
        depth[rows], thing[rows] = best[:, 0], names[:, 0]
    return depth, thing


class _Scenery:
    """Things of a home in each step of a recording, and depths of shapes in them."""

    def __init__(self, replay: Replay, *, moved: bool) -> None:
        scene, recording = replay.scene, replay.recording
        assert scene is not None
        self._all = FclScene(scene)
        joints, positions = joints_of(scene), recording.columns.get(JOINTS, np.zeros((1, len(joints_of(scene)))))
        turned = np.flatnonzero((positions != joints.rest.astype(positions.dtype)).any(0)) if len(joints) else []
        doors = [each for each in scene.static_instances if joints.owner.get(each.name, -1) in turned]
        names = {each.name for each in doors}
        still = tuple(each for each in scene.instances if each.name not in names)
        self._scene = FclScene(replace(scene, instances=still, articulations=())) if doors else self._all
        # in the order of the objects of `FclScene`
        self._bounds = [
            shape_bounds(shape, instance_matrix(instance))
            for instance in still
            if instance.motion == "static"
            for shape in scene.assets[instance.asset].shapes
        ]
        self._moved: list[_Moved] = []
        """Things that move."""
        if moved and doors:
            turns = replay.joint_motions(np.arange(len(recording)))
            self._moved += [
                _Moved.door(door, scene.assets[door.asset].shapes, turns[:, joints.owner[door.name]]) for door in doors
            ]
        if moved:
            self._moved += [_Moved.carried(recording, body) for body in _brought(recording)]

    def kinds(self, thing: NDArray[np.object_], steps: NDArray[np.intp]) -> NDArray[np.object_]:
        """Return the kinds [T, P] of things, given their names [T, P] at steps [T]."""
        out = np.where(thing == "", "", "home").astype(object)
        for moved in self._moved:
            out[(thing == moved.name) & moved.away[steps, None]] = moved.kind
        return out

    def depths(
        self, shapes: Sequence[Shape], frames: NDArray[np.float64], steps: NDArray[np.intp], agent: str
    ) -> tuple[NDArray[np.float64], NDArray[np.object_]]:
        """Return depths [T, S] [m] of an agent's shapes in frames [T, S, 4, 4] at steps [T], and the deepest things' names."""
        depth, thing = np.zeros(frames.shape[:2]), np.full(frames.shape[:2], "", object)
        moving, cores = MovingShapes(shapes), MovingShapes([_core(shape) for shape in shapes])
        others = [moved for moved in self._moved if not moved.name.startswith(f"{agent}_")]
        for t, (step, pose) in enumerate(zip(steps.tolist(), frames, strict=True)):
            moving.set_transforms(pose)
            near: list[_Moved] = []
            if others:
                low, high = _bounds_of(shapes, pose)
                near = [moved for moved in others if moved.is_near(step, low, high)]
            for names, there, bounds in [
                (self._scene.names, self._scene, self._bounds),
                *((moved.names, moved.at(step), moved.bounds(step)) for moved in near),
            ]:
                deepest: dict[tuple[int, int], float] = {}
                for contact in contacts(there, moving):  # deepest first
                    deepest.setdefault((contact.index_a, contact.index_b), contact.depth_m)
                if deepest:
                    cores.set_transforms(pose)
                for (a, b), deep in deepest.items():
                    gap = _gap(there.objects[a], cores, b) if isinstance(shapes[b], Capsule) else 0.0
                    if gap > 0:
                        deep = shapes[b].radius - CORE_M - gap  # pyright: ignore[reportAttributeAccessIssue]
                    else:
                        deep = min(deep, _way_out(bounds[a], shape_bounds(shapes[b], pose[b])))
                    if deep > depth[t, b]:
                        depth[t, b], thing[t, b] = deep, names[a]
        return depth, thing

    def supports(self, point: Array) -> set[str]:
        """Return names of the things on which something at a world point [3] lies."""
        return supports(self._all, point)


class _Moved:
    """Thing that moves along a recording, as convex shapes."""

    def __init__(
        self,
        name: str,
        kind: str,
        shapes: Sequence[Shape],
        frames: Array,
        scale: Sequence[float],
        away: NDArray[np.bool_],
    ) -> None:
        """Create a thing with shapes in frames [T, 4, 4], NaN where it is absent, and flags [T] of where it is moved."""
        self.name, self.kind, self.names = name, kind, [name] * len(shapes)
        self._shapes, self._frames, self._moving = tuple(shapes), frames, MovingShapes(shapes, scale)
        self._scale, self.away = np.diag([*scale, 1.0]), away

    @classmethod
    def door(cls, door: Instance, shapes: Sequence[Shape], turns: Array) -> _Moved:
        """Return a door or drawer that moves by ``turns`` [T, 4, 4]; where these are the identity, it is a part of the home."""
        frames = turns @ pose_to_matrix(np.asarray(door.pose, np.float64))
        return cls(door.name, "door", shapes, frames, tuple(door.scale.tolist()), (turns != np.eye(4)).any((1, 2)))

    @classmethod
    def carried(cls, recording: Recording, body: Body) -> _Moved:
        """Return a thing that a person brought along, a box that counts only while it moves."""
        frames = pose_to_matrix(recording.columns["object_pose"][:, body.moving].astype(np.float64))
        apart = np.abs(np.diff(frames[:, :3, 3], axis=0)).max(1, initial=0.0) > MOVES_M
        moves = np.zeros(len(frames), np.bool_)
        moves[1:] |= apart
        moves[:-1] |= apart
        frames[~moves] = np.nan
        # the solid cube of these things has sides of 2 m before it is scaled
        box = Box(pose=IDENTITY_POSE, half_extents=body.scale.astype(np.float64))
        return cls(body.name, "carried", [box], frames, (1.0, 1.0, 1.0), moves)

    def bounds(self, step: int) -> list[Array]:
        """Return the bounds [2, 3] [m] of each shape in a step."""
        return [shape_bounds(shape, self._frames[step] @ self._scale) for shape in self._shapes]

    def is_near(self, step: int, low: Array, high: Array) -> bool:
        """Return whether the thing may touch what is between two corners [3] [m]."""
        if not np.isfinite(self._frames[step]).all():
            return False
        return any((box[0] <= high).all() and (box[1] >= low).all() for box in self.bounds(step))

    def at(self, step: int) -> MovingShapes:
        """Return the shapes where they are in a step."""
        self._moving.set_transforms(np.broadcast_to(self._frames[step], (len(self._shapes), 4, 4)))
        return self._moving


def _bounds_of(shapes: Sequence[Shape], frames: Array) -> tuple[Array, Array]:
    """Return the corners [3] [m] of a box around shapes in frames [S, 4, 4]."""
    boxes = np.array([shape_bounds(shape, frame) for shape, frame in zip(shapes, frames, strict=True)])
    return boxes[:, 0].min(0), boxes[:, 1].max(0)


def _gap(thing: Any, cores: MovingShapes, b: int) -> float:
    """Return the distance [m] from a thing to the core of capsule ``b``, not above 0 where it is inside."""
    import fcl

    return float(fcl.distance(thing, cores.objects[b], fcl.DistanceRequest(), fcl.DistanceResult()))


def _brought(recording: Recording) -> list[Body]:
    """Return the trays and cartons that people brought along, which are named after them."""
    owners = tuple(f"{agent.name}_{thing}" for agent in recording.agents for thing in ("tray", "carton"))
    return [body for body in recording.moving_bodies if body.name.startswith(owners)]


def _core(shape: Shape) -> Shape:
    """Return a capsule made thin; other shapes stay."""
    return Capsule(start=shape.start, end=shape.end, radius=CORE_M) if isinstance(shape, Capsule) else shape


def _way_out(thing: Array, part: Array) -> float:
    """Return the shortest displacement [m] along a world axis that separates two overlapping boxes [2, 3]."""
    return float(np.minimum(part[1] - thing[0], thing[1] - part[0]).min())
