"""Chores: what people of routines do with the things of a home.

They open a fridge and take something, carry a tray with two hands, put both down elsewhere, and look at a phone.

A `ChoreRoutine` leads people to places from which their hands reach. `act_out` then moves bodies, door and things of a
recording by its events. Every posture follows from what hands touch: trunk and legs are those of reaching
(`h3data.bodies.people.reach`), and both arms are bent so that the palms are at handle, thing or tray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import JOINT_INDEX, Humanoid
from h3data.bodies.people.arms import ARM_JOINTS, bend_arms
from h3data.bodies.people.kernels.attention import curl_fingers
from h3data.bodies.people.reach import Hand, ReachPoses, grasp_point, reach_poses, reacher
from h3data.bodies.people.skeleton import PARENTS
from h3data.errors import InputError
from h3data.geometry import (
    IDENTITY_POSE,
    Array,
    ground_pose,
    heading_from_quat,
    minimum_jerk,
    pose_inverse,
    pose_to_matrix,
    quat_from_heading,
    quat_from_matrix,
    quat_nlerp,
    quat_rotate,
    transform_points,
    wrap_angle,
)
from h3data.recording import AssetRef, Body, Event, Recording, SkillSpan
from h3data.recording.records import JOINTS
from h3data.replay import Replay
from h3data.scene import FreeSpace, Scene
from h3data.scene.articulation import handle_points, joints_of
from h3data.scene.records import Instance, instance_bounds, instance_matrix
from sim_kinematic.crowd.errands import Errand
from sim_kinematic.crowd.routines import PERSON_M, Routine, Stop

CHORES = {"take": 8.0, "lift": 4.0, "put": 4.3, "phone": 3.0}
"""Chores, and the least time that each of them needs [s]. ``lift`` takes up a tray, ``put`` puts down what the hands hold."""
TRAY_M, ITEM_M = np.array([0.13, 0.012, 0.19]), np.array([0.033, 0.1, 0.033])
"""Half sizes of a tray, ahead, up and aside, and of what is taken out of a fridge."""
GRIP_BACK_M = 0.1
"""Distance of the hands behind the middle of a tray."""
OVERHANGS_M = (0.03, 0.06, 0.09, 0.11)
"""Distances of which the nearer side of a tray is over the edge of what it stands on by the first from which hands reach it."""
CARRIED = np.array([0.27, 0.80, 0.15])
"""Place of a hand that carries something, ahead, up and outwards, in heights of the shoulders."""
TRAY_AHEAD, TRAY_UP = 0.26, 0.79
"""Place of the middle of a carried tray in heights of the shoulders."""
AJAR_RAD, WIDE_RAD = 0.95, 1.3
"""Least and greatest angle of a door that a hand opens and holds while the other one reaches in."""
ROOM_M, LEAF = 0.3, 0.16
"""Least distance of a person from obstacles [m], and of the middle of the body from an open door, in body heights."""
NEIGHBOUR_M = 0.12
"""Distance of places beside each other; of two in which people are turned otherwise, a rotation by 1 rad counts as 0.1 m."""
CURL_RAD = 0.55
"""Bend of the fingers around what a hand holds."""
FARTHER_M = (0.0, 0.08, 0.16, 0.24, 0.3, 0.36, 0.42)
"""Distances of which people who reach with both hands lean farther by the first that suffices [m]."""
ASIDE_M = 0.2
"""Greatest distance aside of the middle of what people lift or put down [m]."""
POLE = (-0.35, -0.8, 0.45)
"""Direction of the elbows: back, down and outwards."""
SETTLES_S, AT_REST_M, AT_REST_RAD = 4.0, 0.012, 0.03
"""Time that people have to come to rest and to turn to the thing; they rest where they move and turn by less in 1/6 s."""
_SIDES: tuple[Hand, Hand] = ("left", "right")
_ARMS = [[JOINT_INDEX[f"{side}_{name}"] for name in ARM_JOINTS] for side in _SIDES]


class Chore(NamedTuple):
    """A chore of one body at one place, and what the hands do there."""

    name: str
    root: Array
    """Root of the person (pose7)."""
    spot: Array
    """Place of the thing that is taken, or to which it is put [3]."""
    joint: int = -1
    """Number of the door's joint; -1: nothing opens."""
    angles: Array = np.zeros(1)
    """Angles of the door while the hand leads it [N]."""
    handles: Array = np.zeros((1, 3))
    """Places of the handle at these angles [N, 3]."""
    farther_m: float = 0.0
    """Distance by which people who reach with both hands lean farther than for one of them [m]."""


class ChoreRoutine(Routine):
    """Routine with chores (`CHORES`) beside the other activities."""

    def __init__(self, scene: Scene, free: FreeSpace, stops: Sequence[Stop], body: Humanoid) -> None:
        """Check the stops as `Routine` does."""
        super().__init__(scene, free, stops, body)
        self._body, self._things = body, {"hands": ""}

    def next_stop(
        self, xz: NDArray[np.float64], taken: Sequence[Array] = ()
    ) -> tuple[NDArray[np.float64], Errand] | None:
        """Return the next stop as `Routine.next_stop`; a chore that nobody can do there is refused with the reason."""
        stop = self.stops[self._next % len(self.stops)]
        if stop.activity not in CHORES or stop.activity == "phone":
            return super().next_stop(xz, taken)
        try:
            chore = self._chore(stop, xz, taken)
        except InputError as fault:
            found = super().next_stop(xz, taken)
            return found and (found[0], found[1]._replace(refused=(stop.place, f"{fault.code}: {fault}")))
        self._next += 1
        # facing is by a point ahead
        x, _, z = (chore.root[:3] + quat_rotate(chore.root[3:], np.array([2.0, 0.0, 0.0]))).tolist()
        return np.asarray(chore.root[[0, 2]], np.float64), Errand(
            np.zeros((0, 2)), stop.seconds, (x, z), stop.activity, stop.place
        )

    def _chore(self, stop: Stop, xz: NDArray[np.float64], taken: Sequence[Array]) -> Chore:
        if stop.seconds < CHORES[stop.activity] + SETTLES_S:
            raise InputError(
                f"Expected at least {CHORES[stop.activity] + SETTLES_S:g} s for {stop.activity!r}, got {stop.seconds:g}.",
                code="H3-TASK-088",
            )
        carried = [self.stops[k % len(self.stops)].activity for k in range(self._next - len(self.stops), self._next)]
        held = next((name for name in reversed(carried) if name in ("take", "lift")), "take")
        return chore_at(self._scene, self._free, self._body, stop, near=xz, taken=taken, tray=held == "lift")


def chore_at(
    scene: Scene,
    free: FreeSpace,
    body: Humanoid,
    stop: Stop,
    *,
    near: NDArray[np.float64],
    taken: Sequence[Array] = (),
    tray: bool = False,
) -> Chore:
    """Return a chore at the best place for a body beside the thing of a stop.

    Args:
        scene: The home.
        free: Its floor.
        body: The person's body.
        stop: Thing and chore.
        near: A place [2] from which the person comes.
        taken: Places ``(x, z, ...)`` of others.
        tray: True if what the person puts down is a tray.

    Raises:
        InputError: Nothing there opens, or no place has room and is near enough for the hands.
    """
    thing = next(instance for instance in scene.instances if instance.name == stop.place)
    if stop.activity == "take":
        places, made = _before_door(scene, thing), partial(_opening, scene, body, stop.place)
    else:
        wide = stop.activity == "lift" or tray
        places, made = _around(scene, thing), partial(_surface, scene, body, thing, stop.activity, wide)
    room = free.signed_distance(places[:, :2]) >= ROOM_M
    room &= np.isfinite(free.geodesic(np.broadcast_to(near, places[:, :2].shape), places[:, :2]))
    for other in taken:
        room &= np.hypot(*(places[:, :2] - other[:2]).T) >= PERSON_M
    found = [chore for chore in map(made, places[room]) if chore is not None]
    if not found:
        raise InputError(
            f"{body.name} cannot {stop.activity} at {stop.place}: no place beside it has room and is near enough for the "
            "hands. Hint: choose another thing, or a home whose furniture opens.",
            code="H3-TASK-086",
        )
    # people arrive within some centimetres: the place with most others around it from which the hands reach too
    roots = np.array([chore.root for chore in found])
    apart = np.linalg.norm(roots[:, None, [0, 2]] - roots[None, :, [0, 2]], axis=2)
    apart += 0.2 * np.linalg.norm(roots[:, None, 3:] - roots[None, :, 3:], axis=2)
    return found[int(np.argmax((apart < NEIGHBOUR_M).sum(1)))]


# --- places --------------------------------------------------------------------------------------------------------------
def _before_door(scene: Scene, thing: Instance) -> Array:
    """Places ``(x, z, heading)`` [N, 3] before the door of a thing, facing it."""
    k, handles = _door(scene, thing.name)
    if k < 0:
        return np.zeros((0, 3))
    ahead, along, _ = _frame(handles)
    heading = float(np.arctan2(ahead[1], -ahead[0]))
    # who stands beside the door's path turns to the inside
    inward = -1.0 if ahead[0] * along[1] - ahead[1] * along[0] > 0 else 1.0
    gaps, sides, turns = (
        each.reshape(-1, 1)
        for each in np.meshgrid(
            np.arange(0.25, 0.76, 0.05), np.arange(-0.2, 0.45, 0.05), (0.0, 0.35, 0.7), indexing="ij"
        )
    )
    return np.column_stack([handles[0, [0, 2]] + gaps * ahead + sides * along, heading + inward * turns])


def _around(scene: Scene, thing: Instance) -> Array:
    """Places ``(x, z, heading)`` [N, 3] around a thing, facing it at right angles, the nearest first."""
    low, high = instance_bounds(scene, thing)[:, [0, 2]]
    rows = []
    for gap in (0.33, 0.38, 0.43, 0.48):
        for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
            for share in np.linspace(0.15, 0.85, 8):
                at = low + share * (high - low)
                at[axis] = (low, high)[sign > 0][axis] + sign * gap
                away = np.eye(2)[axis] * sign
                rows.append([*at, float(np.arctan2(away[1], -away[0]))])
    return np.array(rows)


@lru_cache(maxsize=16)
def _door(scene: Scene, name: str) -> tuple[int, Array]:
    """Number of the joint of a thing's first door that encloses something, and its handle when it opens [N, 3]; -1: none."""
    joints = joints_of(scene)
    for k, (thing, part) in enumerate(joints.parts):
        if thing.name == name and part.joint.kind == "revolute" and part.encloses:
            way = np.tile(joints.rest, (40, 1))
            way[:, k] = joints.closed[k] + np.linspace(0, WIDE_RAD, 40) * np.sign(joints.opened[k] - joints.closed[k])
            motions = joints.motions(way)[:, k]
            return k, motions[:, :3, :3] @ handle_points(scene)[k] + motions[:, :3, 3]
    return -1, np.zeros((0, 3))


def _frame(handles: Array) -> tuple[Array, Array, Array]:
    """Directions [2] out of a closed door and from hinge to handle, and the hinge [2], from the handle's path [N, 3]."""
    path = handles[:, [0, 2]]
    ahead = (path[1] - path[0]) / np.hypot(*(path[1] - path[0]))
    middle = path[len(path) // 2]
    # the hinge is where the bisector of a chord meets the closed door
    chord, along = middle - path[0], np.array([-ahead[1], ahead[0]])
    along = along if along @ (path[0] - middle) > 0 else -along
    radius = float(chord @ chord / (2 * abs(chord @ along)))
    return ahead, along, path[0] - radius * along


def _opening(scene: Scene, body: Humanoid, name: str, place: Array) -> Chore | None:
    """The chore of taking something out of a thing with a door, from a place [3]; None: the hands do not reach."""
    k, handles = _door(scene, name)
    ahead, along, hinge = _frame(handles)
    root = ground_pose(place[:2], float(place[2]))
    opens, takes = _hands(root, hinge)
    local = _seen(root, handles)
    angles = np.linspace(0, WIDE_RAD, len(handles))
    # the leaf of the door, which is a little wider than the handle is far from the hinge
    leaf = hinge + np.linspace(0, 1.1, 12)[:, None, None] * (handles[:, [0, 2]] - hinge)
    clear = np.hypot(*(leaf - place[:2]).transpose(2, 0, 1)).min(0) >= LEAF * body.height_m
    count = len(clear) if clear.all() else int(np.argmin(clear))
    if count < 2 or angles[count - 1] < AJAR_RAD:
        return None
    out = np.flatnonzero(~reacher(body, opens).reachable(local[:count]))
    count = int(out[0]) if len(out) else count
    if count < 2 or angles[count - 1] < AJAR_RAD:
        return None
    part = joints_of(scene).parts[k][1]
    by_name = {instance.name: instance for instance in scene.instances}
    for shelf in reversed(part.encloses):
        owner, _, label = shelf.partition("|")
        asset = scene.assets[by_name[owner].asset]
        board = next(each for each in asset.receptacles if each.name == label)
        matrix = instance_matrix(by_name[owner])
        centre = matrix[:3, :3] @ board.center + matrix[:3, 3]
        depth, width = board.half_size[1], board.half_size[0]
        across = centre[[0, 2]] + 0.5 * width * along + (depth - 0.05) * ahead
        spot = np.array([across[0], centre[1] + ITEM_M[1], across[1]])
        if reacher(body, takes).reachable(_seen(root, spot[None]))[0]:
            return Chore("take", root, spot, k, angles[:count], handles[:count])
    return None


def _surface(scene: Scene, body: Humanoid, thing: Instance, name: str, wide: bool, place: Array) -> Chore | None:
    """The chore of lifting something from a thing or putting it there, from a place [3]; None: the hands do not reach."""
    root, matrix = ground_pose(place[:2], float(place[2])), instance_matrix(thing)
    ahead = quat_rotate(root[3:], np.array([1.0, 0.0, 0.0]))
    half = TRAY_M if wide else ITEM_M
    for board in scene.assets[thing.asset].receptacles:
        centre = matrix[:3, :3] @ board.center + matrix[:3, 3]
        if not 0.35 * body.height_m < centre[1] < 0.75 * body.height_m:
            continue
        extent = np.abs(matrix[:3, :3] @ [board.half_size[0], 0, board.half_size[1]])[[0, 2]]
        inset = np.abs(quat_rotate(root[3:], half * (1, 0, 1)))[[0, 2]]
        for over in OVERHANGS_M if wide else (0.0,):
            inner = inset - over * np.abs(ahead[[0, 2]])
            low, high = centre[[0, 2]] - extent + inner, centre[[0, 2]] + extent - inner
            if (low > high).any():
                continue
            near = np.clip(place[:2] + 0.05 * ahead[[0, 2]], low, high)
            spot = np.array([near[0], centre[1] + half[1], near[1]])
            grips = _seen(root, _grips(spot, root) if wide else np.stack([spot, spot]))
            farther = _farther(body, grips) if wide else 0.0
            if not (np.isfinite(farther) if wide else reacher(body, "left").reachable(grips[:1])[0]):
                continue
            aside = float(abs((near - place[:2]) @ [-ahead[2], ahead[0]]))
            if aside < ASIDE_M and not _occupied(scene, thing, spot, inset):
                return Chore(name, root, spot, farther_m=farther)
    return None


def _farther(body: Humanoid, grips: Array) -> float:
    """Distance [m] by which a body has to lean farther so that both palms reach places [2, 3] at once; NaN: they do not.

    The trunk is turned less than for one hand, which takes reach from both.
    """
    for farther in FARTHER_M:
        there = grips + np.array([farther, 0.0, 0.0])
        one, other = (reach_poses(body, there[k : k + 1], hand) for k, hand in enumerate(_SIDES))
        if one.status[0] or other.status[0]:
            continue
        quats = _mixed(one.quats, other.quats, np.array([0.5]))
        frames = body.joint_matrices(IDENTITY_POSE[None], quats, (one.pelvis + other.pelvis) / 2)[0]
        gaps = np.linalg.norm(frames[[joints[0] for joints in _ARMS], :3, 3] - grips, axis=1)
        if all(gap < 0.97 * _arm(body, side) for side, gap in enumerate(gaps.tolist())):
            return farther
    return np.nan


def _arm(body: Humanoid, side: int) -> float:
    """Length of an arm from the shoulder to the palm [m]."""
    grasp = grasp_point(body, _SIDES[side])
    return float(np.linalg.norm(body.joint_offsets[_ARMS[side][1:]], axis=1).sum() + 0.5 * np.linalg.norm(grasp))


@lru_cache(maxsize=16)
def _solids(scene: Scene) -> list[tuple[Instance, Array]]:
    """Everything in a scene that has shapes, with its bounds [2, 3]."""
    return [(each, instance_bounds(scene, each)) for each in scene.instances if scene.assets[each.asset].shapes]


def _occupied(scene: Scene, thing: Instance, spot: Array, inset: Array) -> bool:
    """Returns whether something stands where a tray would."""
    for other, (low, high) in _solids(scene):
        if other is thing:
            continue
        if low[1] < spot[1] + 0.2 and high[1] > spot[1] - 0.005 and not other.name.startswith(f"{thing.name}/"):
            if (np.maximum(low[[0, 2]] - spot[[0, 2]], spot[[0, 2]] - high[[0, 2]]) >= inset).any():
                continue
            # walls are around everything, and chairs before a table are not over it
            points = transform_points(instance_matrix(other), scene.assets[other.asset].mesh.vertices) - spot
            there = (np.abs(points[:, [0, 2]]) < inset).all(1) & (points[:, 1] > -0.005) & (points[:, 1] < 0.2)
            if there.any():
                return True
    return False


def _hands(root: Array, hinge: Array) -> tuple[Hand, Hand]:
    """The hand that opens a door, on the side of its hinge [2], and the one that takes."""
    right = _seen(root, np.array([[hinge[0], 0.0, hinge[1]]]))[0, 2] > 0
    return ("right", "left") if right else ("left", "right")


def _seen(root: Array, points: Array) -> Array:
    """World points [N, 3] in the frames of agent roots, [7] or [N, 7]."""
    inverse = pose_inverse(root)
    return inverse[..., :3] + quat_rotate(np.broadcast_to(inverse[..., 3:], (*points.shape[:-1], 4)), points)


def _grips(middle: Array, root: Array) -> Array:
    """Places [..., 2, 3] of the left and the right palm at the sides of trays whose middle is at world points [..., 3]."""
    ends = np.array([[-GRIP_BACK_M, 0, -TRAY_M[2]], [-GRIP_BACK_M, 0, TRAY_M[2]]])
    quats = np.broadcast_to(root[..., None, 3:], (*middle.shape[:-1], 2, 4))
    return middle[..., None, :] + quat_rotate(quats, np.broadcast_to(ends, (*middle.shape[:-1], 2, 3)))


# --- acting out ----------------------------------------------------------------------------------------------------------
class Thing(NamedTuple):
    """Something that people carry: its name, asset, half sizes [m], poses [T, 7] and where it lies."""

    name: str
    asset: AssetRef
    half: Array
    poses: Array


_LOOKS = {
    "tray": AssetRef(name="tray", uri="primitive:cubeSolid", color=(146, 104, 66)),
    "carton": AssetRef(name="carton", uri="primitive:cubeSolid", color=(214, 226, 236)),
    "phone": AssetRef(name="phone", uri="primitive:cubeSolid", color=(34, 36, 42)),
}
PHONE_M = np.array([0.005, 0.074, 0.036])


def act_out(recording: Recording) -> Recording:
    """Return a recording in which people do the chores of their routines, with what they open and carry.

    Its people have recorded joints, doors their positions, and trays and things tracks of their own. Where people walk, and
    when, stays as it is. Recordings without chores are returned as they are. The result is a film of the simulation, without
    a hash of its state: verify the original.

    Raises:
        InputError: The recording lacks its home.
    """
    replay = Replay(recording)
    doing = sorted({event.agent for event in recording.events if _is_chore(event) and event.agent >= 0})
    if not doing:
        return recording
    if replay.scene is None:
        raise InputError(
            "Expected a recording with its home, in which people do chores. Hint: recordings of h3data generate have it.",
            code="H3-TASK-087",
        )
    joints = joints_of(replay.scene)
    open_by = (
        np.tile(joints.rest, (len(recording), 1))
        if JOINTS not in recording.columns
        else recording.columns[JOINTS].copy()
    )
    acted, things, events, skills = {}, list[Thing](), list(recording.events), list(recording.skills)
    for agent in doing:
        person = _Acting(replay, agent, open_by)
        person.play()
        acted |= person.columns()
        things += person.things
        events += person.events
        skills += person.skills
    moving = len(recording.moving_bodies)
    tracks = [thing.poses[:, None] for thing in things]
    before = [recording.columns["object_pose"]] if moving else []
    columns = {name: values for name, values in recording.columns.items() if name != "state_hash"}
    columns |= {**acted, "object_pose": np.concatenate([*before, *tracks], axis=1).astype(np.float32)}
    if len(joints):
        columns[JOINTS] = open_by.astype(np.float32)
    bodies = tuple(
        Body(
            name=thing.name,
            asset=thing.asset.name,
            pose=thing.poses[0].astype(np.float32),
            scale=thing.half.astype(np.float32),
            moving=moving + k,
        )
        for k, thing in enumerate(things)
    )
    names = {thing.asset.name for thing in things}
    return replace(
        recording,
        episode=replace(recording.episode, info={**recording.episode.info, "acted_out": 1}),
        assets=(*recording.assets, *(look for look in _LOOKS.values() if look.name in names)),
        bodies=(*recording.bodies, *bodies),
        columns=columns,
        events=tuple(sorted(events, key=lambda event: event.step)),
        skills=tuple(sorted(skills, key=lambda span: span.start_step)),
    )


def _is_chore(event: Event) -> bool:
    return event.kind == "activity" and event.target in CHORES


class _Follow(NamedTuple):
    """Steps during which a thing is where hands are."""

    number: int
    hand: int
    """Left 0, right 1, both 2."""
    held: slice
    stays: bool = True
    """True if the thing lies afterwards where it was last held; False if it is nowhere then."""


class _Acting:
    """Motion of one person through a recording."""

    def __init__(self, replay: Replay, agent: int, open_by: Array) -> None:
        recording, model = replay.recording, replay.model(agent)
        assert isinstance(model, Humanoid)
        assert replay.scene is not None
        self.scene, self.agent, self.body, self.open_by = replay.scene, agent, model, open_by
        self.recording, self.name = recording, recording.agents[agent].name
        steps = np.arange(len(recording))
        self.base = recording.agent_column(agent, "base_pose").astype(np.float64)
        self.quats, self.pelvis = _local(replay.joint_matrices(agent, steps), self.base)
        self.seconds = recording.columns["time_ns"].astype(np.float64) * 1e-9
        scale = reacher(model, "right").body.scale
        self.carry = np.stack([CARRIED * scale * (1, 1, -1), CARRIED * scale])
        self.tray_at = np.array([TRAY_AHEAD, TRAY_UP, 0.0]) * scale
        self.palms, self.shares = np.tile(self.carry, (len(steps), 1, 1)), np.zeros((len(steps), 2))
        self.things: list[Thing] = []
        self.events: list[Event] = []
        self.skills: list[SkillSpan] = []
        self.holds: tuple[str, int, int] | None = None
        """Kind, number and hand (2: both) of what the person holds."""
        self._follows: list[_Follow] = []

    def play(self) -> None:
        """Moves the person through all chores, one after another."""
        turns = [
            event
            for event in self.recording.events
            if event.agent == self.agent and event.kind in ("activity", "walks_to", "gets_up")
        ]
        for k, event in enumerate(turns):
            if _is_chore(event):
                end = next((after.step for after in turns[k + 1 :] if after.step > event.step), len(self.seconds))
                getattr(self, f"_{event.target}")(event, slice(max(event.step, 0), end))
        if self.holds is not None:
            self._keep(self._held_since, len(self.seconds))
        self._bend()

    def columns(self) -> dict[str, Array]:
        """Returns the columns of the person's joints."""
        frames = self.body.joint_matrices(self.base, self.quats, self.pelvis)
        root = np.concatenate([frames[:, 0, :3, 3], quat_from_matrix(frames[:, 0, :3, :3])], axis=1)
        prefix = f"agent_{self.agent}."
        return {
            f"{prefix}root_pose": root.astype(np.float32),
            f"{prefix}joint_quat": self.quats[:, 1:].astype(np.float32),
        }

    # --- chores ----------------------------------------------------------------------------------------------------------
    def _take(self, event: Event, rows: slice) -> None:
        t, root = self._since(rows)
        place = np.append(root[[0, 2]], heading_from_quat(root[3:]))
        chore = _opening(self.scene, self.body, event.detail, place) if self.holds is None and len(t) else None
        if chore is None or t[-1] < CHORES["take"] - 0.5:
            return
        _, _, hinge = _frame(chore.handles if len(chore.handles) > 2 else _door(self.scene, event.detail)[1])
        hands = _hands(root, hinge)
        o, h = (_SIDES.index(hand) for hand in hands)
        angle = (_ramp(t, 0.9, 2.3) - _ramp(t, 4.7, 6.0)) * chore.angles[-1]
        handle = np.stack([np.interp(angle, chore.angles, chore.handles[:, k]) for k in range(3)], 1)
        taken = sum(thing.name.startswith(f"{self.name}_carton") for thing in self.things)
        spot = np.broadcast_to(chore.spot, (len(t), 3))
        base = self.base[rows]
        self.palms[rows, o] = _seen(base, handle)
        inside = (_ramp(t, 2.3, 3.4) - _ramp(t, 3.8, 4.9))[:, None]
        # close before the body until the hand is out of what stands beside
        near = self.carry[h] * np.column_stack([np.ones((len(t), 2)), 0.3 + 0.7 * _ramp(t, 4.9, 5.9)])
        self.palms[rows, h] = near + inside * (_seen(base, spot) - near)
        on = _ramp(t, 0.0, 0.9) - _ramp(t, 6.0, 6.9)
        self.shares[rows, o], self.shares[rows, h] = on, _ramp(t, 1.4, 2.2)
        first = reach_poses(self.body, self.palms[rows, o], hands[0])
        other = reach_poses(self.body, _seen(base, spot), hands[1])
        self._lean(rows, first, other, _ramp(t, 2.3, 3.3) - _ramp(t, 3.9, 4.9), on)
        joint = joints_of(self.scene).parts[chore.joint][1].joint
        self.open_by[rows, chore.joint] = joint.closed + np.sign(joint.opened - joint.closed) * angle
        self._new(f"carton_{taken}", "carton", ITEM_M, chore.spot, root)
        self._hold("carton", len(self.things) - 1, h, rows, t, 3.6, event)

    def _lift(self, event: Event, rows: slice) -> None:
        t, root = self._since(rows)
        chore = self._surface_at(event, root, wide=True) if self.holds is None and len(t) else None
        if chore is None or t[-1] < CHORES["lift"] - 0.5 or any("tray" in thing.name for thing in self.things):
            return
        base, up = self.base[rows], _ramp(t, 1.7, 2.9)[:, None]
        spot = _seen(base, np.broadcast_to(chore.spot, (len(t), 3)))
        # hands come from above, not through the edge of a table
        apart = (_ramp(t, 0.5, 1.5)[:, None] - up) * (spot - self.tray_at)
        self._both(rows, self.tray_at + apart, spot, _ramp(t, 0.4, 1.4) - _ramp(t, 2.0, 3.1), chore.farther_m)
        self.shares[rows] = _ramp(t, 0.0, 0.9)[:, None]
        self._new("tray", "tray", TRAY_M, chore.spot, root)
        self._hold("tray", len(self.things) - 1, 2, rows, t, 1.6, event)

    def _put(self, event: Event, rows: slice) -> None:
        t, root = self._since(rows)
        if self.holds is None or not len(t) or t[-1] < CHORES["put"] - 0.5:
            return
        kind, number, hand = self.holds
        chore = self._surface_at(event, root, wide=kind == "tray")
        if chore is None:
            return
        self._keep(self._held_since, rows.start)
        base = self.base[rows]
        spot = _seen(base, np.broadcast_to(chore.spot, (len(t), 3)))
        lean, out = _ramp(t, 0.2, 1.4) - _ramp(t, 2.0, 3.0), (_ramp(t, 0.0, 1.5) - _ramp(t, 2.0, 3.0))[:, None]
        if kind == "tray":
            self._both(rows, self.tray_at + out * (spot - self.tray_at), spot, lean, chore.farther_m)
        else:
            self.palms[rows, hand] = self.carry[hand] + out * (spot - self.carry[hand])
            poses = reach_poses(self.body, spot, _SIDES[hand])
            self._lean(rows, poses, poses, np.zeros(len(t)), lean)
        self.shares[rows, slice(None) if hand == 2 else slice(hand, hand + 1)] = 1 - _ramp(t, 2.9, 3.8)[:, None]
        free = rows.start + int(np.searchsorted(t, 1.7))
        self._follows.append(_Follow(number, hand, slice(self._grasped, free)))
        self._tell(free, "puts", number, rows, event)
        self.holds = None

    def _phone(self, event: Event, rows: slice) -> None:
        shown = slice(rows.start + 20, max(rows.stop - 20, rows.start + 20))
        self._new("phone", "phone", PHONE_M, np.full(3, np.nan), IDENTITY_POSE)
        self.things[-1].poses[:] = np.nan
        self._follows.append(_Follow(len(self.things) - 1, 1, shown, stays=False))

    # --- parts of chores -------------------------------------------------------------------------------------------------
    def _since(self, rows: slice) -> tuple[Array, Array]:
        """Times [T] since the first movement of a chore, and the root's pose then."""
        base = self.base[rows]
        gone = np.hypot(*(base[5:, [0, 2]] - base[:-5, [0, 2]]).T)
        turned = np.abs(wrap_angle(heading_from_quat(base[5:, 3:]) - heading_from_quat(base[:-5, 3:])))
        early = self.seconds[rows][5:] - self.seconds[rows.start] < SETTLES_S + 0.5
        moves = np.flatnonzero(early & ((gone > AT_REST_M) | (turned > AT_REST_RAD)))
        first = int(moves[-1]) + 5 if len(moves) else 0
        return self.seconds[rows] - self.seconds[rows.start + first], self.base[rows.start + first]

    def _surface_at(self, event: Event, root: Array, *, wide: bool) -> Chore | None:
        thing = next(each for each in self.scene.instances if each.name == event.detail)
        place = np.append(root[[0, 2]], heading_from_quat(root[3:]))
        return _surface(self.scene, self.body, thing, event.target, wide, place)

    def _both(self, rows: slice, middle: Array, spot: Array, lean: Array, farther_m: float) -> None:
        """Puts both palms at the sides of a tray whose middle is at places [T, 3] in the root's frame."""
        here = np.tile(IDENTITY_POSE, (len(middle), 1))
        self.palms[rows] = _grips(middle, here)
        ends = _grips(spot, here) + np.array([farther_m, 0.0, 0.0])
        left, right = (reach_poses(self.body, ends[:, k], hand) for k, hand in enumerate(_SIDES))
        self._lean(rows, left, right, np.full(len(middle), 0.5), lean)

    def _lean(self, rows: slice, one: ReachPoses, other: ReachPoses, share: Array, weight: Array) -> None:
        """Blends two postures of reaching, and both with what is recorded."""
        quats = _mixed(one.quats, other.quats, share)
        pelvis = one.pelvis + share[:, None] * (other.pelvis - one.pelvis)
        self.quats[rows] = _mixed(self.quats[rows], quats, weight)
        self.pelvis[rows] += weight[:, None] * (pelvis - self.pelvis[rows])

    def _new(self, name: str, look: str, half: Array, spot: Array, root: Array) -> None:
        pose = np.concatenate([spot, root[3:]])
        self.things.append(Thing(f"{self.name}_{name}", _LOOKS[look], half, np.tile(pose, (len(self.seconds), 1))))

    def _hold(self, kind: str, number: int, hand: int, rows: slice, t: Array, after_s: float, event: Event) -> None:
        self.holds, self._held_since = (kind, number, hand), rows.stop
        self._grasped = rows.start + int(np.searchsorted(t, after_s))
        self._tell(self._grasped, "takes", number, rows, event)

    def _tell(self, step: int, kind: str, number: int, rows: slice, event: Event) -> None:
        """Takes down that a thing is taken or put down."""
        name, skill = self.things[number].name, {"takes": "pick", "puts": "place"}[kind]
        self.events.append(Event(step=step, agent=self.agent, kind=kind, target=name, detail=event.detail))
        self.skills.append(
            SkillSpan(agent=self.agent, name=skill, target=name, start_step=rows.start, end_step=rows.stop - 1)
        )

    def _keep(self, start: int, end: int) -> None:
        """Lets the person carry what they hold for some rows."""
        assert self.holds is not None
        _, number, hand = self.holds
        rows = slice(start, end)
        if hand == 2:
            here = np.tile(IDENTITY_POSE, (end - start, 1))
            self.palms[rows] = _grips(np.tile(self.tray_at, (end - start, 1)), here)
            self.shares[rows] = 1.0
        else:
            self.palms[rows, hand], self.shares[rows, hand] = self.carry[hand], 1.0
        if end == len(self.seconds):
            self._follows.append(_Follow(number, hand, slice(self._grasped, end)))

    def _bend(self) -> None:
        """Bends the arms so that the palms are where they should be, and moves what they hold."""
        rows = np.flatnonzero(self.shares.any(1))
        frames = self.body.joint_matrices(np.tile(IDENTITY_POSE, (len(rows), 1)), self.quats[rows], self.pelvis[rows])
        grips = [grasp_point(self.body, hand) for hand in _SIDES]
        wrists, quats = self.palms[rows].copy(), self.quats[rows].copy()
        bent = np.zeros((len(rows), 2, len(ARM_JOINTS), 4))
        # the wrist is behind the palm by an offset that turns with it
        for _ in range(5):
            bent = bend_arms(self.body.joint_offsets, frames, wrists, pole=POLE, twist_deg=6.0)
            for side in range(2):
                quats[:, _ARMS[side]] = bent[:, side]
            own = self.body.joint_matrices(np.tile(IDENTITY_POSE, (len(rows), 1)), quats, self.pelvis[rows])
            for side, joints in enumerate(_ARMS):
                wrists[:, side] = self.palms[rows, side] - own[:, joints[2], :3, :3] @ grips[side]
        for side, joints in enumerate(_ARMS):
            at = np.ix_(rows, np.array(joints))
            self.quats[at] = _mixed(self.quats[at], bent[:, side], self.shares[rows, side])
        for row in rows.tolist():
            curl_fingers(self.quats[row], CURL_RAD * self.shares[row])
        frames = self.body.joint_matrices(self.base, self.quats, self.pelvis)
        world = np.stack(
            [
                frames[:, own[2], :3, :3] @ grip + frames[:, own[2], :3, 3]
                for own, grip in zip(_ARMS, grips, strict=True)
            ],
            1,
        )
        for number, hand, held, stays in self._follows:
            poses = self.things[number].poses
            poses[held, :3] = world[held].mean(1) if hand == 2 else world[held, hand]
            poses[held, 3:] = quat_from_heading(heading_from_quat(self.base[held, 3:]))
            if hand == 2:
                ahead = np.tile([GRIP_BACK_M, 0.0, 0.0], (held.stop - held.start, 1))
                poses[held, :3] += quat_rotate(poses[held, 3:], ahead)
            if stays and held.stop < len(poses):
                poses[held.stop :] = poses[held.stop - 1]


def _ramp(t: Array, start: float, end: float) -> Array:
    """Shares [T] of a movement between two times, from 0 to 1 with the minimum-jerk profile."""
    return minimum_jerk(np.clip((t - start) / (end - start), 0.0, 1.0))


def _mixed(one: Array, other: Array, share: Array) -> Array:
    """Rotations [T, J, 4] blended by shares [T]."""
    flat = quat_nlerp(one.reshape(-1, 4), other.reshape(-1, 4), np.repeat(share, one.shape[1]))
    return flat.reshape(one.shape)


def _local(frames: Array, base: Array) -> tuple[Array, Array]:
    """Local rotations [T, 55, 4] and places of the pelvis [T, 3] in the root's frame, from frames of joints in the world."""
    root = pose_to_matrix(base)[:, :3, :3].swapaxes(1, 2)
    turns = frames[..., :3, :3].astype(np.float64)
    parents = np.array(PARENTS)
    own = turns.copy()
    own[:, 1:] = turns[:, parents[1:]].swapaxes(2, 3) @ turns[:, 1:]
    own[:, 0] = root @ turns[:, 0]
    return quat_from_matrix(own), _seen(base, frames[:, 0, :3, 3].astype(np.float64))
