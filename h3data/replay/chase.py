"""The ``third_person`` camera: stays near the robot, keeps walls out of the way, and the person in view where it can."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import Array, heading_direction, heading_from_quat, normalized
from h3data.render import look_at, pinhole
from h3data.replay.replay import CameraTrack, Replay

if TYPE_CHECKING:
    from h3data.scene import FreeSpace

BOOM_M = 2.4
"""Distance from the robot along the floor, where there is room."""
CLEARANCE_M = 0.12
"""The camera keeps this far from walls."""
EYE_M, EYE_RISE_M = 1.45, 0.75
"""Height of the eye, and how much higher it is when the boom is short."""
DIRECTIONS = 48
KEY_STEPS = 6
"""Directions are chosen every so many steps and smoothed in between."""
TURN_COST = 1.2
"""Price of turning by one radian between two keys, squared, against scores of about 1."""


def third_person(replay: Replay, *, width: int = 640, height: int = 480) -> CameraTrack:
    """A camera that circles the robot (or the only agent) at the best free place to watch it and the person.

    The best place is found for the whole recording at once (dynamic programming over directions): a long free boom, the
    person visible, preferably from behind the robot, little turning.
    """
    from scipy.ndimage import gaussian_filter1d, minimum_filter1d  # a quarter of a second, which no other camera needs

    recording = replay.recording
    kinds = [agent.kind for agent in recording.agents]
    leader = kinds.index("robot") if "robot" in kinds else 0
    other = kinds.index("human") if "human" in kinds and kinds.index("human") != leader else None
    if other is not None and np.isnan(recording.agent_column(other, "base_pose")).any(-1).all():
        other = None  # never there
    base = recording.agent_column(leader, "base_pose").astype(np.float64)
    camera = pinhole(width, height, hfov_deg=75, name="third_person", hidden_layers=("ceiling",))
    if not len(base):
        return CameraTrack(camera=camera, poses=np.eye(4)[None])
    base = held(base)
    robot, floor = base[:, [0, 2]], base[:, 1]
    ahead = heading_direction(heading_from_quat(base[:, 3:]))
    person = (
        robot + ahead
        if other is None
        else held(recording.agent_column(other, "base_pose")[:, [0, 2]].astype(np.float64))
    )
    walls = _walls(replay)

    keys = np.unique(np.append(np.arange(0, len(base), KEY_STEPS), len(base) - 1))
    angles = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    directions = heading_direction(angles)
    boom = _free_length(walls, robot[keys, None], directions[None])
    eyes = robot[keys, None] + directions * boom[..., None]
    behind = normalized(robot - person)[keys] @ directions.T
    score = 1.5 * boom / BOOM_M + 0.5 * behind + 1.0 * _visible(walls, eyes, person[keys, None])
    angle = np.interp(np.arange(len(base)), keys, np.unwrap(angles[_best_path(score)]))
    angle = gaussian_filter1d(angle, 2 * KEY_STEPS, mode="nearest")

    direction = heading_direction(angle)
    length = _free_length(walls, robot, direction)
    length = gaussian_filter1d(minimum_filter1d(length, 4 * KEY_STEPS, mode="nearest"), KEY_STEPS, mode="nearest")
    eye_height = floor + EYE_M + EYE_RISE_M * (1 - length / BOOM_M)
    eye = _lift(robot + direction * length[:, None], eye_height)
    target = _lift(robot, floor + 0.55)
    if other is not None:
        gap = np.linalg.norm(person - robot, axis=-1, keepdims=True)
        weight = 0.5 * np.clip((5.0 - gap) / 2.0, 0.0, 1.0)
        target = target * (1 - weight) + _lift(person, floor + 1.0) * weight
    target = gaussian_filter1d(target, KEY_STEPS, axis=0, mode="nearest")
    return CameraTrack(camera=camera, poses=np.stack([look_at(e, t) for e, t in zip(eye, target, strict=True)]))


def held(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows [T, n] with those that hold NaN (not there then) replaced by the last, at the start by the first, finite row."""
    finite = np.isfinite(values).all(-1)
    if not finite.any():
        raise InputError("This camera has no pose at any step.")
    last = np.maximum.accumulate(np.where(finite, np.arange(len(values)), -1))
    return values[np.where(last < 0, np.argmax(finite), last)]


def _walls(replay: Replay) -> FreeSpace | None:
    """What stands at eye height; None for recordings that carry no scene."""
    if replay.scene is None or not replay.scene.rooms:
        return None
    from h3data.scene import FreeSpace

    return FreeSpace.from_scene(replay.scene, radius_m=CLEARANCE_M, height_m=EYE_M + EYE_RISE_M - 0.2, max_climb_m=1.3)


def _free_length(walls: FreeSpace | None, start: Array, direction: Array) -> NDArray[np.float64]:
    """How far one can go from ``start`` [..., 2] along ``direction`` [..., 2] at eye height, at most `BOOM_M` [m]."""
    shape = np.broadcast_shapes(start.shape, direction.shape)[:-1]
    if walls is None:
        return np.full(shape, BOOM_M, np.float64)
    reach = np.linspace(0.0, BOOM_M, 49)
    points = start[..., None, :] + direction[..., None, :] * reach[:, None]
    blocked = walls.signed_distance(points) < CLEARANCE_M
    first = np.where(blocked.any(-1), blocked.argmax(-1), len(reach))
    return reach[np.maximum(first - 1, 0)]


def _visible(walls: FreeSpace | None, eyes: Array, person: Array) -> NDArray[np.float64]:
    """1 where nothing at eye height stands between eyes [..., 2] and the person [..., 2], else 0."""
    shape = np.broadcast_shapes(eyes.shape, person.shape)[:-1]
    if walls is None:
        return np.ones(shape)
    share = np.linspace(0.0, 1.0, 41)[:, None]
    points = eyes[..., None, :] * (1 - share) + person[..., None, :] * share
    return np.asarray((walls.signed_distance(points) > 0.02).all(-1), np.float64)


def _best_path(score: NDArray[np.float64]) -> NDArray[np.intp]:
    """The direction at each key [K] of the path with the most score [K, D] less the cost of turning (Viterbi)."""
    count = score.shape[1]
    turn = np.arange(count) * (2 * np.pi / count)
    step = (turn[:, None] - turn[None] + np.pi) % (2 * np.pi) - np.pi
    cost = TURN_COST * (step * KEY_STEPS) ** 2 / KEY_STEPS
    total, came = score[0], np.zeros(score.shape, np.intp)
    for k in range(1, len(score)):
        through = total[None, :] - cost
        came[k] = through.argmax(1)
        total = score[k] + through.max(1)
    path = np.empty(len(score), np.intp)
    path[-1] = total.argmax()
    for k in range(len(score) - 1, 0, -1):
        path[k - 1] = came[k, path[k]]
    return path


def _lift(xz: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([xz[:, 0], y, xz[:, 1]], axis=-1)
