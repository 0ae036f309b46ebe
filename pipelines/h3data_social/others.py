"""The people near whom a robot is measured."""

from __future__ import annotations

from h3data.metrics.requirements import find_pair
from h3data.recording.records import Recording


def find_others(recording: Recording) -> tuple[int, tuple[int, ...]]:
    """Returns the agent that is measured, and all agents that it is measured near: the first robot, and every person.

    Without a robot and a person: the first agent, and all others. An `UnmeasurableError` says that there are fewer than two.
    """
    robot, first = find_pair(recording)
    kinds = [agent.kind for agent in recording.agents]
    mixed = kinds[robot] != kinds[first]
    return robot, tuple(n for n, kind in enumerate(kinds) if n != robot and (kind == "human" or not mixed))
