"""Settings of a training run of crowd navigation, and recipes, which are named settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from h3data.errors import InputError
from h3data_training.settings import Settings

OBSERVED = ("goal_gps", "goal_way", "people", "range_scan", "egomotion")
"""Names of all observations: none of them needs a picture."""
MOST_PEOPLE = 12
"""Largest number of people in the worlds of a run."""
UNUSED = ("walk", "follow_steps", "near_m", "light", "picture_size", "channels", "features", "auxiliary")
"""Settings of social navigation that have no meaning for crowd navigation."""


@dataclass(frozen=True, kw_only=True)
class CrowdSettings(Settings):
    """Settings of a run of one robot among people, who follow a crowd model."""

    crowd_task: str = ""
    """Name of the task, which has the sensors `OBSERVED`."""
    episodes_per_home: int = 24
    rollout: int = 16
    minibatches: int = 8
    people: int = 4
    """Number of people in each home."""
    model: str = "orca"
    """Crowd model of the people: ``orca`` or ``social_force``."""
    limit: int = 900
    """Number of steps after which an episode is cut short, as if it had reached its time limit, because little is
    learned from a robot that is stuck.
    """
    observations: tuple[str, ...] = OBSERVED
    hidden: int = 128
    act_width: int = 128
    rate: float = 1e-3
    auxiliary: float = 0.0
    near_m: float = 0.0
    minutes: float = 6.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.network != "cnn_gru":
            raise InputError(f"Crowd navigation has the network cnn_gru, not {self.network!r}.", code="H3-TRAIN-084")
        if not 0 <= self.people <= MOST_PEOPLE or self.limit < 1:
            raise InputError(
                f"Expected 0 to {MOST_PEOPLE} people and a limit of at least 1, got {self.people} and {self.limit}.",
                code="H3-TRAIN-085",
            )

    @property
    def task(self) -> str:
        """Name of the task in the policy file."""
        return self.crowd_task

    @property
    def pictures(self) -> tuple[str, ...]:
        """Names of the pictures that the policy may observe, of which there are none."""
        return ()

    @property
    def vector_observations(self) -> tuple[str, ...]:
        """Names of the observations that the policy may have."""
        return OBSERVED

    @property
    def critic(self) -> tuple[str, ...]:
        """Names of the observations of the critic."""
        return OBSERVED

    def as_dict(self) -> dict[str, Any]:
        """Return the settings by name, without those that crowd navigation does not use."""
        return {name: value for name, value in super().as_dict().items() if name not in UNUSED}


RECIPES: dict[str, dict[str, Any]] = {
    "fast": {},
    "tiny": {
        "episodes_per_home": 4,
        "worlds": 512,
        "minibatches": 4,
        "hidden": 64,
        "act_width": 64,
        "critic_width": 128,
        "rate": 2e-3,
        "entropy": 0.0,
        "minutes": 10.0,
    },
}
"""Settings of recipes, by name. ``fast`` takes minutes on one GPU, ``tiny`` uses a core of a CPU."""


def crowd_recipe(name: str, task: str, **changes: Any) -> CrowdSettings:
    """Return a recipe for a task with some settings changed; None leaves a setting unchanged.

    Raises:
        InputError: there is no such recipe, or a value is out of range.
    """
    if name not in RECIPES:
        raise InputError(
            f"Unknown recipe {name!r} of crowd navigation. Expected one of: {', '.join(RECIPES)}.", code="H3-TRAIN-083"
        )
    given = {k: v for k, v in changes.items() if v is not None}
    return CrowdSettings(crowd_task=task, **{**RECIPES[name], **given})
