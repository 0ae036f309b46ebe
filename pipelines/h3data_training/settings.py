"""Settings of a training run as one frozen record, and recipes, which are named settings."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

from h3data.errors import InputError
from h3data.render.light.sources import LightMode, check_light
from sim_kinematic.policies.visual_policy import BASE_ACTIONS, PICTURES, VisualPolicy
from sim_kinematic.sensing.encodings import DETECTOR, OF_SOCIAL_NAV
from sim_kinematic.sensing.table import HUMANOID_GPS, PAPER_OBSERVATIONS
from sim_kinematic.tasks.social_nav import SocialNav

NETWORKS = ("cnn_gru", "resnet18_lstm")
CRITIC = tuple(name for name in OF_SOCIAL_NAV if name != DETECTOR)
"""Names of the inputs of the critic of social navigation."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of one training run, in which rates are linear in progress (0 at the start, 1 at the end)."""

    scenes: str = "h3-homes/train"
    """Name of a scene or several names, separated by commas (`h3data_training.episodes.listed_scenes`)."""
    episodes_per_home: int = 28
    observations: tuple[str, ...] = PAPER_OBSERVATIONS
    picture_size: tuple[int, int] = (64, 48)
    """Width and height of pictures [pixels], multiples of 4."""
    light: LightMode = "flat"
    """Light in ``arm_rgb``: ``flat`` or ``baked``. The policy observes the same light wherever it plays."""
    robot: str = "quad_arm"
    human: str = "female_0"
    walk: str = "natural"
    """Walk of people: ``natural`` or ``paper`` (2.5 m/s, turning on the spot)."""
    follow_steps: int = 0
    """Number of steps of following after which an episode is cut short, as if it had reached its time limit; 0 for
    never. Otherwise most of a rollout would be following, and little of it finding.
    """
    worlds: int = 4096
    rollout: int = 32
    """Number of decisions per world between two updates."""
    hold: int = 3
    """Number of steps of 1/30 s for which an action is repeated, because a picture costs more than a step, and because
    rewards are then credited to earlier decisions. With 3 steps, a policy trained with 1 step loses most of its ability
    to keep its distance from people at the paper's 2.5 m/s, and less at walking speed.
    """

    network: str = "cnn_gru"
    """Type of the network. ``cnn_gru`` has three convolutions and a GRU. ``resnet18_lstm`` is the paper's network, with
    ``channels[0]`` planes in the first layer.
    """
    channels: tuple[int, int, int] = (32, 64, 64)
    features: int = 256
    """Number of values that represent a picture."""
    hidden: int = 256
    """Size of the recurrent state."""
    act_width: int = 256
    """Number of units of the layer between the recurrent state and the action."""
    critic_width: int = 256
    """Number of units in each of the two layers of the critic."""

    epochs: int = 3
    minibatches: int = 4
    rate: float = 8e-4
    rate_end: float = 0.05
    """Learning rate at the end of the run, as a share of that at the start."""
    warmup_updates: int = 15
    critic_updates: int = 0
    """Number of updates in which only the critic learns, because it is new if the actor comes from a file."""
    entropy: float = 0.002
    std: float = 0.6
    """Standard deviation of the exploration noise at the start."""
    least_std: float = 0.1
    """Smallest standard deviation of the exploration noise."""
    horizon: tuple[float, float] = (150.0, 500.0)
    """Horizon of the value in steps, at the start and at the end of the run; finding the person is learned before
    avoiding contact.
    """
    gae_lambda: float = 0.95
    clip: float = 0.2
    gradient_norm: float = 1.0
    teacher: float = 0.0
    """Weight of imitating the actions of a scripted teacher at the start, for tasks that have a teacher."""
    teacher_end: float = 0.6
    """Share of the run after which the weight of the teacher is 0."""
    auxiliary: float = 0.5
    """Weight of the head that predicts the critic's inputs from the recurrent state."""
    near_m: float = 3.0
    """Distance from the person that separates two groups of worlds, within which advantages are centred and scaled [m]:
    near the person a step has 30 times the reward of a step on the path to them. With 0, all worlds are scaled
    together.
    """

    updates: int = 0
    """Length of the run in updates; 0 if ``minutes`` determines it."""
    minutes: float = 8.7
    """Length of the run including set-up [min]."""

    def __post_init__(self) -> None:
        check_light(self.light)
        if self.light != "flat" and "arm_rgb" not in self.observations:
            raise InputError(
                "Light makes no difference to depth. Hint: leave out the light, or observe arm_rgb.",
                code="H3-TRAIN-045",
            )
        known = (*self.pictures, *self.vector_observations)
        strangers = [name for name in self.observations if name not in known]
        if strangers or not self.observations:
            raise InputError(
                f"Expected observations among {', '.join(known)}; got {', '.join(strangers) or 'none'}.",
                code="H3-TRAIN-046",
            )
        whole = (
            "episodes_per_home",
            "worlds",
            "rollout",
            "hold",
            "features",
            "hidden",
            "act_width",
            "critic_width",
            "epochs",
            "minibatches",
        )
        for name in whole:
            if getattr(self, name) < 1:
                raise InputError(f"Expected {name} of at least 1, got {getattr(self, name)}.", code="H3-TRAIN-039")
        if set(PICTURES) <= set(self.observations):
            raise InputError(
                f"Expected one picture among the observations, not {' and '.join(PICTURES)}.", code="H3-TRAIN-047"
            )
        if self.network not in NETWORKS:
            raise InputError(
                f"Unknown network {self.network!r}. Expected one of: {', '.join(NETWORKS)}.", code="H3-TRAIN-048"
            )
        width, height = self.picture_size
        if self.network == "cnn_gru" and (fault := VisualPolicy.size_fault(self.picture_size)):
            raise InputError(
                f"Expected pictures with sides in {fault} pixels, got {width}x{height}.", code="H3-TRAIN-049"
            )
        if self.network == "resnet18_lstm" and (
            not 8 <= min(width, height) <= max(width, height) <= 1024 or self.channels[0] % 16
        ):
            raise InputError(
                f"Expected pictures of 8 to 1024 pixels a side and multiples of 16 planes for {self.network}, "
                f"got {width}x{height} and {self.channels[0]}.",
                code="H3-TRAIN-050",
            )
        if self.worlds % self.minibatches:
            raise InputError(
                f"Expected worlds in multiples of minibatches={self.minibatches}, got {self.worlds}.",
                code="H3-TRAIN-051",
            )
        if self.follow_steps < 0 or self.critic_updates < 0:
            raise InputError(
                f"Expected follow_steps and critic_updates >= 0, got {self.follow_steps} and {self.critic_updates}.",
                code="H3-TRAIN-052",
            )
        if self.updates < 0 or not math.isfinite(self.minutes) or self.minutes <= 0:
            raise InputError(
                f"Expected updates >= 0 and minutes > 0, got {self.updates} and {self.minutes}.", code="H3-TRAIN-038"
            )

    @property
    def task(self) -> str:
        """Name on the cards of policy files."""
        return SocialNav.name

    @property
    def pictures(self) -> tuple[str, ...]:
        """Names of observations that are pictures; the actor may have one of them."""
        return tuple(PICTURES)

    @property
    def pictured(self) -> bool:
        """Return whether some of the observations are computed from pictures."""
        return bool({*PICTURES, DETECTOR} & set(self.observations))

    @property
    def vector_observations(self) -> tuple[str, ...]:
        """Names of observations that the actor may have in addition to a picture, or without one."""
        return OF_SOCIAL_NAV

    @property
    def critic(self) -> tuple[str, ...]:
        """Names of the critic's observations, which are used in training only and are not in the policy file."""
        return CRITIC

    @property
    def first_action(self) -> tuple[float, ...]:
        """Action around which an actor explores at first, which is standing still."""
        return (0.0,) * BASE_ACTIONS

    @property
    def actions(self) -> int:
        """Number of components of an action."""
        return len(self.first_action)

    @property
    def decisions_per_update(self) -> int:
        """Number of decisions in the rollouts of one update."""
        return self.worlds * self.rollout

    def second_stage(self) -> Settings:
        """Return settings for a pretrained actor, with which at first only the critic learns, with less exploration."""
        ahead = self.horizon[1]
        return replace(self, horizon=(ahead, 1.5 * ahead), std=0.3, rate=self.rate / 2, critic_updates=20)

    def looking_ahead(self, steps: float) -> Settings:
        """Return settings with a horizon of ``steps`` of 1/30 s at the end, and in proportion at the start."""
        if not (math.isfinite(steps) and steps > self.hold * self.horizon[1] / self.horizon[0]):
            raise InputError(
                f"Expected a horizon that is longer than an action of {self.hold} steps from the start, got {steps:g} steps.",
                code="H3-TRAIN-053",
            )
        return replace(self, horizon=(steps * self.horizon[0] / self.horizon[1], float(steps)))

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as JSON types, as in checkpoints and cards."""
        return {f.name: _plain(getattr(self, f.name)) for f in fields(self)}


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


RECIPES: dict[str, Settings] = {
    "fast": Settings(),
    "paper": Settings(
        network="resnet18_lstm",
        picture_size=(224, 171),
        features=512,
        hidden=512,
        hold=1,
        worlds=96,
        rollout=128,
        minibatches=2,
        rate=1e-4,
        entropy=0.01,
        gradient_norm=0.2,
        horizon=(100.0, 100.0),
        near_m=0.0,
        auxiliary=0.0,
        updates=16_276,
    ),
    "tiny": Settings(
        episodes_per_home=8,
        observations=(HUMANOID_GPS, "range_scan"),
        picture_size=(32, 24),
        worlds=512,
        rollout=16,
        channels=(8, 16, 16),
        features=32,
        hidden=64,
        rate=2e-3,
        entropy=0.0,
        minutes=10.0,
    ),
}
"""Recipes by name. ``paper`` has the published settings, except that the critic observes the map and the learning rate
decreases. ``fast`` takes minutes on one GPU. ``tiny`` uses a CPU core and no pictures; the robot observes the positions
of the person and walls.
"""


def recipe(name: str, **changes: Any) -> Settings:
    """Return a recipe with some settings changed; None leaves a setting unchanged.

    Raises:
        InputError: there is no such recipe, or a value is out of range.
    """
    if name not in RECIPES:
        raise InputError(f"Unknown recipe {name!r}. Expected one of: {', '.join(RECIPES)}.", code="H3-TRAIN-044")
    return replace(RECIPES[name], **{k: v for k, v in changes.items() if v is not None})
