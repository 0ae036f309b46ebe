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
from sim_kinematic.agents.oracle.rules import gets_on, is_there, left_to_do, reaches  # noqa: E402
from sim_kinematic.motion import spec as specs  # noqa: E402
from sim_kinematic.motion.spec import OracleSpec, SocialNavSpec  # noqa: E402
from sim_kinematic.policies.rearrange import Plan  # noqa: E402
from sim_kinematic.sensing.sensor import agents_within_threshold, facing, in_base_frame, scaled_depth  # noqa: E402
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec  # noqa: E402
from sim_kinematic.tasks.rules.predicates import is_found, is_object_at  # noqa: E402
from sim_kinematic.tasks.rules.rewards import REARRANGE_REWARDS, PaperReward  # noqa: E402
from tests.paths import ROOT  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
TORCH = ROOT / "pipelines" / "h3data_training" / "torch"
RULES = ROOT / "sim_kinematic" / "tasks" / "rules"
ORACLE_RULES = ROOT / "sim_kinematic" / "agents" / "oracle" / "rules.py"


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
        files = [ORACLE_RULES, *TORCH.rglob("*.py"), *RULES.rglob("*.py")]
        sources = [file.read_text() for file in files]
        assert any(re.search(rf"\.{name}\b", text) for text in sources), "nothing on a device reads it"
    elif drawn:
        refuse_others(task, rules)
    else:
        with pytest.raises(InputError, match="H3-ENV-034"):
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
TAKEN, THERE = rng.random((2, WORLDS, 2)) < 0.4
PAID, HOLDERS = rng.random((WORLDS, 4)) < 0.3, rng.integers(-1, 2, (WORLDS, 2))
ORDER = np.array([[0, 1], [1, 0], [1, -1], [-1, -1]])[rng.integers(0, 4, WORLDS)]
PASSED, TRIED = rng.integers(0, 3, (2, WORLDS))
GAPS, ORACLE = rng.uniform(-0.4, 0.4, (WORLDS, 3, 2)), OracleSpec(reach_m=0.2)


def _flat(planned: Any) -> tuple[Any, ...]:
    """The object and the plan."""
    return planned[0], *planned[1][1:]


FORMULAS: dict[str, Callable[[Any, Callable[[Any], Any]], Any]] = {
    "social_nav reward": lambda xp, a: PaperReward().of(
        a(np.where(FLAGS[2], np.inf, DISTANCE)),
        a(DISTANCE),
        a(np.where(FLAGS[1], np.nan, BEFORE)),
        a(FACES),
        a(FOLLOWED),
        SocialNavSpec(),
        xp=xp,
    ),
    "found": lambda xp, a: is_found(a(DISTANCE), a(FACES), SocialNavSpec()),
    "facing": lambda xp, a: facing(a(XZ), a(HEADING), a(OTHER), xp=xp),
    "close": lambda xp, a: agents_within_threshold(a(XZ), a(HEADING), a(OTHER), ahead_m=0.8, aside_m=0.5, xp=xp),
    "object_at": lambda xp, a: is_object_at(a(POINT), a(GOAL), xp=xp),
    **{
        f"rearrange reward {profile}": lambda xp, a, worth=worth: worth.step(
            a(TAKEN), a(THERE), a(PAID), a(FLAGS[0].astype(np.float64)), xp=xp
        )
        for profile, worth in REARRANGE_REWARDS.items()
    },
    **{
        f"plan of agent {agent}": lambda xp, a, agent=agent: _flat(
            Plan(a(ORDER), a(PASSED), a(TRIED)).next(a(~FLAGS[0]), a(FLAGS[1]), a(HOLDERS), a(THERE), agent, xp=xp)
        )
        for agent in (0, 1)
    },
    "in_base_frame": lambda xp, a: in_base_frame(a(XZ), a(HEADING), a(OTHER), xp=xp),
    "scaled_depth": lambda xp, a: scaled_depth(a(4 * DISTANCE)),
    "is_there": lambda xp, a: is_there(a(DISTANCE / 8), a(~FLAGS[0]), a(FACES), a(FOLLOWED % 14)),
    "left_to_do": lambda xp, a: left_to_do(a(DISTANCE), a(HEADING)),
    "gets_on": lambda xp, a: gets_on(a(DISTANCE), a(BEFORE)),
    "reaches": lambda xp, a: reaches(ORACLE, a(GAPS), a(HEADING / 4)),
}
TABLED = {
    "is_found": "found",
    "agents_within_threshold": "close",
    "is_object_at": "object_at",
    "PaperReward": "social_nav reward",
    "REARRANGE_REWARDS": "rearrange reward paper",
    "Plan": "plan of agent 0",
}
"""Keys of `FORMULAS` that are not the names of what is called."""


def test_every_rule_that_a_device_shares_is_in_the_table() -> None:
    """What `h3data_training` calls of the modules of rules, sensors and planners is compared below."""
    modules = r"tasks\.rules\.\w+|agents\.oracle\.rules|sensing\.sensor|policies\.rearrange"
    shared = rf"^from sim_kinematic\.(?:{modules}) import (.+)$"
    named = set()
    for file in TORCH.parent.rglob("*.py"):
        for names in re.findall(shared, file.read_text(), re.MULTILINE):
            named |= set(re.findall(r"\w+", names))
    called = {name for name in named if not name.isupper() or name in TABLED} - {
        "partner_plan",
        "planner",
    }  # of the host
    assert called >= {"facing", "Plan", "is_there", "in_base_frame"}
    assert {TABLED.get(name, name) for name in called} <= set(FORMULAS)


@pytest.mark.parametrize("name", FORMULAS)
def test_a_formula_is_the_same_for_arrays_and_tensors(name: str) -> None:
    here, there = FORMULAS[name](np, np.asarray), FORMULAS[name](torch, torch.as_tensor)
    for mine, theirs in zip(*(each if isinstance(each, tuple) else (each,) for each in (here, there)), strict=True):
        assert len(np.unique(mine)) > 1
        np.testing.assert_allclose(theirs.numpy(), mine, rtol=0, atol=1e-12)
