"""Time by which robots delay people of a crowd, from a second simulation without the robots."""

from __future__ import annotations

from itertools import takewhile
from typing import NamedTuple

from h3data.errors import InputError
from h3data.recording import Recording
from h3data.recording.records import agent_numbers
from sim_kinematic.policies.crowd.people import CrowdPolicy
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.recorder import run
from sim_kinematic.tasks.resume import assigned_policies, restored_episode
from sim_kinematic.tasks.wander import Wander


class AddedTime(NamedTuple):
    """Time by which robots delay one person."""

    person: str
    goals: int
    """Number of consecutive goals that the person leaves both in the recording and without robots."""
    seconds: float | None
    """Time at which the person leaves the last of these goals, minus the time without robots [s]; None without such a
    goal."""


def added_time(recording: Recording) -> list[AddedTime]:
    """Return the time by which robots delay each person of a crowd, from a second simulation without them.

    The second simulation has the seed and starts of the recording, so the robots cause the difference. People are
    compared by the goals that they go to in both simulations, up to the first one that differs because of a robot.

    Raises:
        InputError: The recording cannot be simulated again (`sim_kinematic.tasks.resume.verify`), people are not of a
            crowd, or there is no robot.
    """
    task, episode = restored_episode(recording)
    robots, people = agent_numbers(recording.agents, "robot"), agent_numbers(recording.agents, "human")
    policies = assigned_policies(task, episode, recording, {}, strict=False, recorded=robots)
    alone = [policies[k] for k in people]
    if not robots or not alone or not all(isinstance(one.policy, CrowdPolicy) for one in alone):
        raise InputError(
            "Expected a recording of robots among people of a crowd, whose partner is orca or social_force, got "
            f"{', '.join(one.name for one in policies)}.",
            code="H3-TASK-081",
        )
    # by the rules of wander, which need no robot and end nothing before the time limit
    play = WorldRollout.of(Wander(), episode.only(*people), alone, measure=False)
    run(play, steps=len(recording))
    rows = []
    for p, k in enumerate(people):
        here, there = (
            [(event.step, event.detail) for event in events if event.kind == "walks_to" and event.agent == number]
            for events, number in ((recording.events, k), (play.events, p))
        )
        pairs = list(takewhile(lambda pair: pair[0][1] == pair[1][1], zip(here, there, strict=False)))
        # the first event is the departure from the start, which is no goal
        late = (pairs[-1][0][0] - pairs[-1][1][0]) * recording.episode.dt_ns * 1e-9 if len(pairs) > 1 else None
        rows.append(AddedTime(recording.agents[k].name, max(len(pairs) - 1, 0), late))
    return rows
