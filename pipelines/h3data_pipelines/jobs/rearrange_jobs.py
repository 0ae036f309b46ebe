"""Episodes of social rearrangement to simulate: one job each, for datasets and for tables of robots by partners."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from h3data.errors import InputError
from h3data.recording import Recording
from h3data.scene.scene_sets import SceneSource
from h3data_pipelines.jobs.episode_jobs import Changes, drawn_episodes
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec

if TYPE_CHECKING:
    from sim_kinematic.agents.roster import AgentSpec
    from sim_kinematic.tasks.rearrange.episode import RearrangeWorld


@dataclass(frozen=True, kw_only=True)
class RearrangeJob:
    """One episode: all that a worker needs to know."""

    index: int
    seed: int
    scene: str
    """As the command line names it."""
    source: SceneSource
    policy: str
    partner: str
    human: str | None
    spec: RearrangeSpec
    agents: str | None = None
    """Who is there (`sim_kinematic.agents.roster.make_roster`); None: the robot and the person of the paper."""
    origin: dict[str, Any] | None = None
    """Which episode of which set it is."""

    def to_json(self) -> dict[str, Any]:
        """What decides the episode, as JSON gives it back."""
        fields = json.loads(msgspec.json.encode(replace(self, origin=None)))
        return {name: value for name, value in fields.items() if name != "origin" and (name, value) != ("agents", None)}

    @property
    def task(self) -> str:
        return "rearrange"

    def world(self) -> RearrangeWorld:
        """Scene, objects, goals, starts and rules, ready to run."""
        from h3data.habitat.scene_names import open_free_space, open_scene
        from sim_kinematic.tasks.rearrange.episode import PAIR, RearrangeWorld

        free = open_free_space(self.source, self.spec.agent_radius_m, self.spec.agent_height_m)
        return RearrangeWorld.create(
            open_scene(self.source), seed=self.seed, spec=self.spec, free=free, human=self.human or "female_0",
            agents=self.agents or PAIR,
        )  # fmt: skip

    def record(self) -> Recording:
        """Play it."""
        from sim_kinematic.tasks.rearrange.simulate import simulate_rearrange

        return simulate_rearrange(
            self.world(), policy=self.policy, partner=self.partner, episode_id=f"{self.index:06d}"
        )


def recorded_cast(agents: str | None, policy: str) -> tuple[AgentSpec, ...]:
    """Who is in the recordings of these agents under this policy.

    Raises:
        InputError: there are no such agents, or nobody is left.
    """
    from sim_kinematic.tasks.rearrange.log import SOLO

    from sim_kinematic.agents.roster import make_roster
    from sim_kinematic.tasks.rearrange.episode import PAIR

    cast = make_roster(PAIR if agents is None else agents)
    people = tuple(member for member in cast if member.kind == "human")
    if policy == SOLO and not people:
        raise InputError(
            "The policy solo leaves robots away, so somebody else must be there. Expected a person in --agents."
        )
    return people if policy == SOLO else cast


def rules(
    *, human_speed: float | None = None, max_steps: int | None = None, spawn_distance: float | None = None
) -> RearrangeSpec:
    """The rules with what the user asks for; None leaves the paper's."""
    spec = RearrangeSpec()
    if human_speed is not None:
        spec = replace(spec, human=replace(spec.human, speed_mps=human_speed))
    if max_steps is not None:
        spec = replace(spec, max_steps=max_steps)
    return spec if spawn_distance is None else replace(spec, spawn_distance_m=spawn_distance)


def rearrange_jobs(
    scenes: str, *, episodes: int | None, seed: int, policy: str, partner: str, human: str | None, spec: RearrangeSpec,
    agents: str | None = None, homes: int = 4, assets: Sequence[str | Path] = (), allow_missing: bool = False,
) -> list[RearrangeJob]:  # fmt: skip
    """Episodes in the scenes that ``scenes`` means: all of a set by default, else 10.

    Raises:
        InputError: no such scenes, agents, policy or partner; the message lists what there is.
    """
    from sim_kinematic.tasks.rearrange.simulate import minds_of

    from sim_kinematic.agents.roster import kinds_of
    from sim_kinematic.policies.learned import stamped

    policy, partner = (",".join(map(stamped, names.split(","))) for names in (policy, partner))
    minds_of(kinds_of(recorded_cast(agents, policy)), policy, partner, seed=seed, objects=spec.objects)
    bodies = Changes(policy=policy, human=human)
    drawn = drawn_episodes(
        scenes, episodes=episodes, seed=seed, homes=homes, assets=assets, allow_missing=allow_missing
    )  # fmt: skip
    return [
        RearrangeJob(
            index=e.index, seed=e.seed, scene=e.scene, source=e.source, policy=policy, partner=partner,
            human=bodies.body(e.seed), spec=spec, agents=agents, origin=e.origin,
        )
        for e in drawn
    ]  # fmt: skip
