"""Checkpoints of training runs, which hold the state of a run and all its worlds in one file of arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch

from h3data.errors import FormatError, InputError
from h3data_training.ppo import Learner
from h3data_training.running import RunLength, share_of
from h3data_training.torch.graph import overwrite

FORMAT = "h3data.training/1"
FREE = ("minutes", "updates")
"""Settings that may change when a run continues, because they only limit its length."""


def state_of(learner: Learner) -> dict[str, Any]:
    """Return weights, optimizer, random numbers and all worlds; every process has to call this function."""
    m, everyone = learner.memory, learner.ranks.gathered
    return {
        "net": learner.net.state_dict(),
        "optimizer": learner.optimizer.state_dict(),
        "generator": everyone(learner.generator.get_state()[None].to(m.state.device)),
        "play": [everyone(t) for t in learner.worlds.play.tensors()],
        "shown": {n: everyone(t) for n, t in m.shown.items()},
        "state": everyone(m.state),
        "last": everyone(m.last),
        "over": everyone(m.over),
    }


def restore(learner: Learner, kept: dict[str, Any], path: Path) -> None:
    """Restore a learner to the state from `state_of`.

    Raises:
        FormatError: the checkpoint does not fit the learner.
        InputError: the checkpoint is from a run with a different number of processes.
    """
    m, own = learner.memory, learner.ranks.own
    try:
        generator = kept["generator"].cpu()
        if len(generator) != learner.ranks.count:
            raise InputError(
                f"The run in this folder is one of {len(generator)} processes, not {learner.ranks.count}. "
                f"Hint: --gpus {len(generator)}. File: {path}",
                code="H3-TRAIN-004",
            )
        learner.net.load_state_dict(kept["net"])
        learner.optimizer.load_state_dict(kept["optimizer"])
        learner.generator.set_state(own(generator)[0].clone())  # a part of a tensor crashes torch
        overwrite(learner.worlds.play.tensors(), map(own, kept["play"]))
        overwrite(m.shown.values(), (own(kept["shown"][name]) for name in m.shown))
        overwrite((m.state, m.last, m.over), (own(kept[n]) for n in ("state", "last", "over")))
    except (KeyError, RuntimeError, ValueError) as fault:
        reason = str(fault).splitlines()[0]
        raise FormatError(f"The checkpoint does not fit ({reason}). File: {path}", code="H3-TRAIN-005") from None


class PlainSettings(RunLength, Protocol):
    """Protocol of the settings of a run, whose class has defaults for all of them."""

    def as_dict(self) -> dict[str, Any]:
        """Return all settings by name, as JSON types."""
        ...


def load_checkpoint(path: Path, settings: PlainSettings, seed: int, *, form: str = FORMAT) -> dict[str, Any] | None:
    """Return the checkpoint in a file, as `read` does; None if there is no file.

    Raises:
        FormatError, InputError: as for `read`, or the run has already ended.
    """
    if not path.exists():
        return None
    kept = read(path, settings, seed, form=form)
    if share_of(settings, kept["curve"], kept["seconds"], kept["setups_s"]) >= 1:
        raise InputError(
            f"The run is over: {len(kept['curve'])} updates in {kept['seconds'] / 60:.1f} minutes. "
            f"Hint: more --{'updates' if settings.updates else 'minutes'}. Folder: {path.parent}",
            code="H3-TRAIN-001",
        )
    return kept


def read(path: Path, settings: PlainSettings, seed: int, *, form: str = FORMAT) -> dict[str, Any]:
    """Read a checkpoint with the same settings and seed; ``form`` is the format that its file must state.

    Raises:
        FormatError: the file is not a checkpoint, or is damaged.
        InputError: the checkpoint has other settings.
    """
    try:
        kept = torch.load(path, map_location="cpu", weights_only=True)  # numbers only: nothing in it is executed
        then = kept["settings"] | {"seed": kept["seed"]}
        fits = kept["format"] == form
    except Exception as fault:  # torch raises whatever the bytes lead to
        raise FormatError(
            f"Expected a checkpoint of h3data train, this is none, or damaged ({type(fault).__name__}). "
            f"Hint: --force begins anew. File: {path}",
            code="H3-TRAIN-006",
        ) from None
    if not fits:
        raise FormatError(f"Expected a checkpoint {form}, got {kept['format']}. File: {path}", code="H3-TRAIN-002")
    now = settings.as_dict() | {"seed": seed}
    then = type(settings)().as_dict() | then  # settings that are newer than the checkpoint have their defaults
    other = differences(then, {name: value for name, value in now.items() if name not in FREE})
    if other:
        raise InputError(
            f"The run in this folder has {other}. Hint: name the same settings, or another folder.", code="H3-TRAIN-003"
        )
    return kept


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return the settings that differ between ``then`` and ``now`` as text; empty if none differ."""
    return "; ".join(
        f"{name}={then.get(name)!r}, not {value!r}" for name, value in now.items() if then.get(name) != value
    )
