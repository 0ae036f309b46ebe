"""Rules on a device: each field of a spec is ported, acts where episodes are drawn, or is refused; formulas are the CPU's."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("shapely")
pytest.importorskip("fcl")

from h3data.errors import InputError  # noqa: E402
from h3data_training.torch.rules import HELD, refuse_others  # noqa: E402
from sim_kinematic.motion import spec as specs  # noqa: E402
from sim_kinematic.motion.spec import SocialNavSpec  # noqa: E402
from sim_kinematic.sensing.sensor import agents_within_threshold, facing  # noqa: E402
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec  # noqa: E402
from sim_kinematic.tasks.rules.predicates import is_found, is_object_at  # noqa: E402
from sim_kinematic.tasks.rules.rewards import REARRANGE_REWARDS, PaperReward  # noqa: E402
from tests.paths import ROOT  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
TORCH = ROOT / "pipelines" / "h3data_training" / "torch"
RULES = ROOT / "sim_kinematic" / "tasks" / "rules"


# --- every field of every spec ------------------------------------------------------------------------------------------
def specs_of(task: str) -> Iterator[tuple[Any, tuple[str, ...]]]:
    """The specs that a device plays of a task, and by which fields each is reached."""

    def inner(spec: Any, path: tuple[str, ...]) -> Iterator[tuple[Any, tuple[str, ...]]]:
        yield spec, path
        for name in HELD[task].ported.get(type(spec), ()):
            if is_dataclass(getattr(spec, name)):
                yield from inner(getattr(spec, name), (*path, name))

    yield from inner(HELD[task].like, ())


def other(value: Any) -> Any:
    """Another value of its kind."""
    if value is None or isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return f"another {value}"
    if isinstance(value, tuple):
        return tuple(map(other, value))
    if is_dataclass(value):
        return changed(value, (), fields(value)[0].name)
    return 5.0 if np.isinf(value) else value + 1


def changed(spec: Any, path: tuple[str, ...], name: str) -> Any:
    """A spec in which one field has another value, however unusual."""
    found = copy.copy(spec)
    step = path[0] if path else name
    value = getattr(spec, step)
    object.__setattr__(found, step, changed(value, path[1:], name) if path else other(value))
    return found


CASES = [(task, path, f.name) for task in HELD for spec, path in specs_of(task) for f in fields(spec)]


@pytest.mark.parametrize(("task", "path", "name"), CASES, ids=[".".join((t, *p, n)) for t, p, n in CASES])
def test_a_rule_holds_on_a_device_or_is_refused_by_its_name(task: str, path: tuple[str, ...], name: str) -> None:
    held = HELD[task]
    spec = next(spec for spec, at in specs_of(task) if at == path)
    rules = changed(held.like, path, name)
    ported, drawn = (name in names.get(type(spec), ()) for names in (held.ported, held.drawn))
    assert not (ported and drawn)
    if ported:
        refuse_others(task, rules)
        sources = [file.read_text() for folder in (TORCH, RULES) for file in folder.rglob("*.py")]
        assert any(re.search(rf"\.{name}\b", text) for text in sources), "nothing on a device reads it"
    elif drawn:
        refuse_others(task, rules)
    else:
        with pytest.raises(InputError, match=rf"{name} of {type(spec).__name__} is "):
            refuse_others(task, rules)


def test_every_spec_is_looked_at() -> None:
    known = {RearrangeSpec, *(s for s in vars(specs).values() if isinstance(s, type) and is_dataclass(s))}
    of_others = {
        specs.StrideSpec,
        specs.ArmRoomSpec,
        specs.HabitatSlideSpec,
    }  # whole: how people walk, and slide="habitat"
    assert {type(spec) for task in HELD for spec, _ in specs_of(task)} == known - of_others
    for held in HELD.values():
        for names in (held.ported, held.drawn):
            for spec, listed in names.items():
                assert set(listed) <= {f.name for f in fields(spec)}, "it lists what no spec has"


# --- formulas -----------------------------------------------------------------------------------------------------------
WORLDS = 400
rng = np.random.default_rng(0)
DISTANCE, BEFORE = rng.uniform(0, 4, (2, WORLDS))
FACES, FOLLOWED = rng.uniform(-1, 1, WORLDS), rng.integers(395, 403, WORLDS)
XZ, OTHER = rng.uniform(-1, 1, (2, WORLDS, 2))
HEADING = rng.uniform(-4, 4, WORLDS)
POINT, GOAL = rng.uniform(0, 0.5, (2, WORLDS, 3))
FLAGS = rng.random((3, WORLDS)) < 0.3
FORMULAS: dict[str, Callable[[Any, Callable[[Any], Any]], Any]] = {
    "social_nav reward": lambda xp, a: PaperReward().of(
        a(DISTANCE), a(BEFORE), a(FACES), a(FOLLOWED), SocialNavSpec(), xp=xp
    ),
    "found": lambda xp, a: is_found(a(DISTANCE), a(FACES), SocialNavSpec()),
    "facing": lambda xp, a: facing(a(XZ), a(HEADING), a(OTHER), xp=xp),
    "close": lambda xp, a: agents_within_threshold(a(XZ), a(HEADING), a(OTHER), ahead_m=0.8, aside_m=0.5, xp=xp),
    "object_at": lambda xp, a: is_object_at(a(POINT), a(GOAL), xp=xp),
    **{
        f"rearrange reward {profile}": lambda xp, a, worth=worth: worth.of(
            *(a(flags.astype(np.float64)) for flags in FLAGS)
        )
        for profile, worth in REARRANGE_REWARDS.items()
    },
}


@pytest.mark.parametrize("name", FORMULAS)
def test_a_formula_is_the_same_for_arrays_and_tensors(name: str) -> None:
    here, there = FORMULAS[name](np, np.asarray), FORMULAS[name](torch, torch.as_tensor)
    for mine, theirs in zip(*(each if isinstance(each, tuple) else (each,) for each in (here, there)), strict=True):
        assert len(np.unique(mine)) > 1
        np.testing.assert_allclose(theirs.numpy(), mine, rtol=0, atol=1e-12)
