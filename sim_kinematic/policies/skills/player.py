"""Execution of a learned skill: a network moves a robot's base, arm and hand until the skill succeeds or fails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data.geometry import Array
from h3data.scene import FreeSpace
from sim_kinematic.agents.robots.skills import RobotActor
from sim_kinematic.agents.skills import Action, Skill, SkillResult
from sim_kinematic.motion.spec import SkillSpec
from sim_kinematic.motion.state import NOBODY, ROBOT
from sim_kinematic.policies.visual_policy import BASE_ACTIONS, VisualPolicy
from sim_kinematic.sensing.sensor import first_point, in_frame
from sim_kinematic.sensing.table import OF_SKILLS, TABLE, Pose


class SkillView(NamedTuple):
    """State of a robot that carries out a learned skill with an object."""

    free: FreeSpace
    """Floor on which the robot's base moves."""
    xz: Array
    """Position of the base on the floor [2] [m]."""
    heading: float
    before: tuple[Array, float]
    """Position [2] [m] and heading [rad] of the base one step ago."""
    point: Array
    """Point at which the object lies or has to be placed, [3] [m]."""
    stand_xz: Array
    """Position of the base from which the hand reaches the target, [2] [m]."""
    hand: Array
    """Pose (pose7) of the hand in the world, [7]."""
    resting: Array
    """Position of the hand at rest in the world, [3] [m]."""
    arm: Array
    """Positions of the arm's joints, [n] [rad or m]."""
    holds: bool
    """True if the hand holds an object."""
    beyond_m: float
    """Distance from the base within which waypoints are skipped [m]."""

    @property
    def path_m(self) -> float:
        """Length of the shortest path from the base to the stand [m]."""
        return float(self.free.geodesic(self.xz, self.stand_xz, max_snap_m=1.0))


class SkillContext:
    """View of a skill as a `sim_kinematic.sensing.table.Context` of one world, in which the path leads to the stand."""

    xp = np
    agent = ROBOT

    def __init__(self, view: SkillView) -> None:
        self._view, self.arm, self.target, self.resting = view, view.arm, view.point, view.resting
        self.now = Pose(view.xz, np.asarray(view.heading))
        self.before = Pose(*view.before)
        # one object that the agent or nobody holds: `is_holding` asks no more
        self.held_by = np.array([ROBOT if view.holds else NOBODY])

    def path(self) -> tuple[Array, Array]:
        """Return the shortest path to the stand: its length [] [m] and its first waypoint [2] [m]."""
        view, length = self._view, self._view.path_m
        return np.asarray(length), first_point(view.free, view.xz, view.stand_xz, length, beyond_m=view.beyond_m)

    def clearance(self, points: Array) -> Array:
        """Return signed distance [n] [m] of points [n, 2] to the nearest obstacle."""
        return self._view.free.signed_distance(points)

    def in_hand(self, points: Array) -> Array:
        """Return world points [n, 3] [m] in the frame of the hand."""
        return in_frame(self._view.hand, points)


def observe(view: SkillView, names: Sequence[str]) -> dict[str, NDArray[np.float32]]:
    """Return the named observations, some of `sim_kinematic.sensing.table.OF_SKILLS`, each float32 [n]."""
    moment = SkillContext(view)
    return {name: np.asarray(TABLE[name].of(moment), np.float32) for name in names}


TASKS = {"skill_nav": ("nav_to_object", "nav_to_goal"), "skill_pick": ("pick",), "skill_place": ("place",)}
"""Skills of the upper layer that a policy file provides, by the name of the task on its card."""
PICTURE = "arm_depth"


class NetworkSkill:
    """Learned skill of a robot, played by a network whose recurrent state is reset each time that the skill starts."""

    def __init__(self, network: VisualPolicy, *, robot: str = "", rules: SkillSpec | None = None) -> None:
        """Check that the network fits the robot.

        Args:
            network: the policy.
            robot: name of the robot's body; empty if unknown.
            rules: rules of learned skills.

        Raises:
            FormatError: the network is for another task or robot, or needs observations that skills do not have.
        """
        card = network.card
        if card.task not in TASKS:
            raise FormatError(
                f"Expected weights for one of the tasks {', '.join(TASKS)}, these are for {card.task!r}.",
                code="H3-POLICY-057",
            )
        if robot and robot != card.robot:
            raise FormatError(
                f"These weights drive the robot {card.robot}, the episode has {robot}.", code="H3-POLICY-058"
            )
        known = (PICTURE, *OF_SKILLS)
        strangers = [name for name in card.observations if name not in known]
        if strangers:
            raise FormatError(
                f"A skill from a file is not shown {', '.join(strangers)}. There are: {', '.join(known)}.",
                code="H3-POLICY-059",
            )
        # navigation moves the base alone; picking and placing move arm and grip too
        if (card.actions == BASE_ACTIONS) != (card.task == "skill_nav"):
            raise FormatError(
                f"The weights for {card.task} have {card.actions} outputs, which is not what it takes.",
                code="H3-POLICY-060",
            )
        self.network, self.rules = network, rules or SkillSpec()

    @property
    def skills(self) -> tuple[str, ...]:
        """Names of the skills of the upper layer that use the network."""
        return TASKS[self.network.card.task]

    def infeasible(self, actor: RobotActor, action: Action) -> str:
        """Return the reason why the skill cannot start; empty if it can."""
        if action.skill in ("nav_to_object", "nav_to_goal"):
            return ""
        gap = self._point(actor, action)[[0, 2]] - actor.xz
        # 6.0: largest distance from the target at which ``pick`` and ``place`` begin [m]
        return "out_of_reach" if float(np.hypot(*gap)) > 6.0 else ""

    def start(self, actor: RobotActor, action: Action) -> Skill:
        """Start the skill, in which the network is evaluated in each step until the skill succeeds or fails."""
        point = self._point(actor, action)
        stand = actor.open_stand(point)
        if stand is None:
            return SkillResult("failed", "no_way")
        return (yield from self.play(actor, action, point, stand[:2]))

    def play(self, actor: RobotActor, action: Action, point: Array, stand_xz: Array) -> Skill:
        """Move a robot by the network to handle a point [3] that is reached from a place [2]."""
        network, moves_arm = self.network, self.network.card.task != "skill_nav"
        state, command = network.start(), np.zeros(network.outputs, np.float32)
        before = actor.xz.copy(), actor.heading
        # one step old where `_ending` reads it: a hand that was never full has dropped nothing
        held = actor.objects.held(actor.number) == action.target
        step = 0
        while step < (self.rules.arm_steps if moves_arm else self.rules.nav_steps):
            # meanwhile the network is not asked, and its steps do not count
            if actor.aside is not None:
                actor.step_aside()
                yield
                continue
            view = self._view(actor, point, stand_xz, before)
            if step % network.card.hold == 0:
                out, state = network(self._shown(actor, view), command, state)
                command = np.clip(np.nan_to_num(out, nan=0.0), -1, 1)
            before = actor.xz.copy(), actor.heading
            actor.obey(command, point[[0, 2]])
            step += 1
            yield
            ending = self._ending(actor, action, point, stand_xz, before, held)
            if ending is not None:
                return ending
            held = actor.objects.held(actor.number) == action.target
        return SkillResult("failed", "timed_out")

    def _point(self, actor: RobotActor, action: Action) -> Array:
        """Return the point [3] [m] at which the object of an action lies now, or is to be placed."""
        to_object = action.skill in ("nav_to_object", "pick")
        # a copy, as it lies now: its pose changes once it is taken
        k = action.target
        return (actor.objects.poses[k, :3] if to_object else actor.objects.goals[k]).copy()

    def _shown(self, actor: RobotActor, view: SkillView) -> dict[str, NDArray[Any]]:
        """Return the present observations of the network by name."""
        card = self.network.card
        shown: dict[str, NDArray[Any]] = dict(observe(view, [name for name in card.observations if name != PICTURE]))
        if not self.network.sees:
            return shown
        objects, company = actor.objects, actor.company
        if objects.scene is None or company is None:
            raise InputError(f"The skill needs {PICTURE}, and nobody takes pictures here.", code="H3-POLICY-061")
        from sim_kinematic.sensing.eyes import see

        return shown | see(
            objects.state,
            objects.scene,
            company.bodies,
            (PICTURE,),
            agent=actor.number,
            size=card.picture_size,
            objects=objects.names,
            frames=company.frames(),
        )

    def _view(self, actor: RobotActor, point: Array, stand_xz: Array, before: tuple[Array, float]) -> SkillView:
        return SkillView(
            free=actor.free,
            xz=actor.xz,
            heading=actor.heading,
            before=before,
            point=point,
            stand_xz=stand_xz,
            hand=actor.hand_pose,
            resting=actor.resting_point,
            arm=actor.arm,
            holds=actor.objects.held(actor.number) >= 0,
            beyond_m=actor.base.disc_radius_m / 2,
        )

    def _ending(
        self, actor: RobotActor, action: Action, point: Array, stand_xz: Array, before: tuple[Array, float], held: bool
    ) -> SkillResult | None:
        """Return the result if the skill ended in the last step, by the rules of training; None if it continues."""
        rules, objects, k = self.rules, actor.objects, action.target
        if action.skill in ("nav_to_object", "nav_to_goal"):
            gap = point[[0, 2]] - actor.xz
            straight = float(np.hypot(*gap))
            cosine = float(gap @ [np.cos(actor.heading), -np.sin(actor.heading)]) / max(straight, 1e-9)
            if straight >= rules.near_m or cosine <= rules.facing_dot:
                return None
            # the path last, as it takes a search; near the object but behind a wall is not there
            view = self._view(actor, point, stand_xz, before)
            return SkillResult("done") if view.path_m < rules.near_m else None
        folded = float(np.linalg.norm(actor.hand_pose[:3] - actor.resting_point)) < rules.rest_m
        holds = objects.held(actor.number)
        if action.skill == "pick":
            if holds == k:
                return SkillResult("done") if folded else None
            if held:
                return SkillResult("failed", "dropped")
            if holds >= 0:
                return SkillResult("failed", "wrong_object")
            return None if objects.held_by[k] == NOBODY else SkillResult("failed", "held_by_other")
        if holds == k:
            return None
        is_placed = objects.held_by[k] == NOBODY and float(np.linalg.norm(objects.poses[k, :3] - point)) < rules.place_m
        if not is_placed:
            return SkillResult("failed", "dropped" if holds < 0 else "wrong_object")
        return SkillResult("done") if folded else None
