"""Where the rules of a recorded episode differ from those under which the paper's numbers were made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from h3data.recording import Recording

_PACE = {"human.speed_mps": 2.5, "human.turn_rad_s": 2.5, "robot.max_speed_mps": 2.5, "robot.max_turn_rad_s": 2.5}
RULES: dict[str, dict[str, Any]] = {
    "social_nav": {
        "max_steps": 1500, "spawn_distance_m": 5.0, "near_m": 1.0, "far_m": 2.0, "facing_dot": 0.5,
        "end_on_collision": True, **_PACE,
    },
    "rearrange": {"max_steps": 750, "objects": 2, "at_goal_m": 0.3, "end_on_collision": True, **_PACE},
}  # fmt: skip
"""By task: the paper's (section 4, appendix), by their names in ``info["spec"]``."""


def set_up_differences(recording: Recording) -> str:
    """``max_steps 60 (paper 1500), agents robot, robot (paper robot, human)``; empty where nothing differs or is known."""
    task, spec = recording.episode.task, recording.episode.info.get("spec")
    if task not in RULES or not isinstance(spec, Mapping):
        return ""
    told = [(name, _value(spec, name), paper) for name, paper in RULES[task].items()]
    found = [f"{name} {value} (paper {paper})" for name, value, paper in told if value is not None and value != paper]
    kinds = ", ".join(agent.kind for agent in recording.agents)
    return ", ".join(found + ([] if kinds in ("robot, human", "") else [f"agents {kinds} (paper robot, human)"]))


def _value(spec: Mapping[str, Any], name: str) -> Any:
    group, _, key = name.rpartition(".")
    of = spec.get(group) if group else spec
    return of.get(key) if isinstance(of, Mapping) else None
