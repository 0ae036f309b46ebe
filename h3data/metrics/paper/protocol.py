"""Deviations of a recorded episode's rules from the protocol behind the paper's numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from h3data.recording import Recording

# 10 of Habitat's units, the speeds of the paper's agents (spec/habitat.md 0)
_PACE = {"human.speed_mps": 2.5, "human.turn_rad_s": 2.5, "robot.max_speed_mps": 2.5, "robot.max_turn_rad_s": 2.5}
SOCIAL_NAV_PROTOCOL: Mapping[str, Any] = {
    "max_steps": 1500,
    # of evaluation; training starts at 3 m
    "spawn_distance_m": 5.0,
    "near_m": 1.0,
    "far_m": 2.0,
    "facing_dot": 0.5,
    "end_on_collision": True,
    # the two cylinders of v0.3.0, the paper's release; later ones have three (spec/habitat.md 1.1)
    "robot.disc_offsets_m": (0.0, 0.225),
    **_PACE,
}
"""Rules of social navigation in the paper (section 4, appendix), by the names in ``info["spec"]``."""
REARRANGEMENT_PROTOCOL: Mapping[str, Any] = {
    "max_steps": 750,
    "objects": 2,
    "at_goal_m": 0.3,
    "end_on_collision": True,
    **_PACE,
}
"""Rules of social rearrangement in the paper."""


def protocol_deviations(recording: Recording, protocol: Mapping[str, Any]) -> str:
    """Return text such as ``max_steps 60 (paper 1500), agents robot, robot (paper robot, human)``; empty if nothing deviates.

    Rules that the recording does not state are taken to agree with the protocol.
    """
    spec = recording.episode.info.get("spec")
    if not isinstance(spec, Mapping):
        return ""
    recorded: dict[str, Any] = {}
    for name in protocol:
        group, _, key = name.rpartition(".")
        of = spec.get(group) if group else spec
        value = of.get(key) if isinstance(of, Mapping) else None
        # JSON has lists where rules have tuples
        recorded[name] = tuple(value) if isinstance(value, list) else value
    deviations = [
        f"{name} {recorded[name]} (paper {paper})"
        for name, paper in protocol.items()
        if recorded[name] not in (None, paper)
    ]
    human = spec.get("human")
    if isinstance(human, Mapping) and human.get("stride") is not None:
        deviations.append("people walk curves (paper: they turn on the spot)")
    kinds = ", ".join(agent.kind for agent in recording.agents)
    if spec.get("people_give_way") and len(recording.agents) > 1:
        deviations.append("agents give way to each other (paper: they do not)")
    if spec.get("skills") and "robot" in kinds:
        deviations.append("learned skills (paper: oracle skills)")
    if kinds not in ("robot, human", ""):
        deviations.append(f"agents {kinds} (paper robot, human)")
    return ", ".join(deviations)
