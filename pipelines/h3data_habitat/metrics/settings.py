"""Settings of habitat-lab's measures from the facts of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from h3data.errors import InputError
from h3data.metrics.habitat_settings import HabitatConfig, RewardConfig, StatsConfig, SuccessConfig


def config_of(info: Mapping[str, Any]) -> HabitatConfig:
    """Return the settings in ``info["habitat_config"]``; missing keys keep their defaults, unknown ones are ignored.

    The keys are Habitat's: ``{"social_nav_stats": {...}, "social_nav_reward": {...}, "nav_seek_success": {...},
    "slack_reward": x, "success_reward": x}``.
    """
    config = info.get("habitat_config") or {}
    if not isinstance(config, Mapping):
        raise InputError(
            f"Expected info habitat_config to be a mapping of Habitat's settings, got {config!r}.",
            code="H3-METRIC-012",
        )
    return HabitatConfig(
        stats=_read(StatsConfig, config, "social_nav_stats"),
        reward=_read(RewardConfig, config, "social_nav_reward"),
        success=_read(SuccessConfig, config, "nav_seek_success"),
        slack_reward=float(config.get("slack_reward", HabitatConfig.slack_reward)),
        success_reward=float(config.get("success_reward", HabitatConfig.success_reward)),
    )


def _read(kind: type, config: Mapping[str, Any], section: str) -> Any:
    given = config.get(section) or {}
    if not isinstance(given, Mapping):
        raise InputError(
            f"Expected info habitat_config: {section} to be a mapping of settings, got {given!r}.", code="H3-METRIC-010"
        )
    defaults = {f.name: f.default for f in fields(kind)}
    values = {name: value for name, value in given.items() if name in defaults}
    faults = [f"{n} = {v!r}" for n, v in values.items() if not isinstance(v, int | float)]
    if faults:
        raise InputError(
            f"Expected numbers in info habitat_config: {section}, got {', '.join(faults)}.", code="H3-METRIC-011"
        )
    # flags come as numbers, and counts as floats
    return kind(**{n: type(defaults[n])(v) for n, v in values.items()})
