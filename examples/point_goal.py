"""One idea: your own task in one file. The robot drives to a point near a person without disturbing them.

h3data generate examples.point_goal:PointGoal --episodes 3 -o out/pg
h3data metrics out/pg
python examples/point_goal.py
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

import h3data
from h3data.errors import SceneError
from h3data.geometry import wrap_angle
from h3data.policies import AgentView, Velocity
from h3data.sensors import SENSORS, Sensor, gps_compass
from h3data.tasks import (
    Control,
    Episode,
    StepOutcome,
    Task,
    TaskSpec,
    VelocityControl,
    WorldRollout,
    generator,
    sample_starts,
)


@dataclass(frozen=True, kw_only=True)
class PointGoalSpec(TaskSpec):
    """Rules in addition to those of every task."""

    max_steps: int = 500
    spawn_distance_m: float = 3.0
    arrive_m: float = 0.3
    """Distance to the goal below which the robot has arrived [m]."""
    personal_m: float = 1.2
    """Distance below which the robot disturbs a person [m]: Hall's personal distance."""
    goal_from_person_m: tuple[float, float] = (1.5, 3.0)


def drive_to_goal(view: AgentView, base: Any, *, look_ahead_m: float = 0.3) -> Velocity:
    """Return the velocity along the shortest path, waiting while a person is in the way."""
    ahead = view.free.next_waypoint(view.xz, view.extra["goal"], beyond_m=look_ahead_m)
    dx, dz = ahead - view.xz
    error = float(wrap_angle(np.arctan2(-dz, dx) - view.heading))
    gap = min(float(np.hypot(*(place[:2] - view.xz))) for place in view.places[1:])
    forward = 0.0 if abs(error) > 0.5 or gap < 1.3 else 1.0
    return Velocity(forward, float(np.clip(4 * error, -1, 1)), "drive" if forward else "wait")


def goal_gps(moment: Any) -> Any:
    """Return the goal's distance [m] and angle [rad], positive to the right, [W, 2]."""
    return gps_compass(moment.now.xz, moment.now.heading, moment.memory["goal"], xp=moment.xp)


class PointGoal(Task):
    """Task of reaching a point near a person, with as few steps as possible nearer to them than ``personal_m``."""

    Spec = PointGoalSpec
    columns: ClassVar[Mapping[str, Any]] = {"metrics.goal_distance": np.float32, "metrics.disturbs": np.bool_}
    sensors: ClassVar[Mapping[str, Sensor]] = {
        **SENSORS,
        "goal_gps": Sensor(goal_gps, [0.0, -np.pi], [100.0, np.pi], ("m", "rad"), "base", kinds=("robot",)),
    }
    control: ClassVar[Control] = VelocityControl({"robot": ("drive", "wait")})
    policies: ClassVar[Mapping[str, Mapping[str, Any]]] = {"robot": {"drive_to_goal": drive_to_goal}}
    defaults: ClassVar[Mapping[str, str]] = {"robot": "drive_to_goal", "human": "waypoints"}

    def sample(self, scene: Any, free: Any, seed: int, spec: PointGoalSpec, roster: Any) -> Episode:
        """Sample starts as in every task, and a goal on the free floor at walking distance of the person's start."""
        starts, rng = sample_starts(scene, free, seed, spec, roster), generator(seed, "goal")
        near, far = spec.goal_from_person_m
        for goal in free.sample(rng, 500):
            if near <= free.geodesic(goal, starts[-1, :2]) <= far and free.clearance(goal) > 0.2:
                extra = {"goal": goal.tolist()}  # recorded, and there again when the episode is simulated again
                return Episode(scene=scene, free=free, seed=seed, spec=spec, roster=roster, starts=starts, extra=extra)
        raise SceneError(f"No free point {near} to {far} m from the person's start. Hint: another scene or seed.")

    def begin(self, play: WorldRollout, rows: NDArray[np.intp]) -> Mapping[str, Any]:
        """Store the goals and the distances to them; ``play.xp`` is NumPy, or torch on a device."""
        goal = play.extra("goal")
        return {"goal": goal, "left": self._distance(play, goal), "done": play.steps < 0}

    def judge(self, play: WorldRollout) -> StepOutcome:
        """Reward progress along the shortest path, punish disturbing, and end the episode on arrival."""
        xp, memory, spec, (robot, *people) = play.xp, play.memory, play.spec, play.world.state.agents
        left, before = self._distance(play, memory["goal"]), memory["left"]
        gaps = [person.xz - robot.xz for person in people]
        gap = xp.amin(xp.stack([xp.hypot(gap[:, 0], gap[:, 1]) for gap in gaps]), 0)
        disturbs, arrived = gap < spec.personal_m, left < spec.arrive_m
        memory["left"], memory["done"] = left, memory["done"] | arrived
        return StepOutcome(
            reward=before - left - 0.1 * disturbs + 10.0 * arrived,
            terminated=arrived,
            success=memory["done"],
            columns={"metrics.goal_distance": left, "metrics.disturbs": disturbs},
            events=play.events_where(arrived, "arrived", agent=0),
        )

    def _distance(self, play: WorldRollout, goal: Any) -> Any:
        """Return the length of the shortest path to the goal [m], [W]; that of the straight line if there is no path."""
        far, gap = play.path_length(0, goal), goal - play.world.state.agents[0].xz
        return play.xp.where(play.xp.isfinite(far), far, play.xp.hypot(gap[:, 0], gap[:, 1]))


if __name__ == "__main__":
    recording = h3data.simulate(PointGoal(), scenes="medium:1", seed=4)
    arrived = [event.step for event in recording.events if event.kind == "arrived"]
    disturbed = recording.columns["metrics.disturbs"].sum()
    print(f"arrived in step {arrived}, of {len(recording)}, {disturbed} steps too near to the person")
    env = h3data.make(PointGoal(), scenes="small:1", observations=("goal_gps", "range_scan"))
    observation, info = env.reset(seed=0)
    print({name: values.shape for name, values in observation.items()}, "of", len(SENSORS) + 1, "sensors")
