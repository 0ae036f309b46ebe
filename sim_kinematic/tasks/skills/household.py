"""Agents with skills in one home: their observations and actions, and the state of the objects, doors and drawers.

The task determines rewards and the end of the episode (`sim_kinematic.tasks.task.Task.judge`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.errors import InputError
from h3data.geometry import Array, transform_points
from h3data.kernels import kernel
from h3data.kernels.entries import Entries
from h3data.recording import Event
from h3data.recording.log_lines import SAY
from h3data.recording.records import JOINTS
from h3data.scene import Scene
from h3data.scene.articulation import AJAR, joint_names, joints_of
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
    PRIMITIVES,
    Action,
    Message,
    Objects,
    choices,
)
from sim_kinematic.agents.stands import nearest_stand
from sim_kinematic.avoidance.right_of_way import RightOfWay
from sim_kinematic.avoidance.robot_base import base_of, floor_of
from sim_kinematic.avoidance.stand_offs import TaskProgress
from sim_kinematic.crowd.seating import Seats
from sim_kinematic.motion.state import NOBODY, HumanState
from sim_kinematic.policies.assignment import works
from sim_kinematic.policies.rearrange_observations import exact
from sim_kinematic.policies.skills.names import skills_of
from sim_kinematic.policies.views import CloseView, RearrangeView
from sim_kinematic.sensing.sight import LOOK_STEPS, Places, Sight
from sim_kinematic.sensing.table import Sensor
from sim_kinematic.tasks.control import Columns, Team
from sim_kinematic.tasks.rearrange.episode import body_indices
from sim_kinematic.tasks.rules.predicates import is_object_at
from sim_kinematic.tasks.skills.controller import IDLE_SKILLS, SkillController
from sim_kinematic.tasks.skills.errands import errands_of
from sim_kinematic.world import Command

_CALL = Entries()
CONTACT = "contact"
# one second of 30 steps, and the present
TRACK = 31
"""Number of positions of the other agent that a policy observes, including the present one."""


class Household(Team):
    """Agents with skills in one home, and the things that they use: objects, doors, drawers and the floor."""

    def __init__(self, play: Any) -> None:
        super().__init__(play)
        if play.world.worlds != 1:
            raise InputError(
                f"Agents with skills have one world each, got {play.world.worlds} in one rollout.", code="H3-TASK-073"
            )
        self._joints_moved = False
        self._finishers: frozenset[int] = frozenset()
        """Numbers of the agents that placed an object at its goal in the last step."""
        self.is_quiet = False
        """True if no object changed hands or came to its goal in the last step, and no agents touched."""
        self._apart = np.zeros((1, len(play.world.pairs)), np.bool_)
        """Value of `World.touching` if no agents touch."""

    def begin(self, rows: NDArray[np.intp]) -> None:
        """Put the agents and the things of the home at their places at the start of an episode."""
        play, state = self.play, self.play.world.state
        self.episode = episode = play.episode
        self.parts: tuple[int, ...] = play.task.parts_of(episode)
        """Joints of the doors and drawers that agents may choose by number (`Rearrange.parts_of`)."""
        names, joints = tuple(t.name for t in episode.targets), joint_names(episode.scene)
        state.object_pose[0] = [t.start for t in episode.targets]
        goals = np.array([t.goal for t in episode.targets], np.float64)
        self.objects = Objects(names, goals, state, joints, episode.scene)
        self.doorways = RoomDoors.of(episode.scene, episode.free)
        self.floor = episode.free
        """Free floor with doors and drawers at their present positions."""
        self.starts = state.object_pose[0, :, :3].copy()
        self.actors = [self._actor(number) for number in range(len(episode.roster))]
        self.people = [actor for actor in self.actors if isinstance(actor, PersonActor)]
        self._chores: list[Any] = [hands for policy in play.policies if (hands := works(policy)) is not None]
        self.robots = [actor for actor in self.actors if isinstance(actor, RobotActor)]
        # people move first, so robots see where they are going
        self.order = [actor.number for actor in (*self.people, *self.robots)]
        self.controllers = [
            SkillController(actor.number, actor, play.spans, names, joints, aim=self.aim) for actor in self.actors
        ]
        self._errands: dict[int, tuple[Action, bool, int, TaskProgress]] = {}
        """Last progress of each agent, with the action, whether it runs, and the number of tasks that it is made of."""
        self.messages: list[Event] = []
        """Messages that agents have sent so far, as events."""
        self.company = self._introduced()
        # after the company, which doors must not open into
        self.objects.openables = openables = self._openables()
        self.handles: Any = (
            openables.handles(openables.joints.rest)[list(self.parts)] if openables else np.zeros((0, 3))
        )
        """Positions of the handles of `parts` at rest, [M, 3] [m]."""
        # a drawer in which a goal lies takes it along; -1: the goal lies in none
        owner = joints_of(episode.scene).owner
        self._carriers = [owner.get(t.destination.partition("|")[0], -1) for t in episode.targets]
        # with drawers as the scene has them; `Objects.goals` move along with the drawers
        self._goals = goals.copy()
        if episode.spec.observe == "seen":
            bodies = [member.body for member in episode.roster]
            self.objects.sight = sight = Sight(episode.scene, bodies, len(names), episode.free.floor_y)
            for controller in self.controllers:
                controller.surfaces = sight.names
        # `Objects.held` is -1 for an empty hand, which picks the last entry: no body
        self.bodies = np.append(body_indices(episode), -1)
        # which of its `choices` an agent can make, by its number and the bytes of `Objects.held_by`
        self._masks: dict[tuple[int, bytes], NDArray[np.int8]] = {}
        self.at_goal = self._at_goal()
        self._places: list[Sequence[float]] = episode.starts.tolist()
        # views: a step changes the arrays of a world in place
        self._before = [(own.xz[0], own.heading) for own in play.world.before.agents]
        self._look()

    def _introduced(self) -> GivingWay:
        """Return the record by which the agents give way to each other.

        In a pair, the robot may be the only one that gives way: Habitat's rules ask for this, and so does a person whom
        somebody drives from outside.
        """
        episode, spec, oracle = self.episode, self.episode.spec, self.episode.spec.oracle
        is_pair = kinds_of(episode.roster) == ("robot", "human")
        driven = any(isinstance(actor, DrivenPerson) for actor in self.actors)
        alone = len(self.actors) == 1 or (is_pair and (driven or not spec.people_give_way)) or oracle is not None
        # with oracle skills nobody heeds anybody, as in Habitat
        heeds = len(self.actors) > 1 and oracle is None and (not is_pair or bool(spec.people_give_way))
        solid = spec.solid_agents and driven
        return (GivingWay if oracle is None else DiscContacts)(
            episode.roster,
            self.actors,
            RightOfWay(episode.free, self.actors, self.errand, asks=not alone) if heeds else None,
            agreed=not alone,
            people_see_robot=solid or not (alone and is_pair),
            person_radius_m=spec.agent_radius_m if oracle is None else oracle.person_radius_m,
            solid=solid,
        )

    def _actor(self, number: int) -> RobotActor | PersonActor:
        """Return the actor that carries out the skills of an agent.

        The rules choose between learned and oracle skills. A person who is driven from outside has a separate actor.
        """
        world, spec, body = self.episode, self.episode.spec, self.episode.roster[number].body
        if isinstance(body, Robot):
            base, floor = world.bases[number], world.floor(number)
            clearance = arm_clearance(world.scene, body, world.free.floor_y)
            if spec.oracle is not None:
                return OracleRobot(
                    body,
                    floor,
                    base,
                    self.objects,
                    spec.grip_m,
                    spec.arm_rad_s,
                    number,
                    errands=errands_of(world, number, self.parts),
                )
            learned = skills_of(spec.skills, robot=world.roster[number].model)
            return RobotActor(
                body, floor, base, self.objects, spec.grip_m, spec.arm_rad_s, number, clearance, learned=learned
            )
        own = self.objects.state.agents[number]
        assert isinstance(own, HumanState)
        x, z, heading = world.starts[number]
        base = world.free.root_pose(np.array([x, z]), float(heading))
        objects = dict(zip(self.objects.names, self.objects.poses, strict=True))
        room = reach_room(world.scene, body, world.free.floor_y)
        sizes = grip_radii(world.scene, self.objects.names)
        hands = works(self.play.policies[number])
        person = Person(
            body,
            base,
            objects,
            spec=spec.human,
            free=world.free,
            sizes=sizes,
            state=own,
            led=None if hands is None else hands.lead,
        )
        if spec.oracle is not None:
            errands = errands_of(world, number, self.parts)
            return OraclePerson(person, world.free, spec.human, self.objects, number, errands=errands)
        if not self.play.policies[number].takes_commands:
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
            seats=Seats(world.scene, world.free, body),
            chores=hands,
        )

    def _openables(self) -> ArticulatedParts | None:
        """Return the doors and drawers of the home at their rest positions; None if nothing opens."""
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
        # rounded as in recordings, which continue from these positions
        self.objects.state.joint_pos[0] = found.joints.rest.astype(np.float32)
        return found

    def _move_joints(self, before: NDArray[np.float64]) -> None:
        """Report doors and drawers that have opened or closed in this step, as events.

        When all of them have come to rest, the collision shapes that bodies and arms avoid are updated.
        """
        openables = self.objects.openables
        if openables is None:
            return
        after = openables.positions
        for k, (was, now) in enumerate(zip(*(openables.joints.shares(q) for q in (before, after)), strict=True)):
            # where it passes ajar, so that a motion of many steps is one event
            if (was < AJAR) != (now < AJAR):
                who = next(
                    (
                        r.number
                        for r in (self.controllers[k] for k in self.order)
                        if r.skill and r.action[:2] in (("open", k), ("close", k))
                    ),
                    -1,
                )
                name = openables.joints.names[k]
                self.play.events.append(
                    Event(step=self.play.step, agent=who, kind="open" if now >= AJAR else "close", target=name)
                )
        if (before != after).any():
            self._joints_moved = True
            self._carry_goals()
        elif self._joints_moved:
            self._joints_moved = False
            self._show_scene(openables.scene_now())

    def _look(self) -> None:
        """Update the knowledge of the agents by what they see, and report objects that they find or miss as events."""
        sight, openables, held_by = self.objects.sight, self.objects.openables, self.objects.held_by
        if sight is None:
            return
        changed = not self.play.step or self._joints_moved or bool((self._held != held_by).any())
        if changed and openables is not None:
            sight.open(openables.joints.is_open(openables.positions))
            sight.hidden[:] = [openables.barrier_of(k) >= 0 for k in range(len(held_by))]
        # between looks only where something has changed: hands and doors reveal and hide objects at once
        if not changed and self.play.step % LOOK_STEPS:
            return
        for agent, k, found in sight.look(np.array(self._places), self.objects.poses[:, :3], held_by):
            kind = "see" if found else "miss"
            event = Event(step=self.play.step, agent=agent, kind=kind, target=self.objects.names[k])
            self.play.events.append(event)

    def set_goal(self, k: int, goal: Array, receptacle: str) -> None:
        """Give object ``k`` another goal, a world point [3] [m] on a receptacle with doors and drawers at rest."""
        self._goals[k] = self.objects.goals[k] = goal
        self._carriers[k] = joints_of(self.episode.scene).owner.get(receptacle.partition("|")[0], -1)
        self._carry_goals()

    def aim(self, number: int, action: Action) -> str:
        """Carry out a command that takes no time: send a `Message`, or give an object the goal of a `Destination`.

        Returns:
            The reason if this is impossible, as another goal is in most tasks; empty if it is done.
        """
        if not isinstance(action.command, Message):
            return "no_space"
        text, to = action.command
        self.messages.append(Event(step=self.play.step, agent=number, kind=SAY, target=to, detail=text))
        self.play.events.append(self.messages[-1])
        return ""

    def _carry_goals(self) -> None:
        """Move goals that are in drawers together with the drawers."""
        openables = self.objects.openables
        if openables is None or max(self._carriers, default=-1) < 0:
            return
        motions = openables.joints.motions(openables.positions)
        for k, joint in enumerate(self._carriers):
            if joint >= 0:
                self.objects.goals[k] = transform_points(motions[joint], self._goals[k][None])[0]

    def _show_scene(self, scene: Scene) -> None:
        """Let all agents move, reach and avoid by a scene whose doors and drawers have come to rest."""
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

    def begin_step(self) -> None:
        """Decide at the start of a step which agents step aside."""
        super().begin_step()
        # copies, with which `move` compares what the agents have made of them
        self._held = self.objects.held_by.tolist()
        if self.objects.openables is not None:
            self._joints = self.objects.state.joint_pos[0].copy()
        self.company.begin_step([number for number in self._held if number != NOBODY])

    def begin_turn(self, number: int) -> None:
        """Update an agent's view of the others, and interrupt its skill if its policy requests it."""
        controller = self.controllers[number]
        controller.actor.hindered_by = frozenset()
        # a command lasts one step, so there is nothing to interrupt
        if controller.is_free:
            return
        policy, step = self.play.policies[number].policy, self.play.step
        interrupts = getattr(policy, "interrupts", None)
        if interrupts is None or step % getattr(policy, "interrupts_every", 1):
            return
        # most of the time nobody is close, and a view takes far longer than to find that out
        needs_view, close = not getattr(policy, "interrupts_only_when_close", False), self._is_close(number)
        if not close and not needs_view:
            return
        k, held_by = controller.action.target, self.objects.held_by
        is_taken = 0 <= k < len(held_by) and held_by.item(k) not in (NOBODY, number)
        glance = CloseView(controller.action, close, step, is_taken)
        # what an agent knows that has not seen everything only a view tells
        may_interrupt = getattr(policy, "may_interrupt", None) if self.objects.sight is None else None
        if may_interrupt is not None and not may_interrupt(glance):
            return
        if reason := interrupts(self.play.view(number) if needs_view else glance):
            controller.interrupt(reason)

    def end_turn(self, number: int) -> None:
        """Note that an agent has moved."""
        self.company.end_turn(number)

    def note_places(self) -> None:
        """Store the present poses of all agents, and those of the last call in `World.before`."""
        for (xz, heading), place in zip(self._before, self._places, strict=True):
            xz[0], xz[1], heading[0] = place
        self._places = list(self.company.at)

    def move(self, commands: Sequence[Command | None]) -> None:
        """Complete a step in which the agents have moved one after the other."""
        world, was_at_goal, held_now = self.play.world, self.at_goal, self.objects.held_by.tolist()
        self.company.end_step()
        self.note_places()
        touching = self.company.touching
        # nearly always nobody touches: one array for all these steps, into which nobody may write
        world.touching = np.array([[pair in touching for pair in world.pairs]], np.bool_) if touching else self._apart
        self.at_goal = self._at_goal()
        for hands in self._chores:
            hands.follow(self.play)
        if self.objects.openables is not None:
            self._move_joints(self._joints)
        # after doors and drawers have moved, as they reveal and hide things in the same step
        if self.objects.sight is not None:
            self._look()
        self.is_quiet = not touching and held_now == self._held and self.at_goal.tobytes() == was_at_goal.tobytes()
        if self.is_quiet:
            self._finishers = frozenset()
        else:
            self._tell(self._held, held_now)

    @property
    def open_joints(self) -> NDArray[np.bool_]:
        """Return which doors and drawers are at least ajar, as bool [J]."""
        if self.objects.openables is None:
            return np.zeros(0, np.bool_)
        return self.objects.openables.joints.shares(self.objects.openables.positions) >= AJAR

    @property
    def openables(self) -> ArticulatedParts | None:
        """Doors and drawers of the home; None: nothing opens."""
        return self.objects.openables

    def finish(self) -> None:
        """Report the skills that are still running at the end of the episode."""
        success = bool(self.play.outcome.success[0])
        for number in self.order:
            # the episode ends while the last placing runs on: it has done what it was to do
            done = success and number in self._finishers
            self.controllers[number].finish(max(self.play.step - 1, 0), completed=done)

    def view(self, agent: int, world: int = 0) -> RearrangeView:
        """Return the present knowledge of an agent, for policies that choose skills."""
        runner, before = self.controllers[agent], self.play.world.before.agents[agent]
        me, other = self.actors[runner.number], self.company.nearest(runner.number)
        track = self.company.track(other) if other >= 0 else np.full((1, 2), np.nan)
        other_xz = self.actors[other].xz.copy() if other >= 0 else track[-1]
        xz, heading = me.xz.copy(), me.heading  # of a person they are computed
        known = self._known(runner.number)
        return RearrangeView(
            step=self.play.step,
            free=self.doorways.open_floor,
            agent=runner.number,
            xz=xz,
            heading=heading,
            other_xz=other_xz,
            other_track=track[-TRACK:].copy(),
            close=self._is_close(agent),
            objects=known[0],
            goals=self.objects.goals,
            held_by=known[1],
            at_goal=known[2],
            action=runner.action,
            last=runner.ending,
            starts=self.starts
            if known[3] is None
            else np.where(self.objects.sight.known[agent, :, None], self.starts, np.nan),
            hand=lambda: me.hand_pose,
            arm=me.arm,
            start=self.episode.starts[runner.number],
            before=np.array([*before.xz[0].tolist(), before.heading.item(0)]),
            collision=bool(self.company.touching),
            contact=isinstance(me, RobotActor) and bool(me.state.contact[0]),
            barrier=partial(self.barrier, me),
            observe=partial(self.play.observe, runner.number, 0),
            places=known[3],
            messages=[
                e for e in self.messages if agent == e.agent or e.target in ("", self.episode.roster[agent].name)
            ],
            parts=self.parts,
            open_parts=self.open_joints[list(self.parts)] if self.parts else np.zeros(0, np.bool_),
            handles=self.handles,
        )

    def choices(self, agent: int) -> tuple[Action, ...]:
        """Return the actions that an agent can choose from, by number (`sim_kinematic.agents.skills.choices`)."""
        return choices(len(self.starts), robot=isinstance(self.actors[agent], RobotActor), parts=self.parts)

    def _known(self, agent: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_], Places | None]:
        """Return positions, holders, and which things are at goals, as an agent knows them, and places to look at."""
        objects, sight = self.objects, self.objects.sight
        if sight is None:
            return objects.poses[:, :3].copy(), objects.held_by.copy(), self._at_goal(), None
        # an agent knows where its own hand is, whatever it sees
        mine = objects.held_by == agent
        where = np.where(mine[:, None], objects.poses[:, :3], sight.where[agent])
        # what the agent last saw in its own hand has left it, unless it still holds it
        held = np.where(mine, agent, np.where(sight.held[agent] == agent, NOBODY, sight.held[agent]))
        near = is_object_at(where, objects.goals, distance_m=self.episode.spec.at_goal_m)
        return (
            where,
            held,
            near & (held == NOBODY),
            Places(sight.points, sight.looked[agent], sight.shut),
        )

    def _is_close(self, agent: int) -> bool:
        """Return whether the nearest other agent is inside the ellipse in which skills may be interrupted."""
        other, (a, b) = self.company.nearest(agent), self.episode.spec.near_m
        if other < 0:
            return False
        ahead, aside = _seen(*self.company.at[agent], *self.company.at[other][:2])
        return (ahead / a) ** 2 + (aside / b) ** 2 < 1

    def errand(self, number: int) -> TaskProgress:
        """Return the progress of an agent in its present task."""
        runner = self.controllers[number]
        goes, known = runner.skill is not None, self._errands.get(number)
        # by identity, as commands in actions may be arrays; it is the same for nearly all steps of a skill
        if known is None or known[0] is not runner.action or known[1:3] != (goes, runner.completed):
            skill, k, *_ = runner.action
            # skills by which somebody else moves a robot step by step
            driven = skill in (CONTROL, *PRIMITIVES) or isinstance(runner.actor, DrivenPerson)
            progress = TaskProgress(
                goes and skill not in IDLE_SKILLS,
                (skill, k),
                partial(self._way, runner),
                runner.completed,
                obeys=not driven,
            )
            known = self._errands[number] = runner.action, goes, runner.completed, progress
        return known[3]

    def _way(self, runner: SkillController) -> Callable[[], float]:
        """Return `TaskProgress.way` of an agent, whose skill leads to an object, a goal or a handle; infinite: nowhere."""
        skill, k = runner.action[:2]
        if runner.skill is None or not skill.startswith("nav"):
            return lambda: math.inf
        if skill == "nav_to_handle":
            assert self.objects.openables is not None
            point = self.objects.openables.handles(self.objects.openables.positions)[k]
        else:
            point = self.objects.destination(runner.number, runner.action)
        floor, xz, end = self.floor, runner.actor.xz.copy(), point[[0, 2]]
        # things on furniture are off the free floor: the path leads to the floor nearest to them
        return lambda: float(floor.geodesic(xz, end, max_snap_m=2.0))

    def barrier(self, actor: AnyActor, k: int, at_goal: bool, *, detour_m: float = DETOUR_M) -> int:
        """Return `RearrangeView.barrier` for an agent that prefers detours of ``detour_m`` [m] to opening a door."""
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
        # doors before that door, until one can be reached
        while nearer >= 0 and nearer != door:
            door = nearer
            nearer = first(actor.xz, partial(actor.stands_on, point=handles[door]))
        return door

    def _at_goal(self) -> NDArray[np.bool_]:
        """Return which objects are at their goals and in nobody's hand, [K]."""
        objects, at_goal = self.objects, np.empty(len(self.objects.goals), np.bool_)
        _CALL(_reached, objects.poses, objects.goals, objects.held_by, float(self.episode.spec.at_goal_m), at_goal)
        return at_goal

    def exact(
        self, agent: int, names: Sequence[str], sensors: Mapping[str, Sensor], *, beside: Sequence[Team] = ()
    ) -> dict[str, Array]:
        """Return the named observations of an agent in the only world, followed by those of the teams ``beside``."""
        shown = exact([team.view(agent, 0) for team in (self, *beside)], names, sensors)
        if self.objects.sight is not None:
            # positions of things that the agent has not seen are NaN, which no network takes
            shown = {name: np.nan_to_num(values) for name, values in shown.items()}
        return shown

    def info(self, number: int) -> dict[str, Any]:
        """Return facts about an agent's last skill, the objects, and the choices that are possible now."""
        ending = self.controllers[number].ending
        # by who holds what: nothing else decides where agents know everything, and it seldom changes
        now = number, self.objects.held_by.tobytes()
        if now not in self._masks or self.objects.sight is not None:
            possible = [not self.objects.why_not(number, action) for action in self.choices(number)]
            self._masks[now] = np.array(possible, np.int8)
        return {
            "outcome": ending.outcome if ending else "running",
            "reason": ending.reason if ending else "",
            "collision": bool(self.company.touching),
            "at_goal": self.at_goal.copy(),
            "held_by": self.objects.held_by.copy(),
            "action_mask": self._masks[now].copy(),
        }

    def scenery(self, world: int) -> dict[str, Any]:
        """Return the present state of arms, hands and objects, and doors and drawers where they last came to rest."""
        objects = self.objects
        return {
            "state": objects.state,
            "scene": objects.scene,
            "objects": objects.names,
            "frames": self.company.frames(),
        }

    def snapshot(self) -> dict[str, Any]:
        """Return the poses, held objects and skills of all agents, and the poses of all things."""
        # copies, as the recorder keeps rows until a block is full, while the state goes on
        row: dict[str, Any] = {"object_pose": np.concatenate([self.objects.poses, *(h.poses for h in self._chores)])}
        if self.objects.openables is not None:
            row[JOINTS] = self.objects.openables.positions.copy()
        for number in self.order:
            at, runner = f"agent_{number}.", self.controllers[number]
            actor = runner.actor
            if isinstance(actor, RobotActor):
                row |= {
                    at + "base_pose": actor.pose,
                    at + "joint_pos": actor.joints.copy(),
                    at + "action": actor.command,
                }
                row[at + CONTACT] = bool(actor.state.contact[0])
            else:
                frame = actor.person.frame()
                row |= {at + "base_pose": frame.base, at + "root_pose": frame.root, at + "joint_quat": frame.joints}
                if isinstance(actor, DrivenPerson):
                    row[at + "action"] = actor.command
            row |= {
                at + "grasp_body": self.bodies[self.objects.held(number)],
                at + "skill": ALL_SKILLS.index(runner.action.skill),
                at + "skill_target": runner.action.target,
            }
        return row

    def columns(self, snapshots: Sequence[dict[str, Any]]) -> tuple[Columns, list[Array], NDArray[np.bool_] | None]:
        """Return the columns of all agents and things."""
        columns = {name: np.array([row[name] for row in snapshots]) for name in snapshots[0]}
        # not columns of their own: any robot's contact makes `metrics.robot_contact`
        contact = [columns.pop(f"agent_{actor.number}.{CONTACT}") for actor in self.robots]
        places = [columns[f"agent_{number}.base_pose"][:, [0, 2]] for number in range(len(self.actors))]
        # types (dtype) of the columns of a step, those of agents without their prefix ``agent_<i>.``
        dtypes: dict[str, type] = {
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
        }
        block = {
            name: values.astype(dtypes[name.partition(".")[2] if name.startswith("agent_") else name])
            for name, values in columns.items()
        }
        return block, places, np.any(contact, axis=0) if contact else None

    def _tell(self, held: Sequence[int], held_now: Sequence[int]) -> None:
        """Report objects that changed hands and agents that touch as events of this step."""
        finishers = set()
        for k, (was, now) in enumerate(zip(held, held_now, strict=True)):
            name = self.objects.names[k]
            if was != now and was != NOBODY and now == NOBODY:
                where = "at its goal" if self.at_goal[k] else "elsewhere"
                if self.at_goal[k]:
                    finishers.add(was)
                self.play.events.append(Event(step=self.play.step, agent=was, kind="place", target=name, detail=where))
            # also from hand to hand, where the taker picks and nobody places
            elif was != now:
                self.play.events.append(Event(step=self.play.step, agent=now, kind="pick", target=name))
        self._finishers = frozenset(finishers)
        for a, b in self.company.touching:
            self.play.events.append(
                Event(step=self.play.step, agent=a, kind="collision", target=self.episode.roster[b].name)
            )


@kernel(error_model="numpy")
def _reached(poses, goals, held_by, within, at_goal):
    """Write to ``at_goal`` [K] whether free objects with poses [K, 7] are ``within`` [m] of goals [K, 3]."""
    for k in range(len(goals)):
        dx, dy, dz = poses[k, 0] - goals[k, 0], poses[k, 1] - goals[k, 1], poses[k, 2] - goals[k, 2]
        # strictly nearer, in three dimensions, as Habitat's object_at
        at_goal[k] = held_by[k] == NOBODY and math.sqrt(dx * dx + dy * dy + dz * dz) < within


def _seen(x: float, z: float, heading: float, other_x: float, other_z: float) -> tuple[float, float]:
    """Return another place in an agent's frame: ahead and to its right [m]."""
    dx, dz = other_x - x, other_z - z
    # forward is (c, -s) in (x, z), and the right-hand side (s, c)
    c, s = math.cos(heading), math.sin(heading)
    return c * dx - s * dz, s * dx + c * dz
