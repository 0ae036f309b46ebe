"""Settings of a training run of rearrangement as one frozen record, and recipes, which are named settings."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

from h3data.errors import InputError, suggest
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import WALKERS
from sim_kinematic.policies.choosers.chooser_network import OBSERVATIONS, OF_OTHER, PIXELS
from sim_kinematic.policies.rearrange import POPULATIONS
from sim_kinematic.policies.visual_policy import VisualPolicy
from sim_kinematic.sensing.table import HUMANOID_GPS, SENSES
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec

WITHOUT_OTHER = tuple(name for name in OBSERVATIONS if name not in OF_OTHER)
"""Observations of a chooser without the paper's humanoid GPS."""

ROBOT = "robot"
"""Name of the learner that every population has."""
LEARNED = {"learn_single": 1, "learn_pop": 8}
"""Number of learning partners of each population with learning partners (paper section 4.2)."""
NAMES = ("learn_single", *POPULATIONS, "learn_pop")
"""Names of the paper's populations."""
LONGEST = {"paper": 750, "natural": 1500}
"""Number of steps of an episode by the gait of people: that of the paper, and that of h3data, in which people walk at
1.3 m/s.
"""
ABLATIONS = (HUMANOID_GPS, "primitives")
"""Parts that a robot can be trained without (paper, additional ablations): the observation of the person's position,
and the primitives of navigation.
"""
LEAST_CHUNKS = 12
"""Smallest number of chunks of a partner's minibatch; with fewer chunks its gradient is noise."""
BOTH = "both"
"""Value of ``walk`` with which half of the episodes have ``natural`` walking and half ``paper`` walking."""


def rules_of(walk: str) -> RearrangeSpec:
    """Return the rules of episodes with a given gait of people and the paper's reward."""
    return RearrangeSpec(max_steps=LONGEST[walk], human=WALKERS[walk])


@dataclass(frozen=True, kw_only=True)
class PopulationSettings:
    """Settings of one training run, in which rates are linear in progress (0 at the start, 1 at the end)."""

    population: str = "plan_pop_3"
    scenes: str = "h3-homes/train"
    """Name of a scene or several names, separated by commas (`h3data_training.episodes.listed_scenes`)."""
    episodes_per_home: int = 32
    """Number of episodes per home, which are sampled once and played repeatedly with different partners."""
    robot: str = "quad_arm"
    human: str = "female_0"
    walk: str = BOTH
    """Gait of people: ``natural``, in episodes of 1,500 steps, ``paper`` (2.5 m/s, 750 steps), or ``both`` (each in
    half of the episodes), for a robot that can handle both.
    """
    oracle: bool = False
    """True if episodes have oracle skills and are played in worlds on a device, all of an update at once
    (`h3data_training.populations.worlds`). People are then those of the paper, even in episodes that were sampled with
    other people.
    """
    moves_starts: bool = True
    """True if, in worlds on a device, agents start at starts of other episodes of the same home. Encounters are then so
    varied that success in training predicts success in other homes.
    """
    without: tuple[str, ...] = ()
    """Ablations (`ABLATIONS`) of the robot only."""
    pixels: bool = False
    """True if the robot has the observations of the paper's robot
    (`sim_kinematic.policies.choosers.chooser_network.PIXELS`) and does not observe the state. The critic, which only
    training needs, observes the state in either case.
    """
    picture_size: tuple[int, int] = (64, 48)
    """Width and height of the robot's pictures [pixels]."""
    channels: tuple[int, int, int] = (16, 32, 32)
    """Number of planes of the three convolutions for pictures."""
    features: int = 64
    """Number of values that represent a picture after the convolutions."""
    temperature: float = 1.0
    """Temperature at which the finished robot samples its choices (`PolicyCard.temperature`); in training the
    temperature is 1.
    """
    think_steps: int = 30
    """Number of steps after which a learner chooses again while it walks."""

    episodes: int = 32
    """Number of episodes of an update."""
    hidden: int = 64
    """Size of the recurrent state."""
    width: int = 64
    """Width of the other layers."""
    chunk: int = 16
    """Number of decisions through which a gradient is propagated."""
    critic_updates: int = 2
    """Number of updates at the start in which only the critic learns, because advantages are noise until the critic has
    been trained.
    """
    epochs: int = 8
    chunks_per_minibatch: int = 12
    kl_most: float = 0.02
    """KL divergence between the updated policy and the one that played, above which no further epoch is run."""
    rate: float = 1e-3
    rate_end: float = 0.1
    """Learning rate at the end of the run, as a share of that at the start."""
    guess: float = 0.0
    """Weight of the loss of predictions about objects, for a robot with pictures
    (`h3data_training.populations.networks.GUESSED`).
    """
    entropy: float = 0.005
    entropy_end: float = 0.2
    """Weight of the entropy at the end of the run, as a share of that at the start."""
    horizon: float = 500.0
    """Horizon of the value in steps; a decision that takes d steps is discounted by (1 - 1 / horizon)^d."""
    gae_lambda: float = 0.98
    clip: float = 0.2
    gradient_norm: float = 0.5
    reward_scale: float = 0.1

    updates: int = 0
    """Length of the run in updates; 0 if ``minutes`` determines it."""
    minutes: float = 30.0
    """Length of the run including set-up [min]."""

    def __post_init__(self) -> None:
        if self.population not in NAMES:
            raise InputError(
                f"Unknown population {self.population!r}.{suggest(self.population, NAMES)}", code="H3-TRAIN-034"
            )
        if self.walk not in (*LONGEST, BOTH):
            raise InputError(
                f"Unknown walk {self.walk!r}. Expected one of: {', '.join((*LONGEST, BOTH))}.", code="H3-TRAIN-035"
            )
        if strangers := [name for name in self.without if name not in ABLATIONS]:
            raise InputError(
                f"Unknown ablation {strangers[0]!r}.{suggest(strangers[0], ABLATIONS, lead='Expected some of')}",
                code="H3-TRAIN-036",
            )
        object.__setattr__(self, "without", tuple(name for name in ABLATIONS if name in self.without))
        if fault := VisualPolicy.size_fault(self.picture_size):
            raise InputError(f"Expected pictures with sides in {fault}, got {self.picture_size}.", code="H3-TRAIN-080")
        whole = (
            "episodes_per_home",
            "think_steps",
            "episodes",
            "hidden",
            "width",
            "chunk",
            "epochs",
            "chunks_per_minibatch",
            "features",
        )
        for name in whole:
            if getattr(self, name) < 1:
                raise InputError(f"Expected {name} of at least 1, got {getattr(self, name)}.", code="H3-TRAIN-039")
        if self.critic_updates < 0 or self.horizon <= 1:
            raise InputError(
                f"Expected critic_updates >= 0 and a horizon above 1, got {self.critic_updates} and {self.horizon}.",
                code="H3-TRAIN-037",
            )
        if self.updates < 0 or not math.isfinite(self.minutes) or self.minutes <= 0:
            raise InputError(
                f"Expected updates >= 0 and minutes > 0, got {self.updates} and {self.minutes}.", code="H3-TRAIN-038"
            )

    @property
    def walks(self) -> tuple[str, ...]:
        """Gaits that alternate over the episodes of a home."""
        return tuple(LONGEST) if self.walk == BOTH else (self.walk,)

    @property
    def partners(self) -> tuple[str, ...]:
        """Partners that the robot may have: plans, or learners by name."""
        if self.population in POPULATIONS:
            return POPULATIONS[self.population]
        return tuple(f"partner_{k}" for k in range(LEARNED[self.population]))

    @property
    def learners(self) -> tuple[str, ...]:
        """Names of the learners: the robot, and partners that are not planners."""
        return (ROBOT, *self.partners) if self.population in LEARNED else (ROBOT,)

    def minibatch_of(self, learner: str) -> int:
        """Return the number of chunks in a minibatch of one of the learning policies.

        Each of P partners plays in one of P episodes. The minibatches of partners are smaller by the factor P, but not
        smaller than `LEAST_CHUNKS`, so that all policies make the same number of gradient steps in an update.
        """
        if learner == ROBOT:
            return self.chunks_per_minibatch
        least = min(self.chunks_per_minibatch, LEAST_CHUNKS)
        return max(least, self.chunks_per_minibatch // len(self.partners))

    def observations_of(self, agent: str) -> tuple[str, ...]:
        """Return observations of a learner, the ``robot`` or a ``human``."""
        is_hidden = HUMANOID_GPS in self.without
        if agent == ROBOT and self.pixels:
            return tuple(name for name in PIXELS if not (is_hidden and name in SENSES and SENSES[name].of_other))
        return WITHOUT_OTHER if agent == ROBOT and is_hidden else OBSERVATIONS

    def partner_of(self, seed: int, episode: int) -> str:
        """Return the partner in a training episode.

        Each of P partners plays once in P consecutive episodes, in random order.
        """
        block, place = divmod(episode, len(self.partners))
        order = generator(seed, f"partners/{self.population}", step=block).permutation(len(self.partners))
        return self.partners[int(order[place])]

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as JSON types, as in checkpoints and cards."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def in_worlds(self, worlds: int) -> PopulationSettings:
        """Return the settings with oracle skills in a given number of worlds."""
        return replace(self.in_updates_of(worlds), oracle=True)

    def in_updates_of(self, episodes: int) -> PopulationSettings:
        """Return the settings with a given number of episodes in an update, and the same number of minibatches."""
        per_episode = self.chunks_per_minibatch / self.episodes
        return replace(self, episodes=episodes, chunks_per_minibatch=max(1, round(episodes * per_episode)))

    def changed(self, **changes: Any) -> PopulationSettings:
        """Return the settings with some values changed; None leaves a value unchanged."""
        return replace(self, **{k: v for k, v in changes.items() if v is not None})


RECIPES: dict[str, PopulationSettings] = {
    "paper": PopulationSettings(
        walk="paper",
        episodes=20,
        updates=8_333,
        hidden=512,
        width=512,
        chunk=128,
        chunks_per_minibatch=10,
        epochs=1,
        critic_updates=0,
        kl_most=1e9,
        rate=2.5e-4,
        rate_end=1.0,
        entropy=1e-4,
        entropy_end=1.0,
        horizon=3000.0,
        gae_lambda=0.95,
        gradient_norm=0.2,
        reward_scale=1.0,
    ),
}
"""Recipes by name. ``paper`` has the published settings, as far as they apply to a policy that observes the state. The
12,288 steps of an update (96 environments of 128) are 20 episodes of about 600, and 100 M steps are 8,333 updates. A
rollout of 128 steps is a chunk, so that 10 chunks are one of two minibatches. The discount of 0.99 applies to a
decision of ``think_steps``.
"""


SEEING = PopulationSettings(
    pixels=True, hidden=128, chunk=64, chunks_per_minibatch=3, guess=0.25, entropy_end=0.05, temperature=0.25
)
"""Settings of h3data for a robot with pictures, which has to remember what it has observed in an episode. While the
person is near, it decides six times a second, so gradients go through 64 decisions; a minibatch has as many decisions
as without pictures. The temperature was chosen on val homes (h3data docs populations).
"""


def rearrange_recipe(name: str | None, **changes: Any) -> PopulationSettings:
    """Return a recipe of rearrangement with some settings changed, or h3data's own settings for None.

    A setting that is None is not changed.

    Raises:
        InputError: there is no such recipe, or a value is out of range.
    """
    if name is not None and name not in RECIPES:
        raise InputError(
            f"Unknown recipe {name!r} of rearrange. Expected one of: {', '.join(RECIPES)}; or none, for our own settings.",
            code="H3-TRAIN-033",
        )
    ours = SEEING if changes.get("pixels") else PopulationSettings()
    return (ours if name is None else RECIPES[name]).changed(**changes)
