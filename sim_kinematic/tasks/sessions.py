"""Implementation of `h3data.session` and `h3data.simulate`, which play one episode of a task given by names."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from h3data.bodies import Robot
from h3data.recording import Recording, RecordingHeader, RecordingWriter
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY
from sim_kinematic.policies.assignment import PolicyChoice
from sim_kinematic.tasks.episode import Episode, TaskSpec, with_options
from sim_kinematic.tasks.recorder import Sink
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.runner import Session
from sim_kinematic.tasks.runner import simulate as simulate_episode
from sim_kinematic.tasks.sources import EpisodeSource, Scenes
from sim_kinematic.tasks.task import Task

if TYPE_CHECKING:
    from sim_kinematic.tasks.rearrange.episode import RearrangeSpec

    Spec = TaskSpec | RearrangeSpec
RuleValue = bool | int | float | str | tuple[float, ...] | None


def session(
    task: str | Task | type[Task],
    scenes: Scenes = "small:0",
    *,
    agents: Mapping[str, PolicyChoice | Sequence[PolicyChoice]] | None = None,
    roster: str | Sequence[str | Robot] | None = None,
    seed: int = 0,
    index: int = 0,
    spec: Spec | None = None,
    record: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    share_in: str | os.PathLike[str] | None = None,
    robot: str | Path | Robot = ROBOT_BODY,
    human: str = HUMAN_BODY,
    rules: Literal["natural", "paper"] | None = None,
    human_speed: float | None = None,
    max_steps: int | None = None,
    **overrides: RuleValue,
) -> Session:
    """Start an episode that is played one step at a time, with agents driven from outside (h3data docs sessions).

    Args:
        task: Task, its name, or ``module:Class``.
        scenes: Homes, as in `h3data.make`; ``seed`` and ``index`` choose one of them.
        agents: Policy of each agent, by agent or kind: a name, a policy, a function, or
            `sim_kinematic.policies.policy.External` for an agent that `Session.act` controls.
        roster: Agents that are present (default: the task's).
        seed: Seed of the run.
        index: Number of the episode in the run.
        spec: Rules of the task (default: the task's).
        record: MCAP file to which the running episode is written; None keeps the recording in memory.
        overwrite: True if an existing file may be replaced.
        share_in: Folder around ``record`` whose recordings share their scenes (`RecordingWriter`); None stores the scene in
            the recording.
        robot: Body of robots.
        human: Body of people.
        rules: Set of rules, ``natural`` or ``paper`` (default: those of ``spec``, else ``natural``).
        human_speed: Walking speed of people [m/s].
        max_steps: Steps after which the episode ends.
        **overrides: Single rules of the task, by the name of their field in its spec, such as ``objects=3``.

    Raises:
        InputError: there is no such task, scene, agent, policy or rule.
        SceneError: No scene has room for the episode.
    """
    changes = {"rules": rules, "human_speed": human_speed, "max_steps": max_steps, **overrides}
    found, episode = _episode(task, scenes, roster, seed, index, spec, robot, human, changes)
    return Session(found, episode, agents, sink=_sink(record, overwrite, share_in))


def simulate(
    task: str | Task | type[Task],
    scenes: Scenes = "small:0",
    *,
    agents: Mapping[str, PolicyChoice | Sequence[PolicyChoice]] | None = None,
    roster: str | Sequence[str | Robot] | None = None,
    seed: int = 0,
    index: int = 0,
    spec: Spec | None = None,
    record: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    share_in: str | os.PathLike[str] | None = None,
    robot: str | Path | Robot = ROBOT_BODY,
    human: str = HUMAN_BODY,
    rules: Literal["natural", "paper"] | None = None,
    human_speed: float | None = None,
    max_steps: int | None = None,
    sensors: Sequence[str] = (),
    **overrides: RuleValue,
) -> Recording:
    """Play one episode under policies and return its recording; the other arguments are those of `session`.

    Args:
        sensors: Sensors of robots, such as ``("lidar",)``, that are recorded with every step (h3data docs lidar).
    """
    changes = {"rules": rules, "human_speed": human_speed, "max_steps": max_steps, **overrides}
    found, episode = _episode(task, scenes, roster, seed, index, spec, robot, human, changes)
    return simulate_episode(found, episode, agents, sink=_sink(record, overwrite, share_in), sensors=sensors)


def _episode(
    task: str | Task | type[Task],
    scenes: Scenes,
    roster: str | Sequence[str | Robot] | None,
    seed: int,
    index: int,
    spec: Spec | None,
    robot: str | Path | Robot,
    human: str,
    changes: Mapping[str, Any],
) -> tuple[Task, Episode]:
    found = find_task(task)
    changed = with_options(found.Spec() if spec is None else spec, **changes)
    source = EpisodeSource(found, scenes, spec=changed, agents=roster, robot=robot, human=human)
    return found, source.sample(seed, index)


def _sink(
    record: str | os.PathLike[str] | None, overwrite: bool, share_in: str | os.PathLike[str] | None
) -> Callable[[RecordingHeader], Sink] | None:
    if record is None:
        return None
    # opened only with a header: a wrong policy or a home without room leaves no file behind
    return lambda header: RecordingWriter(Path(record), header, overwrite=overwrite, share_in=share_in)
