"""Episodes of any robots and people who wander about a home: one job each."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from h3data.recording import Recording
from h3data.scene.scene_sets import SceneSource
from h3data_pipelines.jobs.episode_jobs import ANY_BODY, drawn_body, drawn_episodes
from sim_kinematic.agents.roster import HUMAN_BODY, make_roster
from sim_kinematic.motion.spec import SocialNavSpec

AGENTS = "robot,human"
STEPS = 300


@dataclass(frozen=True, kw_only=True)
class WanderJob:
    """One episode: all that a worker needs to know."""

    index: int
    seed: int
    scene: str
    """As the command line names it."""
    source: SceneSource
    agents: tuple[str, ...]
    """Who is there (`sim_kinematic.agents.roster.make_roster`)."""
    spec: SocialNavSpec
    """Speeds and sizes; it lasts ``max_steps``."""
    origin: dict[str, Any] | None = None
    """Which episode of which set it is."""

    @property
    def task(self) -> str:
        return "wander"

    def to_json(self) -> dict[str, Any]:
        """What decides the episode, as JSON gives it back."""
        fields = json.loads(msgspec.json.encode(replace(self, origin=None)))
        del fields["origin"]
        return fields

    def record(self) -> Recording:
        """Play it."""
        from h3data.habitat.scene_names import open_free_space, open_scene
        from sim_kinematic.tasks.wander import simulate_wander

        return simulate_wander(
            open_scene(self.source), self.agents, seed=self.seed, steps=self.spec.max_steps, spec=self.spec,
            free=open_free_space(self.source, self.spec.agent_radius_m, self.spec.agent_height_m),
            episode_id=f"{self.index:06d}",
        )  # fmt: skip


def wander_jobs(
    scenes: str, *, episodes: int | None, seed: int, agents: str, human: str | None, spec: SocialNavSpec,
    homes: int = 4, assets: Sequence[str | Path] = (), allow_missing: bool = False,
) -> list[WanderJob]:  # fmt: skip
    """Episodes in the scenes that ``scenes`` means: all of a set by default, else 10.

    ``human`` is the body of all who are named ``human``; with ``any`` each of them draws one in each episode.

    Raises:
        InputError: no such scenes, agents or body; the message lists what there is.
    """
    names = [name.strip() for name in agents.split(",")]
    make_roster(_named(names, human, seed))
    drawn = drawn_episodes(
        scenes, episodes=episodes, seed=seed, homes=homes, assets=assets, allow_missing=allow_missing
    )  # fmt: skip
    return [
        WanderJob(
            index=e.index, seed=e.seed, scene=e.scene, source=e.source, agents=_named(names, human, e.seed), spec=spec,
            origin=e.origin,
        )
        for e in drawn
    ]  # fmt: skip


def _named(names: Sequence[str], human: str | None, seed: int) -> tuple[str, ...]:
    """The cast with a body for each who is named ``human``."""
    if human == ANY_BODY:
        return tuple(drawn_body(seed, k) if name == "human" else name for k, name in enumerate(names))
    return tuple((human or HUMAN_BODY) if name == "human" else name for name in names)
