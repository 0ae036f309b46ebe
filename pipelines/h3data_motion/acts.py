"""Captured motions as activities: a clip that a person plays at a place, from standing and back to standing.

`h3data.bodies.names` finds this module by the entry-point group ``h3data.walks``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from io import BytesIO
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.gestures import BOTH
from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.humanoid_file import load_humanoid
from h3data.bodies.people.reach import hand_points
from h3data.bodies.people.soles import ANKLE, HIP, KNEE, LEG_JOINTS, TOE, sole_points
from h3data.errors import InputError
from h3data.geometry import (
    IDENTITY_POSE,
    Array,
    quat_conjugate,
    quat_from_matrix,
    quat_multiply,
    quat_nlerp,
    smoothstep,
)
from h3data.recording import Recording
from h3data.replay.posed_recording import BEGINS
from h3data.scene import FreeSpace
from h3data_motion.clip import Motion, pelvis_heading
from h3data_motion.contacts import leg_frames, legs_to
from h3data_motion.files import load_motion, motion_bytes, read_motion
from h3data_motion.retarget import retarget
from h3data_motion.walks import CUT_M, CUT_MPS2, KEPT_FPS, LEAST_FPS

BLEND_S = 0.5
"""Time in which a person goes from standing into a clip, and back before its end [s]."""
SECONDS = (1.2, 120.0)
"""Shortest and longest clip [s]."""
DRIFT_M = 0.5
"""Largest distance of the pelvis along the floor from where it begins [m]; beyond it, the person walks away."""
TURN_DEG = 60.0
"""Largest turn of the pelvis from the first to the last frame [deg], as the person turns back in `BLEND_S`."""
LIFT, STEP_S = 0.3, 1 / 30
"""Height of a foot's path between standing and the clip, as a share of its length; and the duration of a step [s]."""
OUTLINE_M, INTO_M = 0.04, 0.02
"""Grid on which the floor below a clip is counted, and depth by which a body may come into obstacles there [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Act:
    """A motion fitted to a body, which stays where the person stands."""

    event: ClassVar[str] = "performs"
    """Kind of the event with which a person begins; the target ends with the name, and the detail is the number of
    repetitions. A person who is driven from outside begins and ends by events `activity` without a place."""
    blend_s: ClassVar[float] = BLEND_S
    """Time before its end in which a person goes back to standing [s]."""
    body: Humanoid
    motion: Motion
    """Motion of the body with its feet on the floor, in the agent root frame of the place where the person stands."""

    @property
    def seconds(self) -> float:
        """Duration of one repetition [s], in whole steps of 1/30 s."""
        return round(self.motion.duration_s / STEP_S) * STEP_S

    def weight(self, since: Array) -> tuple[Array, Array]:
        """Return the time [T] [s] in the motion and the progress [T], 0 to 1, from standing, at times since its start [T]."""
        # whole steps: rounding must not make the last moment of a repetition the first of the next
        steps = np.rint(np.asarray(since, np.float64) / STEP_S * 64) / 64 % round(self.seconds / STEP_S)
        time = steps * STEP_S
        return time, np.clip(np.minimum(time, self.seconds - time) / BLEND_S, 0.0, 1.0)

    def replay(
        self, recording: Recording, agent: int, name: str, steps: NDArray[np.integer], quats: Array, pelvis: Array
    ) -> None:
        """Change poses of an agent at ``steps`` [T] of a recording, in place, where the agent plays the motion ``name``."""
        seconds, target = recording.columns["time_ns"] * 1e-9, f"{recording.agents[agent].name}_{name}"
        own = [event for event in recording.events if event.agent == agent]
        for k, event in enumerate(own):
            since = seconds[steps] - seconds[max(event.step, 0)]
            if (event.kind, event.target) == (self.event, target):
                self.perform(quats, pelvis, since, int(event.detail))
            elif (event.kind, event.target, event.detail) == (BEGINS, name, ""):
                end = next((after.step for after in own[k + 1 :] if after.kind == BEGINS), None)
                left = np.full(len(steps), np.inf) if end is None else seconds[end - 1] - seconds[steps]
                self.perform(quats, pelvis, since, math.inf, left)

    def fits(self, free: FreeSpace, xz: Array, heading: float, others: Array) -> bool:
        """Return whether the floor below all that the body passes over is free at a place [2].

        The circles ``(x, z, radius)`` [N, 3] [m] cover the ``others``.
        """
        cos, sin = math.cos(heading), math.sin(heading)
        points = xz + self.outline[:, :2] @ np.array([[cos, -sin], [sin, cos]])
        gaps = np.linalg.norm(points[:, None] - others[:, :2], axis=2) - others[:, 2]
        room = np.minimum(free.signed_distance(points), gaps.min(1, initial=np.inf))
        return bool((room >= self.outline[:, 2] - INTO_M).all())

    def perform(self, quats: Array, pelvis: Array, since: Array, times: float, left: Array | float = math.inf) -> None:
        """Change poses of a standing person to those of the clip, in place.

        Into the clip and out of it, one foot after the other steps from where it stands to where the clip has it.

        Args:
            quats: Local rotations [T, 55, 4].
            pelvis: Positions of the pelvis in the agent root frame [T, 3] [m].
            since: Time since the person began [T] [s]; before and after the repetitions, poses stay as they are.
            times: Number of repetitions.
            left: Time until the person stands again [T] [s], if that is earlier.
        """
        left = np.broadcast_to(left, since.shape)
        rows = np.flatnonzero((since > 0) & (since < times * self.seconds - STEP_S / 2) & (left >= 0))
        time, progress = self.weight(since[rows])
        progress = np.minimum(progress, left[rows] / BLEND_S)
        clip_quats, clip_pelvis = self.motion.pose(time)
        blends = np.flatnonzero(progress < 1)
        into = rows[blends], clip_quats[blends], clip_pelvis[blends], progress[blends]
        mixed = self._mixed(quats[into[0]], pelvis[into[0]], *into[1:])
        quats[rows], pelvis[rows] = clip_quats, clip_pelvis
        quats[into[0]], pelvis[into[0]] = mixed

    def _mixed(
        self, quats: Array, pelvis: Array, to_quats: Array, to_pelvis: Array, progress: Array
    ) -> tuple[Array, Array]:
        """Return poses between standing, ``quats`` [T, 55, 4] and ``pelvis`` [T, 3], and those of the clip."""
        share = smoothstep(progress)
        out = quat_nlerp(quats, to_quats, np.broadcast_to(share[:, None], quats.shape[:2]))
        place = pelvis + share[:, None] * (to_pelvis - pelvis)
        was, to = (leg_frames(self.body, *pose)[:, :, ANKLE] for pose in ((quats, pelvis), (to_quats, to_pelvis)))
        # the left foot steps in the first half of the way into the clip, the right one in the second half
        steps = smoothstep(np.clip(2 * progress[:, None] - (0, 1), 0.0, 1.0))
        path = to[..., :3, 3] - was[..., :3, 3]
        ankles = was[..., :3, 3] + steps[..., None] * path
        ankles[..., 1] += LIFT * np.hypot(path[..., 0], path[..., 2]) * 4 * steps * (1 - steps)
        turned = quat_nlerp(quat_from_matrix(was[..., :3, :3]), quat_from_matrix(to[..., :3, :3]), steps)
        toes = LEG_JOINTS[:, TOE]
        out[:, toes] = quat_nlerp(quats[:, toes], to_quats[:, toes], steps)
        legs = self.body.gaits.legs
        for _ in range(2):
            knees = quat_from_matrix(leg_frames(self.body, out, place)[:, :, KNEE, :3, :3])
            out[:, LEG_JOINTS[:, ANKLE]] = quat_multiply(quat_conjugate(knees), turned)
            frames = leg_frames(self.body, out, place)
            # a foot that turns about its ankle would put its heel or its toes into the floor
            soles = sole_points(self.body, frames) - frames[:, :, ANKLE, None, :3, 3]
            ankles[..., 1] = np.maximum(ankles[..., 1], -soles[..., 1].min(2))
            # the pelvis sinks to where both legs reach the feet
            gaps = frames[:, :, HIP, :3, 3] - ankles
            high = np.sqrt(np.maximum((0.9995 * legs.length) ** 2 - gaps[..., 0] ** 2 - gaps[..., 2] ** 2, 0.0))
            place[:, 1] -= np.maximum(gaps[..., 1] - high, 0.0).max(1)
            out = legs_to(self.body, out, place, ankles)
        return out, place

    @cached_property
    def leads(self) -> Array:
        """Places of the palms in each step of one repetition, as `gestures.lead_hands` takes them, [T, 4, 4]."""
        time, progress = self.weight(np.arange(round(self.seconds / STEP_S)) * STEP_S)
        leads = np.zeros((len(time), 4, 4))
        joints = self.body.joint_matrices(IDENTITY_POSE[None], *self.motion.pose(time))
        for k, hand in enumerate(BOTH):
            leads[:, k, :3] = hand_points(joints, self.body, hand)
        leads[:, :2, 3] = smoothstep(progress)[:, None]
        return leads

    @cached_property
    def outline(self) -> Array:
        """Circles ``(ahead, right, radius)`` [N, 3] [m] on the floor that cover the body during the clip."""
        joints = self.body.joint_matrices(
            IDENTITY_POSE[None], *self.motion.pose(np.arange(0.0, self.motion.duration_s, 1 / 15))
        )
        start, end, radius = self.body.capsules_world(joints)
        along = np.linspace(0, 1, 4)[:, None, None, None]
        points = (start + along * (end - start))[..., [0, 2]]
        rows = np.column_stack([points.reshape(-1, 2), np.broadcast_to(radius, points.shape[:-1]).ravel()])
        cells = np.concatenate([np.rint(rows[:, :2] / OUTLINE_M), np.ceil(rows[:, 2:] / 0.01)], 1)
        return np.unique(cells, axis=0) * (OUTLINE_M, OUTLINE_M, 0.01)


def acting(body: Humanoid, clips: Mapping[str, bytes], *, name: str) -> Humanoid:
    """Return a body called ``name`` that can play the contents of motion files, by name of the activity."""
    acts = {
        key: Act(body=body, motion=retarget(load_motion(BytesIO(data)), body)) for key, data in sorted(clips.items())
    }
    return replace(body, name=name, acts=acts)


@lru_cache(maxsize=16)
def act_file(path: str) -> bytes:
    """Return the contents of a file with the motion of a motion file, as an activity.

    Raises:
        InputError: There is no such file, or the motion cannot be an activity.
        FormatError: The file is not a motion file.
    """
    if not Path(path).is_file():
        raise InputError(
            f"Expected a motion file for an activity (.npz, .pkl, .bvh), there is none there: {path}",
            code="H3-BODY-183",
        )
    motion = replace(read_motion(path), body="")
    what = f"Motion {motion.name!r} cannot be an activity:"
    if motion.fps < LEAST_FPS:
        raise InputError(
            f"{what} expected at least {LEAST_FPS:g} frames per second, got {motion.fps:g}.", code="H3-BODY-184"
        )
    if not SECONDS[0] <= motion.duration_s <= SECONDS[1]:
        raise InputError(
            f"{what} expected {SECONDS[0]} to {SECONDS[1]:g} s, it lasts {motion.duration_s:.2f} s.", code="H3-BODY-185"
        )
    motion = motion.resampled(KEPT_FPS) if motion.fps > KEPT_FPS else motion
    body = load_humanoid("neutral_0")
    fitted = retarget(motion, body)
    drift = float(np.hypot(*(fitted.pelvis - fitted.pelvis[0])[:, [0, 2]].T).max())
    if drift > DRIFT_M:
        raise InputError(
            f"{what} the person gets {drift:.2f} m away, and at most {DRIFT_M} m are possible at a place. Hint: cut out a part "
            "on the spot, or use the motion as a walk (--motion).",
            code="H3-BODY-186",
        )
    turn = float(np.degrees(np.abs(pelvis_heading(fitted.quats[-1:, 0])[0])))
    if turn > TURN_DEG:
        raise InputError(
            f"{what} the person ends turned by {turn:.0f} degrees from the beginning, and at most {TURN_DEG:g} are possible. "
            "Hint: cut out a part that ends in the direction in which it begins.",
            code="H3-BODY-188",
        )
    places = body.joint_matrices(IDENTITY_POSE[None], fitted.quats, fitted.pelvis)[:, :22, :3, 3]
    jumps = np.linalg.norm(np.diff(places, n=2, axis=0), axis=-1).mean(1) >= CUT_M + CUT_MPS2 / motion.fps**2
    if jumps.any():
        at = float(np.argmax(jumps) + 1) / motion.fps
        raise InputError(
            f"{what} the joints jump at {at:.2f} s. Hint: cut out a part without a jump.", code="H3-BODY-187"
        )
    return motion_bytes(motion)
