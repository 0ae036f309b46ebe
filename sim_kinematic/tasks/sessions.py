"""`h3data.session` and `h3data.simulate`: one episode by a few names."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from h3data.recording import Recording, RecordingHeader, RecordingWriter
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY
from sim_kinematic.policies.assignment import Assigned
from sim_kinematic.tasks.episode import Episode, with_options
from sim_kinematic.tasks.recorder import Sink
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.runner import Session
from sim_kinematic.tasks.runner import simulate as simulate_episode
from sim_kinematic.tasks.sources import EpisodeSource, Scenes
from sim_kinematic.tasks.task import Task


def session(
    task: str | Task,
    scenes: Scenes = "small:0",
    *,
    agents: Assigned | None = None,
    roster: str | Sequence[str] | None = None,
    seed: int = 0,
    index: int = 0,
    spec: Any = None,
    record: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    share_in: str | os.PathLike[str] | None = None,
    robot: str = ROBOT_BODY,
    human: str = HUMAN_BODY,
    **rules: Any,
) -> Session:
    """Begins an episode that is played one step at a time, with agents driven from outside (h3data docs sessions).

    Args:
        task: Name, ``module:Class``, or a task.
        scenes: Homes, as in `h3data.make`; ``seed`` and ``index`` choose one of them.
        agents: Policy of each agent, by agent or kind: a name, a policy, a function, or
            `sim_kinematic.policies.policy.External` for one that `Session.act` controls.
        roster: Agents that are present (default: the task's).
        seed: Seed of the run.
        index: Number of the episode in the run.
        spec: Rules of the task (default: the task's).
        record: MCAP file that grows while the episode runs; None keeps the recording in memory.
        overwrite: Whether an existing file is replaced.
        share_in: Folder around ``record`` whose recordings share their scenes (`RecordingWriter`); None stores the scene in
            the recording.
        robot: Body of robots.
        human: Body of people.
        **rules: Fields of the rules to change, such as ``max_steps=900`` ``human_speed=1.2`` or
            ``human_walk="paper"``.

    Raises:
        InputError: there is no such task, scene, agent, policy or rule.
        SceneError: no scene has room for the episode.
    """
    found, episode = _episode(task, scenes, roster, seed, index, spec, robot, human, rules)
    return Session(found, episode, agents, sink=_sink(record, overwrite, share_in))


def simulate(
    task: str | Task,
    scenes: Scenes = "small:0",
    *,
    agents: Assigned | None = None,
    roster: str | Sequence[str] | None = None,
    seed: int = 0,
    index: int = 0,
    spec: Any = None,
    record: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    share_in: str | os.PathLike[str] | None = None,
    robot: str = ROBOT_BODY,
    human: str = HUMAN_BODY,
    **rules: Any,
) -> Recording:
    """Plays one episode under policies and returns its recording; arguments as `session`."""
    found, episode = _episode(task, scenes, roster, seed, index, spec, robot, human, rules)
    return simulate_episode(found, episode, agents, sink=_sink(record, overwrite, share_in))


def _episode(
    task: str | Task,
    scenes: Scenes,
    roster: str | Sequence[str] | None,
    seed: int,
    index: int,
    spec: Any,
    robot: str,
    human: str,
    rules: Mapping[str, Any],
) -> tuple[Task, Episode]:
    found = find_task(task) if isinstance(task, str) else task
    spec = with_options(found.Spec() if spec is None else spec, **rules)
    source = EpisodeSource(found, scenes, spec=spec, agents=roster, robot=robot, human=human)
    return found, source.sample(seed, index)


def _sink(
    record: str | os.PathLike[str] | None, overwrite: bool, share_in: str | os.PathLike[str] | None
) -> Callable[[RecordingHeader], Sink] | None:
    if record is None:
        return None
    return lambda header: RecordingWriter(Path(record), header, overwrite=overwrite, share_in=share_in)
