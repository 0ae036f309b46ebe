"""Social rearrangement: a robot helps a person to bring objects to their goals, or other agents do so.

The rules follow the paper (section 4.2 and appendix) and habitat-lab (spec/habitat.md 2). There are two layers:
high-level policies (`sim_kinematic.policies.rearrange`) choose skills (`sim_kinematic.agents.skills`), and skills move
bodies.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.errors import InputError
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.roster import AgentSpec, common_floor, kinds_of
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.policies.assignment import AssignedPolicy, PolicyMaker
from sim_kinematic.policies.choosers.recurrent_chooser import RecurrentSkillPolicy
from sim_kinematic.policies.learned import SHIPPED_HELPERS, SHIPPED_PARTNERS, is_learned, naming, stamped
from sim_kinematic.policies.rearrange import (
    PARTNERS,
    ROBOT_POLICIES,
    Chooser,
    Planner,
    learned_chooser,
    partner_plan,
    partner_policy,
    robot_policy,
)
from sim_kinematic.policies.searching import Seeking
from sim_kinematic.sensing.table import SENSES, TABLE, Sensor
from sim_kinematic.tasks.control import Control
from sim_kinematic.tasks.episode import Episode, Starts, StepOutcome
from sim_kinematic.tasks.rearrange.codec import RearrangeCodec
from sim_kinematic.tasks.rearrange.episode import (
    ORACLE_RULES,
    RearrangeEpisode,
    RearrangeSpec,
    draw_episode,
    pair_of,
    rules_in,
    starts_of,
)
from sim_kinematic.tasks.rules.rewards import REARRANGE_REWARDS
from sim_kinematic.tasks.skills.control import SkillControl
from sim_kinematic.tasks.task import Task, TaskUsage


def check_level(level: Any) -> None:
    """Raise an `InputError` if ``level`` is not a level of actions of environments."""
    if level not in ("high", "low"):
        raise InputError(f"Unknown level {level!r}. Expected one of: high, low.", code="H3-ENV-025")


class Rearrange(Task):
    """Task of bringing objects to their goals (paper section 4.2)."""

    name: ClassVar[str] = "rearrange"
    Spec: ClassVar[type[Any]] = RearrangeSpec
    usage: ClassVar[TaskUsage] = TaskUsage(
        crosses_partners=True,
        can_be_solo=True,
        env_options={"level": check_level, "interrupts_when_close": bool},
        env_partners={"human": "plan_pop_4"},
        device_rules=ORACLE_RULES,
    )
    control: ClassVar[Control] = SkillControl()
    columns: ClassVar[Mapping[str, Any]] = {"metrics.at_goal": np.bool_}
    # those of parts are of width 0 where the rules have no parts, and left out there
    sensors: ClassVar[Mapping[str, Sensor]] = {n: s for n, s in TABLE.items() if n in SENSES or s.times == "parts"}
    policies: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "robot": {**ROBOT_POLICIES, **SHIPPED_HELPERS},
        "human": dict.fromkeys((*PARTNERS, *SHIPPED_PARTNERS), partner_policy),
    }
    defaults: ClassVar[Mapping[str, str]] = {"robot": "complement", "human": "both"}

    # --- episodes -----------------------------------------------------------------------------------------------------
    def sample(
        self, scene: Scene, free: FreeSpace, seed: int, spec: RearrangeSpec, roster: tuple[AgentSpec, ...]
    ) -> RearrangeEpisode:
        """Sample an episode for the first robot and the first person of the roster.

        Default bodies replace a missing robot or person, so that objects, goals and the starts of these two do not
        depend on the agents that play the episode.
        """
        self.control.check_roster(roster)
        pair, free = pair_of(roster), common_floor(roster, free)
        spec = rules_in(scene, spec)
        starts, sampled = self.draw(scene, free, seed, spec, load_robot(pair[0]), load_humanoid(pair[1]))
        return RearrangeEpisode(
            scene=scene,
            free=free,
            seed=seed,
            spec=spec,
            roster=roster,
            starts=starts_of(scene, free, seed, spec, starts, roster),
            pair=pair,
            pair_starts=starts,
            **sampled,
        )

    def draw(
        self, scene: Scene, free: FreeSpace, seed: int, spec: Any, robot: Robot, person: Humanoid
    ) -> tuple[Starts, dict[str, Any]]:
        """Sample the starts of a robot and a person, and further fields of the episode."""
        starts, targets = draw_episode(scene, free, seed, spec, robot, person)
        return starts, {"targets": targets}

    def parts_of(self, episode: RearrangeEpisode) -> tuple[int, ...]:
        """Return the joints of the doors and drawers that agents may choose to open by number, ``spec.parts`` of them.

        The joints follow from the episode. Oracle skills, and therefore worlds on a device, open no others.
        """
        return ()

    # --- rules --------------------------------------------------------------------------------------------------------
    def begin(self, play: Any, rows: NDArray[np.intp]) -> Mapping[str, Any] | None:
        """Reset the sub-goals that have been rewarded: that each object was taken, and that it came to its goal."""
        play.memory = np.zeros((1, 2 * play.world.state.held_by.shape[1]), np.bool_)

    def judge(self, play: Any) -> StepOutcome:
        """Reward sub-goals that are reached for the first time; end with all objects at their goals, or by contact."""
        worth = REARRANGE_REWARDS[play.spec.reward]
        # nothing has changed since a step without any of this, as in ninety-nine steps of a hundred
        if play.team.is_quiet and play.outcome.columns and play.outcome.reward.item(0) == worth.slack:
            return play.outcome
        held, at_goal, collides = (
            play.world.state.held_by != NOBODY,
            play.team.at_goal[None],
            np.logical_or.reduce(play.world.touching, axis=1),
        )
        reward, play.memory, done = worth.step(held, at_goal, play.memory, collides.astype(np.float64))
        success = bool(done[0])
        return StepOutcome(
            reward=reward,
            terminated=done | (collides & play.spec.end_on_collision),
            success=done,
            columns={"metrics.at_goal": at_goal},
            ended="success" if success else "collision",
            events=play.events_where(done, "success") if success else [],
        )

    @property
    def codec(self) -> RearrangeCodec:
        """Codec of episodes with objects and goals, in our files and Habitat's."""
        return RearrangeCodec(self)

    def named_policy(self, kind: str, name: str, spec: Any) -> PolicyMaker | None:
        """Return the maker of a learned or planning policy, which uses the agent's own seed; None for other names."""
        if is_learned(name):
            # only for its check: it raises if the network does not fit
            if spec is not None:
                learned_chooser(name, Rearrange.name, spec.objects, robot=kind == "robot")
        elif name not in ROBOT_POLICIES and name not in PARTNERS:
            return None
        return partial(_made_policy, name)


def _made_policy(name: str, episode: Episode, number: int) -> AssignedPolicy:
    assert isinstance(episode, RearrangeEpisode)
    kinds, objects = kinds_of(episode.roster), len(episode.targets)
    kind, is_robot = kinds[number], kinds[number] == "robot"
    nth = kinds[:number].count(kind)
    # the first of each kind draws by the episode's own seed, as where it plays in a pair
    seed = episode.seed if not nth else episode_seed(episode.seed, nth)
    if is_learned(name):
        policy = learned_chooser(name, Rearrange.name, objects, robot=is_robot)
        plan = "" if is_robot else stamped(name)
    # a name that is in both tables means the one of the agent's own kind
    elif name not in ROBOT_POLICIES or (name in PARTNERS and not is_robot):
        policy, plan = partner_policy(name, seed, objects), partner_plan(name, seed)
    else:
        policy, plan = robot_policy(name), ""
    # who stands still looks for nothing
    if episode.spec.observe == "seen" and isinstance(policy, Planner | Chooser) and plan != "still" and name != "still":
        policy = Seeking(policy)
    # it draws skills by their probabilities: the likeliest every time got stuck in loops
    if isinstance(policy, RecurrentSkillPolicy):
        policy.seed = seed
        if is_robot:
            with naming(name):
                policy.require_body(episode.roster[number].model)
    return AssignedPolicy(policy, stamped(name), kind, plan)
