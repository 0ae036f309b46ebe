"""Skills nav, pick and place in W worlds on a device, with a robot alone.

The low-level control equals that of `sim_kinematic.agents.robots.skills` in each step, and rewards are those of the
paper (appendix, low-level skill training).

State, actions and results stay on the device, and no operation waits for it. Base, joints, grip and the held object
with its pose are as on the CPU. Unlike on the CPU, paths are looked up (`h3data_training.torch.geodesic`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from h3data.bodies import Robot, load_robot
from h3data.errors import InputError
from h3data.geometry import Array, quat_to_matrix
from h3data_training.torch.geodesic import Lattices, ShortestPath, shortest_path
from h3data_training.torch.rules import refuse_others
from h3data_training.torch.seen import clearance, read_sensors
from h3data_training.torch.skills.arm import Arm, Hand, place_hand, seen_by, turned
from h3data_training.torch.skills.bank import SkillBank
from h3data_training.torch.skills.driving import Drive
from h3data_training.torch.state import RobotTensors
from h3data_training.torch.step import Grids, heading_direction
from sim_kinematic.agents.robots.hand_reach import hand_target, reach_posture
from sim_kinematic.avoidance.robot_base import base_of, carrying_base_of
from sim_kinematic.motion.spec import HOME_BASE, ArmSpec, BaseSpec, SkillSpec
from sim_kinematic.motion.state import ROBOT
from sim_kinematic.sensing.sensor import FAR_M
from sim_kinematic.sensing.table import OF_SKILLS, Pose
from sim_kinematic.tasks.skills.skill_starts import Skill

NOTHING = -1
"""Number for an empty hand."""


class SkillPlay(NamedTuple):
    """State of W worlds in their episodes."""

    robot: RobotTensors
    joints: Tensor
    """Positions of the arm's joints, [W, n]."""
    objects: Tensor
    """Positions of the objects [W, K, 3] [m]."""
    turned: Tensor
    """Axes of the objects as columns, [W, K, 3, 3]."""
    grip: Tensor
    """Axes of the object in the hand, in the frame of the hand, [W, 3, 3]."""
    held: Tensor
    """Number of the object in the hand, int64 [W]."""
    wide: Tensor
    """True if the base also keeps a distance for the size of the held object, bool [W]."""
    episode: Tensor
    """Number of the episode in the bank, int64 [W]."""
    steps: Tensor
    ended: Tensor
    """True if the episode is over, so that the next step starts another, bool [W]."""
    way: Tensor
    """Length of the path to the stand [W] [m]."""
    towards: Tensor
    """Direction (x, z) in which the path to the stand starts, not normalised, [W, 2]."""
    apart: Tensor
    """Distance from the hand to the target [W] [m]."""
    folded: Tensor
    """Distance from the hand to its resting position [W] [m]."""
    paid: Tensor
    """True if the object being at its goal has been rewarded, bool [W]."""
    before_xz: Tensor
    before_heading: Tensor
    reward: Tensor
    """Reward of the last step [W]."""
    success: Tensor
    """True if the skill succeeded in the last step, bool [W]."""
    terminated: Tensor
    """True if the skill has succeeded or can no longer succeed, bool [W]."""
    truncated: Tensor
    """True if the skill reached its time limit, bool [W]."""

    def tensors(self) -> Iterator[Tensor]:
        """Yield all tensors, in a fixed order."""
        for part in self:
            yield from (part if isinstance(part, tuple) else (part,))


def _reaching(robot: Robot, bank: SkillBank) -> Array:
    """Return joints of a robot's arm that reach for each target of a bank from its stand, [N, n]."""
    columns, floors = list(robot.require_arm()), np.array([floor.floor_y for floor in bank.floors])
    distances = np.hypot(*(bank.point[:, [0, 2]] - bank.stand).T).round(2)
    heights = (bank.point[:, 1] - floors[bank.place]).round(2)
    spots, which = np.unique(np.stack([distances, heights], 1), axis=0, return_inverse=True)
    targets = np.stack([hand_target(robot, distance, height) for distance, height in spots.tolist()])
    return reach_posture(robot, targets).joint_pos[:, columns][which.ravel()]


class SkillContext(NamedTuple):
    """Data of robots with a skill to learn in W worlds, from which sensors read (`sim_kinematic.sensing.table`)."""

    play: SkillPlay
    grids: Grids
    """Grids of the worlds' floors."""
    hand: Hand
    target: Tensor
    """World position of the target [W, 3] [m]."""
    resting: Tensor
    """Resting position of the hand [W, 3] [m]."""

    @property
    def xp(self) -> ModuleType:
        """Array namespace of the tensors."""
        return torch

    @property
    def agent(self) -> int:
        """Number of the robot."""
        return ROBOT

    @property
    def now(self) -> RobotTensors:
        """Current state of the robots."""
        return self.play.robot

    @property
    def before(self) -> Pose:
        """State of the robots before the last step."""
        return Pose(self.play.before_xz, self.play.before_heading)

    @property
    def arm(self) -> Tensor:
        """Positions of the arm's joints [W, n] [rad or m]."""
        return self.play.joints

    @property
    def held_by(self) -> Tensor:
        """Number of the agent that holds the object, [W, 1]."""
        return self.play.held.clamp_max(ROBOT)[:, None]  # an empty hand holds object -1, which is nobody's number

    def path(self) -> tuple[Tensor, Tensor]:
        """Return the length of the shortest path to the stand [W] [m], and a point in its initial direction [W, 2]."""
        return self.play.way, self.play.robot.xz + self.play.towards

    def clearance(self, points: Tensor) -> Tensor:
        """Return the signed distance [W, n] [m] of points [W, n, 2] to the nearest obstacle."""
        return clearance(self.grids, points)

    def in_hand(self, points: Tensor) -> Tensor:
        """Transform world points [W, n, 3] into the frames of the hands."""
        return seen_by(Hand(self.hand.point[:, None], self.hand.axes[:, None]), points)


class SkillTensors:
    """W worlds, each in an episode of a bank, which start the following episode in the step after the end of one."""

    def __init__(
        self,
        skill: Skill,
        bank: SkillBank,
        *,
        device: torch.device | str,
        dtype: torch.dtype,
        robot: str = "quad_arm",
        base: BaseSpec | None = None,
        rules: SkillSpec | None = None,
        arm: ArmSpec | None = None,
    ) -> None:
        """Copy a bank of starts to the device.

        Args:
            skill: name of the skill (nav, pick or place).
            bank: episodes of the skill.
            device: device of all tensors.
            dtype: type of the state.
            robot: name of a built-in robot.
            base: rules for bases (default: `sim_kinematic.motion.spec.HOME_BASE`).
            rules: rules of the skills.
            arm: rules of the arm.

        Raises:
            InputError: the robot has no arm, or its base has rules of sliding that devices do not support.
        """
        self.skill, self.bank = skill, bank
        self.device, self.dtype = torch.device(device), dtype
        self.rules, self.arm_rules = rules or SkillSpec(), arm or ArmSpec()
        body = load_robot(robot)
        self.arm = Arm(body, self.device, dtype)
        own = base_of(body, base or HOME_BASE)
        refuse_others("base of a skill", own)
        refuse_others("skill", self.rules)
        refuse_others("arm of a skill", self.arm_rules)
        grids = Grids.of(bank.floors, self.device, dtype)
        self.drive = Drive(grids=grids, base=own, carrying=carrying_base_of(body, own))
        self.lattices = Lattices.of(bank.floors, self.device, dtype)
        self.rest = self.arm.hand(self.arm.rest[None]).point[0]
        """Place of the hand at rest in the agent root frame, [3]."""
        self._reaching = torch.as_tensor(_reaching(body, bank), dtype=dtype, device=self.device)

        def on_device(rows: Any) -> Tensor:
            tensor = torch.as_tensor(rows, device=self.device)
            return tensor.to(dtype) if tensor.is_floating_point() else tensor

        self._starts = torch.cat([on_device(bank.xz), on_device(bank.heading[:, None])], 1)
        unfolded = np.zeros(len(bank)) if bank.unfolded is None else bank.unfolded
        self._joints = torch.lerp(self.arm.rest.expand_as(self._reaching), self._reaching, on_device(unfolded[:, None]))
        self._place, self._target, self._holds = map(on_device, (bank.place, bank.target, bank.holds))
        self._objects, self._point, self._stand = map(on_device, (bank.objects, bank.point, bank.stand))
        self._turned, self._straight = on_device(quat_to_matrix(bank.turned)), on_device(np.eye(3))
        self._floor_y = on_device([float(floor.floor_y) for floor in bank.floors])

    @property
    def action_width(self) -> int:
        """Number of values of an action: base [2], for pick and place also arm [n] and grip [1]."""
        return 2 if self.skill == "nav" else self.arm.count + 3

    @property
    def most_steps(self) -> int:
        """Time limit of the skill in steps."""
        return self.rules.nav_steps if self.skill == "nav" else self.rules.arm_steps

    def before_the_first(self, episode: Tensor) -> SkillPlay:
        """Return worlds whose first step starts the episodes after ``episode`` [W]."""
        worlds = len(episode)

        def numbers(*axes: int) -> Tensor:
            return torch.zeros((worlds, *axes), dtype=self.dtype, device=self.device)

        def flags() -> Tensor:
            return torch.zeros(worlds, dtype=torch.bool, device=self.device)

        return SkillPlay(
            robot=RobotTensors(numbers(2), numbers(), flags()),
            joints=numbers(self.arm.count),
            objects=numbers(self.bank.objects.shape[1], 3),
            turned=numbers(self.bank.objects.shape[1], 3, 3),
            grip=numbers(3, 3),
            held=torch.full_like(episode, NOTHING),
            wide=flags(),
            episode=episode.clone(),
            steps=torch.zeros_like(episode),
            ended=~flags(),
            way=numbers(),
            towards=numbers(2),
            apart=numbers(),
            folded=numbers(),
            paid=flags(),
            before_xz=numbers(2),
            before_heading=numbers(),
            reward=numbers(),
            success=flags(),
            terminated=flags(),
            truncated=flags(),
        )

    # --- a step -------------------------------------------------------------------------------------------------------
    def step(self, play: SkillPlay, action: Tensor, *, looks: bool = True) -> SkillPlay:
        """Return all worlds after ``action`` [W, n]; worlds that had ended are at the start of their next episode.

        A step without ``look`` does not update the path to the stand, so that progress on it is rewarded in the next
        step with ``look``. The update takes a third of the time of a step.
        """
        fresh = play.ended
        begins = fresh[:, None]
        episode = torch.where(fresh, (play.episode + 1) % len(self.bank), play.episode)
        place, start = self._place[episode], self._starts[episode]
        floor_y = self._floor_y[place]
        action = torch.nan_to_num(action, 0.0, 0.0, 0.0)
        wide = self.drive.widened(place, play.robot, play.held != NOTHING, play.wide)
        robot = self.drive.step(place, play.robot, action[:, :2], wide)
        robot = RobotTensors(
            torch.where(begins, start[:, :2], robot.xz),
            torch.where(fresh, start[:, 2], robot.heading),
            robot.contact & ~fresh,
        )
        joints, held = play.joints, play.held
        if self.skill != "nav":
            joints = self.arm.moved(joints, action[:, 2:-1], self.arm_rules)
        joints = torch.where(begins, self._joints[episode], joints)
        objects = torch.where(begins[..., None], self._objects[episode], play.objects)
        hand = place_hand(self.arm.hand(joints), robot.xz, robot.heading, floor_y)
        if self.skill != "nav":
            held = self._gripped(hand, objects, held, action[:, -1])
        target = self._target[episode]
        held = torch.where(fresh, torch.where(self._holds[episode], target, NOTHING), held)
        carried = torch.arange(objects.shape[1], device=self.device) == held[:, None]
        objects = torch.where(carried[..., None], hand.point[:, None], objects)
        axes, grip = self._turned_objects(play, episode, hand, held, carried)
        way = ShortestPath(play.way, play.towards)
        if looks:
            way = shortest_path(self.drive.grids.at(place), self.lattices.at(place), robot.xz, self._stand[episode])
        moved = play._replace(
            robot=robot,
            joints=joints,
            objects=objects,
            turned=axes,
            grip=grip,
            held=held,
            wide=wide & ~fresh,
            episode=episode,
            steps=torch.where(fresh, 0, play.steps + 1),
            way=way.length,
            towards=way.towards,
            apart=(hand.point - self._point[episode]).norm(dim=-1),
            folded=self._from_rest(hand, robot, floor_y),
            before_xz=torch.where(begins, robot.xz, play.robot.xz),
            before_heading=torch.where(fresh, robot.heading, play.robot.heading),
        )
        return self._judged(play, moved)

    def _gripped(self, hand: Hand, objects: Tensor, held: Tensor, action: Tensor) -> Tensor:
        """Return what hands hold after a step, [W]: `sim_kinematic.agents.manipulation.grip_objects`."""
        distance, nearest = (objects - hand.point[:, None]).norm(dim=-1).min(1)
        takes = (held == NOTHING) & (action > 0) & (distance < self.arm_rules.grasp_m)
        return torch.where(takes, nearest, torch.where(action < 0, NOTHING, held))

    def _turned_objects(
        self, play: SkillPlay, episode: Tensor, hand: Hand, held: Tensor, carried: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the axes of the objects after a step, [W, K, 3, 3], and of the held one in its hand, [W, 3, 3].

        An object that is taken keeps its rotation; one that is held at the start of an episode is turned like the hand.
        """
        fresh = play.ended[:, None, None]
        axes = torch.where(fresh[..., None], self._turned[episode], play.turned)
        own = axes[torch.arange(len(held), device=self.device), held.clamp_min(0)]
        taken = ((held != play.held) & (held != NOTHING))[:, None, None]
        grip = torch.where(taken, turned(hand.axes.mT, own), play.grip)
        grip = torch.where(fresh, self._straight, grip)
        return torch.where(carried[..., None, None], turned(hand.axes, grip)[:, None], axes), grip

    def _from_rest(self, hand: Hand, robot: RobotTensors, floor_y: Tensor) -> Tensor:
        return (hand.point - self._resting(robot, floor_y)).norm(dim=-1)

    def _resting(self, robot: RobotTensors, floor_y: Tensor) -> Tensor:
        """Return where hands would be at rest, in the world [W, 3]."""
        rest = Hand(self.rest.expand(len(floor_y), 3), self.rest.new_zeros(len(floor_y), 3, 3))
        return place_hand(rest, robot.xz, robot.heading, floor_y).point

    def _judged(self, before: SkillPlay, now: SkillPlay) -> SkillPlay:
        """Return the state with the reward of the step."""
        going = ~before.ended
        judge = {"nav": self._nav, "pick": self._pick, "place": self._place_skill}[self.skill]
        reward, success, lost, paid = judge(before, now)
        success, lost = going & success, going & lost
        terminated = success | lost
        truncated = going & ~terminated & (now.steps >= self.most_steps)
        return now._replace(
            ended=terminated | truncated,
            paid=going & paid,
            reward=torch.where(going, reward, 0.0),
            success=success,
            terminated=terminated,
            truncated=truncated,
        )

    def _facing(self, now: SkillPlay) -> tuple[Tensor, Tensor]:
        """Return the straight distance from the base to the target on the floor plane [W] [m], and the cosine to it."""
        gap = self._point[now.episode][:, 0:3:2] - now.robot.xz
        straight = torch.hypot(gap[:, 0], gap[:, 1])
        return straight, (gap * heading_direction(now.robot.heading)).sum(-1) / straight.clamp_min(1e-9)

    def _nav(self, before: SkillPlay, now: SkillPlay) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        rules = self.rules
        straight, cosine = self._facing(now)
        success = (straight < rules.near_m) & (now.way < rules.near_m) & (cosine > rules.facing_dot)
        reward = before.way.clamp_max(FAR_M) - now.way.clamp_max(FAR_M) + rules.nav_success * success
        reward = reward + torch.where(now.way <= rules.facing_within_m, rules.facing * (cosine - 1.0), 0.0)
        reward = reward - rules.contact * now.robot.contact - 2 * rules.slack
        return reward, success, torch.zeros_like(success), torch.zeros_like(success)

    def _nearer(self, before: SkillPlay, now: SkillPlay) -> Tensor:
        """Return by how much the hand has come nearer to the target, along the path and from its end [W] [m]."""
        paths = before.way.clamp_max(FAR_M) - now.way.clamp_max(FAR_M)
        return paths + before.apart - now.apart

    def _pick(self, before: SkillPlay, now: SkillPlay) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        rules, target = self.rules, self._target[now.episode]
        holds = now.held == target
        success = holds & (now.folded < rules.rest_m)
        lost = ((now.held != NOTHING) & ~holds) | ((before.held == target) & ~holds)
        moved = torch.where(before.held == target, before.folded - now.folded, self._nearer(before, now))
        reward = moved + rules.pick_success * success - rules.lost * lost - rules.slack
        return reward, success, lost, torch.zeros_like(success)

    def _place_skill(self, before: SkillPlay, now: SkillPlay) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        rules, target = self.rules, self._target[now.episode]
        worlds = torch.arange(len(target), device=self.device)
        gap = (now.objects[worlds, target] - self._point[now.episode]).norm(dim=-1)
        is_placed = (now.held == NOTHING) & (gap < rules.place_m)
        lost = (now.held != target) & ~is_placed
        success = is_placed & (now.folded < rules.rest_m)
        moved = torch.where(is_placed, before.folded - now.folded, self._nearer(before, now))
        reward = moved + rules.place_success * success + rules.placed * (is_placed & ~before.paid) - rules.slack
        return reward, success, lost, before.paid | is_placed

    # --- for those who look on ----------------------------------------------------------------------------------------
    def points(self, play: SkillPlay) -> Tensor:
        """Return the positions or goals of the target objects, [W, 3] [m]."""
        return self._point[play.episode]

    def targets(self, play: SkillPlay) -> Tensor:
        """Return the numbers of the target objects, [W]."""
        return self._target[play.episode]

    def floors(self, play: SkillPlay) -> Tensor:
        """Return heights of the floors, [W] [m]."""
        return self._floor_y[self._place[play.episode]]

    def reaching(self, play: SkillPlay) -> Tensor:
        """Return arm joints with which hands reach the targets from their stands, [W, n]."""
        return self._reaching[play.episode]

    def reach(self, play: SkillPlay) -> Tensor:
        """Return the horizontal distance of the targets from their stands [W] [m]."""
        return (self._point[play.episode][:, 0:3:2] - self._stand[play.episode]).norm(dim=-1)

    def off(self, play: SkillPlay, posture: Tensor) -> Tensor:
        """Return the distance of joints from a posture [n] or [W, n], as a share of that from rest to reaching, [W]."""
        whole = (self.reaching(play) - self.arm.rest).abs().sum(-1).clamp_min(0.1)
        return (play.joints - posture).abs().sum(-1) / whole

    # --- what the robot is shown --------------------------------------------------------------------------------------
    def observations(self, names: Sequence[str], play: SkillPlay) -> dict[str, Tensor]:
        """Return observations without pictures, as in `sim_kinematic.policies.skills.player`, float32 [W, ...].

        Raises:
            InputError: there is no such observation.
        """
        if strangers := [name for name in names if name not in OF_SKILLS]:
            raise InputError(f"On a device there is no observation {strangers[0]!r} of skills.", code="H3-TRAIN-073")
        robot, place = play.robot, self._place[play.episode]
        floor_y = self._floor_y[place]
        hand = place_hand(self.arm.hand(play.joints), robot.xz, robot.heading, floor_y)
        grids = self.drive.grids.at(place)
        return read_sensors(
            SkillContext(play, grids, hand, self._point[play.episode], self._resting(robot, floor_y)), names
        )
