"""An episode of a task with skills under way: who moves when, who is asked what, what has happened to things.

What a step is worth and when the episode ends is for the task to say (`sim_kinematic.tasks.task.Task.judge`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.errors import InputError
from h3data.geometry import Array
from h3data.kernels import kernel
from h3data.moved import refuse_renamed
from h3data.recording import STEP_NS, Event, SkillSpan
from h3data.recording.records import JOINTS
from h3data.render.light.sources import LightMode
from h3data.scene import FreeSpace, Scene
from h3data.scene.articulation import AJAR, joint_names
from sim_kinematic.agents.driven.object_room import ObjectRoom, grip_radii
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.giving_way import AnyActor, GivingWay
from sim_kinematic.agents.opening.doorways import DETOUR_M, RoomDoors
from sim_kinematic.agents.opening.openables import ArticulatedParts
from sim_kinematic.agents.oracle.actors import DiscContacts, OraclePerson, OracleRobot
from sim_kinematic.agents.person import Person
from sim_kinematic.agents.person_clearance import reach_room
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.robots.arm_clearance import arm_clearance
from sim_kinematic.agents.robots.skills import RobotActor
from sim_kinematic.agents.roster import common_floor, kinds_of
from sim_kinematic.agents.skills import (
    ALL_SKILLS,
    CONTROL,
    OPENING_SKILLS,
    PRIMITIVES,
    Action,
    Objects,
    Skill,
    SkillResult,
)
from sim_kinematic.agents.stands import nearest_stand
from sim_kinematic.avoidance.right_of_way import RightOfWay
from sim_kinematic.avoidance.robot_base import base_of, floor_of
from sim_kinematic.avoidance.stand_offs import TaskProgress
from sim_kinematic.avoidance.yielding import NO_PATH
from sim_kinematic.motion.state import NOBODY, HumanState
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.policies.rearrange import HighLevelPolicy
from sim_kinematic.policies.rearrange_observations import SENSES, observe
from sim_kinematic.policies.skills.names import skills_of
from sim_kinematic.policies.views import RearrangeView
from sim_kinematic.sensing.agent_pictures import picture_names
from sim_kinematic.tasks.episode import StepOutcome
from sim_kinematic.tasks.play import Columns, check_observations, checked_outcome, contact_columns
from sim_kinematic.tasks.rearrange.episode import PAIR, RearrangeEpisode, body_indices
from sim_kinematic.tasks.rearrange.oracle import errands_of
from sim_kinematic.world import World

if TYPE_CHECKING:
    from sim_kinematic.sensing.eyes import PictureSize
else:
    __getattr__ = refuse_renamed(__name__)

Row = dict[str, Any]
DTYPES: dict[str, type] = {
    "base_pose": np.float32,
    "joint_pos": np.float32,
    "root_pose": np.float32,
    "joint_quat": np.float32,
    "grasp_body": np.int32,
    "action": np.float32,
    "skill": np.int32,
    "skill_target": np.int32,
    "object_pose": np.float32,
    JOINTS: np.float32,
    "metrics.dist_agents": np.float32,
    "metrics.collision": np.bool_,
    "metrics.collision_people": np.bool_,
    "metrics.collision_robots": np.bool_,
    "metrics.robot_contact": np.bool_,
    "metrics.reward": np.float32,
    "metrics.success": np.bool_,
}
"""dtypes of the columns of a step; those of agents without ``agent_<i>.``."""
TRACK = 31
"""Past positions of the other agent that a policy sees, the present one included."""
IDLE_SKILLS = ("wait", CONTROL, *PRIMITIVES)
"""Skills by whose end an agent has completed nothing."""
CHOICES = 9
"""Number of skills ending at once that an agent may choose in one step, after which it does nothing."""


@dataclass(eq=False)
class SkillExecutor:
    """One agent: its running skill, and what comes next."""

    number: int
    """Number of the agent, as in the state and in the recording."""
    actor: AnyActor
    policy: HighLevelPolicy
    spans: list[SkillSpan]
    """Skills that have ended, for the recorder."""
    names: tuple[str, ...]
    joints: tuple[str, ...] = ()
    """Names of doors and drawers."""
    action: Action = field(default_factory=lambda: Action("wait"))
    ending: SkillResult | None = None
    skill: Skill | None = None
    begun: int = 0
    completed: int = 0
    """Skills that it has completed, but for waiting and commands."""
    _driven_since: int = -1
    """First step of the commands that a driven person has followed without a skill in between; -1: they follow none."""

    @property
    def is_free(self) -> bool:
        """Returns whether it will have to choose in its next step."""
        return self.skill is None or self.action.skill == CONTROL

    def act(self, step: int, view: Callable[[int], RearrangeView]) -> Generator[int, Action, None]:
        """One step: go on, or choose until something takes time; every ``yield`` asks what to do next.

        Who is interrupted and chooses the same again goes on with it.
        """
        chosen: Action | None = None
        goes_on = self.skill is not None and self.action.skill != CONTROL  # a command lasts one step: nothing to abort
        if goes_on and (reason := self.interrupts(view)):
            self.ending = SkillResult("aborted", reason)
            chosen = yield self.number
            if chosen == self.action:
                self.ending = chosen = None
            else:
                self._end(step - 1, self.ending)
        for _ in range(CHOICES):
            if self.skill is None:
                if chosen is None:
                    chosen = yield self.number
                if self._driven_since >= 0 and chosen.skill != CONTROL:
                    self._end_drive(step - 1)
                self.action, self.begun, chosen = chosen, step, None
                why = self.actor.infeasible(self.action)
                if why:  # a no-op that takes one step, as Habitat's
                    self._end(step, SkillResult("failed", why))
                    break
                self.skill, self.ending = self.actor.start(self.action), None
            try:
                next(self.skill)
                return
            except StopIteration as end:
                self._end(max(step - 1, self.begun), end.value)
        self.actor.idle()

    def interrupts(self, view: Callable[[int], RearrangeView]) -> str:
        """The policy's reason to abort the running skill, or nothing."""
        interrupts = getattr(self.policy, "interrupts", None)
        return interrupts(view(self.number)) if interrupts is not None else ""

    def _end(self, step: int, ending: SkillResult) -> None:
        if self.skill is not None:
            self.skill.close()  # one that is interrupted folds the arm
        self.skill, self.ending = None, ending
        self.completed += ending is not None and ending.outcome == "done" and self.action.skill not in IDLE_SKILLS
        self.actor.path, self.actor.yields = NO_PATH, True
        if self.action.skill == CONTROL and isinstance(self.actor, DrivenPerson):
            # one span for a whole drive: 30 a second were 8% of the CPU of a step
            self._driven_since = self.begun if self._driven_since < 0 else self._driven_since
        else:
            self.write(step, ending.outcome, ending.reason)

    def _end_drive(self, step: int) -> None:
        self.begun, self._driven_since = self._driven_since, -1
        self.write(step, "done", "")

    def finish(self, step: int, *, completed: bool) -> None:
        """Reports the skill that is still running in the last step.

        If the agent ``completed`` the task, the skill counts as done: the episode ends before the skill itself does.
        """
        if self._driven_since >= 0:
            self._end_drive(step)
        elif self.skill is not None:
            self.write(step, "done" if completed else "running", "")
        self.skill = None

    def write(self, step: int, outcome: str, reason: str) -> None:
        """Reports the action up to ``step``."""
        names = self.joints if self.action.skill in OPENING_SKILLS else self.names
        self.spans.append(
            SkillSpan(
                agent=self.number,
                name=self.action.skill,
                target=names[self.action.target] if self.action.target >= 0 else "",
                start_step=self.begun,
                end_step=step,
                outcome=outcome,  # type: ignore[arg-type]
                reason=reason,
            )
        )


@dataclass(eq=False)
class SkillRollout:
    """The changing half of an episode of a task whose agents have skills: a `sim_kinematic.tasks.play.Rollout`.

    For the rules it looks like a `sim_kinematic.tasks.play.WorldRollout` of one world: `world`, `memory`, `outcome`.
    """

    task: Any
    """The `sim_kinematic.tasks.task.Task` that judges."""
    episode: RearrangeEpisode
    policies: list[AssignedPolicy]
    step: int = 0
    """The step that is being played, from 0."""
    steps: int = 0
    """Number of steps made."""
    memory: Any = None
    """The task's own state."""
    ended: str = "max_steps"
    events: list[Event] = field(default_factory=list)
    spans: list[SkillSpan] = field(default_factory=list)
    _joints_moved: bool = False
    finishers: frozenset[int] = frozenset()
    """Agents that placed an object at its goal in the step that completed the task."""

    def __post_init__(self) -> None:
        world = self.episode
        names, joints = tuple(t.name for t in world.targets), joint_names(world.scene)
        if len(self.policies) != len(world.roster):
            raise InputError(
                f"Expected one policy for each of {len(world.roster)} agents, got {len(self.policies)}.",
                code="H3-TASK-016",
            )
        self.world = World(
            world.roster,
            base=world.spec.robot,
            walker=world.spec.human,
            person_radius_m=world.spec.agent_radius_m,
            objects=len(names),
            scene_joints=len(joints),
        )
        """All that moves: agents, objects, who holds them, doors and drawers. Skills move it; `World.step` is not called."""
        self.world.rest_at(world.starts[None], np.zeros(1, np.intp))
        self.state = state = self.world.state
        state.object_pose[0] = [t.start for t in world.targets]
        self.outcome = StepOutcome(reward=np.zeros(1), terminated=np.zeros(1, np.bool_), success=np.zeros(1, np.bool_))
        """The task's evaluation of the last step."""
        self._checked, self._records_judgement = False, bool(self.task.codec.records_judgement)
        self.objects = Objects(names, np.array([t.goal for t in world.targets], np.float64), state, joints)
        self.doorways = RoomDoors.of(world.scene, world.free)
        self.floor = world.free
        """Present free floor, with doors and drawers as they stand."""
        self.objects.scene = world.scene
        self.starts = state.object_pose[0, :, :3].copy()
        self.actors = [self._actor(number) for number in range(len(world.roster))]
        self.people = [actor for actor in self.actors if isinstance(actor, PersonActor)]
        self.robots = [actor for actor in self.actors if isinstance(actor, RobotActor)]
        acts = sorted(self.actors, key=lambda actor: isinstance(actor, RobotActor))  # people first: robots see where to
        self.runners = [
            SkillExecutor(
                actor.number,
                actor,
                self.policies[actor.number].policy,
                self.spans,
                names,
                joints,
            )
            for actor in acts
        ]
        self._by_number = sorted(self.runners, key=lambda runner: runner.number)
        # a robot gives way to a person by itself, and the person to nobody: as Habitat's, or as whoever drives them decides
        is_pair = kinds_of(world.roster) == PAIR
        driven = any(policy.takes_commands for policy in self.policies if policy.kind == "human")
        oracle = world.spec.oracle
        alone = len(self.actors) == 1 or (is_pair and (driven or not world.spec.people_give_way)) or oracle is not None
        solid = world.spec.solid_agents and driven
        heeds = len(self.actors) > 1 and oracle is None and (not is_pair or bool(world.spec.people_give_way))
        self.company = (GivingWay if oracle is None else DiscContacts)(
            world.roster,
            self.actors,
            RightOfWay(world.free, self.actors, self.errand, asks=not alone) if heeds else None,
            agreed=not alone,
            people_see_robot=solid or not (alone and is_pair),
            person_radius_m=world.spec.agent_radius_m if oracle is None else oracle.person_radius_m,
            solid=solid,
        )
        self.objects.openables = self._openables()
        self.bodies = np.append(body_indices(world), -1)
        self.at_goal = self._at_goal()
        self.places = self.before = world.starts.copy()
        self.task.begin(self, np.zeros(1, np.intp))

    @property
    def episodes(self) -> list[RearrangeEpisode]:
        """The episode of the only world."""
        return [self.episode]

    @property
    def spec(self) -> Any:
        """The rules."""
        return self.episode.spec

    @property
    def reward(self) -> float:
        """Reward of the last step."""
        return float(self.outcome.reward[0])

    def _actor(self, number: int) -> RobotActor | PersonActor:
        world, spec, body = self.episode, self.episode.spec, self.episode.roster[number].body
        if isinstance(body, Robot):
            base, clearance = base_of(body, spec.robot), arm_clearance(world.scene, body, world.free.floor_y)
            floor = floor_of(body, base, world.scene, world.free)
            if spec.oracle is not None:
                return OracleRobot(
                    body,
                    floor,
                    base,
                    self.objects,
                    spec.grip_m,
                    spec.arm_rad_s,
                    number,
                    errands=errands_of(world, number),
                )
            learned = skills_of(spec.skills, robot=world.roster[number].model)
            return RobotActor(
                body, floor, base, self.objects, spec.grip_m, spec.arm_rad_s, number, clearance, learned=learned
            )
        own = self.state.agents[number]
        assert isinstance(own, HumanState)
        x, z, heading = world.starts[number]
        base = world.free.root_pose(np.array([x, z]), float(heading))
        objects = dict(zip(self.objects.names, self.objects.poses, strict=True))
        room = reach_room(world.scene, body, world.free.floor_y)
        sizes = grip_radii(world.scene, self.objects.names)
        person = Person(body, base, objects, spec=spec.human, free=world.free, sizes=sizes, state=own)
        if spec.oracle is not None:
            errands = errands_of(world, number)
            return OraclePerson(person, world.free, spec.human, self.objects, number, errands=errands)
        if not self.policies[number].takes_commands:
            return PersonActor(person, world.free, spec.human, self.objects, number, room)
        return DrivenPerson(
            person,
            world.free,
            spec.human,
            self.objects,
            number,
            room,
            object_room=ObjectRoom(world.scene, self.objects.names, world.free.floor_y),
            radius_m=spec.agent_radius_m,
        )

    def _openables(self) -> ArticulatedParts | None:
        """The doors and drawers of the home at their rest positions; None if nothing opens."""
        world = self.episode
        if not self.objects.joints:
            return None
        found = ArticulatedParts(
            world.scene,
            self.objects,
            world.free.floor_y,
            self.company,
            doors=frozenset(self.doorways.joints),
        )
        self.state.joint_pos[0] = found.joints.rest.astype(np.float32)  # as they are recorded
        return found

    def _move_joints(self, before: NDArray[np.float64]) -> None:
        """Reports doors and drawers that have opened or closed in this step, as events.

        When all of them have come to rest, the collision shapes that bodies and arms avoid are updated.
        """
        openables = self.objects.openables
        if openables is None:
            return
        after = openables.positions
        for k, (was, now) in enumerate(zip(*(openables.joints.shares(q) for q in (before, after)), strict=True)):
            if (was < AJAR) != (now < AJAR):
                who = next(
                    (r.number for r in self.runners if r.skill and r.action[:2] in (("open", k), ("close", k))), -1
                )
                name = openables.joints.names[k]
                self.events.append(
                    Event(step=self.step, agent=who, kind="open" if now >= AJAR else "close", target=name)
                )
        if (before != after).any():
            self._joints_moved = True
        elif self._joints_moved:
            self._joints_moved = False
            self._show_scene(openables.scene_now())

    def _show_scene(self, scene: Scene) -> None:
        world, floor_y, self.objects.scene = self.episode, self.episode.free.floor_y, scene
        if world.spec.floor_moves:
            self.floor = common_floor(world.roster, world.free.as_in(scene))
            if self.company.right_of_way is not None:
                self.company.right_of_way.walk_on(self.floor)
        for actor in self.actors:
            if isinstance(actor, RobotActor):
                actor.arm_clearance = arm_clearance(scene, actor.robot, floor_y)
                if world.spec.floor_moves:
                    base = base_of(actor.robot, world.spec.robot)
                    actor.walk_on(floor_of(actor.robot, base, scene, self.floor))
            else:
                actor.room = reach_room(scene, actor.person.body, floor_y)
                actor.walk_on(self.floor)
                if isinstance(actor, DrivenPerson):
                    actor.object_room = ObjectRoom(scene, self.objects.names, floor_y)

    def turns(self) -> Generator[int | None, Action, None]:
        """Plays the episode to its end: yields each agent that must choose, and None after each step."""
        spec = self.episode.spec
        for self.step in range(spec.max_steps):
            held, joints = self.objects.held_by.copy(), self.state.joint_pos[0].copy()
            self.company.begin_step([number for number in held.tolist() if number != NOBODY])
            for runner in self.runners:
                self.company.begin_turn(runner.actor)
                yield from runner.act(self.step, self.view)
                self.company.end_turn(runner.number)
            self.company.end_step()
            self.world.touching[:] = False
            self.before, self.places = (
                self.places,
                np.array([[*own.xz[0].tolist(), own.heading.item(0)] for own in self.state.agents]),
            )
            self.at_goal = self._at_goal()
            for a, b in self.company.touching:
                self.world.touching[0, self.world.pairs.index((a, b))] = True
            self._move_joints(joints)
            self._tell(held)
            outcome = self.task.judge(self)
            if not self._checked:
                outcome, self._checked = checked_outcome(self.task, outcome, 1), True
            self.outcome = outcome
            self.events += [event for _, event in outcome.events]
            self.steps += 1
            success = bool(outcome.success[0])
            if success:
                released = (held != NOBODY) & (self.objects.held_by == NOBODY) & self.at_goal
                self.finishers = frozenset(held[released].tolist())
            if outcome.terminated[0]:
                self.ended = outcome.ended or ("success" if success else "terminated")
                yield None
                return
            yield None

    @property
    def over(self) -> bool:
        """Returns whether the episode has ended, by success, by a rule, or by its number of steps."""
        return self.ended != "max_steps" or self.steps == self.episode.spec.max_steps

    @property
    def open_joints(self) -> NDArray[np.bool_]:
        """Which doors and drawers stand open, at least ajar, [J]."""
        if self.objects.openables is None:
            return np.zeros(0, np.bool_)
        return self.objects.openables.joints.shares(self.objects.openables.positions) >= AJAR

    @property
    def openables(self) -> ArticulatedParts | None:
        """Doors and drawers; None: nothing opens."""
        return self.objects.openables

    def finish(self) -> None:
        """Reports the skills that are still running."""
        for runner in self.runners:
            runner.finish(self.step, completed=runner.number in self.finishers)

    def runner(self, number: int) -> SkillExecutor:
        """The run of an agent."""
        return self._by_number[number]

    @property
    def collision(self) -> bool:
        """Returns whether agents touch now."""
        return bool(self.company.touching)

    def view(self, agent: int) -> Any:
        """Observation of an agent's policy, as the task defines it."""
        return self.task.view(self, agent, 0)

    def agent_view(self, agent: int, world: int = 0) -> RearrangeView:
        """The knowledge of an agent at this moment, for policies that choose skills."""
        del world
        runner = self.runner(agent)
        me, other = self.actors[runner.number], self.company.nearest(runner.number)
        track = self.company.track(other) if other >= 0 else np.full((1, 2), np.nan)
        other_xz = self.actors[other].xz.copy() if other >= 0 else track[-1]
        xz, heading = me.xz.copy(), me.heading  # of a person they are computed
        ahead, aside = _seen(xz, heading, other_xz)
        a, b = self.episode.spec.near_m
        return RearrangeView(
            step=self.step,
            free=self.doorways.open_floor,
            agent=runner.number,
            xz=xz,
            heading=heading,
            other_xz=other_xz,
            other_track=track[-TRACK:].copy(),
            close=bool((ahead / a) ** 2 + (aside / b) ** 2 < 1),
            objects=self.objects.poses[:, :3].copy(),
            goals=self.objects.goals,
            held_by=self.objects.held_by.copy(),
            at_goal=self._at_goal(),
            action=runner.action,
            last=runner.ending,
            starts=self.starts,
            hand=lambda: me.hand_pose,
            arm=me.arm,
            start=self.episode.starts[runner.number],
            before=self.before[runner.number],
            collision=self.collision,
            contact=isinstance(me, RobotActor) and bool(me.state.contact[0]),
            barrier=partial(self.barrier, me),
            observe=partial(self.observe, runner.number),
        )

    def errand(self, number: int) -> TaskProgress:
        """Progress of an agent with its present task."""
        runner = self.runner(number)
        skill, k = runner.action[:2]
        driven = isinstance(runner.actor, DrivenPerson) or skill in (CONTROL, *PRIMITIVES)
        busy = runner.skill is not None and skill not in IDLE_SKILLS
        return TaskProgress(busy, (skill, k), partial(self._left_m, runner), runner.completed, obeys=not driven)

    def _left_m(self, runner: SkillExecutor) -> float:
        """Length of the path to the object, goal or handle to which an agent is going [m]; infinite: it goes nowhere."""
        skill, k = runner.action[:2]
        if runner.skill is None or not skill.startswith("nav"):
            return math.inf
        if skill == "nav_to_handle":
            assert self.objects.openables is not None
            point = self.objects.openables.handles(self.objects.openables.positions)[k]
        else:
            point = self.objects.goals[k] if skill == "nav_to_goal" else self.objects.poses[k, :3]
        return float(self.floor.geodesic(runner.actor.xz, point[[0, 2]], max_snap_m=2.0))

    def barrier(self, actor: AnyActor, k: int, at_goal: bool, *, detour_m: float = DETOUR_M) -> int:
        """Returns `RearrangeView.barrier` for an agent that walks up to ``detour_m`` farther to avoid opening a door."""
        if self.objects.openables is None:
            return -1
        shut, positions = self.objects.openables.barrier_of(k, at_goal=at_goal), self.objects.openables.positions
        if not self.episode.spec.floor_moves or not self.doorways.any_closed(positions):
            return shut
        handles, start = self.objects.openables.handles(positions), actor.xz
        point = self.objects.goals[k] if at_goal else self.objects.poses[k, :3]
        if shut >= 0:
            point = handles[shut]
        elif at_goal and self.objects.held_by[k] == NOBODY:  # from where it lies
            stands = actor.stands_on(self.doorways.open_floor, self.objects.poses[k, :3])
            nearest = nearest_stand(self.doorways.open_floor, stands, start)[0]
            start = stands[nearest, :2] if nearest >= 0 else start
        first = partial(self.doorways.first, floor=self.floor, positions=positions, detour_m=detour_m)
        door, nearer = shut, first(start, partial(actor.stands_on, point=point))
        while nearer >= 0 and nearer != door:
            door = nearer
            nearer = first(actor.xz, partial(actor.stands_on, point=handles[door]))
        return door

    def door_before(self, actor: AnyActor, stands: Callable[[FreeSpace], Array]) -> int:
        """Number of the first closed door between rooms that blocks all poses from which an agent could act.

        Args:
            actor: the agent.
            stands: poses ``(x, z, heading)`` [N, 3] on a given floor from which the agent could act.

        Returns:
            The door's number; -1 if the agent can get to one of the poses, or if no door blocks them.
        """
        if self.objects.openables is None or not self.episode.spec.floor_moves:
            return -1
        positions = self.objects.openables.positions
        if not self.doorways.any_closed(positions):
            return -1
        return self.doorways.first(actor.xz, stands, self.floor, positions, detour_m=np.inf)

    def _at_goal(self) -> NDArray[np.bool_]:
        """Which objects are at their goals and in nobody's hand, [K]."""
        at_goal = np.empty(len(self.objects.goals), np.bool_)
        _reached(self.objects.poses, self.objects.goals, self.objects.held_by, self.episode.spec.at_goal_m, at_goal)
        return at_goal

    def observe(
        self, agent: int, names: Sequence[str], size: PictureSize = None, light: LightMode = "flat"
    ) -> dict[str, NDArray[Any]]:
        """Named observations of an agent now, as environments show them.

        Raises:
            InputError: it has no observation of such a name.
        """
        member = self.episode.roster[agent]
        pictures = picture_names(member.body)
        check_observations(names, (SENSES, pictures), member.name)
        measured = [name for name in names if name not in pictures]
        shown: dict[str, NDArray[Any]] = dict(observe(self.view(agent), measured)) if measured else {}
        if len(measured) < len(names):
            shown |= self.pictures(agent, [name for name in names if name in pictures], size, light)
        return shown

    def pictures(
        self, agent: int, names: Sequence[str], size: PictureSize, light: LightMode = "flat"
    ) -> dict[str, NDArray[Any]]:
        """Named pictures from the cameras of an agent at the present step, as `sim_kinematic.sensing.eyes.see` renders them.

        Arms and hands are where they are now, objects where they lie or are held, doors and drawers where they last
        stood still.
        """
        from sim_kinematic.sensing.eyes import see

        bodies = [member.body for member in self.episode.roster]
        return see(
            self.state,
            self.objects.scene,
            bodies,
            names,
            agent=agent,
            size=size,
            objects=self.objects.names,
            frames=self.company.frames(),
            light=light,
            lit_as=self.episode.scene,
        )

    def snapshot(self) -> Row:
        """The columns of the step that has just been played."""
        frames = {person.number: person.person.frame() for person in self.people}
        row: Row = {"object_pose": self.objects.poses.copy()}
        if self.objects.openables is not None:
            row[JOINTS] = self.objects.openables.positions.copy()
        for runner in self.runners:
            at, actor = f"agent_{runner.number}.", runner.actor
            if isinstance(actor, RobotActor):
                row |= {
                    at + "base_pose": actor.pose,
                    at + "joint_pos": actor.joints.copy(),
                    at + "action": actor.command,
                }
            else:
                frame = frames[runner.number]
                row |= {at + "base_pose": frame.base, at + "root_pose": frame.root, at + "joint_quat": frame.joints}
                if isinstance(actor, DrivenPerson):
                    row[at + "action"] = actor.command
            row |= {
                at + "grasp_body": self.bodies[self.objects.held(runner.number)],
                at + "skill": ALL_SKILLS.index(runner.action.skill),
                at + "skill_target": runner.action.target,
            }
        row |= {name: np.array(values[0]) for name, values in self.outcome.columns.items()}
        if len(self.actors) > 1:
            row["metrics.dist_agents"] = min(np.hypot(*(a.xz - b.xz)) for a, b in combinations(self.actors, 2))
            kinds = [member.kind for member in self.episode.roster]
            touching = [pair in self.company.touching for pair in combinations(range(len(kinds)), 2)]
            row |= {name: flags[0] for name, flags in contact_columns(kinds, np.array([touching])).items()}
        if self.robots:
            row["metrics.robot_contact"] = any(own.contact[0] for own in self.state.robots)
        row["metrics.reward"] = self.reward
        if self._records_judgement:
            row["metrics.success"] = bool(self.outcome.success[0])
        return row

    def columns(self, snapshots: Sequence[Row], first: int) -> Columns:
        """Columns of a recording from the snapshots of consecutive steps."""
        count = len(snapshots)
        block: Columns = {"time_ns": np.arange(first + 1, first + count + 1, dtype=np.int64) * STEP_NS}
        for name in snapshots[0]:
            dtype = self.task.columns.get(name) or DTYPES[name.partition(".")[2] if name.startswith("agent_") else name]
            block[name] = np.array([row[name] for row in snapshots]).astype(dtype)
        return block

    def _tell(self, held: NDArray) -> None:
        """Returns the events of this step, of things and between agents."""
        for k, (was, now) in enumerate(zip(held.tolist(), self.objects.held_by.tolist(), strict=True)):
            name = self.objects.names[k]
            if was != now and was != NOBODY and now == NOBODY:
                where = "at its goal" if self.at_goal[k] else "elsewhere"
                self.events.append(Event(step=self.step, agent=was, kind="place", target=name, detail=where))
            elif was != now:
                self.events.append(Event(step=self.step, agent=now, kind="pick", target=name))
        for a, b in self.company.touching:
            self.events.append(Event(step=self.step, agent=a, kind="collision", target=self.episode.roster[b].name))


@kernel(error_model="numpy")
def _reached(poses, goals, held_by, within, at_goal):
    """Returns whether objects with poses [K, 7] that nobody holds are ``within`` [m] of goals [K, 3], into ``at_goal`` [K]."""
    for k in range(len(goals)):
        dx, dy, dz = poses[k, 0] - goals[k, 0], poses[k, 1] - goals[k, 1], poses[k, 2] - goals[k, 2]
        at_goal[k] = held_by[k] == NOBODY and math.sqrt(dx * dx + dy * dy + dz * dz) < within


def _seen(xz: NDArray, heading: float, other: NDArray) -> tuple[float, float]:
    """Another place in an agent's frame: ahead and to its right [m]."""
    (x, z), (other_x, other_z) = xz.tolist(), other.tolist()
    dx, dz = other_x - x, other_z - z
    c, s = math.cos(heading), math.sin(heading)
    return c * dx - s * dz, s * dx + c * dz
