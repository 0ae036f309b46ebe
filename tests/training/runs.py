"""Small training runs for tests: two homes, four worlds, seconds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from h3data_training.settings import PAPER_OBSERVATIONS, RECIPES, Settings

SMALL = replace(
    RECIPES["tiny"],
    scenes="h3-homes/train#0",
    episodes_per_home=2,
    worlds=4,
    rollout=3,
    picture_size=(16, 12),
    observations=PAPER_OBSERVATIONS,
    minibatches=2,
    epochs=2,
    channels=(4, 4, 4),
    features=8,
    hidden=8,
    updates=3,
)


def small(**changes: Any) -> Settings:
    return replace(SMALL, **changes)
