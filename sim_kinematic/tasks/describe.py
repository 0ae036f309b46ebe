"""One-line descriptions of training environments, for their ``repr``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from h3data.scene import Scene
from sim_kinematic.tasks.sources import Scenes

LISTED = 3
"""Largest number of scenes of a list that are named."""


def in_words(
    task: str,
    scenes: Scenes,
    count: int,
    agents: Mapping[str, str],
    *,
    beside: Mapping[str, str] | None = None,
    worlds: int = 1,
) -> str:
    """Describe an environment: ``social_nav, 37 scenes of h3-homes/train, robot quad_arm beside human female_0, 64 worlds``.

    Args:
        task: Name of the task.
        scenes: Scenes as given to the environment.
        count: Number of scenes.
        agents: Models, by kind, of the agents that act.
        beside: Models, by kind, of the agents that a policy moves.
        worlds: Number of worlds.
    """
    who = " and ".join(f"{kind} {model}" for kind, model in agents.items())
    others = " and ".join(f"{kind} {model}" for kind, model in (beside or {}).items())
    return (
        f"{task}, {_scenes(scenes, count)}, {who}{' beside ' + others if others else ''}, {worlds} "
        f"world{'s' if worlds > 1 else ''}"
    )


def _scenes(scenes: Scenes, count: int) -> str:
    listed: list[Any] = list(scenes) if isinstance(scenes, list | tuple) else [scenes]
    names = [scene.name if isinstance(scene, Scene) else os.fspath(scene) for scene in listed]
    named = ", ".join(names[:LISTED]) + (", ..." if len(names) > LISTED else "")
    return f"scene {named}" if count == 1 else f"{count} scenes of {named}"
