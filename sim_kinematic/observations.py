"""What a learning agent is shown of a `SocialNavBatch`: named observations as Gymnasium spaces and arrays, worlds first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, MissingExtraError
from sim_kinematic.sensors import (
    DEPTH_RANGE_M,
    DETECTED_PIXELS,
    FAR_M,
    RANGE_M,
    RANGES,
    detect_humanoids,
    egomotion,
    gps_compass,
    humanoid_velocity,
    localization,
    range_scan,
    way,
)
from sim_kinematic.social_nav_batch import SocialNavBatch
from sim_kinematic.state import AgentState

if TYPE_CHECKING:
    from gymnasium.spaces import Dict

    from sim_kinematic.camera_sensor import StateRenderer

try:
    import gymnasium
except ImportError as error:
    raise MissingExtraError(
        "Training environments need Gymnasium and PettingZoo. Hint: pip install 'h3data[env]'"
    ) from error

Observation = Literal[
    "arm_depth", "humanoid_detector", "humanoid_gps", "egomotion", "localization", "humanoid_velocity", "way", "range_scan"
]  # fmt: skip
PAPER_OBSERVATIONS: tuple[Observation, ...] = ("arm_depth", "humanoid_detector", "humanoid_gps")
"""What the paper's policy sees (appendix, social navigation). Needs a picture in every step."""
STATE_OBSERVATIONS: tuple[Observation, ...] = ("humanoid_gps", "egomotion")
"""What costs no picture."""
CAMERA = "robot_arm"
FAST = 10.0
"""Bound of velocities [m/s, rad/s]: four times the robot's limits."""

_BOUNDS: dict[str, tuple[list[float], list[float]]] = {
    "humanoid_detector": ([0.0], [1.0]),
    "humanoid_gps": ([0.0, -np.pi], [FAR_M, np.pi]),
    "egomotion": ([-FAST] * 3, [FAST] * 3),
    "localization": ([-FAR_M] * 3 + [-np.pi], [FAR_M] * 3 + [np.pi]),
    "humanoid_velocity": ([-FAST] * 2, [FAST] * 2),
    "way": ([0.0, -np.pi], [FAR_M, np.pi]),
    "range_scan": ([0.0] * RANGES, [RANGE_M] * RANGES),
}


def state_box(name: Observation) -> gymnasium.spaces.Box:
    """The space of one world's observation that is no picture."""
    low, high = (np.array(bound, np.float32) for bound in _BOUNDS[name])
    return gymnasium.spaces.Box(low, high, dtype=np.float32)


class Observer:
    """The robots' observations of a batch; each array is [W, ...] float32 and within its space.

    ``arm_depth``: depth of the arm's camera, [H, W, 1] in 0..1 of `DEPTH_RANGE_M`, 0 = nothing hit.
    ``humanoid_detector``: 1 when more than 1,000 pixels of that picture show the person, [1]; with ``depth_size`` as many
    as are the same part of it. ``humanoid_gps``: distance [m] and angle [rad] to her, positive to the right, [2].
    ``egomotion``: forward, left [m/s] and turn [rad/s] of the last step, [3]. ``localization``: x, y, z [m] and heading
    [rad] in the world, [4]. Of the person's last step ``humanoid_velocity``: forward and left of the robot [m/s], [2]. By the
    map: ``way``, the length of the shortest way to her [m] and the angle at which it begins [rad], positive to the right,
    [2]; ``range_scan``, the free way in 12 directions [m], [12] (`sim_kinematic.sensors`).
    """

    def __init__(
        self, batch: SocialNavBatch, names: Sequence[Observation], *, depth_size: tuple[int, int] | None = None,
        threads: int = 1,
    ) -> None:  # fmt: skip
        """``depth_size``: width and height of pictures [pixels], None for the camera's own 224 x 171.

        Raises:
            InputError: there are no such observations.
        """
        self.names = _checked_names(names)
        self._batch, self._threads = batch, threads
        camera = batch.robot.camera(CAMERA)
        self._own_size = camera.width, camera.height
        self._size = depth_size or self._own_size
        if min(self._size) < 1:
            raise InputError(f"Expected a picture of at least 1 x 1 pixels, got {self._size}.")
        self._pictured = tuple(n for n in self.names if n in ("arm_depth", "humanoid_detector"))
        self._drawn: dict[int, StateRenderer] = {}

    def space(self) -> Dict:
        """The space of one world's observations."""
        return gymnasium.spaces.Dict({name: self._box(name) for name in self.names})

    def _box(self, name: Observation) -> gymnasium.spaces.Box:
        if name == "arm_depth":
            return gymnasium.spaces.Box(0.0, 1.0, (*self._size[::-1], 1), np.float32)
        return state_box(name)

    def observe(self) -> dict[str, NDArray[np.float32]]:
        """What the robots see now, [W, ...] each."""
        now, before = self._batch.state, self._batch.before
        agents = now.robots[0], before.robots[0], now.people[0], before.people[0]
        pictures = self._pictures() if self._pictured else {}
        return {n: pictures[n] if n in pictures else self._seen(n, *agents) for n in self.names}

    def observe_people(self) -> dict[str, NDArray[np.float32]]:
        """The same for the people, who look for the robot, without pictures."""
        now, before = self._batch.state, self._batch.before
        agents = now.people[0], before.people[0], now.robots[0], before.robots[0]
        return {n: self._seen(n, *agents) for n in self.names if n not in self._pictured}

    def people_space(self) -> Dict:
        """The space of one person's observations."""
        return gymnasium.spaces.Dict({n: self._box(n) for n in self.names if n not in self._pictured})

    def _seen(
        self, name: Observation, now: AgentState, before: AgentState, other: AgentState, other_before: AgentState
    ) -> NDArray[np.float32]:
        """What one agent observes of itself, of the other and of the home."""
        batch = self._batch
        if name == "humanoid_gps":
            return _within(gps_compass(now.xz, now.heading, other.xz), FAR_M)
        if name == "egomotion":
            return _within(egomotion(before.xz, before.heading, now.xz, now.heading), FAST)
        if name == "humanoid_velocity":
            return _within(humanoid_velocity(now.heading, other_before.xz, other.xz), FAST)
        if name == "localization":
            return _within(localization(now.xz, now.heading, batch.floor_y), FAR_M)
        seen = np.zeros((batch.worlds, len(_BOUNDS[name][0])))
        for free, rows in batch.groups:
            if name == "range_scan":
                seen[rows] = range_scan(free, now.xz[rows], now.heading[rows])
            else:
                begun = batch.spec.robot.disc_radius_m / 2
                seen[rows] = [
                    way(free, now.xz[w], float(now.heading[w]), other.xz[w], float(batch.geodesic[w]), beyond_m=begun)
                    for w in rows
                ]
        return _within(seen, FAR_M)

    # --- pictures -----------------------------------------------------------------------------------------------------
    def _pictures(self) -> dict[str, NDArray[np.float32]]:
        from h3data.render import Output
        from sim_kinematic.camera_sensor import CameraSensor

        wanted: list[Output] = []
        if "arm_depth" in self._pictured:
            wanted.append("depth")
        if "humanoid_detector" in self._pictured:
            wanted.append("semantic")
        sensor = CameraSensor(camera=CAMERA, outputs=tuple(wanted), depth_range_m=DEPTH_RANGE_M, size=self._size)
        width, height = self._size
        share = width * height / (self._own_size[0] * self._own_size[1])
        result: dict[str, NDArray[np.float32]] = {}
        if "depth" in wanted:
            result["arm_depth"] = np.zeros((self._batch.worlds, height, width, 1), np.float32)
        if "semantic" in wanted:
            result["humanoid_detector"] = np.zeros((self._batch.worlds, 1), np.float32)
        for k in np.unique(self._batch.place):
            drawn = self.renderer(int(k))
            rows = np.flatnonzero(self._batch.place == k)
            for part in rows.reshape(-1, drawn.worlds):
                drawn.pose(self._batch.state.take(part), floor_y=self._batch.episodes[part[0]].free.floor_y)
                seen = sensor.observe(drawn)
                if "depth" in wanted:
                    result["arm_depth"][part] = seen["depth"].reshape(len(part), height, width, 1)
                if "semantic" in wanted:
                    found = detect_humanoids(seen["semantic"], more_than_pixels=int(DETECTED_PIXELS * share)).found
                    result["humanoid_detector"][part, 0] = found
        return result

    def renderer(self, place: int) -> StateRenderer:
        """What draws a scene: all worlds at once where there is only one scene, else world by world."""
        from sim_kinematic.camera_sensor import StateRenderer

        if place not in self._drawn:
            batch = self._batch
            self._drawn[place] = StateRenderer(
                batch.places[place].scene, [batch.robot, batch.human], threads=self._threads,
                worlds=batch.worlds if len(batch.places) == 1 else 1, speed_mps=batch.spec.human.speed_mps,
            )  # fmt: skip
        return self._drawn[place]


def _within(values: NDArray[Any], bound: float) -> NDArray[np.float32]:
    return np.clip(values, -bound, bound).astype(np.float32)


def _checked_names(names: Sequence[Observation]) -> tuple[Observation, ...]:
    known = get_args(Observation)
    if isinstance(names, str) or not names or not set(names) <= set(known):
        raise InputError(f"Expected a list of observations, some of: {', '.join(known)}. Got {names!r}.")
    return tuple(dict.fromkeys(names))
