"""Short recordings for tests of what reads recordings, and the three tasks by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from h3data.recording import Recording
from h3data.scene import FreeSpace, Scene
from sim_kinematic.motion.spec import NATURAL_WALKER, SocialNavSpec, WalkerSpec
from sim_kinematic.policies.assignment import SOLO
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode, RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.social_nav import SocialNav
from sim_kinematic.tasks.wander import Wander

SOCIAL_NAV, REARRANGE, WANDER = SocialNav(), Rearrange(), Wander()


def social_nav_episode(
    home: Scene,
    *,
    seed: int = 0,
    spec: SocialNavSpec | None = None,
    free: FreeSpace | None = None,
    human: str = "female_0",
    robot: str = "quad_arm",
) -> Episode:
    """The episode of social navigation that a seed samples in a home."""
    return SOCIAL_NAV.episode(home, seed=seed, spec=spec, free=free, human=human, robot=robot)


def simulate_social_nav(episode: Episode, *, policy: Any = "rollout_expert", **options: Any) -> Recording:
    """Its recording; ``options`` as of `simulate`."""
    return simulate(SOCIAL_NAV, episode, {"robot": policy}, **options)


def rearrange_episode(
    home: Scene,
    *,
    seed: int = 0,
    spec: RearrangeSpec | None = None,
    free: FreeSpace | None = None,
    agents: str | Sequence[str] | None = None,
    human: str = "female_0",
    robot: str = "quad_arm",
) -> RearrangeEpisode:
    """The episode of rearrangement that a seed samples in a home."""
    episode = REARRANGE.episode(home, seed=seed, spec=spec, free=free, agents=agents, human=human, robot=robot)
    assert isinstance(episode, RearrangeEpisode)
    return episode


def simulate_rearrange(
    episode: RearrangeEpisode,
    *,
    policy: Any = "complement",
    partner: Any = "both",
    solo_steps: int | None = None,
    **options: Any,
) -> Recording:
    """Its recording. ``solo_steps`` saves playing it once more by the person alone."""
    kinds = {member.kind for member in episode.roster}
    people = [k for k, member in enumerate(episode.roster) if member.kind == "human"]
    played = episode.only(*people) if people and policy == SOLO else episode
    chosen = {"robot": policy, "human": partner}
    chosen = {kind: choice for kind, choice in chosen.items() if kind in kinds and (kind, choice) != ("robot", SOLO)}
    info = None if solo_steps is None else {"solo_steps": solo_steps}
    return simulate(REARRANGE, played, chosen, info=info, **options)


def simulate_wander(
    home: Scene,
    agents: str | Sequence[str] = ("robot", "human"),
    *,
    seed: int = 0,
    steps: int = 300,
    free: FreeSpace | None = None,
    human: WalkerSpec = NATURAL_WALKER,
    **options: Any,
) -> Recording:
    """A recording of agents that wander about."""
    spec = SocialNavSpec(max_steps=steps, human=human)
    return simulate(WANDER, WANDER.episode(home, seed=seed, spec=spec, free=free, agents=agents), **options)
