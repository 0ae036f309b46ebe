"""W worlds with the same agents, each in its own home, with placement, motion and contacts of the agents.

```python
world = World(make_roster("robot,robot,human"), worlds=16)
world.place(starts, [free] * 16)                     # [16, 3, 3]: x, z, heading
world.step([DriveCommand(a), DriveCommand(b), WaypointCommand(points)])  # [16, 2] each
world.touching                                       # [16, 3]: of world.pairs
```

A single world has W = 1. Motion, contact and arms are computed by the kernels in `sim_kinematic.motion`. A task
(`sim_kinematic.tasks.task`) adds rules, and a rollout (`sim_kinematic.tasks.play`) adds the loop over steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.bodies.people.sitting import take_seats
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, Array, ground_pose, quat_conjugate, quat_rotate
from h3data.kernels import kernel
from h3data.scene import FreeSpace
from sim_kinematic.agents.arm_tuck import draw_arms
from sim_kinematic.agents.roster import AgentSpec, kinds_of
from sim_kinematic.avoidance.robot_base import base_of
from sim_kinematic.contact import AgentContacts
from sim_kinematic.contact.clearance import LYING_M, RobotHumanContact, clip_reach, robot_reach
from sim_kinematic.contact.frames import body_frames, body_shapes, root_pose, shape_frames
from sim_kinematic.contact.outlines import legs_at, shins
from sim_kinematic.motion.gait import cycle_phase, drive_people, move_people, walk_humans
from sim_kinematic.motion.spec import HOME_BASE, BaseSpec, PersonContact, WalkerSpec
from sim_kinematic.motion.state import AgentState, HumanState, RobotState, StateBlock, WorldState
from sim_kinematic.motion.step import discs_at, drive_robots, first_not_finite

Rows = NDArray[np.intp]


class DriveCommand(NamedTuple):
    """Base velocities of an agent: forward and left turn in -1..1 of the limits, [W, 2], or [W, 3] to move sideways.

    People drive too: as a disc that slides along obstacles, forwards only.
    """

    velocity: Array


class WaypointCommand(NamedTuple):
    """Command with points that people walk straight to, turning on the spot first, [W, 2] [m]."""

    points: Array


class PoseCommand(NamedTuple):
    """Command that places people who walk along a path (`sim_kinematic.motion.stride`)."""

    points: Array
    """Positions on the floor [W, 2] [m]."""
    headings: Array
    """Headings [W] [rad]."""
    seats: Array
    """Seats that the people sit down on, as in `HumanState.seat`, [W, 2]."""


class GaitCommand(NamedTuple):
    """Command with the place and walking phase of people in this step, which are computed elsewhere."""

    gait: HumanState
    """Gait of the person, as a state of W worlds."""


class RecordedPoseCommand(NamedTuple):
    """Command that puts people at the next pose of a recorded track, without checks by the world."""

    xz: Array
    """Positions on the floor [W, 2] [m]."""
    heading: Array
    """Headings [W] [rad]."""
    posture: Posture


class Posture(NamedTuple):
    """Postures of people as motion clips, with one row per world."""

    clip: NDArray[np.int64]
    """Index of the motion clip, [W]."""
    phase: Array
    """Phase in the cycle of the clip, 0..1, [W]."""
    blend: Array
    """Weight of the clip over standing, 0..1, [W]."""
    arms: Array
    """Fold of the left and the right arm, from 0 (out) to 1 (in), [W, 2]."""
    seat: Array
    """Seat of the person as in `HumanState.seat`, [W, 2]."""


Command = DriveCommand | WaypointCommand | PoseCommand | GaitCommand | RecordedPoseCommand


class World:
    """W worlds with one roster, whose state arrays are changed in place; `before` is the state one step ago."""

    def __init__(
        self,
        roster: Sequence[AgentSpec],
        *,
        worlds: int = 1,
        base: BaseSpec | None = None,
        walker: WalkerSpec | None = None,
        person_radius_m: float = 0.25,
        solid: bool = False,
        contact: bool = True,
        person_contact: PersonContact = "body",
        objects: int = 0,
        scene_joints: int = 0,
    ) -> None:
        """Create worlds without a floor; `place` puts the agents into their homes.

        Args:
            roster: agents of every world, robots first, then people.
            worlds: number of worlds W.
            base: rules for bases, unless a robot's own base overrides them (`base_of`).
            walker: gait and speed of people.
            person_radius_m: radius of a person who is driven from outside [m].
            solid: whether people who are driven slide along the discs of the other agents, at their positions before the step.
            contact: whether contacts are computed; otherwise the code that moves the agents sets `touching`.
            person_contact: collision shapes of people.
            objects: number of things that agents can take, in `state`.
            scene_joints: number of doors and drawers, in `state`.

        Raises:
            InputError: W is less than 1.
        """
        if isinstance(worlds, bool) or not isinstance(worlds, int | np.integer) or worlds < 1:
            raise InputError(f"Expected at least 1 world, a whole number, got {worlds!r}.", code="H3-SIM-050")
        self.roster, self.worlds = tuple(roster), int(worlds)
        rules, self.walker = base or HOME_BASE, walker or WalkerSpec()
        self.bases = tuple(base_of(member.body, rules) for member in self.roster)
        """Discs and limits of each agent's base; those of the rules for people."""
        self._person_radius_m, self._solid, self._finds_contact = person_radius_m, solid, contact
        self._person_contact: PersonContact = person_contact
        robots = [member.robot for member in self.roster[: kinds_of(self.roster).count("robot")]]
        people = len(self.roster) - len(robots)
        driven = self.bases[: len(robots)]
        self.widths = (*(3 if base.max_lateral_mps else 2 for base in driven), *[2] * people)
        """Number of values of each agent's velocity; 3 for a robot that can move sideways."""
        self._discs = (
            *((base.disc_offsets_m, base.disc_radius_m) for base in driven),
            *[((0.0,), person_radius_m)] * people,
        )
        state = WorldState.zeros(
            self.worlds,
            robots=len(robots),
            people=people,
            joints=[len(r.rest) for r in robots],
            objects=objects,
            scene_joints=scene_joints,
        )
        self.now, self.was = StateBlock.of(state), StateBlock.of(state)
        """Blocks of memory with the state now and one step ago; steps change their arrays in place."""
        self.state, self.people = self.now.state, self.now.people
        """State of the worlds now, and all people of all worlds in one state (`StateBlock.people`)."""
        self.before, self.people_before = self.was.state, self.was.people
        """State of the worlds one step ago, and all people of all worlds in one state."""
        self.start = state.copy()
        self.clips = tuple(
            member.body.clip_for_speed(self.walker.speed_mps) if isinstance(member.body, Humanoid) else -1
            for member in self.roster
        )
        """Index of the clip that each agent walks with; -1 for robots."""
        self.floors: list[FreeSpace] = []
        """Floor map of each world."""
        self.groups: list[tuple[FreeSpace, Rows]] = []
        """Groups of worlds that share a map, each as the map and the indices of the worlds."""
        self._uneven: tuple[tuple[FreeSpace, Rows], ...] = ()
        """Groups of worlds whose floor is not level."""
        self.blocked = np.zeros((self.worlds, len(self.roster)), np.bool_)
        """Agents that touched an obstacle in the last step, [W, A]."""
        self.pairs = tuple(combinations(range(len(self.roster)), 2))
        """Pairs (a, b) with a < b of the numbers of all agents, P in all."""
        self.touching = np.zeros((self.worlds, len(self.pairs)), np.bool_)
        """True for pairs of agents that touch after the last step, [W, P]."""
        self.floor_y: Array = np.zeros(self.worlds)
        """Height of the floor in each world, or of its lowest storey (`heights`), [W] [m]."""
        self.rows = np.arange(self.worlds)
        """Numbers of all worlds, [W]."""
        self._kept: dict[int, Posture] = {}
        self._arms: dict[tuple[int, ...], list[Rows]] = {}
        """Rows of `people` with one body on one map, by the numbers of those who are posed."""

    @cached_property
    def _contact(self) -> _PairContacts:
        return _PairContacts(self.roster, self.pairs, self._person_contact)

    def place(self, starts: Array, floors: Sequence[FreeSpace], rows: Rows | None = None) -> None:
        """Put all agents at rest at their starts, each world on its own floor.

        Args:
            starts: places ``(x, z, heading)`` of the agents, [n, A, 3].
            floors: free floor of each of the n worlds.
            rows: numbers of these worlds (default: all).
        """
        rows = np.arange(self.worlds) if rows is None else rows
        self.rest_at(starts, rows)
        # the first call places all worlds; later ones may replace the floors of some
        if len(self.floors) != self.worlds:
            self.floors = list(floors)
        for w, free in zip(rows.tolist(), floors, strict=True):
            self.floors[w] = free
        self.floor_y = np.array([free.floor_y for free in self.floors])
        # by identity, as maps have no other equality: worlds share one where they were given the same object
        number = {id(free): k for k, free in enumerate(dict.fromkeys(self.floors))}
        of = np.array([number[id(free)] for free in self.floors])
        self.groups = [(self.floors[g[0]], g) for g in (np.flatnonzero(of == k) for k in np.unique(of))]
        self._uneven = tuple((free, group) for free, group in self.groups if len(free.heights))
        # a recorded posture belongs to the episode that is over
        self._kept.clear()
        self._arms.clear()
        self.blocked[rows] = False
        self.touching[rows] = self._touching(rows)

    def rest_at(self, starts: Array, rows: Rows) -> None:
        """Put agents of the worlds ``rows`` [n] at rest at their starts ``(x, z, heading)`` [n, A, 3], with empty hands."""
        joints = [own.joints.shape[1] for own in self.state.robots]
        fresh = WorldState.zeros(
            len(rows),
            robots=len(joints),
            people=len(self.state.people),
            joints=joints,
            objects=self.state.object_pose.shape[1],
            scene_joints=self.state.joint_pos.shape[1],
        )
        for k, (member, own) in enumerate(zip(self.roster, fresh.agents, strict=True)):
            own.xz[:], own.heading[:] = starts[:, k, :2], starts[:, k, 2]
            if isinstance(own, RobotState):
                own.joints[:] = member.body.rest
        # the state one step ago too: agents at rest have no velocity in their first observation
        for state in (self.state, self.before, self.start):
            state.put(rows, fresh)

    def step(self, commands: Sequence[Command | None]) -> None:
        """Move all agents by one step of 1/30 s: people first, then robots, as in Habitat.

        Raises:
            InputError: the number of commands is wrong, or one has a wrong shape or is not finite; then
                nothing has moved.
        """
        commands = self._checked(commands)
        self.was.block[:] = self.now.block
        posed = {k: command for k, command in enumerate(commands) if isinstance(command, PoseCommand)}
        if posed:
            self._move_posed(posed)
        alone = len(self.groups) == 1
        for free, rows in self.groups:
            # one pass over the agents, in any order: what they do in a step depends on the map alone, not on the others
            at = slice(None) if alone else rows
            for k, (everywhere, command) in enumerate(zip(self.state.agents, commands, strict=True)):
                # a tuple, as Python makes a union of classes anew in every step
                if isinstance(command, (RecordedPoseCommand, PoseCommand)):
                    continue
                if isinstance(command, GaitCommand):
                    assert isinstance(everywhere, HumanState)
                    everywhere.put(at, command.gait.take(at))
                    continue
                # numbers of rows copy, unlike the slice: what has moved is put back at the end
                own, values = everywhere if alone else everywhere.take(rows), command[0][at]
                if isinstance(own, RobotState):
                    drive_robots(own, self._driven_on(k, free), values, self.bases[k])
                    self.blocked[at, k] = own.contact
                elif isinstance(command, WaypointCommand):
                    walk_humans(own, values, self.walker)
                else:
                    # as they stood before the step, so that the order of the agents does not matter
                    others = self._discs_beside(k, self.before.agents)[at] if self._solid else None
                    self.blocked[at, k] = drive_people(
                        own, free, values, self.walker, radius_m=self._person_radius_m, others=others
                    )
                if isinstance(own, HumanState):
                    draw_arms(own, free, self.roster[k].body, self.walker.arms)  # type: ignore[arg-type]
                if not alone:
                    everywhere.put(rows, own)  # type: ignore[arg-type]
        for k, command in enumerate(commands):
            if isinstance(command, RecordedPoseCommand):
                self._keep(k, command)
        self.touching = self._touching(self.rows)

    def _move_posed(self, posed: Mapping[int, PoseCommand]) -> None:
        """Move people to the places that commands give them, all of them at once: the map does not change where they get."""
        every, robots = len(posed) == len(self.state.people), len(self.state.robots)
        rows = slice(None) if every else np.concatenate([(k - robots) * self.worlds + self.rows for k in posed])
        own = self.people if every else self.people.take(rows)
        # the arrays of one person need no copy
        alone, given = len(posed) == 1, tuple(posed.values())
        points, headings, seats = given[0] if alone else (np.concatenate(part) for part in zip(*given, strict=True))
        move_people(own, points, headings, self.walker)
        own.seat[:] = seats
        if not every:
            self.people.put(rows, own)
        if alone and every and len(self.groups) == 1:
            draw_arms(own, self.floors[0], self.roster[robots].body, self.walker.arms)  # type: ignore[arg-type]
            return
        if tuple(posed) not in self._arms:
            # people with one body on one map draw in their arms together
            alike: dict[tuple[int, int], list[int]] = {}
            for k in posed:
                for w, free in enumerate(self.floors):
                    alike.setdefault((id(self.roster[k].body), id(free)), []).append((k - robots) * self.worlds + w)
            self._arms[tuple(posed)] = [np.array(those) for those in alike.values()]
        for those in self._arms[tuple(posed)]:
            k, w = robots + those[0] // self.worlds, those[0] % self.worlds
            drawn = self.people if len(those) == len(self.people.heading) else self.people.take(those)
            draw_arms(drawn, self.floors[w], self.roster[k].body, self.walker.arms)  # type: ignore[arg-type]
            self.people.arms[those] = drawn.arms

    def heights(self, xz: Array) -> Array:
        """Return the height of the floor [W] [m] at a place ``(x, z)`` in each world [W, 2]."""
        if not self._uneven:
            return self.floor_y
        height = self.floor_y.copy()
        for free, group in self._uneven:
            height[group] = free.height_at(xz[group])
        return height

    def roots(self, agent: int, rows: Rows) -> Array:
        """Return the poses (pose7) [n, 7] of an agent's roots in the worlds ``rows`` [n]."""
        own, body = self.state.agents[agent], self.roster[agent].body
        poses = ground_pose(own.xz[rows], own.heading[rows], self.floor_y[rows])
        for free, group in self._uneven:
            at = np.isin(rows, group)
            poses[at] = root_pose(body, own.xz[rows[at]], own.heading[rows[at]], free)
        return poses

    def geodesic(self, a: int, b: int, rows: Rows | None = None) -> Array:
        """Return the lengths [n] [m] of the shortest paths between two agents in worlds ``rows`` [n] (default: all)."""
        xz, other = self.state.agents[a].xz, self.state.agents[b].xz
        if rows is None and len(self.groups) == 1:
            return self.groups[0][0].geodesic(xz, other)
        lengths = np.zeros(self.worlds)
        for free, group in self.groups:
            at = group if rows is None else np.intersect1d(group, rows)
            lengths[at] = free.geodesic(xz[at], other[at])
        return lengths if rows is None else lengths[rows]

    def clearance(self, points: Array) -> Array:
        """Return the signed distance [W, n] [m] of points [W, n, 2] to the nearest obstacle."""
        left = np.empty(points.shape[:-1])
        for free, rows in self.groups:
            left[rows] = free.signed_distance(points[rows])
        return left

    def free_along(self, xz: Array, headings: Array, max_m: float) -> Array:
        """Return the distance [W, R] [m] to the nearest obstacle, from places [W, 2] along headings [W, R] [rad].

        The distance is at most ``max_m`` [m].
        """
        reach = np.empty(headings.shape)
        for free, rows in self.groups:
            reach[rows] = free.free_along(xz[rows], headings[rows], max_m=max_m)
        return reach

    def circles(self, agent: int, *, legs: bool = False) -> Array:
        """Return all other agents as circles ``(x, z, radius)`` [W, N, 3] [m].

        Robots are the discs of their bases. A person is one disc, or with ``legs`` two circles for the legs in their
        posture.
        """
        return self._discs_beside(agent, self.state.agents, legs=legs)

    def in_root_frame(self, own: AgentState, points: Array) -> Array:
        """Transform world points [W, n, 3] [m] to the agent root frames of the agents with the state ``own``."""
        root = ground_pose(own.xz, own.heading, self.heights(own.xz))[:, None]
        return np.asarray(quat_rotate(quat_conjugate(root[..., 3:]), points - root[..., :3]))

    def posture(self, agent: int, rows: Rows) -> Posture:
        """Return a person's posture in the worlds ``rows`` [n], in float32 precision, as it is recorded."""
        if agent in self._kept:
            kept = self._kept[agent]
            return Posture(kept.clip[rows], kept.phase[rows], kept.blend[rows], kept.arms[rows], kept.seat[rows])
        own, body = self.state.agents[agent], self.roster[agent].body
        assert isinstance(own, HumanState)
        assert isinstance(body, Humanoid)
        clip = self.clips[agent]
        walk = body.clips[clip]
        phase = cycle_phase(walk, own.distance[rows], own.set_off[rows])
        return Posture(
            np.full(len(rows), clip), *map(_recorded, (phase, own.blend[rows], own.arms[rows], own.seat[rows]))
        )

    # --- parts of a step ----------------------------------------------------------------------------------------------
    def _checked(self, commands: Sequence[Command | None]) -> list[Command]:
        if len(commands) != len(self.roster):
            raise InputError(
                f"Expected one command for each of {len(self.roster)} agents, got {len(commands)}.", code="H3-SIM-051"
            )
        checked: list[Command] = []
        posed = [command.points for command in commands if isinstance(command, PoseCommand)]
        # people of crowds are many, so they are looked at together first
        sound = not posed or (
            all(isinstance(p, np.ndarray) and p.shape == (self.worlds, 2) and p.dtype == np.float64 for p in posed)
            and first_not_finite(posed[0] if len(posed) == 1 else np.concatenate(posed)) < 0
        )
        for member, command, width in zip(self.roster, commands, self.widths, strict=True):
            assert command is not None, "agents with skills move themselves"
            known = sound and isinstance(command, PoseCommand) and member.kind == "human"
            if known or isinstance(command, (RecordedPoseCommand, GaitCommand)):
                checked.append(command)
                continue
            values = np.asarray(command[0], np.float64)
            if member.kind == "robot" and not isinstance(command, DriveCommand):
                raise InputError(
                    f"{member.name} drives: expected DriveCommand, got {type(command).__name__}.", code="H3-SIM-054"
                )
            # the shape first: the kernel expects two axes
            if values.shape != (self.worlds, width) or first_not_finite(values) >= 0:
                infinite = "" if np.isfinite(values).all() else " with numbers that are not finite"
                raise InputError(
                    f"Expected finite actions of {member.name}, shape {[self.worlds, width]}, got shape "
                    f"{list(values.shape)}{infinite}.",
                    code="H3-SIM-053",
                )
            if values is not command[0]:
                command = command._replace(points=values) if isinstance(command, PoseCommand) else type(command)(values)
            checked.append(command)
        return checked

    def _discs_beside(self, agent: int, agents: Sequence[AgentState], *, legs: bool = False) -> Array:
        """Return the discs ``(x, z, radius)`` of all others in a state, [W, N, 3]."""
        # a lone agent has nobody beside it, and `np.concatenate` takes no empty list
        discs = [np.zeros((self.worlds, 0, 3))]
        for k, (member, was) in enumerate(zip(self.roster, agents, strict=True)):
            if k == agent:
                continue
            if legs and isinstance(member.body, Humanoid):
                clip, phase, blend, _, seat = self.posture(k, self.rows)
                posture = member.body.clip_pose(clip, phase, blend)
                take_seats(member.body, *posture, seat)
                # posed at the origin, as `legs_at` takes shins in the frame of the root
                joints = member.body.joint_matrices(np.tile(IDENTITY_POSE, (self.worlds, 1)), *posture)
                discs.append(legs_at(np, was.xz, was.heading, shins(joints)))
                continue
            discs.append(discs_at(was.xz, was.heading, *self._discs[k]))
        return np.concatenate(discs, axis=1)

    def _driven_on(self, agent: int, free: FreeSpace) -> FreeSpace:
        """Return the map on which a robot moves: to one that does not climb, stairs are walls."""
        body = self.roster[agent].body
        return free if not free.has_stairs or body.climbs_stairs else free.without_stairs

    def _keep(self, agent: int, command: RecordedPoseCommand) -> None:
        own = self.state.agents[agent]
        if isinstance(own, HumanState):
            # before the place is overwritten, from which the distance walked is measured
            own.distance[:] += np.hypot(*(command.xz - own.xz).T)
            own.xz[:], own.heading[:], self._kept[agent] = command.xz, command.heading, command.posture
            own.seat[:] = command.posture.seat

    def _touching(self, rows: Rows) -> NDArray[np.bool_]:
        """Return the pairs that touch in the worlds ``rows`` [n], [n, P]."""
        return (
            self._contact.touching(self, rows)
            if self._finds_contact
            else np.zeros((len(rows), len(self.pairs)), np.bool_)
        )


@kernel(error_model="numpy")
def _near_pairs(xz, seats, hands, rows, pairs, gates, near):
    """Mark pairs [P, 2] of agents at ``xz`` [A, W, 2] that are at most ``gates`` [P] apart in the worlds ``rows`` [n].

    Gates are wider where one of the people, the last agents, lies or reaches for something, as their ``seats`` and
    ``hands`` say (`HumanState`). Marks go to ``near`` [n, P], which are false; returns whether there are any.
    """
    some, worlds, robots = False, xz.shape[1], xz.shape[0] - len(seats) // xz.shape[1]
    for n in range(len(rows)):
        w = rows[n]
        for p in range(len(pairs)):
            gate, wide = gates[p], False
            for k in pairs[p]:
                if k >= robots:
                    row = (k - robots) * worlds + w
                    wide |= seats[row, 1] > 1.0
                    for hand in range(hands.shape[1]):
                        wide |= hands[row, hand, 3] != 0.0
            gate += LYING_M * wide
            a, b = pairs[p, 0], pairs[p, 1]
            near[n, p] = math.hypot(xz[a, w, 0] - xz[b, w, 0], xz[a, w, 1] - xz[b, w, 1]) <= gate
            some |= near[n, p]
    return some


class _PairContacts:
    """Contact between all pairs of agents: by distance first, then by FCL in the worlds where a pair is near."""

    def __init__(
        self, roster: Sequence[AgentSpec], pairs: Sequence[tuple[int, int]], person_contact: PersonContact
    ) -> None:
        self._roster, self._pairs = roster, pairs
        self._person_contact: PersonContact = person_contact
        # a robot that keeps its posture beside a person: posed together, as recorded
        # one for each two bodies, whoever has them
        count = kinds_of(roster).count("robot")
        bodies = {(id(a.body), id(b.body)): (a.body, b.body) for a in roster[:count] for b in roster[count:]}
        kinds = {
            key: RobotHumanContact(*both, person_contact=person_contact)  # type: ignore[arg-type]
            for key, both in bodies.items()
        }
        self._of = [kinds.get((id(roster[a].body), id(roster[b].body))) for a, b in pairs]
        reach = [
            *(robot_reach(member.robot, member.robot.rest) for member in roster[:count]),
            *(clip_reach(member.body, person_contact) for member in roster[count:]),
        ]
        # 1 mm wider than the gate of `touching`, which asks by places rounded to float32
        gates = [
            reach[a] + reach[b] if own is None else own.gate_m + 1e-3
            for (a, b), own in zip(pairs, self._of, strict=True)
        ]
        self._gates, self._numbers = np.array(gates), np.array(pairs, np.intp).reshape(-1, 2)
        self._others = np.array([p for p, own in enumerate(self._of) if own is None], np.intp)
        shapes = (body_shapes(m.body, person_contact) for m in roster)
        self._contacts = AgentContacts(*shapes) if len(self._others) else None

    def touching(self, world: World, rows: Rows) -> NDArray[np.bool_]:
        if not self._pairs:
            return np.zeros((len(rows), 0), np.bool_)
        result, robots = np.zeros((len(rows), len(self._pairs)), np.bool_), len(world.state.robots)
        own = world.people
        if not _near_pairs(world.now.xz, own.seat, own.hands, rows, self._numbers, self._gates, result):
            return result
        # people of one body beside robots of one body are posed together
        asked: dict[RobotHumanContact | None, list[int]] = {}
        for p in np.flatnonzero(result.any(0)).tolist():
            asked.setdefault(self._of[p], []).append(p)
        asked.pop(None, None)
        for contact, pairs in asked.items():
            assert contact is not None
            near, told = [np.flatnonzero(result[:, p]) for p in pairs], []
            for p, those in zip(pairs, near, strict=True):
                (a, b), at = self._pairs[p], rows[those]
                hands = world.people.hands[(b - robots) * world.worlds + at]
                told.append((world.roots(a, at), world.roots(b, at), *world.posture(b, at), hands))
            robot, human, clip, phase, blend, arms, seats, hands = map(np.concatenate, zip(*told, strict=True))
            bases = robot.astype(np.float32), human.astype(np.float32)
            led = hands if hands.any() else None
            touched = contact.touching(*bases, clip, phase, blend, arms, seats, led)
            for p, those, own in zip(
                pairs, near, np.split(touched, np.cumsum([len(n) for n in near])[:-1]), strict=True
            ):
                result[those, p] = own
        if self._contacts is not None:
            self._decide(world, rows, result)
        return result

    def _decide(self, world: World, rows: Rows, near: NDArray[np.bool_]) -> None:
        """Ask FCL about the near pairs that are not a robot and a person, in place; only who is in one of them is posed."""
        assert self._contacts is not None
        near_others = near[:, self._others]
        asked = {k: self._others[near_others[k]].tolist() for k in np.flatnonzero(near_others.any(1)).tolist()}
        # each agent once, however many of its pairs are near
        each = {k: sorted({number for p in pairs for number in self._pairs[p]}) for k, pairs in asked.items()}
        who = [(k, number) for k, numbers in each.items() for number in numbers]
        frames = self._posed(world, [(int(rows[k]), number) for k, number in who])
        for k, pairs in asked.items():
            for number in each[k]:
                self._contacts.update(number, frames[int(rows[k]), number])
            for p in pairs:
                near[k, p] = self._contacts.collides(*self._pairs[p])

    def _posed(self, world: World, who: Sequence[tuple[int, int]]) -> dict[tuple[int, int], Array]:
        """Return frames of the shapes of agents, each given by world and number.

        Those with one body and floor are posed together.
        """
        uneven = {int(w): free for free, group in world._uneven for w in group}
        alike: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for w, number in who:
            # level floors count as one (None): only their heights differ, which are given row by row
            body = number if number < len(world.state.robots) else id(self._roster[number].body)
            alike.setdefault((body, id(uneven.get(w))), []).append((w, number))
        frames: dict[tuple[int, int], Array] = {}
        for those in alike.values():
            w, number = those[0]
            body = self._roster[number].body
            robots, at = len(world.state.robots), np.array([row for row, _ in those])
            if number < robots:
                together = world.state.robots[number].take(at)
            else:
                together = world.people.take(np.array([(n - robots) * world.worlds for _, n in those]) + at)
            floor = uneven.get(w, world.floor_y[[row for row, _ in those]])
            posed = body_frames(body, together, floor, speed_mps=world.walker.speed_mps)
            frames |= dict(zip(those, shape_frames(body, posed, self._person_contact), strict=True))
        return frames


def _recorded(values: Array) -> Array:
    """Return numbers as they are after having been written in float32."""
    return values.astype(np.float32).astype(np.float64)
