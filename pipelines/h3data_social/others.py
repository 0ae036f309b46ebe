"""Selection of the measured robot and the people near it, for metrics."""

from __future__ import annotations

from h3data.metrics.requirements import UnmeasurableError, find_agents
from h3data.recording.records import Recording


def find_others(recording: Recording) -> tuple[int, tuple[int, ...]]:
    """Return the numbers of the measured agent (the first robot) and of the agents near it (all people).

    Without a robot and a person, these are the first agent and all others. Near a robot alone there is nobody. An
    `UnmeasurableError` is raised if there is no agent, or one person alone.
    """
    if [agent.kind for agent in recording.agents] == ["robot"]:
        return 0, ()
    robot, first = find_pair(recording)
    kinds = [agent.kind for agent in recording.agents]
    mixed = kinds[robot] != kinds[first]
    return robot, tuple(n for n, kind in enumerate(kinds) if n != robot and (kind == "human" or not mixed))


def find_pair(recording: Recording) -> tuple[int, int]:
    """Return the indices of two agents: the first robot and the first human, else the first two of any kind.

    The first of them is measured, near the second. An `UnmeasurableError` is raised if there are fewer than two agents.
    """
    agents = recording.agents
    if {"robot", "human"} <= {a.kind for a in agents}:
        return find_agents(recording)
    if len(agents) < 2:
        present = ", ".join(f"{a.name} ({a.kind})" for a in agents) or "nobody"
        raise UnmeasurableError(
            f"These metrics need two agents; recording {recording.episode.episode_id!r} has {present}.",
            "needs two agents",
            code="H3-METRIC-029",
        )
    return 0, 1
