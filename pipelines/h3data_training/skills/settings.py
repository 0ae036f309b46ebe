"""Settings of a training run of a skill, and recipes, which are named settings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from h3data.bodies import load_robot
from h3data.errors import InputError
from h3data_training.settings import Settings
from sim_kinematic.motion.spec import SkillSpec
from sim_kinematic.policies.visual_policy import BASE_ACTIONS
from sim_kinematic.sensing.table import OF_SKILLS
from sim_kinematic.tasks.skills.skill_starts import SKILL_NAMES, Skill

OF_THE_BASE = ("target_gps_compass", "way", "range_scan", "egomotion")
OF_THE_ARM = (*OF_THE_BASE, "target_sensor", "resting_sensor", "arm_joints", "is_holding")
GRIPS: dict[Skill, float] = {"pick": 2.0, "place": 1.6}
"""Command of the hand around which an actor explores at first. A hand that opens at random never experiences the steps
that follow. With 1, robots learned not to take anything, because they dropped it again.
"""
UNTAUGHT_GRIP = 1.0
"""Command of the hand around which the skill place explores without a teacher. With 1.6, noise of 0.4 would open the
hand once in 30,000 decisions, so that nothing would be placed.
"""
UNUSED = ("human", "walk", "follow_steps", "near_m", "critic_updates", "light")
"""Settings of social navigation that have no meaning for skills."""


def check_skill(skill: str) -> Skill:
    """Return the name of a skill after checking that it exists.

    Raises:
        InputError: There is no such skill.
    """
    if skill not in SKILL_NAMES:
        raise InputError(f"Unknown skill {skill!r}. Expected one of: {', '.join(SKILL_NAMES)}.", code="H3-SIM-022")
    return skill  # type: ignore[return-value]


@dataclass(frozen=True, kw_only=True)
class SkillSettings(Settings):
    """Settings of a run of one skill, in which no other agent is present."""

    skill: Skill = "nav"
    episodes_per_home: int = 3
    """Number of rearrangement episodes per home; each has several objects and goals as targets."""
    starts: int = 32
    """Number of starts of the robot in each episode."""
    path_m: tuple[float, float] = (0.0, 1000.0)
    """Smallest and largest length of the path to the target at the start [m]. With paths shorter than in the
    evaluation, a robot learns the end of the skill first.
    """
    near_share: float = 0.0
    """Share of starts within a metre of the place from which the target is reached. From other starts a robot seldom
    experiences the end of the skill.
    """
    reaching_share: float = 0.0
    """Share of starts at the place from which the target is reached, with the arm between rest and the target. With
    such starts, a robot without a teacher experiences the end of the skill first.
    """
    demonstrations: float = 0.0
    """Share of worlds in which the teacher acts as long as it has a weight. The policy imitates the teacher there too,
    and so observes states that it would not reach by itself.
    """
    limit: int = 300
    """Number of steps after which an episode is cut short, as if it had reached its time limit, because little is
    learned from a robot that is stuck.
    """
    observations: tuple[str, ...] = OF_THE_BASE
    near_m: float = 0.0

    def __post_init__(self) -> None:
        check_skill(self.skill)
        super().__post_init__()
        if self.network != "cnn_gru":
            raise InputError(f"Skills have the network cnn_gru, not {self.network!r}.", code="H3-TRAIN-055")
        for name in ("near_share", "reaching_share", "demonstrations"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(
                    f"Expected {name} from 0 to less than 1, got {getattr(self, name)}.", code="H3-TRAIN-056"
                )
        if min(self.starts, self.limit) < 1 or not 0 <= self.path_m[0] < self.path_m[1]:
            raise InputError(
                f"Expected starts and limit of at least 1 and path_m ascending, "
                f"got {self.starts}, {self.limit}, {self.path_m}.",
                code="H3-TRAIN-057",
            )

    @property
    def task(self) -> str:
        """Name of the task in the policy file."""
        return f"skill_{self.skill}"

    @property
    def pictures(self) -> tuple[str, ...]:
        """Names of the pictures that the policy observes, which is the depth of the arm's camera."""
        return ("arm_depth",)

    @property
    def vector_observations(self) -> tuple[str, ...]:
        """Names of the other observations of the policy."""
        return OF_SKILLS

    @property
    def critic(self) -> tuple[str, ...]:
        """Names of the observations of the critic."""
        return OF_THE_BASE if self.skill == "nav" else OF_THE_ARM

    @property
    def first_action(self) -> tuple[float, ...]:
        """Action before the first decision of an episode: no motion, and the initial grip of the skill."""
        still = (0.0,) * BASE_ACTIONS
        return (
            still
            if self.skill == "nav"
            else (*still, *(0.0 for _ in load_robot(self.robot).require_arm()), self._first_grip)
        )

    @property
    def _first_grip(self) -> float:
        return UNTAUGHT_GRIP if self.skill == "place" and not self.teacher else GRIPS[self.skill]

    def second_stage(self) -> SkillSettings:
        """Return the settings of the second stage without the teacher, which a trained actor does not need.

        Episodes are as long as in play. In most of those that a trained robot fails, it drives to and fro until its time
        is over, and it can only learn to leave such a loop if it is in one.
        """
        rules = SkillSpec()
        steps = rules.nav_steps if self.skill == "nav" else rules.arm_steps
        return replace(super().second_stage(), teacher=0.0, limit=steps)  # type: ignore[return-value]

    def as_dict(self) -> dict[str, Any]:
        """Return the settings by name, without those that skills do not use."""
        return {name: value for name, value in super().as_dict().items() if name not in UNUSED}


_TINY = SkillSettings(
    picture_size=(32, 24),
    worlds=512,
    rollout=16,
    hidden=48,
    act_width=64,
    critic_width=128,
    channels=(8, 16, 16),
    features=32,
    rate=1.5e-3,
    warmup_updates=5,
    epochs=6,
    entropy=0.0,
    std=0.4,
    auxiliary=0.0,
    horizon=(100.0, 300.0),
    teacher=3.0,
    minutes=10.0,
)
_ARM = replace(_TINY, skill="pick", observations=OF_THE_ARM, path_m=(0.0, 5.0), near_share=0.5)
_FAST = SkillSettings(
    episodes_per_home=8,
    starts=24,
    limit=600,
    observations=("arm_depth", "target_gps_compass"),
    std=0.4,
    entropy=0.0,
    horizon=(100.0, 300.0),
    teacher=3.0,
    minutes=6.0,
)
_FAST_ARM = replace(
    _FAST,
    skill="pick",
    observations=("arm_depth", "target_sensor", "resting_sensor", "arm_joints", "is_holding"),
    path_m=(0.0, 5.0),
    near_share=0.5,
    limit=300,
)
RECIPES: dict[str, dict[Skill, SkillSettings]] = {
    "fast": {
        "nav": _FAST,
        "pick": _FAST_ARM,
        # without demonstrations, it never saw what comes after letting go before the teacher was gone
        "place": replace(_FAST_ARM, skill="place", demonstrations=0.25, minibatches=16),
    },
    "tiny": {"nav": _TINY, "pick": _ARM, "place": replace(_ARM, skill="place")},
}
"""Recipes by name. ``fast`` takes minutes on one GPU, with pictures of 64 x 48 pixels and the observations of the
paper's robot; only critic and teacher observe the map. ``tiny`` uses one CPU core and no pictures; the robot observes
its target and the start of the path to it.
"""


def skill_recipe(name: str, skill: str, **changes: Any) -> SkillSettings:
    """Return a recipe for a skill with some settings changed; None leaves a setting unchanged.

    Raises:
        InputError: there is no such recipe or skill, or a value is out of range.
    """
    if name not in RECIPES:
        raise InputError(
            f"Unknown recipe {name!r} of skills. Expected one of: {', '.join(RECIPES)}.", code="H3-TRAIN-054"
        )
    assert set(RECIPES[name]) == set(SKILL_NAMES)
    return replace(RECIPES[name][check_skill(skill)], **{k: v for k, v in changes.items() if v is not None})
