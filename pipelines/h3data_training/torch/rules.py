"""Rules of tasks that a device supports; other rules are refused by name, so that no rule is silently ignored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

from h3data.errors import InputError
from sim_kinematic.motion.spec import ArmSpec, BaseSpec, OracleSpec, SkillSpec, SocialNavSpec, WalkerSpec
from sim_kinematic.tasks.rearrange.episode import ORACLE_RULES, RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.social_nav import SocialNav

Names = Mapping[type, tuple[str, ...]]


class Held(NamedTuple):
    """Rules of a task that a device supports."""

    like: Any
    """Rules that a device supports; other rules may differ from them only in the fields `ported` and `drawn`."""
    ported: Names
    """Fields of each spec that a device reads, including those of specs within it."""
    drawn: Names
    """Fields that are used on the CPU, where episodes are sampled, or by agents that no device supports."""


_BASE = (
    "max_speed_mps",
    "max_turn_rad_s",
    "max_lateral_mps",
    "allow_back",
    "disc_offsets_m",
    "disc_radius_m",
    "slide_iterations",
    "clearance_tolerance_m",
    "contact_tolerance_m",
    "keeps_speed",
)
_WALKER = ("speed_mps", "turn_rad_s", "turn_before_walk_rad", "arrive_m", "blend_s")
_SCRIPTED = ("maneuvers",)
"""Rules that matter only for scripted robots, which a device does not have."""
_SAMPLED = ("spawn_distance_m", "agent_radius_m", "agent_height_m")
HELD: Mapping[str, Held] = {
    SocialNav.name: Held(
        SocialNavSpec(),
        {
            SocialNavSpec: (
                "max_steps",
                "near_m",
                "far_m",
                "facing_dot",
                "end_on_collision",
                "robot",
                "human",
                "person_contact",
            ),
            BaseSpec: _BASE,
            WalkerSpec: _WALKER,
        },
        # arms always swing here (h3data docs gpu); with strides, people are where the bank says after each step
        {SocialNavSpec: _SAMPLED, BaseSpec: _SCRIPTED, WalkerSpec: ("clearance_m", "arms", "stride")},
    ),
    Rearrange.name: Held(
        ORACLE_RULES,
        {
            RearrangeSpec: (
                "max_steps",
                "objects",
                "at_goal_m",
                "near_m",
                "end_on_collision",
                "reward",
                "robot",
                "human",
                "oracle",
                "parts",
            ),
            BaseSpec: _BASE,
            WalkerSpec: _WALKER,
            OracleSpec: ("robot_steps", "person_steps", "reach_m", "reach_rad", "person_radius_m"),
        },
        # oracle skills open nothing, take things without a grip and walk along tables of paths; agents touch where discs do
        {
            RearrangeSpec: (*_SAMPLED, "carry_m", "open_m", "object_radius_m", "floor_moves", "grip_m"),
            BaseSpec: _SCRIPTED,
            WalkerSpec: ("clearance_m", "arms"),
        },
    ),
    "base of a skill": Held(BaseSpec(), {BaseSpec: _BASE}, {BaseSpec: _SCRIPTED}),
    "skill": Held(
        SkillSpec(),
        {
            SkillSpec: (
                "nav_steps",
                "arm_steps",
                "near_m",
                "facing_dot",
                "rest_m",
                "place_m",
                "slack",
                "contact",
                "facing",
                "facing_within_m",
                "nav_success",
                "pick_success",
                "place_success",
                "placed",
                "lost",
            )
        },
        {SkillSpec: ("nav_start_m", "arm_start_m", "arm_most_m")},
    ),
    "arm of a skill": Held(ArmSpec(), {ArmSpec: ("joint_step", "grasp_m")}, {}),
}
"""Supported rules, by task and by part of a learned skill."""
_WORLD = ("solid_agents", "floor_moves")
"""Rules that the CPU's world reads of the spec of any task."""


def _held(rules: Any) -> Held:
    """Return the rules for a user's task.

    The task's own functions read its rules; those that move agents are as in the built-in tasks.
    """
    if isinstance(rules, RearrangeSpec):
        return _held_with_things(rules)
    task, like = type(rules), HELD[SocialNav.name]
    ported = tuple(f.name for f in fields(rules) if f.name not in (*_SAMPLED, *_WORLD))
    usual = replace(
        rules, robot=like.like.robot, human=like.like.human, **{n: False for n in _WORLD if hasattr(rules, n)}
    )
    return Held(usual, {**like.ported, task: ported}, {**like.drawn, task: _SAMPLED})


def _held_with_things(rules: RearrangeSpec) -> Held:
    like, task, shared = HELD[Rearrange.name], type(rules), [f.name for f in fields(RearrangeSpec)]
    usual = replace(rules, **{name: getattr(like.like, name) for name in shared})
    own = tuple(f.name for f in fields(rules) if f.name not in shared)
    ported = {**like.ported, task: (*like.ported[RearrangeSpec], *own)}
    return Held(usual, ported, {**like.drawn, task: like.drawn[RearrangeSpec]})


def refuse_others(task: str, rules: Any) -> None:
    """Raise an error for rules that a device does not support; for custom tasks, check only those of the base class.

    Raises:
        InputError: a field that a device does not read differs from its value in `Held.like`.
    """
    held = HELD.get(task) or _held(rules)
    _refuse(held, rules, held.like)


def _refuse(held: Held, rules: Any, like: Any) -> None:
    spec = type(rules)
    for name in (f.name for f in fields(rules)):
        value, usual = getattr(rules, name), getattr(like, name)
        if name in held.ported.get(spec, ()):
            if is_dataclass(value) and type(value) is type(usual):
                _refuse(held, value, usual)
        elif name not in held.drawn.get(spec, ()) and value != usual:
            raise InputError(
                f"On a device, {name} of {spec.__name__} is {usual!r}, not {value!r}. Hint: change it, or leave out device.",
                code="H3-ENV-034",
            )
