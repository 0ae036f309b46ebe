"""People who do chores at chosen places."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from h3data_crowds.chores import ChoreRoutine
from h3data_crowds.routines import Stop
from sim_kinematic.policies.crowd.people import CrowdPolicy


def chores_at(stops: Sequence[Stop], episode: Any, number: int) -> CrowdPolicy:
    """The policy of person ``number`` of an episode, who does the chores of some stops."""
    body, start = episode.roster[number].body, episode.starts[number, :2]
    routine = ChoreRoutine(episode.scene, episode.free, tuple(stops), body, start=start)
    return CrowdPolicy("orca", episode.free, episode.seed, number, episode.spec.human, routine=routine)
