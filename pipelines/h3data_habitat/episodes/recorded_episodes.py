"""Starts, goals and waypoints of recorded episodes, to play them again or to write them into Habitat's files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np

from h3data.bodies.names import split_walk
from h3data.errors import InputError
from h3data.recording import Recording
from h3data.recording.records import agent_numbers
from h3data.recording.task_episodes import social_nav_episodes, stored_rearrangements
from h3data.recording.task_episodes.social_nav_episodes import SocialNavEpisode
from h3data.recording.task_episodes.stored_episodes import plain
from h3data.recording.task_episodes.stored_rearrangements import StoredRearrangement


def social_nav_of(recording: Recording) -> SocialNavEpisode:
    """Return the starts and waypoints of a recorded episode, to run it again with another policy.

    The person's goals are taken from ``episode.info["human_goals"]`` if it exists, else from the ``new_goal`` events,
    which state them to the centimetre (``goals_within_m``).

    Raises:
        InputError: the recording is of another task, or does not contain the starts of the agents.
    """
    info = recording.episode.info
    name = recording.episode.episode_id
    if recording.episode.task != social_nav_episodes.TASK:
        raise InputError(
            f"Expected a recording of social_nav, {name!r} is one of {recording.episode.task!r}.", code="H3-HABITAT-039"
        )
    robots = agent_numbers(recording.agents, "robot")
    humans = agent_numbers(recording.agents, "human")
    if len(robots) != 1 or len(humans) != 1 or not len(recording):
        raise InputError(
            f"Expected one robot, one human and some steps, {name!r} has {len(robots)}, {len(humans)}, {len(recording)}.",
            code="H3-HABITAT-040",
        )
    goals, within = _goals(recording, humans[0])
    floor_y = float(recording.agent_column(robots[0], "base_pose")[0, 1])
    with _whole_info(name):
        nav = msgspec.convert(
            {
                "robot_start": info.get("robot_start"),
                "human_start": info.get("human_start"),
                "human_goals": goals,
                "goals_within_m": within,
                "goals_complete": len(recording) >= int(info.get("max_steps", 0)) > 0,
                "floor_y": floor_y,
                "max_steps": info.get("max_steps", len(recording)),
                "seed": recording.episode.seed,
                "robot": recording.agents[robots[0]].model,
                "human": split_walk(recording.agents[humans[0]].model)[0],
                "scene_sha256": info.get("scene_sha256", ""),
                "scene_source": plain(info.get("scene_source", {})),
                "rules": plain(info.get("spec", {})),
                "recording": recording.episode.uid,
            },
            SocialNavEpisode,
        )
    social_nav_episodes.require_finite(nav)
    return nav


@contextmanager
def _whole_info(name: str) -> Iterator[None]:
    """Refuse the info of a recording from which no record of an episode can be made."""
    try:
        yield
    except (msgspec.ValidationError, TypeError, ValueError) as fault:
        raise InputError(
            f"The info of recording {name!r} lacks something: {str(fault).replace('`', '')}", code="H3-HABITAT-043"
        ) from None


_POINT = re.compile(r"\((-?\d+\.?\d*), (-?\d+\.?\d*)\)")


def _goals(recording: Recording, human: int) -> tuple[Any, float]:
    """Return the person's goals, and how far they may be off [m]."""
    exact = recording.episode.info.get("human_goals")
    if exact is not None:
        return exact, 0.0
    goals: list[tuple[float, float]] = []
    for event in recording.events:
        if event.kind != "new_goal" or event.agent != human:
            continue
        point = _POINT.fullmatch(event.detail)
        if point is None:
            raise InputError(
                f"Expected a point like (1.20, -3.40) in the event of step {event.step}, got {event.detail!r}.",
                code="H3-HABITAT-044",
            )
        goals.append((float(point[1]), float(point[2])))
    column = recording.columns.get("sim.human_goal")
    # the column numbers the goals, so a lost event shows
    count = int(np.max(column)) + 1 if column is not None and len(column) else len(goals)
    if count != len(goals):
        raise InputError(
            f"Recording {recording.episode.episode_id!r} has {len(goals)} events new_goal, its steps speak of {count}.",
            code="H3-HABITAT-041",
        )
    return goals, 0.01


def rearrangement_of(recording: Recording) -> StoredRearrangement:
    """Return the objects, goals and starts of a recorded episode, to play it again with other policies.

    Raises:
        InputError: the recording is of another task, or lacks one of these values.
    """
    info, name = recording.episode.info, recording.episode.episode_id
    if recording.episode.task != stored_rearrangements.TASK:
        raise InputError(
            f"Expected a recording of rearrange, {name!r} is one of {recording.episode.task!r}.", code="H3-HABITAT-049"
        )
    if not len(recording) or not recording.agents:
        raise InputError(f"Expected a recording with agents and steps, {name!r} has none.", code="H3-HABITAT-050")
    # reversed, so that the first agent of a kind is kept
    first = {agent.kind: k for k, agent in reversed(list(enumerate(recording.agents)))}
    starts = {kind: info.get(f"{kind}_start") for kind in ("robot", "human")}
    if "starts" in info:
        starts |= {kind: info["starts"][k] for kind, k in first.items()}
    models = {kind: recording.agents[k].model for kind, k in first.items()}
    floor_y = float(recording.agent_column(next(iter(first.values())), "base_pose")[0, 1])
    with _whole_info(name):
        record = msgspec.convert(
            {
                "goals": info.get("goals"),
                **{f"{kind}_start": start for kind, start in starts.items()},
                "floor_y": floor_y,
                "seed": recording.episode.seed,
                "robot": models.get("robot", ""),
                "human": split_walk(models.get("human", ""))[0],
                "scene_sha256": info.get("scene_sha256", ""),
                "scene_source": plain(info.get("scene_source", {})),
                "rules": plain(info.get("spec", {})),
                "recording": recording.episode.uid,
                "instruction": str(info.get("instruction") or ""),
            },
            StoredRearrangement,
        )
    stored_rearrangements.require_finite(record)
    return record
