"""An episode of rearrangement as it is played: who moves when, what each is asked, what a step is worth.

`RearrangePlay.questions` is a coroutine: it gives whoever has to choose what to do next and takes the answer. `run` lets
policies answer; a training environment lets its caller (`sim_kinematic.rearrange_env`). Both play the same, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.geometry import Array, ground_pose
from h3data.recording import Event, SkillSpan
from sim_kinematic.avoidance import AVOIDANCE
from sim_kinematic.collision import AgentContacts
from sim_kinematic.person import Frame, Person
from sim_kinematic.person_skills import PersonActor
from sim_kinematic.planners import HighLevelPolicy, TaskView
from sim_kinematic.posing import body_shapes, shape_frames
from sim_kinematic.rearrange_episode import RearrangeWorld
from sim_kinematic.rearrange_log import RearrangeLog, Row, body_indices
from sim_kinematic.rewards import REARRANGE_REWARDS
from sim_kinematic.robot_skills import RobotActor
from sim_kinematic.skills import CONTROL, SKILLS, Action, Actor, Ending, Objects, Skill
from sim_kinematic.spec import STEP_S
from sim_kinematic.state import HUMAN, NOBODY, ROBOT, WorldState

TRACK = 31
"""Past positions of the other agent that a policy sees, the present one included."""
VELOCITY_STEPS = 3
"""Over so many steps the robot measures how fast the person walks."""
CONTACT_GATE_M = 2.0
"""Bases farther apart than this on the floor cannot touch, arms stretched out."""
CHOICES = 9
"""So many skills that end at once an agent may choose in one step, then it does nothing."""


@dataclass(eq=False)
class Runner:
    """One agent: what it is doing, and what comes next."""

    number: int
    """`ROBOT` or `HUMAN`."""
    index: int
    """In the recording."""
    actor: Actor
    policy: HighLevelPolicy
    log: RearrangeLog | None
    names: tuple[str, ...]
    action: Action = field(default_factory=lambda: Action("wait"))
    ending: Ending | None = None
    skill: Skill | None = None
    begun: int = 0

    @property
    def is_free(self) -> bool:
        """Whether it will have to choose in its next step."""
        return self.skill is None or self.action.skill == CONTROL

    def act(self, step: int, view: Callable[[Runner], TaskView]) -> Generator[Runner, Action, None]:
        """One step: go on, or choose until something takes time; every ``yield`` asks what to do next.

        Who is interrupted and chooses the same again goes on with it.
        """
        chosen: Action | None = None
        if self.skill is not None and (reason := self.policy.interrupts(view(self))):
            self.ending = Ending("aborted", reason)
            chosen = yield self
            if chosen == self.action:
                self.ending = chosen = None
            else:
                self._end(step - 1, self.ending)
        for _ in range(CHOICES):
            if self.skill is None:
                if chosen is None:
                    chosen = yield self
                self.action, self.begun, chosen = chosen, step, None
                why = self.actor.infeasible(self.action)
                if why:  # a no-op that takes one step, as Habitat's
                    self._end(step, Ending("failed", why))
                    break
                self.skill, self.ending = self.actor.start(self.action), None
            try:
                next(self.skill)
                return
            except StopIteration as end:
                self._end(max(step - 1, self.begun), end.value)
        self.actor.idle()

    def _end(self, step: int, ending: Ending) -> None:
        self.skill, self.ending = None, ending
        self.write(step, ending.outcome, ending.reason)

    def write(self, step: int, outcome: str, reason: str) -> None:
        """Log what it has been doing up to ``step``."""
        if self.log is not None:
            target = self.names[self.action.target] if self.action.target >= 0 else ""
            self.log.skill(
                SkillSpan(
                    agent=self.index, name=self.action.skill, target=target, start_step=self.begun, end_step=step,
                    outcome=outcome, reason=reason,  # type: ignore[arg-type]
                )
            )  # fmt: skip


@dataclass(eq=False)
class RearrangePlay:
    """The changing half of an episode."""

    world: RearrangeWorld
    robot_policy: HighLevelPolicy | None
    person_policy: HighLevelPolicy
    log: RearrangeLog | None = None
    step: int = 0
    """The step that is being played, from 0."""
    steps: int = 0
    """How many are over."""
    reward: float = 0.0
    """Of the last step."""
    collision: bool = False
    tracks: dict[int, list[NDArray]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        world, spec = self.world, self.world.spec
        names = tuple(t.name for t in world.targets)
        state = WorldState.zeros(1, joints=len(world.robot.rest), objects=len(names))
        robot = state.robots[ROBOT]
        robot.xz[0], robot.heading[0] = world.starts.robot_xz, world.starts.robot_heading
        robot.joints[0] = world.robot.rest
        state.object_pose[0] = [t.start for t in world.targets]
        self.state = state
        self.objects = Objects(names, np.array([t.goal for t in world.targets], np.float64), state)
        base = ground_pose(world.starts.human_xz, world.starts.human_heading, world.free.floor_y)
        objects = dict(zip(names, state.object_pose[0], strict=True))
        self.person = PersonActor(
            Person(world.human, base, objects, spec=spec.human), world.free, spec.human, self.objects
        )
        self.robot = RobotActor(world.robot, world.free, spec.robot, self.objects, spec.grip_m, spec.arm_rad_s)
        self.actors: dict[int, RobotActor | PersonActor] = {HUMAN: self.person}
        policies = {HUMAN: self.person_policy}
        if self.robot_policy is not None:
            self.actors[ROBOT], policies[ROBOT] = self.robot, self.robot_policy
        self.runners = [
            Runner(number, len(self.actors) - 1 - k, actor, policies[number], self.log, names)
            for k, (number, actor) in enumerate(self.actors.items())
        ]
        self.tracks = {number: [actor.xz.copy()] for number, actor in self.actors.items()}
        self.contact = _PosedContact(world.robot, world.human)
        self.starts = state.object_pose[0, :, :3].copy()
        self.bodies = np.append(body_indices(world), -1)
        self.at_goal = self._at_goal()
        self.paid = np.zeros((1, 2 * len(names)), np.bool_)

    def run(self, progress: Callable[[int], object] | None = None) -> str:
        """Play to the end under the policies; returns what ended it. ``progress`` is called with 1 after every step."""
        asked = self.questions(progress)
        try:
            runner = next(asked)
            while True:
                runner = asked.send(runner.policy.choose(self.view(runner)))
        except StopIteration as end:
            return end.value

    def questions(self, progress: Callable[[int], object] | None = None) -> Generator[Runner, Action, str]:
        """Play to the end; ask who has to choose; returns what ended it."""
        spec = self.world.spec
        for self.step in range(spec.max_steps):
            held = self.objects.held_by.copy()
            for runner in self.runners:
                yield from runner.act(self.step, self.view)
                if runner.number == HUMAN:
                    self._show_person()
            for number, actor in self.actors.items():
                self.tracks[number].append(actor.xz.copy())
            self.at_goal = self._at_goal()
            frame = self.person.person.frame()
            self.collision = self.robot_policy is not None and self.contact.touching(self.robot, frame)
            success = bool(self.at_goal.all())
            self.reward = self._reward(success)
            if self.log is not None:
                self.log.add(self._row(frame))
                self._tell(held, success)
            self.steps += 1
            if progress is not None:
                progress(1)
            if success or (self.collision and spec.end_on_collision):
                return self._stop("success" if success else "collision")
        return self._stop("max_steps")

    def _stop(self, ended: str) -> str:
        for runner in self.runners:
            if runner.skill is not None:
                runner.write(self.step, "running", "")
        return ended

    def _show_person(self) -> None:
        """The robot sees where she is and how she moves."""
        track = [*self.tracks[HUMAN][-VELOCITY_STEPS:], self.person.xz.copy()]
        self.robot.person_xz = track[-1]
        self.robot.person_velocity = (track[-1] - track[0]) / (STEP_S * (len(track) - 1))
        long = np.stack(self.tracks[HUMAN][-AVOIDANCE.still_steps :])
        self.robot.person_settled = len(long) == AVOIDANCE.still_steps and float(np.ptp(long, axis=0).max()) < 0.01

    def view(self, runner: Runner) -> TaskView:
        """What an agent knows now."""
        me, other = self.actors[runner.number], self.actors.get(1 - runner.number)
        track = self.tracks.get(1 - runner.number, [np.full(2, np.nan)])
        other_xz = other.xz.copy() if other is not None else track[-1]
        ahead, aside = _seen(me.xz, me.heading, other_xz)
        a, b = self.world.spec.near_m
        return TaskView(
            step=self.step, free=self.world.free, agent=runner.number, xz=me.xz.copy(), heading=me.heading,
            other_xz=other_xz, other_track=np.stack(track[-TRACK:]), close=bool((ahead / a) ** 2 + (aside / b) ** 2 < 1),
            objects=self.objects.poses[:, :3].copy(), goals=self.objects.goals, held_by=self.objects.held_by.copy(),
            at_goal=self._at_goal(), action=runner.action, last=runner.ending,
            starts=self.starts, hand=lambda: me.hand_pose, arm=me.arm,
        )  # fmt: skip

    def _at_goal(self) -> NDArray[np.bool_]:
        """Which objects are at their goals and in nobody's hand, [K]."""
        gap = np.linalg.norm(self.objects.poses[:, :3] - self.objects.goals, axis=1)
        return (gap < self.world.spec.at_goal_m) & (self.objects.held_by == NOBODY)

    def _row(self, frame: Frame) -> Row:
        row: Row = {"object_pose": self.objects.poses.copy()}
        for runner in self.runners:
            at = f"agent_{runner.index}."
            if runner.number == ROBOT:
                row |= {
                    at + "base_pose": self.robot.pose, at + "joint_pos": self.robot.joints.copy(),
                    at + "action": self.robot.command,
                }  # fmt: skip
            else:
                row |= {at + "base_pose": frame.base, at + "root_pose": frame.root, at + "joint_quat": frame.joints}
            row |= {
                at + "grasp_body": self.bodies[self.objects.held(runner.number)],
                at + "skill": SKILLS.index(runner.action.skill),
                at + "skill_target": runner.action.target,
            }
        row["metrics.at_goal"] = self.at_goal.copy()
        if self.robot_policy is not None:
            row["metrics.dist_agents"] = np.hypot(*(self.robot.xz - self.person.xz))
            row["metrics.collision"] = self.collision
            row["metrics.robot_contact"] = self.state.robots[ROBOT].contact[0]
        row["metrics.reward"] = self.reward
        return row

    def _reward(self, success: bool) -> float:
        """Sub-goals are an object picked and an object at its goal."""
        reward = REARRANGE_REWARDS[self.world.spec.reward]
        stages = np.concatenate([self.objects.held_by != NOBODY, self.at_goal])[None]
        return float(reward.step(stages, self.paid, collides=self.collision, success=success)[0])

    def _tell(self, held: NDArray, success: bool) -> None:
        """Events of this step."""
        assert self.log is not None
        index = {runner.number: runner.index for runner in self.runners}
        for k, (was, now) in enumerate(zip(held.tolist(), self.objects.held_by.tolist(), strict=True)):
            name = self.objects.names[k]
            if was != now and was != NOBODY and now == NOBODY:
                where = "at its goal" if self.at_goal[k] else "elsewhere"
                self.log.event(Event(step=self.step, agent=index[was], kind="place", target=name, detail=where))
            elif was != now:
                self.log.event(Event(step=self.step, agent=index[now], kind="pick", target=name))
        if self.collision:
            self.log.event(Event(step=self.step, agent=index[ROBOT], kind="collision", target="human"))
        if success:
            self.log.event(Event(step=self.step, agent=-1, kind="success"))


class _PosedContact:
    """Contact between a robot with a moving arm and a person in any pose, as recorded: in float32."""

    def __init__(self, robot: Robot, human: Humanoid) -> None:
        self._human = human
        self._pair = AgentContacts(body_shapes(robot), body_shapes(human))

    def touching(self, robot: RobotActor, frame: Frame) -> bool:
        if np.hypot(*(robot.pose[[0, 2]] - frame.base[[0, 2]])) > CONTACT_GATE_M:
            return False
        base, joints = _stored(robot.pose), _stored(robot.joints)
        links = robot.robot.link_matrices(base[None], joints[None])[0]
        bones = self._human.joint_matrices_free(_stored(frame.root)[None], _stored(frame.joints)[None])
        self._pair.update(0, shape_frames(robot.robot, links))
        self._pair.update(1, shape_frames(self._human, bones)[0])
        return self._pair.collides()


def _stored(values: Array) -> Array:
    """As float32 gives it back."""
    return values.astype(np.float32).astype(np.float64)


def _seen(xz: NDArray, heading: float, other: NDArray) -> tuple[float, float]:
    """Another place in an agent's frame: ahead and to its right [m]."""
    dx, dz = other - xz
    c, s = np.cos(heading), np.sin(heading)
    return float(c * dx - s * dz), float(s * dx + c * dz)
