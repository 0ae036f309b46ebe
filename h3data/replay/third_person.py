"""Camera ``third_person``, which follows an agent on a free line of sight, with the other agent in view if possible.

Depth images around the agent (`sight`) limit the camera's distance, so it works for any recording. The stages:

1. The free distance in all directions, every `FRAMING.key_s`.
2. The best path among directions (Viterbi), smoothed.
3. The free distance along that path at every step.
4. Its moving minimum, smoothed by a window that is no wider, so that the line of sight is free at every step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, heading_direction, heading_from_quat, normalized
from h3data.render import Camera, look_at, pinhole
from h3data.replay.records import CameraTrack, forward_fill
from h3data.replay.replay import Replay
from h3data.replay.sight import Fan, Sight, reach_of


@dataclass(frozen=True)
class FramingSpec:
    """Constants of the camera that follows an agent."""

    robot_m: float = 0.55
    """Height above the floor of the point on a robot that the camera keeps in sight [m]."""
    person_m: float = 1.25
    """Height above the floor of the point on a person that the camera keeps in sight [m]."""
    boom_m: float = 2.6
    """Distance from the agent if there is enough space [m]."""
    nearest_m: float = 1.0
    """Smallest distance from the agent [m]; if even that is obstructed, the near plane cuts obstacles away
    (`CameraTrack.nears`)."""
    close_m: float = 1.6
    """Distance below which other directions are preferred [m]."""
    head_m: float = 1.5
    """Height above the floor of the other agent's head [m]."""
    directions: int = 48
    """Number of directions around the agent that are compared."""
    elevations_deg: tuple[float, ...] = (8.0, 22.0, 42.0)
    """Elevations of the camera over the agent that are compared [degrees]."""
    body_m: float = 0.4
    """Radius of agents as obstacles in the line of sight to another agent [m]."""
    key_s: float = 0.2
    """Time between the steps at which a direction is chosen [s]; directions in between are interpolated and
    smoothed."""
    smooth_s: float = 0.5
    """Half width of the window over which the distance is smoothed [s]."""
    around_s: float = 8.0
    """Time before and after a step that `third_person_at` considers [s]; with 5 s the camera deviated by up to 0.7 m,
    with 8 s never."""
    off_axis_rad: float = 0.5
    """Largest angle between the optical axis and the followed agent [rad]."""
    together_rad: float = 1.0
    """Angle between both agents up to which both are in the picture [rad]."""
    apart_rad: float = 1.5
    """Angle between both agents beyond which the other one is left out [rad]."""
    together_m: float = 6.0
    """Distance between both agents up to which both are in the picture [m]."""
    apart_m: float = 9.0
    """Distance between both agents beyond which the other one is left out [m]."""
    jump_m: float = 0.5
    """Distance of an agent in one step above which the camera cuts, if the agent is also faster than `jump_mps` [m]."""
    jump_mps: float = 8.0
    """Speed beyond which the camera cuts, if the agent also moves by more than `jump_m` [m/s]."""


FRAMING = FramingSpec()


def third_person(replay: Replay, leader: int | None = None, *, width: int = 640, height: int = 480) -> CameraTrack:
    """Return a camera track that follows an agent from the best free positions around it.

    Positions are optimised for the whole recording at once, by dynamic programming over directions: a long free line of
    sight, the other agent visible, preferably from behind, and little turning. The followed agent is visible at every
    step except when another agent walks through the line of sight.

    Args:
        replay: recording to film.
        leader: number of the agent to follow; by default the robot, or else the first agent.
        width: width of the picture [px].
        height: height of the picture [px].
    """
    camera = _lens(width, height)
    if not len(replay):
        return CameraTrack(camera=camera, poses=np.eye(4)[None])
    scene = _scene(replay, leader)
    parts = [_follow(scene, steps, np.arange(len(steps))) for steps in scene.runs]
    poses, nears = (np.concatenate(p) for p in zip(*parts, strict=True))
    return CameraTrack(camera=camera, poses=poses, nears=nears if nears.any() else None)


def third_person_at(
    replay: Replay,
    step: int,
    leader: int | None = None,
    *,
    width: int = 640,
    height: int = 480,
    around_s: float = FRAMING.around_s,
) -> Camera:
    """Return the camera of `third_person` at one step, computed from the surrounding steps in 0.17 s.

    The best local path is usually that of the whole recording: equal within 1e-5 m at 144 steps in four homes. With
    ``around_s=0`` it is the best view of this step alone, computed in 0.02 s, for single images.
    """
    scene = _scene(replay, leader)
    run = next(run for run in scene.runs if run[-1] >= step)
    row, reach = step - run[0], round(around_s / scene.dt)
    # a step between two keys has the same neighbours as in the whole recording
    first = max(row - reach, 0) // scene.stride * scene.stride  # same keys as for the whole recording
    poses, nears = _follow(scene, run[first : row + reach + 1], np.array([row - first]))
    return CameraTrack(camera=_lens(width, height), poses=poses, nears=nears if nears.any() else None).at(0)


def _lens(width: int, height: int) -> Camera:
    return pinhole(width, height, hfov_deg=75, name="third_person")


@dataclass(frozen=True, eq=False)
class _Scene:
    """The followed agent, the other agents, and the obstacles around them."""

    sight: Sight
    pivot: Array
    """Point on the followed agent that stays in sight, shape [T, 3]."""
    watched: Array
    """Head of the other agent, or a point ahead of the only agent, shape [T, 3]."""
    two: bool
    """True if there is another agent to watch."""
    bodies: Array
    """Floor positions (x, z) of all other agents, shape [T, N, 2]."""
    dt: float
    runs: list[NDArray[np.intp]]
    """Steps of each stretch between two cuts."""

    @property
    def stride(self) -> int:
        """Number of steps between keys."""
        return max(round(FRAMING.key_s / self.dt), 1)


def default_leader(replay: Replay) -> int:
    """Return the number of the agent that ``third_person`` follows by default: the first robot, or else the first agent."""
    kinds = [agent.kind for agent in replay.recording.agents]
    return kinds.index("robot") if "robot" in kinds else 0


def _scene(replay: Replay, leader: int | None) -> _Scene:
    recording = replay.recording
    kinds = [agent.kind for agent in recording.agents]
    leader = default_leader(replay) if leader is None else leader
    other = next((k for k, kind in enumerate(kinds) if kind == "human" and k != leader), None)
    if other is not None and np.isnan(recording.agent_column(other, "base_pose")).any(-1).all():
        other = None  # absent throughout
    base = forward_fill(recording.agent_column(leader, "base_pose").astype(np.float64))
    pivot = base[:, :3] + (0.0, FRAMING.person_m if kinds[leader] == "human" else FRAMING.robot_m, 0.0)
    ahead = heading_direction(heading_from_quat(base[:, 3:]))
    person = (
        None if other is None else forward_fill(recording.agent_column(other, "base_pose").astype(np.float64))[:, :3]
    )
    watched = (
        pivot + np.insert(ahead, 1, 0.0, axis=1) if person is None else person + np.array([0.0, FRAMING.head_m, 0.0])
    )
    dt = max(recording.duration_s, 1e-3) / max(len(base) - 1, 1)
    bodies = [recording.agent_column(i, "base_pose") for i in range(len(kinds)) if i != leader]
    bodies = np.stack([b[:, [0, 2]] for b in bodies], axis=1) if bodies else np.zeros((len(base), 0, 2))
    # where an agent was put elsewhere, the camera cuts: a smooth path would fly through walls
    moved = np.linalg.norm(np.diff(pivot, axis=0), axis=1)
    cuts = np.flatnonzero(moved > max(FRAMING.jump_m, FRAMING.jump_mps * dt)) + 1
    sight = Sight(replay)
    return _Scene(sight, pivot, watched, person is not None, bodies, dt, np.split(np.arange(len(base)), cuts))


def _follow(
    scene: _Scene, steps: NDArray[np.intp], wanted: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return camera poses [N, 4, 4] and near planes [N] [m] at ``wanted`` rows [N] of ``steps``, which form one run.

    The direction depends on all steps, the distance only on those within `FRAMING.smooth_s`.
    """
    from scipy.ndimage import gaussian_filter1d, minimum_filter1d  # takes 0.25 s, which other cameras do not need

    sight, two = scene.sight, scene.two
    pivot, watched, bodies = scene.pivot[steps], scene.watched[steps], scene.bodies[steps]
    count, stride = len(steps), scene.stride
    keys = np.unique(np.append(np.arange(0, count, stride), count - 1))
    azimuth = np.tile(np.arange(FRAMING.directions) * (2 * np.pi / FRAMING.directions), len(FRAMING.elevations_deg))
    elevation = np.repeat(np.radians(FRAMING.elevations_deg), FRAMING.directions)
    directions = _direction(azimuth, elevation)
    fan, far_m = Fan(sight, directions), reach_of(FRAMING.boom_m)
    boom, score = np.empty((2, len(keys), len(directions)))
    for row, key in enumerate(keys):
        sight.at(int(steps[key]))
        boom[row] = fan.free(sight.around(pivot[key], far_m), FRAMING.boom_m)
        away = normalized((pivot - watched)[key, [0, 2]]) if two else (pivot - watched)[key, [0, 2]]
        obstructed = _first_body(pivot[key], directions, boom[row], bodies[key]) > 0
        score[row] = 0.5 * directions[:, [0, 2]] @ away - 2.0 * obstructed
        if two:
            eyes = pivot[key] + directions * boom[row, :, None]
            score[row] += sight.sees(watched[key], eyes)
            score[row] -= _lost(_angle(-directions, watched[key] - eyes)) * (1 - _far(pivot[key], watched[key]))
    # the agent moves between keys: a direction has to be free at its neighbours too
    boom = minimum_filter1d(boom, 3, axis=0, mode="nearest")
    # a bonus for each elevation, the lowest first
    score += (
        1.5 * boom / FRAMING.boom_m
        - 2.0 * np.maximum(1 - boom / FRAMING.close_m, 0.0)
        + np.repeat((-0.3, 0.0, -0.2), FRAMING.directions)
    )
    path = _best_path(score, azimuth, elevation)
    # unwrapped, so that the angle between two keys takes the smaller of the two turns
    turned = np.interp(np.arange(count), keys, np.unwrap(azimuth[path]))
    raised = np.interp(np.arange(count), keys, elevation[path])
    turned, raised = (gaussian_filter1d(angle, 2 * stride, mode="nearest") for angle in (turned, raised))
    direction = _direction(turned, raised)

    # the distance never exceeds the free one: a window over a moving minimum of its own width stays below it
    reach = max(round(FRAMING.smooth_s / scene.dt), 1)
    free = np.full(count, FRAMING.boom_m)
    for row in range(max(wanted[0] - 2 * reach, 0), min(wanted[-1] + 2 * reach + 1, count)):
        sight.at(int(steps[row]))
        free[row] = sight.free_ahead(pivot[row], direction[row], FRAMING.boom_m)
    window = np.hanning(2 * reach + 3)[1:-1]
    length = np.pad(minimum_filter1d(free, 2 * reach + 1, mode="nearest"), reach, mode="edge")
    length = np.maximum(np.convolve(length, window / window.sum(), mode="valid"), FRAMING.nearest_m)
    eye = pivot + direction * length[:, None]

    view = normalized(pivot - eye)
    if two:
        other = normalized(watched - (0.0, 0.5, 0.0) - eye)
        apart = _angle(view, other)
        share = 0.5 * (1 - _lost(apart)) * (1 - _far(pivot, watched))
        turn = gaussian_filter1d(np.minimum(share * apart, FRAMING.off_axis_rad), 2 * stride, mode="nearest")
        view = _towards(view, other, np.minimum(turn, apart))
    view = normalized(gaussian_filter1d(view, stride, axis=0, mode="nearest"))
    poses = np.stack([look_at(e, e + v) for e, v in zip(eye[wanted], view[wanted], strict=True)])
    # what still stands in the line of sight is cut away by the near plane
    hidden = np.maximum(length - free, 0.0)
    for row in wanted:
        obstacle = float(_first_body(pivot[row], direction[[row]], length[[row]], bodies[row])[0])
        # A near plane is as good as a body that stands around the eye. Farther ahead it would leave a foot below it and cut
        # a strip out of the floor, so somebody who walks by there is left whole and hides the agent for a moment.
        if length[row] - 2 * FRAMING.body_m < obstacle < length[row]:
            hidden[row] = max(hidden[row], length[row] - obstacle)
    return poses, (hidden * np.einsum("ti,ti->t", view, -direction))[wanted]


def _first_body(start: Array, directions: Array, length: Array, bodies: Array) -> NDArray[np.float64]:
    """Return distances [D] from ``start`` [3] at which lines meet the first of ``bodies`` [N, 2] [m]; 0 = none.

    The lines have unit ``directions`` [D, 3], none of them vertical, and ``length`` [D] [m].
    """
    offsets = bodies[np.isfinite(bodies).all(-1)] - start[[0, 2]]
    flat = np.linalg.norm(directions[:, [0, 2]], axis=1, keepdims=True)
    along = directions[:, [0, 2]] @ offsets.T / flat
    across = np.sqrt(np.maximum((offsets**2).sum(1) - along**2, 0.0))
    meets = (across < FRAMING.body_m) & (along > 0) & (along < length[:, None] * flat + FRAMING.body_m)
    first = np.where(meets, np.maximum(along - FRAMING.body_m, 0.4) / flat, np.inf).min(1, initial=np.inf)
    return np.where(np.isfinite(first), first, 0.0)


def _direction(azimuth: Array, elevation: Array) -> Array:
    """Return the unit vectors [..., 3]; azimuth is a heading."""
    flat = heading_direction(azimuth) * np.cos(elevation)[..., None]
    return np.stack([flat[..., 0], np.sin(elevation), flat[..., 1]], axis=-1)


def _angle(start: Array, end: Array) -> NDArray[np.float64]:
    """Return angles [...] between directions [..., 3] [rad]."""
    return np.arccos(np.clip(np.einsum("...i,...i->...", normalized(start), normalized(end)), -1.0, 1.0))


def _lost(angle: Array) -> Array:
    """Return 0 where both agents fit into the picture, 1 where they do not, by the angle between them [rad]."""
    return np.clip((angle - FRAMING.together_rad) / (FRAMING.apart_rad - FRAMING.together_rad), 0.0, 1.0)


def _far(pivot: Array, watched: Array) -> Array:
    """Return 0 where the agents [..., 3] are near each other, 1 where they have nothing to do with each other."""
    gap = np.linalg.norm((watched - pivot)[..., [0, 2]], axis=-1)
    return np.clip((gap - FRAMING.together_m) / (FRAMING.apart_m - FRAMING.together_m), 0.0, 1.0)


def _towards(start: Array, end: Array, angle: Array) -> Array:
    """Return the unit directions ``start`` [T, 3], turned towards ``end`` by an angle [T] [rad]."""
    side = normalized(end - np.einsum("ti,ti->t", start, end)[:, None] * start)
    return start * np.cos(angle)[:, None] + side * np.sin(angle)[:, None]


def _best_path(score: Array, azimuth: Array, elevation: Array) -> NDArray[np.intp]:
    """Return the direction at each key [K] on the path with the highest score [K, D] minus the cost of turning (Viterbi)."""
    # the smaller of the two turns
    step = (azimuth[:, None] - azimuth[None] + np.pi) % (2 * np.pi) - np.pi
    # a radian between two keys costs 7.2, where scores are about 1: the camera turns slowly or for good reasons
    cost = 6 * 1.2 * (step**2 + (elevation[:, None] - elevation[None]) ** 2)
    total, previous = score[0], np.zeros(score.shape, np.intp)
    for k in range(1, len(score)):
        through = total[None, :] - cost
        previous[k] = through.argmax(1)
        total = score[k] + through.max(1)
    path = np.empty(len(score), np.intp)
    path[-1] = total.argmax()
    for k in range(len(score) - 1, 0, -1):
        path[k - 1] = previous[k, path[k]]
    return path
