"""What a learning agent is shown of a `SocialNavBatch`: named observations as Gymnasium spaces and arrays, worlds first."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.geometry import ground_pose
from sim_kinematic.contact.frames import Body
from sim_kinematic.motion.state import ROBOT, AgentState
from sim_kinematic.sensing.agent_pictures import Limits, picture_names
from sim_kinematic.sensing.observation_set import Arrays, ObservationSet, box, checked_names, gymnasium
from sim_kinematic.sensing.sensor import (
    FAR_M,
    FAST,
    RANGE_M,
    RANGES,
    NoiseModel,
    egomotion,
    gps_compass,
    humanoid_velocity,
    in_frame,
    localization,
    localization_in_start_frame,
    range_scan,
    way,
)
from sim_kinematic.tasks.social_nav_batch import SocialNavBatch

if TYPE_CHECKING:
    from gymnasium.spaces import Dict

    from sim_kinematic.sensing.camera_sensor import StateRenderer

PAPER_OBSERVATIONS = ("arm_depth", "humanoid_detector", "humanoid_gps")
"""What the paper's policy sees (appendix, social navigation). Needs a picture in every step."""
STATE_OBSERVATIONS = ("humanoid_gps", "egomotion")
"""What costs no picture."""
JOINT_MOST = 10.0
"""Bound of joints [rad or m]."""


class Seen(NamedTuple):
    """What one agent of each world can tell."""

    batch: SocialNavBatch
    now: AgentState
    before: AgentState
    """One step ago."""
    start: AgentState
    other: AgentState
    other_before: AgentState
    contact: NDArray[np.bool_]
    """It touched an obstacle in the last step, [W]."""
    arm: NDArray[np.float64]
    """Its arm's joints, which rest in this task, [n]; of a person [0]."""


class State(NamedTuple):
    """An observation that is no picture."""

    of: Callable[[Seen], NDArray[np.floating]]
    """Values [W, n]."""
    low: ArrayLike
    high: ArrayLike


def _other_from_start(seen: Seen) -> NDArray[np.floating]:
    start = ground_pose(seen.start.xz, seen.start.heading)
    return in_frame(start, ground_pose(seen.other.xz, seen.other.heading)[:, None, :3])[:, 0]


def _way(seen: Seen) -> NDArray[np.floating]:
    begun = seen.batch.base.disc_radius_m / 2
    xz, heading, other, length = seen.now.xz, seen.now.heading.tolist(), seen.other.xz, seen.batch.geodesic.tolist()
    found = np.zeros((len(xz), 2))
    for free, rows in seen.batch.groups:
        found[rows] = [way(free, xz[w], heading[w], other[w], length[w], beyond_m=begun) for w in rows]
    return found


def _range_scan(seen: Seen) -> NDArray[np.floating]:
    found = np.zeros((len(seen.now.xz), RANGES))
    for free, rows in seen.batch.groups:
        found[rows] = range_scan(free, seen.now.xz[rows], seen.now.heading[rows])
    return found


STATES: Mapping[str, State] = {
    "humanoid_gps": State(
        lambda s: gps_compass(s.now.xz, s.now.heading, s.other.xz), [0.0, -np.pi], [FAR_M, np.pi]
    ),
    "egomotion": State(
        lambda s: egomotion(s.before.xz, s.before.heading, s.now.xz, s.now.heading), [-FAST] * 3, [FAST] * 3
    ),
    "localization": State(
        lambda s: localization(s.now.xz, s.now.heading, s.batch.floor_y), [-FAR_M] * 3 + [-np.pi], [FAR_M] * 3 + [np.pi]
    ),
    "humanoid_velocity": State(
        lambda s: humanoid_velocity(s.now.heading, s.other_before.xz, s.other.xz), [-FAST] * 2, [FAST] * 2
    ),
    "way": State(_way, [0.0, -np.pi], [FAR_M, np.pi]),
    "range_scan": State(_range_scan, [0.0] * RANGES, [RANGE_M] * RANGES),
    "localization_in_start_frame": State(
        lambda s: localization_in_start_frame(s.start.xz, s.start.heading, s.now.xz, s.now.heading),
        [-FAR_M] * 3 + [-np.pi], [FAR_M] * 3 + [np.pi],
    ),
    "humanoid_in_start_frame": State(_other_from_start, [-FAR_M] * 3, [FAR_M] * 3),
    "collision": State(
        lambda s: np.stack([s.contact, s.batch.collides], -1).astype(np.float64), [0.0] * 2, [1.0] * 2
    ),
    "is_holding": State(lambda s: np.zeros((s.batch.worlds, 1)), [0.0], [1.0]),
    "arm_joints": State(lambda s: np.tile(s.arm, (s.batch.worlds, 1)), [-JOINT_MOST], [JOINT_MOST]),
}  # fmt: skip


def _limits(name: str, joints: int) -> Limits:
    known = STATES[name]
    low, high = (np.array(bound, np.float32).repeat(joints if name == "arm_joints" else 1) for bound in known[1:])
    return Limits(low, high, low.shape, np.float32)


def state_box(name: str) -> gymnasium.spaces.Box:
    """The space of one world's observation that is a few numbers."""
    if name == "humanoid_detector":
        return gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
    return box(_limits(name, 0))


class Observer:
    """What robots, and people if they learn too, observe in a batch; each array is [W, ...] and within its space.

    Pictures (`sim_kinematic.sensing.agent_pictures`) are ``arm_depth`` [H, W, 1], 0..1 of `DEPTH_RANGE_M`, 0 = nothing hit; ``arm_rgb``
    uint8 [H, W, 3]; the same of body cameras (``front_left_depth``) and of a person's own view (``head_rgb``);
    ``humanoid_detector`` [1]: 1 when more than 1,000 pixels of ``arm_depth`` show the person, with ``depth_size`` as many as
    are the same part of it; ``humanoid_mask``, ``humanoid_box`` [H, W, 1]: 1 in her pixels, in the rectangle around them.

    Of itself ``egomotion``: forward, left [m/s] and turn [rad/s] of the last step, [3]; ``localization``: x, y, z [m] and
    heading [rad] in the world, [4]; ``localization_in_start_frame``: the same from where it began; ``collision``: with an
    obstacle, with the other agent, [2]; ``arm_joints`` [7] and ``is_holding`` [1], which do not change in this task. Of the
    other agent ``humanoid_gps``: distance [m] and angle [rad], positive to the right, [2]; ``humanoid_velocity``: forward and
    left [m/s] in its last step, [2]; ``humanoid_in_start_frame``: its place from where the agent itself began, [3]. By the
    map ``way``: length of the shortest way to the other [m] and the angle at which it begins [rad], positive to the right,
    [2]; ``range_scan``: the free way in 12 directions [m], [12] (`sim_kinematic.sensing.sensor`).
    """

    def __init__(
        self, batch: SocialNavBatch, names: Sequence[str], *, depth_size: tuple[int, int] | None = None,
        rgb_size: tuple[int, int] | None = None, noise: Mapping[str, NoiseModel] | None = None, people: bool = False,
        threads: int = 1,
    ) -> None:  # fmt: skip
        """
        Args:
            batch: Whose agents observe.
            names: Of the robots' observations and, with ``people``, of the people's: each has its own of them.
            depth_size: Width and height of depth, masks and boxes [pixels], None for the cameras' own: 224 x 171 of the arm.
            rgb_size: The same of colours.
            noise: Model by name of an observation (`sim_kinematic.sensing.sensor.NoiseModel`); by default all are exact.
            people: Whether people observe too.
            threads: Draw pictures.

        Raises:
            InputError: there are no such observations.
        """
        self._batch, self._threads = batch, threads
        self._drawn: dict[int, StateRenderer] = {}
        bodies: tuple[Body, ...] = (batch.robot, batch.human) if people else (batch.robot,)
        joints = len(batch.robot.arm_columns)
        self._arm = batch.robot.rest[list(batch.robot.arm_columns)].astype(np.float64)
        states = [
            {name: _limits(name, joints) for name in STATES if name != "arm_joints" or (joints and body is batch.robot)}
            for body in bodies
        ]
        known = [(*own, *picture_names(body)) for own, body in zip(states, bodies, strict=True)]
        chosen = checked_names(names, *known, noise=noise or ())
        self._sets = tuple(
            ObservationSet(
                own, limits, body, agent=agent, depth_size=depth_size, rgb_size=rgb_size, noise=noise
            )
            for agent, (own, limits, body) in enumerate(zip(chosen, states, bodies, strict=True))
        )  # fmt: skip

    def space(self, agent: int = ROBOT) -> Dict:
        """The space of one robot's observations, or of one person's."""
        return self._sets[agent].space()

    def observe(self, agent: int = ROBOT) -> Arrays:
        """What the robots see now, or the people, [W, ...] each."""
        own, batch = self._sets[agent], self._batch
        seen = self._seen(agent)
        exact = {name: STATES[name].of(seen) for name in own.states}
        if own.pictures.names:
            exact |= self._pictures(own)
        return own.shown(exact, [episode.seed for episode in batch.episodes], batch.steps.tolist())

    def _seen(self, agent: int) -> Seen:
        batch = self._batch
        now, before, is_robot = batch.state.agents, batch.before.agents, agent == ROBOT
        return Seen(
            batch, now[agent], before[agent], batch.start.agents[agent], now[1 - agent], before[1 - agent],
            batch.state.robots[0].contact if is_robot else batch.human_contact, self._arm if is_robot else np.zeros(0),
        )  # fmt: skip

    # --- pictures -----------------------------------------------------------------------------------------------------
    def _pictures(self, own: ObservationSet) -> Arrays:
        result: Arrays = {}
        for k in np.unique(self._batch.place):
            rows = np.flatnonzero(self._batch.place == k)
            for part in rows.reshape(-1, self.renderer(int(k)).worlds):
                for name, picture in own.take(self.posed(part)).items():
                    if name not in result:
                        result[name] = np.zeros((self._batch.worlds, *picture.shape[1:]), picture.dtype)
                    result[name][part] = picture
        return result

    def posed(self, worlds: NDArray[np.intp]) -> StateRenderer:
        """What draws some worlds that are in one scene, with everything where it is now."""
        batch = self._batch
        drawn = self.renderer(int(batch.place[worlds[0]]))
        drawn.pose(batch.state.take(worlds), floor_y=batch.episodes[worlds[0]].free.floor_y)
        return drawn

    def renderer(self, place: int) -> StateRenderer:
        """What draws a scene: all worlds at once where there is only one scene, else world by world."""
        from sim_kinematic.sensing.camera_sensor import StateRenderer

        if place not in self._drawn:
            batch = self._batch
            self._drawn[place] = StateRenderer(
                batch.places[place].scene, [batch.robot, batch.human], threads=self._threads,
                worlds=batch.worlds if len(batch.places) == 1 else 1, speed_mps=batch.spec.human.speed_mps,
            )  # fmt: skip
        return self._drawn[place]
