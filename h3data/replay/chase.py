"""The ``third_person`` camera: on a free line of sight from the agent it follows, with the other agent in view where it can.

Depth images around the agent (`sight`) say how far the camera may be, whatever the recording is made of. The chain: lengths of
free lines every `KEY_S` to all directions; the best path among them (Viterbi), smoothed; the free length along it at every
step; its moving minimum, smoothed by a window no wider. So the line from camera to agent is free at every step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import Array, heading_direction, heading_from_quat, normalized
from h3data.render import Camera, look_at, pinhole
from h3data.replay.records import CameraTrack
from h3data.replay.replay import Replay
from h3data.replay.sight import Fan, Sight

BOOM_M = 2.6
"""Distance from the agent, where there is room."""
NEAREST_M = 1.0
"""It comes no nearer; where even that is not free, what is in between is cut away (`CameraTrack.nears`)."""
CLOSE_M = 1.6
"""Where it is nearer than this, it rather turns."""
PIVOT_M = {"robot": 0.55, "human": 1.25}
"""Height above the floor of the point of the agent that the camera keeps in sight."""
HEAD_M = 1.5
DIRECTIONS, ELEVATIONS_DEG = 48, (8.0, 22.0, 42.0)
ELEVATION_SCORE = (-0.3, 0.0, -0.2)
BODY_M = 0.4
"""Radius of an agent in another's line of sight."""
KEY_S = 0.2
"""Directions are chosen so often and smoothed in between."""
SMOOTH_S = 0.5
"""Half the window over which the distance is smoothed."""
AROUND_S = 8.0
"""What lies farther away has no say in where the camera is: with 5 s it was 0.7 m off at times, with 8 s nowhere."""
TURN_COST = 1.2
"""Price of turning by one radian between two keys, squared, against scores of about 1."""
HIDDEN = ("ceiling",)
"""Layers that are not drawn and hide nothing."""
OFF_AXIS_RAD = 0.3
"""The agent is at most so far from the middle of the picture."""
JUMP_M, JUMP_MPS = 0.5, 8.0
"""The camera cuts where the agent moves by more than both in one step; elsewhere it moves smoothly."""


def third_person(replay: Replay, *, width: int = 640, height: int = 480) -> CameraTrack:
    """A camera that circles the robot (or the first agent, if there is none) at the best free place to watch it.

    The best place is found for the whole recording at once (dynamic programming over directions): a long free line, the
    other agent visible, preferably from behind, little turning. The followed agent is in sight at every step.
    """
    camera = _lens(width, height)
    if not len(replay):
        return CameraTrack(camera=camera, poses=np.eye(4)[None])
    scene = _scene(replay)
    parts = [_follow(scene, steps, np.arange(len(steps))) for steps in scene.runs]
    poses, nears = (np.concatenate(p) for p in zip(*parts, strict=True))
    return CameraTrack(camera=camera, poses=poses, nears=nears if nears.any() else None)


def third_person_at(replay: Replay, step: int, *, width: int = 640, height: int = 480) -> Camera:
    """The camera of `third_person` at one step, found among the steps around it (0.17 s, however long the recording).

    The best path there is as a rule that of the whole recording: within 1e-5 m at 144 steps of four homes.
    """
    scene = _scene(replay)
    run = next(run for run in scene.runs if run[-1] >= step)
    row, reach = step - run[0], round(AROUND_S / scene.dt)
    first = max(row - reach, 0) // scene.stride * scene.stride  # the same keys
    poses, nears = _follow(scene, run[first : row + reach + 1], np.array([row - first]))
    return CameraTrack(camera=_lens(width, height), poses=poses, nears=nears if nears.any() else None).at(0)


def _lens(width: int, height: int) -> Camera:
    return pinhole(width, height, hfov_deg=75, name="third_person", hidden_layers=HIDDEN)


@dataclass(frozen=True, eq=False)
class _Scene:
    """Whom the camera follows, and what it has to look past."""

    sight: Sight
    pivot: Array
    """Point of the followed agent that it keeps in sight [T, 3]."""
    watched: Array
    """Head of the other agent, or a point ahead of the only one, [T, 3]."""
    two: bool
    """Whether there is another agent to watch."""
    bodies: Array
    """Where all other agents are on the floor [T, N, 2]."""
    dt: float
    runs: list[NDArray[np.intp]]
    """Steps without a cut."""

    @property
    def stride(self) -> int:
        """Steps from key to key."""
        return max(round(KEY_S / self.dt), 1)


def _scene(replay: Replay) -> _Scene:
    recording = replay.recording
    kinds = [agent.kind for agent in recording.agents]
    leader = kinds.index("robot") if "robot" in kinds else 0
    other = kinds.index("human") if "human" in kinds and kinds.index("human") != leader else None
    if other is not None and np.isnan(recording.agent_column(other, "base_pose")).any(-1).all():
        other = None  # never there
    base = held(recording.agent_column(leader, "base_pose").astype(np.float64))
    pivot = base[:, :3] + (0.0, PIVOT_M.get(kinds[leader], PIVOT_M["robot"]), 0.0)
    ahead = heading_direction(heading_from_quat(base[:, 3:]))
    person = None if other is None else held(recording.agent_column(other, "base_pose").astype(np.float64))[:, :3]
    watched = pivot + np.insert(ahead, 1, 0.0, axis=1) if person is None else person + np.array([0.0, HEAD_M, 0.0])
    dt = max(recording.duration_s, 1e-3) / max(len(base) - 1, 1)
    bodies = [recording.agent_column(i, "base_pose") for i in range(len(kinds)) if i != leader]
    bodies = np.stack([b[:, [0, 2]] for b in bodies], axis=1) if bodies else np.zeros((len(base), 0, 2))
    moved = np.linalg.norm(np.diff(pivot, axis=0), axis=1)
    cuts = np.flatnonzero(moved > max(JUMP_M, JUMP_MPS * dt)) + 1
    sight = Sight(replay, hidden_layers=HIDDEN)
    return _Scene(sight, pivot, watched, person is not None, bodies, dt, np.split(np.arange(len(base)), cuts))


def _follow(
    scene: _Scene, steps: NDArray[np.intp], wanted: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses [len(wanted), 4, 4] and near planes [m] at ``wanted`` rows of ``steps``, which are one run.

    All steps count for where the camera circles; how near it comes depends on `SMOOTH_S` before and after alone.
    """
    from scipy.ndimage import gaussian_filter1d, minimum_filter1d  # a quarter of a second, which no other camera needs

    sight, two = scene.sight, scene.two
    pivot, watched, bodies = scene.pivot[steps], scene.watched[steps], scene.bodies[steps]
    count, stride = len(steps), scene.stride
    keys = np.unique(np.append(np.arange(0, count, stride), count - 1))
    azimuth = np.tile(np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS), len(ELEVATIONS_DEG))
    elevation = np.repeat(np.radians(ELEVATIONS_DEG), DIRECTIONS)
    directions = _direction(azimuth, elevation)
    fan = Fan(sight, directions)
    boom, score = np.empty((2, len(keys), len(directions)))
    for row, key in enumerate(keys):
        sight.at(int(steps[key]))
        boom[row] = fan.free(sight.around(pivot[key]), BOOM_M)
        away = normalized((pivot - watched)[key, [0, 2]]) if two else (pivot - watched)[key, [0, 2]]
        hides = _passed(pivot[key], directions, boom[row], bodies[key]) > 0
        score[row] = 0.5 * directions[:, [0, 2]] @ away - 2.0 * hides
        if two:
            eyes = pivot[key] + directions * boom[row, :, None]
            score[row] += sight.sees(sight.around(watched[key]), watched[key], eyes)
    boom = minimum_filter1d(boom, 3, axis=0, mode="nearest")
    score += 1.5 * boom / BOOM_M - 2.0 * np.maximum(1 - boom / CLOSE_M, 0.0) + np.repeat(ELEVATION_SCORE, DIRECTIONS)
    path = _best_path(score, azimuth, elevation)
    turned = np.interp(np.arange(count), keys, np.unwrap(azimuth[path]))
    raised = np.interp(np.arange(count), keys, elevation[path])
    turned, raised = (gaussian_filter1d(angle, 2 * stride, mode="nearest") for angle in (turned, raised))
    direction = _direction(turned, raised)

    reach = max(round(SMOOTH_S / scene.dt), 1)
    free = np.full(count, BOOM_M)
    for row in range(max(wanted[0] - 2 * reach, 0), min(wanted[-1] + 2 * reach + 1, count)):
        sight.at(int(steps[row]))
        free[row] = sight.free_ahead(pivot[row], direction[row], BOOM_M)
    window = np.hanning(2 * reach + 3)[1:-1]
    length = np.pad(minimum_filter1d(free, 2 * reach + 1, mode="nearest"), reach, mode="edge")
    length = np.maximum(np.convolve(length, window / window.sum(), mode="valid"), NEAREST_M)
    eye = pivot + direction * length[:, None]

    target = pivot
    if two:
        gap = np.linalg.norm((watched - pivot)[:, [0, 2]], axis=-1, keepdims=True)
        weight = 0.5 * np.clip((5.0 - gap) / 2.0, 0.0, 1.0)
        target = pivot * (1 - weight) + (watched - (0.0, 0.5, 0.0)) * weight
    target = gaussian_filter1d(target, stride, axis=0, mode="nearest")
    view = _towards(pivot - eye, target - eye)
    poses = np.stack([look_at(e, e + v) for e, v in zip(eye[wanted], view[wanted], strict=True)])
    hidden = np.maximum(length - free, 0.0)
    for row in wanted:
        passed = float(_passed(pivot[row], direction[[row]], length[[row]], bodies[row])[0])
        if 0 < passed < length[row]:
            hidden[row] = max(hidden[row], length[row] - passed)
    return poses, (hidden * np.einsum("ti,ti->t", view, -direction))[wanted]


def _passed(start: Array, directions: Array, length: Array, bodies: Array) -> NDArray[np.float64]:
    """How far from ``start`` [3] lines meet the first of ``bodies`` [N, 2] [m]; 0 = none.

    The lines have unit ``directions`` [D, 3], none of them upright, and ``length`` [D] [m].
    """
    there = bodies[np.isfinite(bodies).all(-1)] - start[[0, 2]]
    flat = np.linalg.norm(directions[:, [0, 2]], axis=1, keepdims=True)
    along = directions[:, [0, 2]] @ there.T / flat
    across = np.sqrt(np.maximum((there**2).sum(1) - along**2, 0.0))
    meets = (across < BODY_M) & (along > 0) & (along < length[:, None] * flat + BODY_M)
    first = np.where(meets, np.maximum(along - BODY_M, 0.4) / flat, np.inf).min(1, initial=np.inf)
    return np.where(np.isfinite(first), first, 0.0)


def _direction(azimuth: Array, elevation: Array) -> Array:
    """Unit vectors [..., 3]; azimuth is a heading."""
    flat = heading_direction(azimuth) * np.cos(elevation)[..., None]
    return np.stack([flat[..., 0], np.sin(elevation), flat[..., 1]], axis=-1)


def _towards(start: Array, end: Array) -> Array:
    """The directions [T, 3] of ``start`` turned towards those of ``end`` by at most `OFF_AXIS_RAD`."""
    start, end = normalized(start), normalized(end)
    cosine = np.clip(np.einsum("ti,ti->t", start, end), -1.0, 1.0)[:, None]
    side = end - cosine * start
    length = np.linalg.norm(side, axis=1, keepdims=True)
    side = np.divide(side, length, out=np.zeros_like(side), where=length > 1e-9)
    angle = np.minimum(np.arccos(cosine), OFF_AXIS_RAD)
    return start * np.cos(angle) + side * np.sin(angle)


def held(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows [T, n] with those that hold NaN (not there then) replaced by the last, at the start by the first, finite row."""
    finite = np.isfinite(values).all(-1)
    if not finite.any():
        raise InputError("This camera has no pose at any step.")
    last = np.maximum.accumulate(np.where(finite, np.arange(len(values)), -1))
    return values[np.where(last < 0, np.argmax(finite), last)]


def _best_path(score: Array, azimuth: Array, elevation: Array) -> NDArray[np.intp]:
    """The direction at each key [K] of the path with the most score [K, D] less the cost of turning (Viterbi)."""
    step = (azimuth[:, None] - azimuth[None] + np.pi) % (2 * np.pi) - np.pi
    cost = 6 * TURN_COST * (step**2 + (elevation[:, None] - elevation[None]) ** 2)
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
