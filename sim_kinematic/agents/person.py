"""A person under control, by joints (`Person.set_pose`), by a target for a hand (`Person.reach_to`), or by skills.

Skills are generators. Each ``next`` is one step of 1/30 s, after which the person's pose and the objects in the hands
are up to date; the generator's return value is a `MotionResult`. `run` plays a skill to its end and collects the
frames:

```python
person = Person(load_humanoid("female_1"), ground_pose([0, 0], 0.0), {"mug": mug_pose})
frames, result = run(person, person.pick("mug", "left"))
```

Everything is kinematic: nothing is pushed, and nothing stops a hand. A hand picks only objects that it reaches: success
depends on where the hand is, unlike in Habitat, where it depends on the commanded target (spec/habitat.md 3.5).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import JOINT_INDEX, Humanoid
from h3data.bodies.people.arms import ARM_JOINTS, CARRY_CLOSE, CARRY_JOINTS
from h3data.bodies.people.gestures import lead_hands
from h3data.bodies.people.kernels.attention import curl_fingers, turn_gaze
from h3data.bodies.people.kernels.single_pose import blend_pose, frame_of_joint, hold
from h3data.bodies.people.planted_gait import PlantedWalk, on_floor
from h3data.bodies.people.reach import (
    BaseMotion,
    Hand,
    ReachPoses,
    ReachResult,
    grasp_point,
    reach,
    reach_poses,
    reacher,
)
from h3data.errors import InputError
from h3data.geometry import (
    Array,
    ground_pose,
    heading_from_quat,
    pose_inverse,
    pose_multiply,
    quat_from_heading,
    quat_from_matrix,
    quat_multiply,
    quat_rotate,
    smoothstep,
    wrap_angle,
)
from h3data.kernels.entries import Entries
from h3data.scene import FreeSpace
from sim_kinematic.agents.arm_tuck import HANDS, arm_room, draw_in_planted, held_close
from sim_kinematic.motion.gait import walk_humans
from sim_kinematic.motion.spec import STEP_S, WalkerSpec
from sim_kinematic.motion.state import HumanState

CARRY = (0.27, 0.80, 0.15)
"""Position of a hand that carries something: forward, up, and to its side, as multiples of the height of the
shoulder."""
HAND_SPEED_MPS, HAND_LEAST_S = 0.9, 0.4
"""Mean speed of a hand on its line [m/s], and the least duration of such a movement [s]."""
SNAP_M = 0.01
"""Distance from the palm within which a hand takes hold of an object [m]."""
EASE_M, JOINT_STEP_RAD = 0.08, 0.18
"""Length of the part of the path over which the trunk moves from standing to reaching [m], where an empty hand may
leave its line by 8 mm; and largest turn of a joint per step [rad] (310 degrees per second). A hand moves more slowly
where a joint would exceed this turn."""
SETTLE_STEPS, CLOSE_ENOUGH = 45, 0.1
"""Number of steps within which feet get to their standing places; and remaining share of the movement to the carrying
pose at which a person starts to walk."""
FADE_STEPS = 12
"""Number of steps over which walking is blended into reaching and back. A straight movement of the hand takes at least
as many steps, so its end is exact. Without the blend, interrupting a reach turned a shoulder by up to 76 degrees in one
step."""
GRIP_M, GRIP_WITHIN = 0.03, (0.01, 0.09)
"""Radius that a hand closes around if no size is known, and the range of possible radii [m]."""
FINGER_M, FINGER_HALF = 0.026, 0.008
"""Length and half thickness of the bone of a finger [m]."""
REST_CURL, OPEN_CURL, HANDLE_CURL, CURL_MOST, CURL_STEP = 0.244, -0.2, 0.9, 1.1, 0.12
"""Bend of each joint of a finger [rad]: in the rest pose; relative to the rest pose just before the hand takes an
object, around a handle, and at most; and the largest change in one step."""
CLOSES_FROM = 0.8
"""Share of the path to an object after which a hand starts to close."""
ARM_CHAINS: dict[Hand, NDArray[np.intp]] = {
    side: np.array(
        [
            JOINT_INDEX[name]
            for name in ("spine1", "spine2", "spine3", *(f"{side}_{part}" for part in ("collar", *ARM_JOINTS)))
        ]
    )
    for side in ("left", "right")
}
"""Joints from above the pelvis to each wrist."""
HEAD_JOINTS = [JOINT_INDEX["neck"], JOINT_INDEX["head"]]
LOOK_STEPS, LOOKED_RAD = 10, 0.15
"""Largest number of steps that the hand waits for the head, and remaining turn of the head below which the hand sets
off [rad]."""
PERSON_SPEC = WalkerSpec(speed_mps=1.2, turn_rad_s=1.6)


@dataclass(frozen=True, kw_only=True)
class MotionResult:
    """Result of a person's motion."""

    success: bool
    reason: str = ""
    """Reason for the failure: a status of `h3data.bodies.people.reach`, or ``missed``."""
    hand_error_m: float = 0.0
    """Distance from the target to the hand, or to the object that it puts down, at its present or its nearest possible
    position [m]."""
    base_motion: BaseMotion | None = None
    """Motion to a place from which the target is reached (see `Person.approach`); None if no such motion helps."""


Skill = Generator[object, None, MotionResult]


class Frame(NamedTuple):
    """State of a person in one step: the free-form pose columns of a recording, and the poses of the objects."""

    base: Array
    """Pose (pose7) of the agent root [7]."""
    root: Array
    """Pose (pose7) of the pelvis in the world [7]."""
    joints: Array
    """Local rotations of the other joints, shape [54, 4]."""
    objects: dict[str, Array]
    """Pose (pose7) of each object."""


class Held(NamedTuple):
    """Object that a person holds in one hand."""

    name: str
    grip: Array
    """Pose (pose7) of the object in the palm's frame [7]."""
    stood: Array
    """Rotation (quaternion xyzw) of the object relative to the person's heading when it was taken [4]."""


class Transition(NamedTuple):
    """Progress of a person from one kind of motion to another, such as from walking to reaching."""

    kind: str = ""
    """Kind of the last pose: ``walk``, ``reach``, or empty if it was set from outside."""
    quats: Array | None = None
    """Last pose [55, 4] of the previous kind of motion (quaternions xyzw); None if there was none."""
    pelvis: Array | None = None
    left: float = 0.0
    """Remaining weight of the last pose of the previous motion in the blend, from 1 to 0."""


class Person:
    """Humanoid with a place and a pose in the world, and the objects that it can take."""

    call: ClassVar[Entries] = Entries()
    """Kernels that are called with the poses of people, which are contiguous and float64."""

    def __init__(
        self,
        body: Humanoid,
        base_pose: ArrayLike,
        objects: Mapping[str, ArrayLike] | None = None,
        *,
        spec: WalkerSpec = PERSON_SPEC,
        free: FreeSpace | None = None,
        sizes: Mapping[str, float] | None = None,
        state: HumanState | None = None,
        led: Array | None = None,
    ) -> None:
        """Put a person at a pose, standing still.

        Args:
            body: body of the person.
            base_pose: pose of the agent root [7].
            objects: world poses [7] of the objects that can be picked, by name.
            spec: how the person walks.
            free: free floor, whose obstacles cause the arms to fold in by the rules ``spec.arms``.
            sizes: radii of the grips of objects by name [m]; the default is `GRIP_M`.
            state: the person's part of the state of one world, whose place and heading follow the agent root.
            led: places to which hands that handle things are led (`h3data.bodies.people.gestures.lead_hands`) [4, 4].
        """
        self.state = HumanState.zeros(1) if state is None else state
        self.body, self.spec, self.free, self.led = body, spec, free, led
        self.spot: Array = self.state.xz[0]
        """Position on the floor [2] [m], a view."""
        # place and heading are the state's own arrays, so they follow it without copies
        self._drawn = replace(self.state, arms=np.zeros((1, 2)))
        """Same place, and how far the arms are folded in."""
        self.tilts: dict[Hand, float] = {"left": 0.0, "right": 0.0}
        """Share of the hand's tilt by which a held thing turns, 0 (it stays upright) to 1."""
        self._close: dict[Hand, float] = {"left": 0.0, "right": 0.0}
        """Closeness to the body at which each hand carries what it holds, 0 (held out) to 1."""
        self.objects: dict[str, Array] = {name: np.array(pose, np.float64) for name, pose in (objects or {}).items()}
        self.held: dict[Hand, Held] = {}
        self.base = np.array(base_pose, np.float64)
        self._offsets = np.ascontiguousarray(body.joint_offsets, np.float64)
        tables = body.gait_tables if free is None else on_floor(body.gait_tables, free)
        self.walk = PlantedWalk(tables, self.base)
        """State of the feet: positions, and whether they stand or swing."""
        self.transition = Transition()
        self.sizes: dict[str, float] = dict(sizes or {})
        self.look_at: Array | None = None
        """World point [3] to which head and eyes turn; None: they stay as the motion has them."""
        self.plays: Callable[[Array, Array], object] | None = None
        """Function that changes rotations [1, 55, 4] and pelvis [1, 3] of each pose in place, such as a captured motion."""
        self.curl: Array = np.zeros(2)
        self.gaze: Array = np.zeros(6)
        """Bend of the fingers of the left and the right hand, and turn of head and eyes beyond the motion's
        (`h3data.bodies.people.kernels.attention`) [rad]."""
        self._to_turn = 0.0
        self._room: tuple[float, ...] | None = None
        """Constants by which the arms fold (`arm_room`), found at their first use."""
        self._closing: dict[Hand, float] = {}
        self._carry_points: dict[Hand, Array] = {}
        self._carry_arms: dict[Hand, Array] = {}
        self._carried: dict[Hand, tuple[float, Array]] = {}
        """Rotations of arms that hold something out, and at their last closeness to the body."""
        self._stand()

    @property
    def base(self) -> Array:
        """Pose of the agent root [7]."""
        return self._base

    @base.setter
    def base(self, pose: Array) -> None:
        self._base = pose
        # in place, because `spot` and `_drawn` look at the same arrays
        self.spot[0], _, self.spot[1], *_ = pose.tolist()
        self.state.heading[0] = heading_from_quat(pose[3:])

    @property
    def heading(self) -> float:
        """Heading of the agent root [rad]."""
        return self.state.heading.item(0)

    # --- joints -----------------------------------------------------------------------------------------------------
    def set_pose(self, quats: ArrayLike, pelvis: ArrayLike, base_pose: ArrayLike | None = None) -> None:
        """Set the joints of the body; objects in the hands move with them.

        Args:
            quats: local rotations [55, 4], that of the pelvis in the agent root frame, as `Humanoid.clip_pose` returns them.
            pelvis: position of the pelvis in the agent root frame [3] [m].
            base_pose: pose of the agent root [7] (default: unchanged).
        """
        quats, pelvis = np.array(quats, np.float64), np.array(pelvis, np.float64)
        if quats.shape != (55, 4) or pelvis.shape != (3,):
            raise InputError(
                f"Expected rotations [55, 4] and a pelvis [3], got {quats.shape} and {pelvis.shape}.", code="H3-SIM-013"
            )
        if base_pose is not None:
            self.base = np.array(base_pose, np.float64)
        # of no kind, so that whatever motion comes next is blended with this pose
        self.transition = Transition()
        self.curl, self.gaze = np.zeros(2), np.zeros(6)
        self._assign(quats, pelvis, quats)

    def _assign(self, quats: Array, pelvis: Array, bare: Array) -> None:
        self.quats, self.pelvis, self.bare = quats, pelvis, bare
        for hand, held in self.held.items():
            self.objects[held.name] = pose = np.empty(7)
            # the place is rigid with the palm, the rotation is not: what stood upright keeps upright
            self.call(hold, *self._wrist(hand), held.grip, self.heading, held.stood, float(self.tilts[hand]), pose)

    @property
    def joint_matrices(self) -> Array:
        """World frames of the joints, shape [55, 4, 4]."""
        return self.body.joint_matrices(self.base, self.quats[None], self.pelvis[None])[0]

    def palm(self, hand: Hand) -> Array:
        """Return the pose (pose7) of a palm in the world: origin at its grasp point, axes of the wrist."""
        frame, place = self._wrist(hand)
        return np.concatenate([place, quat_from_matrix(frame[:3, :3])])

    def _wrist(self, hand: Hand) -> tuple[Array, Array]:
        """Return the frame of a wrist in the world [4, 4], and the place of its palm's grasp point [3]."""
        frame = np.empty((1, 4, 4))
        self.call(frame_of_joint, self.base, self.quats, self.pelvis, self._offsets, ARM_CHAINS[hand], frame[0])
        return frame[0], (frame[:, :3, :3] @ grasp_point(self.body, hand) + frame[:, :3, 3])[0]

    def upright(self, held: Held) -> Array:
        """Return the world rotation (quaternion) [4] of a held object that stays as upright as it was when taken."""
        return quat_multiply(quat_from_heading(self.heading), held.stood)

    def frame(self) -> Frame:
        """Return a copy of the person's present state."""
        root = pose_multiply(self.base, np.concatenate([self.pelvis, self.quats[0]]))
        return Frame(self.base.copy(), root, self.quats[1:].copy(), {n: p.copy() for n, p in self.objects.items()})

    # --- a hand's target --------------------------------------------------------------------------------------------
    def reach_to(self, position: ArrayLike, hand: Hand = "right") -> ReachResult:
        """Move a palm to a world position [3] [m] at once, or as near to it as possible; the result says which."""
        result = reach(self.body, self.seen(position), hand)
        # at once: an arm that is let out by small steps would keep the palm off its place
        self._drawn.arms[0, HANDS.index(hand)] = 0.0
        self.set_pose(self.with_arms(result.quats, hand), result.pelvis)
        return result

    # --- skills -----------------------------------------------------------------------------------------------------
    def wait(self, seconds: float) -> Skill:
        """Stand for some seconds, breathing and shifting weight."""
        for _ in range(round(seconds / STEP_S)):
            self.stride()
            yield
        return MotionResult(success=True)

    def turn(self, heading: float, *, settles: bool = True) -> Skill:
        """Turn on the spot by steps until the heading [rad] is reached.

        If the turn ``settles``, both feet end in their standing places.
        """
        start = float(heading_from_quat(self.base[3:]))
        way = float(wrap_angle(heading - start))
        steps = max(int(np.ceil(abs(way) / (self.spec.turn_rad_s * STEP_S))), 1) if abs(way) > 1e-9 else 0
        for k in range(1, steps + 1):
            # a share of the whole turn rather than a sum of steps, so that the last one ends on the heading
            self.base = np.append(self.base[:3], quat_from_heading(start + way * k / steps))
            self.stride()
            yield
        if settles:
            yield from self.settle()
        return MotionResult(success=True)

    def settle(self) -> Generator[None, None, None]:
        """Step until both feet are in their standing places, unless they are or the root was moved from outside."""
        if not self.walk.is_at(self.base):
            self.walk.stand(self.base)
        for _ in range(SETTLE_STEPS):
            if self.walk.stands:
                return
            self.stride()
            yield

    def walk_to(self, path: ArrayLike) -> Skill:
        """Walk along floor points ``(x, z)`` [K, 2] [m], turning on the spot before each leg; carry held objects."""
        points = np.atleast_2d(np.asarray(path, np.float64))
        if points.shape[-1] != 2 or not np.isfinite(points).all():
            raise InputError(f"Expected floor points (x, z) of shape [K, 2], got {points.shape}.", code="H3-SIM-014")
        for point in points:
            way = point - self.base[[0, 2]]
            if np.hypot(*way) <= self.spec.arrive_m:
                continue
            heading = float(np.arctan2(-way[1], way[0]))
            if abs(wrap_angle(heading - heading_from_quat(self.base[3:]))) > self.spec.turn_before_walk_rad:
                yield from self.turn(heading, settles=False)
            state = HumanState.zeros(1)
            state.xz[0], state.heading[0] = self.base[[0, 2]], heading_from_quat(self.base[3:])
            while True:
                walk_humans(state, point[None], self.spec)
                self.stride(state)
                yield
                # the blend gets to 0 only when the legs have come to rest, some steps after the arrival
                if state.blend[0] == 0:
                    break
        yield from self.settle()
        return MotionResult(success=True)

    def approach(self, position: ArrayLike, hand: Hand = "right") -> Skill:
        """Walk in a straight line to a place from which the hand reaches a world position [3] [m]."""
        result = reach(self.body, self.seen(position), hand)
        if result.base_motion is None:
            return MotionResult(success=False, reason=result.status, hand_error_m=result.hand_error_m)
        goal = result.base_motion.of(self.base)
        yield from self.walk_to(goal[[0, 2]])
        yield from self.turn(float(heading_from_quat(goal[3:])))
        return MotionResult(success=True)

    def pick(self, name: str, hand: Hand = "right") -> Skill:
        """Move a hand in a straight line to an object, take it, and bring it to the carrying position."""
        if name not in self.objects:
            raise InputError(
                f"There is no object {name!r}. There are: {', '.join(self.objects) or 'none'}.", code="H3-SIM-015"
            )
        if hand in self.held:
            raise InputError(
                f"The {hand} hand already holds {self.held[hand].name!r}. Hint: place it first.", code="H3-SIM-016"
            )
        target = self.seen(self.objects[name][:3])
        answer = reach(self.body, target, hand)
        if not answer.reached:
            return _unreached(answer)
        yield from self._look(self.objects[name][:3])
        for share in self._move(hand, self._path_out(hand, target), ends=(0.0, 1.0)):
            self._closing[hand] = OPEN_CURL if share < CLOSES_FROM else self.curl_around(name)
            yield
        self._closing.pop(hand, None)
        palm = self.palm(hand)
        error = float(np.linalg.norm(palm[:3] - self.objects[name][:3]))
        # the object may have been taken away while the hand was on its way
        if error > SNAP_M:
            self.look_at = None
            yield from self._move(hand, self._path_out(hand, target)[::-1], ends=(1.0, 0.0))
            return MotionResult(success=False, reason="missed", hand_error_m=error)
        # the inverse of the heading, to which the rotation of what is held is relative
        heading = quat_from_heading(-heading_from_quat(self.base[3:]))
        self.held = {other: held for other, held in self.held.items() if held.name != name}  # from the other hand
        self.held[hand] = Held(
            name, pose_multiply(pose_inverse(palm), self.objects[name]), quat_multiply(heading, self.objects[name][3:])
        )
        self.look_at = None
        # only the trunk goes back to standing: the arm carries in the reaching posture (`_carry_arm`)
        yield from self._move(hand, np.stack([target, self._carry_point(hand)]), ends=(1.0, 0.0), arms=(1.0, 1.0))
        yield from self._take_close(hand)
        return MotionResult(success=True, hand_error_m=error)

    def place(self, position: ArrayLike, hand: Hand = "right") -> Skill:
        """Put down the object in a hand at a world position [3] [m], upright as it was taken, and withdraw the hand."""
        if hand not in self.held:
            raise InputError(f"The {hand} hand holds nothing.", code="H3-SIM-017")
        held, target = self.held[hand], self.seen(position)
        answer = reach(self.body, target, hand)
        if not answer.reached:
            return _unreached(answer)
        yield from self._look(np.asarray(position, np.float64))
        # the palm goes to the target itself, as an object is within `SNAP_M` of the palm that took it
        line = np.stack([self._carry_point(hand), target])
        for _ in self._move(hand, line, ends=(0.0, 1.0), arms=(1.0, 1.0)):
            yield
        # before the hand goes back, which would take the object along
        del self.held[hand]
        self.look_at = None
        error = float(np.linalg.norm(self.objects[held.name][:3] - np.asarray(position, np.float64)))
        yield from self._move(hand, self._path_out(hand, target)[::-1], ends=(1.0, 0.0))
        return MotionResult(success=error < SNAP_M, reason="" if error < SNAP_M else "missed", hand_error_m=error)

    def lead(self, points: ArrayLike, advance: Callable[[int], bool], hand: Hand = "right") -> Skill:
        """Grasp a handle, lead it along a path, and withdraw the hand.

        Args:
            points: world points of the path [T, 3], the first at the handle; the hand follows them as far as the arm reaches.
            advance: moves the part to point k in the same step; if it returns False, the hand waits. The part finishes its
                motion after the hand has let go.
            hand: which hand.
        """
        local = self.seen(points)
        answer = reach(self.body, local[0], hand)
        if not answer.reached:
            return _unreached(answer)
        yield from self._look(np.asarray(points, np.float64)[0])
        for share in self._move(hand, self._path_out(hand, local[0]), ends=(0.0, 1.0)):
            self._closing[hand] = OPEN_CURL if share < CLOSES_FROM else HANDLE_CURL
            yield
        out = np.flatnonzero(~reacher(self.body, hand).reachable(local))
        # up to the first point out of reach: a hand that has let go does not take hold again farther on
        held = int(out[0]) if len(out) else len(local)
        poses = reach_poses(self.body, local[:held], hand, trunk=np.ones(held), arm=np.ones(held))
        for k in range(len(local)):
            waits = True
            while waits:
                waits = not advance(k)
                at = min(k, held - 1)
                quats = poses.quats[at].copy()
                self.walk.step(self.base)
                quats[HEAD_JOINTS] = self.walk.pose(joints=HEAD_JOINTS[-1] + 1)[0][HEAD_JOINTS]
                self.show("reach", self.with_arms(quats, hand), poses.pelvis[at])
                yield
        self._closing.pop(hand, None)
        self.look_at = None
        yield from self._move(hand, self._path_out(hand, local[held - 1])[::-1], ends=(1.0, 0.0))
        return MotionResult(success=True)

    # --- how ---------------------------------------------------------------------------------------------------------
    def seen(self, position: ArrayLike) -> Array:
        """Transform a world position [3] [m] into the agent root frame."""
        return seen_from(self.base, position)

    def hand_path(self, position: ArrayLike, hand: Hand = "right", *, full: bool = False) -> ReachPoses:
        """Return the poses of the body while a hand moves to a world position [3] [m], in the agent root frame.

        An empty hand moves as in `pick`, and a hand that holds an object as in `place`. The person is not moved.
        """
        target = self.seen(position)
        if full:
            return self._line(hand, np.stack([self._carry_point(hand), target]), (0.0, 1.0), (1.0, 1.0))[0]
        return self._line(hand, self._path_out(hand, target), (0.0, 1.0), (0.0, 1.0))[0]

    def _carry_point(self, hand: Hand) -> Array:
        if hand not in self._carry_points:
            side = 1.0 if hand == "right" else -1.0
            self._carry_points[hand] = np.array(CARRY) * (1, 1, side) * reacher(self.body, hand).body.scale
        return self._carry_points[hand]

    def _path_out(self, hand: Hand, target: Array) -> Array:
        """Return corners of the hand's way to a target: in front of the chest first, unless the target is low."""
        rest = reacher(self.body, hand).rest
        return np.stack([rest, target] if target[1] < rest[1] else [rest, self._carry_point(hand), target])

    def _move(
        self, hand: Hand, corners: Array, *, ends: tuple[float, float], arms: tuple[float, float] | None = None
    ) -> Generator[float, None, None]:
        """Move a palm along straight lines through ``corners`` [K, 3] (agent root frame), at ease at each.

        ``ends`` says whether it begins and ends in the standing trunk (0) or the reaching one (1), ``arms`` the same of
        the elbow. Yields the share of the way.
        """
        # a reach is solved for feet as in standing
        for _ in self.settle():
            yield 0.0
        poses, way = self._line(hand, corners, ends, ends if arms is None else arms)
        fastest = float(joint_steps(poses.quats).max(initial=0.0))
        if fastest > JOINT_STEP_RAD:
            # how fast joints turn only the poses tell: the line is solved again, slower by the excess
            poses, way = self._line(hand, corners, ends, ends if arms is None else arms, fastest / JOINT_STEP_RAD)
        for quats, pelvis, at in zip(poses.quats, poses.pelvis, way, strict=True):
            self.walk.step(self.base)
            # those of a reach look at the target at once: up to 480 degrees a second
            quats[HEAD_JOINTS] = self.walk.pose(joints=HEAD_JOINTS[-1] + 1)[0][HEAD_JOINTS]
            self.show("reach", self.with_arms(quats, hand), pelvis)
            yield float(at / way[-1]) if way[-1] else 1.0

    def _line(
        self, hand: Hand, corners: Array, ends: tuple[float, float], arms: tuple[float, float], slower: float = 1.0
    ) -> tuple[ReachPoses, Array]:
        """Return the poses of `_move` and the way [T] [m] covered at each."""
        legs = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        points, done = [], []
        for k, leg in enumerate(legs):
            steps = int(np.ceil(slower * max(leg / HAND_SPEED_MPS, HAND_LEAST_S) / STEP_S))
            u = np.arange(1, steps + 1)[:, None] / steps
            # at rest at both corners; halfway it is 1.5 times as fast as `HAND_SPEED_MPS`, which is the mean
            u = smoothstep(u)
            points.append(corners[k] + u * (corners[k + 1] - corners[k]))
            done.append(legs[:k].sum() + u[:, 0] * leg)
        way = np.concatenate(done)
        trunk, arm = _eased(way, ends), _eased(way, arms)
        return reach_poses(self.body, np.concatenate(points), hand, trunk=trunk, arm=arm), way

    def _stand(self) -> None:
        self.walk.stand(self.base)
        quats, pelvis = self.walk.pose()
        self.set_pose(self.with_arms(quats), pelvis)
        self.transition = Transition("walk")

    def stride(self, gait: HumanState | None = None) -> None:
        """Make one step of the feet while the root moves to ``gait`` (one world), or stays where it is.

        Hands that hold something keep carrying it.
        """
        if gait is not None:
            self.base = self.root_at(gait)
        quats, pelvis = self.walk.stride(self.base, self.heading)
        if self._is_bare:
            # in place, as nobody else has the new arrays
            self._draw_in(quats)
            self.quats, self.pelvis, self.bare = quats, pelvis, quats
        else:
            self.show("walk", self.with_arms(quats), pelvis)

    @property
    def _is_bare(self) -> bool:
        """Return whether the pose of walking is shown as it is: nothing is blended, held, looked at or led."""
        kind, blended, *_ = self.transition
        if kind != "walk" or blended is not None or self.held or self._closing or self.look_at is not None:
            return False
        extra = *self._close.values(), *self.curl.tolist(), *self.gaze.tolist()
        return self.led is None and not any(extra)

    def _draw_in(self, quats: Array, moving: Hand | None = None) -> None:
        """Fold the arms of a pose [55, 4] in place by one step where there is little room, except a ``moving`` one."""
        if self.free is None or self.spec.arms is None:
            return
        if self._room is None:
            self._room = arm_room(self.body, self.spec.arms)
        free, drawn = self.free, self._drawn
        where = free.sdf, free.origin, free.cell_m, drawn.xz, drawn.heading, drawn.arms
        free.entries(draw_in_planted, *where, HANDS.index(moving) if moving else -1, self._room, quats[None])

    def root_at(self, gait: HumanState) -> Array:
        """Return the pose (pose7) of the agent root at the place and heading of ``gait`` (one world), on the floor."""
        if self.free is not None and len(self.free.heights):
            return self.free.root_pose(gait.xz[0], gait.heading.item(0))
        return ground_pose(gait.xz[0], gait.heading[0], float(self.base[1]))

    def leave(self) -> None:
        """Start a blend from the present pose to the next ones, of whatever motion."""
        self.transition = Transition()

    def show(self, kind: str, quats: Array, pelvis: Array) -> None:
        """Show a pose of one kind of motion, blended over `FADE_STEPS` with the last pose of the previous kind.

        The feet stay where walking has put them.
        """
        if self.led is not None and self.led.any():
            quats, pelvis = quats.copy(), pelvis.copy()
            lead_hands(self.body, quats[None], pelvis[None], self.led[None])
        if self.plays is not None:
            quats, pelvis = quats.copy(), pelvis.copy()
            self.plays(quats[None], pelvis[None])
        fade = self.transition
        if fade.kind != kind:
            fade = Transition(kind, self.bare, self.pelvis, 1.0)
        was_quats, was_pelvis = fade.quats, fade.pelvis
        if was_quats is not None and was_pelvis is not None:
            fade = fade._replace(left=fade.left - 1 / FADE_STEPS)
            share = smoothstep(fade.left)
            quats = _blended(quats, was_quats, share)
            pelvis = pelvis + share * (was_pelvis - pelvis)
            # half a step, because a sum of twelfths does not end exactly at 0
            fade = fade if fade.left > 0.5 / FADE_STEPS else Transition(kind)
        # a pose of walking alone has its feet planted already
        if kind != "walk" or fade.quats is not None:
            self.walk.plant(quats, pelvis)
        # the next transition starts from the bare pose: gaze and fingers are added to every pose anew
        self._assign(self._attend(quats, pelvis), pelvis, quats)
        self.transition = fade

    def _attend(self, quats: Array, pelvis: Array) -> Array:
        """Move fingers, head and eyes by one step; return the pose with them, which is a copy if it differs."""
        curls = self.curl.tolist()
        for k, hand in enumerate(HANDS):
            held = self.held.get(hand)
            goal = self._closing.get(hand, 0.0) if held is None else self.curl_around(held.name)
            if goal != curls[k]:
                curls[k] += min(max(goal - curls[k], -CURL_STEP), CURL_STEP)
                self.curl[k] = curls[k]
        bends, turns = any(curls), self.look_at is not None or any(self.gaze.tolist())
        if bends or turns:
            quats = quats.copy()
        if bends:
            self.call(curl_fingers, quats, self.curl)
        if turns:
            # the kernel takes a point in either case; it is not used if the person looks at nothing
            looks, turning = self.look_at is not None, self.walk.head_turn
            seen = self.base, self.base[:3] if self.look_at is None else self.look_at
            self._to_turn = self.call(turn_gaze, self._offsets, quats, pelvis, *seen, looks, turning, self.gaze)
        return quats

    def curl_around(self, name: str) -> float:
        """Return the bend of each finger joint [rad] at which the fingers touch an object, by the object's name."""
        radius = min(max(self.sizes.get(name, GRIP_M), GRIP_WITHIN[0]), GRIP_WITHIN[1])
        # bones of length l that touch a circle of radius r at their middles bend by 2 atan(l / 2r)
        return min(2 * math.atan(FINGER_M / 2 / (radius + FINGER_HALF)) - REST_CURL, CURL_MOST)

    def _look(self, point: Array) -> Generator[None, None, None]:
        """Turn head and eyes to a world point [3], and wait until they are nearly there."""
        self.look_at = np.array(point, np.float64)
        for _ in range(LOOK_STEPS):
            if self.transition.kind == "reach":  # breathing would move a hand that carries off the start of its line
                self.walk.step(self.base)
                self.show("reach", self.bare.copy(), self.pelvis)
            else:
                self.stride()
            yield
            if self._to_turn < LOOKED_RAD:
                return

    def with_arms(self, quats: Array, moving: Hand | None = None) -> Array:
        """Return a pose [55, 4] with the arms folded in by one step where there is little room.

        An arm that holds something and is not ``moving`` keeps carrying it, close to the body where there is little
        room.
        """
        quats = quats.copy()
        self._draw_in(quats, moving)
        if self.free is not None and self.spec.arms is not None:
            rate = self.spec.arms.rate
            # an emptied hand goes back to 0 at the same rate, so that the next thing does not begin close
            for hand, close in self._close.items():
                if close or hand in self.held:
                    self._close[hand] = close + min(max(self._wanted_close(hand, moving) - close, -rate), rate)
        # last, over what drawing in has made of an arm that carries
        for hand in self.held:
            if hand != moving:
                joints, arm = self._carry_arm(hand)
                quats[joints] = arm
        return quats

    def _wanted_close(self, hand: Hand, moving: Hand | None = None) -> float:
        """Return how close to the body a hand should carry an object, 0 if it holds nothing or moves."""
        rules = self.spec.arms
        if self.free is None or rules is None or hand == moving or hand not in self.held:
            return 0.0
        k = HANDS.index(hand)
        ahead, _, aside = self._carry_point(hand).tolist()
        wanted = held_close(self.free, self.state.xz[0], self.heading, (ahead, aside), self.spec, rules)
        # no farther out than an arm that holds nothing would be here
        return max(wanted, float(self._drawn.arms[0, k]))

    def _take_close(self, hand: Hand) -> Generator[None, None, None]:
        """Stand until the object in hand is as close to the body as turning and walking require."""
        for _ in range(FADE_STEPS):
            if self._wanted_close(hand) <= self._close[hand] + CLOSE_ENOUGH:
                return
            self.stride()
            yield

    def _carry_arm(self, hand: Hand) -> tuple[NDArray[np.integer], Array]:
        """Return joints [4] of an arm that carries something, and their rotations [4, 4] at its present closeness."""
        k, close = HANDS.index(hand), self._close[hand]
        joints = CARRY_JOINTS[k]
        if hand not in self._carry_arms:
            poses = reach_poses(self.body, self._carry_point(hand)[None], hand, trunk=0.0, arm=1.0)
            self._carry_arms[hand] = poses.quats[0, joints]
        if self._carried.get(hand, (None,))[0] != close:  # it is the same one for most of a walk
            self._carried[hand] = close, _blended(self._carry_arms[hand], CARRY_CLOSE[k], close)
        return joints, self._carried[hand][1]


def _blended(a: Array, b: Array, share: float) -> Array:
    """Return rotations [J, 4] blended by a share, 0 (a) to 1 (b)."""
    out = np.empty(a.shape)
    Person.call(blend_pose, a, b, float(share), out)
    return out


def seen_from(base: Array, position: ArrayLike) -> Array:
    """Return a world position [3] [m] in the frame of an agent root at a pose7 [7]."""
    inverse = pose_inverse(base)
    return inverse[:3] + quat_rotate(inverse[3:], np.asarray(position, np.float64))


def run(person: Person, skill: Skill) -> tuple[list[Frame], MotionResult]:
    """Play a skill to its end; return the frames after each of its steps, and the result of the skill."""
    frames = []
    while True:
        try:
            next(skill)
        except StopIteration as end:
            return frames, end.value
        frames.append(person.frame())


def _unreached(answer: ReachResult) -> MotionResult:
    return MotionResult(
        success=False, reason=answer.status, hand_error_m=answer.hand_error_m, base_motion=answer.base_motion
    )


def joint_steps(quats: Array) -> Array:
    """Return how far each joint turns from one pose to the next, [T-1, 55] [rad], of local rotations [T, 55, 4]."""
    # the absolute value, because q and -q are the same rotation
    return 2 * np.arccos(np.minimum(np.abs(np.sum(quats[1:] * quats[:-1], axis=-1)), 1.0))


def _eased(way: Array, ends: tuple[float, float]) -> Array:
    """Return the weights [T] that go over between ``ends`` and 1 within `EASE_M` of either end of the way [T] [m]."""
    # both eases have to fit into a short way; one of no length needs a divisor other than 0
    ease = min(EASE_M, way[-1] / 2) or 1.0
    weight = np.ones_like(way)
    for from_end, value in ((way, ends[0]), (way[-1] - way, ends[1])):
        u = np.clip(from_end / ease, 0, 1)
        weight = np.minimum(weight, value + (1 - value) * u * u * (3 - 2 * u))
    return weight
