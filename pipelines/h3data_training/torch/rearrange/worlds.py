"""Social rearrangement in W worlds on a device, under the rules of `sim_kinematic.motion.spec.OracleSpec`.

State, choices and results stay on the device, and no operation waits for it, so that on a GPU a whole step, including
new episodes, is one CUDA graph. The same episodes with the same choices equal those of
`sim_kinematic.tasks.skills.household` on the CPU (tests/training/torch/test_rearrange.py): positions are equal within
1e-9 m in float64, and everything else is equal exactly.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from h3data_training.torch.rearrange.bank import RearrangeBank
from h3data_training.torch.rearrange.rollout import SkillTensorRollout
from h3data_training.torch.rearrange.skills import (
    Choices,
    begin,
    handle,
    interrupted,
    move_people,
    move_robots,
    of_object,
    one_of,
)
from h3data_training.torch.rearrange.state import DONE, FAILED, FREE, NOBODY, Hands, Play, SubGoal
from h3data_training.torch.rearrange.tables import Places, Tables
from h3data_training.torch.state import HumanTensors, RobotTensors, choose
from h3data_training.torch.step import Grids, heading_direction
from h3data_training.torch.task_worlds import in_words, on_meta, require_tensors, typed
from sim_kinematic.agents.robots.hand_reach import reach_bearing
from sim_kinematic.avoidance.robot_base import base_of
from sim_kinematic.motion.spec import OracleSpec
from sim_kinematic.policies.rearrange import Plan
from sim_kinematic.sensing.sensor import agents_within_threshold
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.rules.predicates import is_object_at
from sim_kinematic.tasks.rules.rewards import REARRANGE_REWARDS
from sim_kinematic.tasks.skills.household import TRACK


class RearrangeTensors:
    """W worlds, each in an episode of a bank, which start the following episode in the step after the end of one."""

    def __init__(
        self,
        bank: RearrangeBank,
        *,
        task: Rearrange | None = None,
        device: torch.device | str,
        dtype: torch.dtype | None = None,
        planners: Collection[str] = ("human",),
        partner: str = "plan_pop_4",
        interrupts: Literal["close", "always", "never"] = "close",
        repeats: bool = True,
    ) -> None:
        """Copy a bank of episodes to the device.

        Args:
            bank: the episodes.
            task: the task that made them, whose `begin` and `judge` are called with tensors; by default rearrangement.
            device: device of all tensors.
            dtype: type of the state: by default float64 on the CPU, else float32.
            planners: agents (``robot``, ``human``) that follow plans; the others are controlled from outside.
            partner: planner whose plans these agents follow (`sim_kinematic.policies.rearrange.PARTNERS`).
            interrupts: when agents controlled from outside may choose again before their skill has ended: while the other agent
                is ``close``, as in the environments, ``always`` or ``never``.
            repeats: whether another episode starts when one is over; otherwise the world does not change.
        """
        self.device = torch.device(device)
        self.dtype = dtype or (torch.float64 if self.device.type == "cpu" else torch.float32)
        self.task = task or Rearrange()
        self._is_usual = type(self.task).judge is Rearrange.judge
        self.bank, self.spec, self.planners = bank, bank.spec, frozenset(planners)
        self.interrupts, self._repeats = interrupts, repeats
        self.oracle = bank.spec.oracle or OracleSpec()
        self.tables = Tables.of(bank, self.device, self.dtype)
        self._grids = Grids.of(bank.floors, self.device, self.dtype)
        self._base, self._bearing = base_of(bank.robot, bank.spec.robot), reach_bearing(bank.robot)
        self.choices = {
            kind: Choices.of(body, bank.objects, self.oracle, self.device, self.dtype, bank.spec.parts)
            for kind, body in (("robot", bank.robot), ("human", bank.human))
        }
        """Choices of each agent."""
        self.orders = torch.as_tensor(bank.orders(partner), device=self.device)
        """Plan of each episode of the bank, [N, K]."""

    def before_the_first(self, episode: Tensor) -> Play:
        """Return worlds whose first step starts the episodes after ``episode`` [W]."""
        blank = Play.before_the_first(episode.to(self.device), self.bank.objects, self.dtype, self.spec.parts)
        return blank._replace(memory={name: torch.zeros_like(t) for name, t in self._remembered(blank).items()})

    # --- a step -------------------------------------------------------------------------------------------------------
    def step(self, play: Play, robot: Tensor, human: Tensor) -> Play:
        """Advance all worlds by a step with the choices ``robot`` and ``human``, int64 [W], and return the new state.

        Worlds whose episode had ended are at the start of their next one. Choices of planners and of busy agents have
        no effect; -1 continues the current skill, or waits.
        """
        if not self._repeats:
            return self._kept(play, robot, human)
        return self._begun(play, self._moved(play, robot, human), play.ended)

    def start_at(self, episode: Tensor, starts: Tensor) -> Play:
        """Return worlds at the start of episodes [W], with both agents at ``(x, z, heading)`` [W, 2, 3]."""
        return self._at_start(episode, starts)

    def start(self, play: Play) -> Play:
        """Move worlds that have ended to the start of their next episode."""
        return self._begun(play, play, play.ended)

    def _kept(self, play: Play, robot: Tensor, human: Tensor) -> Play:
        over, after = play.ended, self._moved(play, robot, human)
        nothing = torch.zeros_like(after.reward)
        kept = [choose(over, a, b) for a, b in zip(play.tensors(), after.tensors(), strict=True)]
        stays = packed(play, kept)
        return stays._replace(
            reward=torch.where(over, nothing, after.reward),
            terminated=after.terminated & ~over,
            truncated=after.truncated & ~over,
        )

    def _moved(self, play: Play, robot_choice: Tensor, human_choice: Tensor) -> Play:
        """Return the state of unfinished worlds after a step: people first, then robots, as on the CPU."""
        places = self.tables.at(play.episode)
        hands = play.hands
        before = self._poses(play.robot, play.human)
        floor_y = self.tables.floor_y[places.place]
        human, does, hands = self._human(play, human_choice, places, hands, floor_y)
        robot, robot_does, hands = self._robot(play, human, robot_choice, places, hands, floor_y)
        steps = play.steps + 1
        now = torch.stack([robot.xz, human.xz], 1)
        row = one_of(steps % TRACK, TRACK)
        play = play._replace(
            robot=robot,
            human=human,
            robot_does=robot_does,
            human_does=does,
            objects=hands.objects,
            held_by=hands.held_by,
            moved=hands.moved,
            placed_by=hands.placed_by,
            opened=hands.opened,
            steps=steps,
            before=before,
            track=torch.where(row[..., None, None], now[:, None], play.track),
        )
        return self._judged(play, places)

    def _human(
        self, play: Play, choice: Tensor, places: Places, hands: Hands, floor_y: Tensor
    ) -> tuple[HumanTensors, SubGoal, Hands]:
        person, choices, does = play.human, self.choices["human"], play.human_does
        close = self.close(person.xz, person.heading, play.robot.xz)
        does, choice = self._chosen("human", choices, does, choice, close, hands, places)
        turn = begin(choices, does, choice, places, person.xz, person.heading, 0.0, hands, self.oracle)
        person, does = move_people(turn, person, places, self.spec.human)
        root = torch.stack([person.xz[:, 0], floor_y, person.xz[:, 1]], -1)
        does, hands = handle(choices, turn.kind, does, hands, turn.spot, root, person.heading)
        return person, does, hands

    def _robot(
        self, play: Play, human: HumanTensors, choice: Tensor, places: Places, hands: Hands, floor_y: Tensor
    ) -> tuple[RobotTensors, SubGoal, Hands]:
        robot, choices, does = play.robot, self.choices["robot"], play.robot_does
        close = self.close(robot.xz, robot.heading, human.xz)
        does, choice = self._chosen("robot", choices, does, choice, close, hands, places)
        turn = begin(choices, does, choice, places, robot.xz, robot.heading, self._bearing, hands, self.oracle)
        robot, does = move_robots(choices, turn, robot, places, self._grids.at(places.place), self._base, self._bearing)
        root = torch.stack([robot.xz[:, 0], floor_y, robot.xz[:, 1]], -1)
        does, hands = handle(choices, turn.kind, does, hands, turn.spot, root, robot.heading)
        return robot, does, hands

    def _chosen(
        self, agent: str, choices: Choices, does: SubGoal, choice: Tensor, close: Tensor, hands: Hands, places: Places
    ) -> tuple[SubGoal, Tensor]:
        """Return an agent's turn after interruptions, with a new choice if it is free."""
        if agent in self.planners:
            return self._planned(choices, does, hands, self.at_goal(hands, places))
        choice = choice.clamp(FREE, len(choices) - 1)
        if self.interrupts != "never":
            does = interrupted(does, choice, close if self.interrupts == "close" else torch.ones_like(close))
        return does, torch.where(choice == FREE, 4 * self.bank.objects, choice)

    def _planned(self, choices: Choices, does: SubGoal, hands: Hands, at_goal: Tensor) -> tuple[SubGoal, Tensor]:
        """Let free planners choose; return their memory, and the number of the sub-goal chosen in each world, int64 [W]."""
        plan, failed = Plan(does.order, does.passed, does.tries), does.outcome == FAILED
        k, plan = plan.next(does.skill == FREE, failed, hands.held_by, at_goal, choices.who, xp=torch)
        came = torch.where(of_object(hands.held_by, k.clamp_min(0)) == choices.who, self.bank.objects + k, k)
        there = (does.outcome == DONE) & (does.last == came)
        number = torch.where(there, came + 2 * self.bank.objects, came)
        waits = 4 * self.bank.objects
        return does._replace(passed=plan.passed, tries=plan.tries), torch.where(k < 0, waits, number)

    def _judged(self, play: Play, places: Places) -> Play:
        """Return the state with the reward of the step."""
        spec, collides, hands = self.spec, self.touching(play.robot, play.human), play.hands
        if not self._is_usual:
            return self._judged_by_task(play._replace(collides=collides))
        held, at_goal, worth = play.held_by != NOBODY, self.at_goal(hands, places), REARRANGE_REWARDS[spec.reward]
        reward, paid, success = worth.step(held, at_goal, play.paid, collides.to(self.dtype), xp=torch)
        terminated = success | collides if spec.end_on_collision else success
        return self._ended(play._replace(paid=paid, success=success, collides=collides), reward, terminated)

    def _judged_by_task(self, play: Play) -> Play:
        """Return the state with the task's judgement of the step."""
        rollout = self._rollout(play, dict(play.memory))
        outcome: Any = self.task.judge(rollout)
        memory = {name: typed(rollout.memory[name], self.dtype) for name in play.memory}
        reward = typed(outcome.reward, self.dtype)
        return self._ended(play._replace(memory=memory, success=outcome.success), reward, outcome.terminated)

    def _rollout(self, play: Play, memory: Any) -> Any:
        return SkillTensorRollout(self.spec, play, self.at_goal(play.hands, self.tables.at(play.episode)), memory)

    def _ended(self, play: Play, reward: Tensor, terminated: Tensor) -> Play:
        truncated = ~terminated & (play.steps >= self.spec.max_steps)
        ends = terminated | truncated
        return play._replace(reward=reward, terminated=terminated, truncated=truncated, ended=ends)

    def _remembered(self, play: Play) -> dict[str, Tensor]:
        """Return the memory of a task that is not the built-in one if all worlds began in their present state."""
        if self._is_usual:
            return {}
        rows: Any = torch.arange(len(play.steps), device=self.device)
        begun: Any = self.task.begin(self._rollout(play, None), rows)
        return {name: typed(values, self.dtype) for name, values in (begun or {}).items()}

    def _begun(self, before: Play, after: Play, fresh: Tensor) -> Play:
        """Return the worlds that are ``fresh`` [W] at the start of their next episode, and the others as ``after``."""
        number = (before.episode + 1) % len(self.bank)
        start = self._at_start(number, self.tables.starts[number])
        kept = [choose(fresh, a, b) for a, b in zip(start.tensors(), after.tensors(), strict=True)]
        return packed(start, kept)

    def _at_start(self, episode: Tensor, starts: Tensor) -> Play:
        fresh = Play.before_the_first(episode, self.bank.objects, self.dtype, self.spec.parts)
        objects = self.tables.spots[episode, : self.bank.objects]
        (rx, rz, rh), (hx, hz, hh) = starts[:, 0].unbind(-1), starts[:, 1].unbind(-1)
        robot = fresh.robot._replace(xz=torch.stack([rx, rz], -1), heading=rh)
        human = fresh.human._replace(xz=torch.stack([hx, hz], -1), heading=hh)
        order = self.orders[episode]
        begun = fresh._replace(
            robot=robot,
            human=human,
            objects=objects,
            before=starts,
            ended=torch.zeros_like(fresh.ended),
            robot_does=fresh.robot_does._replace(order=order),
            human_does=fresh.human_does._replace(order=order),
            track=torch.stack([robot.xz, human.xz], 1)[:, None].expand(-1, TRACK, -1, -1),
        )
        return begun._replace(memory=self._remembered(begun))

    def check_functions(self, worlds: int = 2) -> None:
        """Call `Task.begin` and `Task.judge` of a custom task with tensors without data.

        Raises:
            InputError: one of them waits for the device, or needs NumPy or features that no device has; the message
                names it.
        """
        if self._is_usual:
            return
        sim, who = on_meta(copy.copy(self)), self.task.name
        sim.device = torch.device("meta")
        number = torch.zeros(worlds, dtype=torch.int64, device="meta")
        blank = Play.before_the_first(number, self.bank.objects, self.dtype, self.spec.parts)
        with in_words(f"{who}: the function begin"):
            rollout: Any = sim._rollout(blank, None)
            begun: Any = self.task.begin(rollout, number)  # type: ignore[arg-type]
            if begun is None and rollout.memory is not None:
                raise TypeError("it sets play.memory, and must return it: arrays [W, ...] by name")
            require_tensors(begun or {}, worlds)
        with in_words(f"{who}: the function judge"):
            rollout = sim._rollout(blank, dict(begun or {}))
            outcome: Any = self.task.judge(rollout)
            flags = {name: getattr(outcome, name) for name in ("reward", "terminated", "success")}
            require_tensors({**flags, **rollout.memory}, worlds)
            if strange := set(rollout.memory) ^ set(begun or {}):
                raise TypeError(f"begin and judge must remember the same; {', '.join(sorted(strange))} differ")

    # --- what holds now -----------------------------------------------------------------------------------------------
    def at_goal(self, hands: Hands, places: Places) -> Tensor:
        """Return whether objects are at their goals and not held, bool [W, K]."""
        goals, within_m = self.tables.goals(places.episode), self.spec.at_goal_m
        return (hands.held_by == NOBODY) & is_object_at(hands.objects, goals, distance_m=within_m, xp=torch)

    def close(self, xz: Tensor, heading: Tensor, other: Tensor) -> Tensor:
        """Return whether other agents [W, 2] are in the ellipse in which skills may be interrupted, bool [W]."""
        ahead_m, aside_m = self.spec.near_m
        return agents_within_threshold(xz, heading, other, ahead_m=ahead_m, aside_m=aside_m, xp=torch)  # type: ignore[arg-type]

    def touching(self, robot: RobotTensors, human: HumanTensors) -> Tensor:
        """Return whether the discs of robot and person overlap, bool [W]."""
        ahead = heading_direction(robot.heading)
        discs = torch.stack([torch.add(robot.xz, ahead, alpha=offset) for offset in self._base.disc_offsets_m])
        gap = discs - human.xz
        reach = self._base.disc_radius_m + self.oracle.person_radius_m
        return (torch.hypot(gap[..., 0], gap[..., 1]) < reach).any(0)

    @staticmethod
    def _poses(robot: RobotTensors, human: HumanTensors) -> Tensor:
        """Return ``(x, z, heading)`` of both, [W, 2, 3]."""
        return torch.stack([torch.cat([own.xz, own.heading[:, None]], 1) for own in (robot, human)], 1)


def packed(like: Play, tensors: list[Tensor]) -> Play:
    """Return a state that consists of given tensors, in the order of `Play.tensors`."""
    parts, left = [], list(tensors)
    for part in like:
        count = len(part) if isinstance(part, tuple | Mapping) else 1
        taken, left = left[:count], left[count:]
        if isinstance(part, Mapping):
            parts.append(dict(zip(part, taken, strict=True)))
        else:
            parts.append(type(part)(*taken) if isinstance(part, tuple) else taken[0])
    return Play(*parts)
