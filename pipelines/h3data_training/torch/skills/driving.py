"""Motion of robot bases in W worlds, by `torch.step.drive_robots` with larger bases for held objects."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from h3data_training.torch.state import RobotTensors
from h3data_training.torch.step import (
    Grids,
    drive_robots,
    heading_direction,
    integrate,
    least_clearance,
    velocities,
)
from sim_kinematic.motion.spec import STEP_S, BaseSpec


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """Motion of robots in some homes, with an empty hand or with a held object."""

    grids: Grids
    """Grids of all homes."""
    base: BaseSpec
    carrying: BaseSpec
    """Discs of a base that also cover the object in the hand."""

    def widened(self, place: Tensor, robot: RobotTensors, holds: Tensor, wide: Tensor) -> Tensor:
        """Return whether bases keep a distance that also covers the objects in their hands, bool [W].

        These are robots that hold something, as soon as there is enough room, as in
        `sim_kinematic.agents.robots.driving.RobotDriver`.
        """
        if self.carrying is self.base:
            return torch.zeros_like(holds)
        if _on_cpu(robot):  # hardly any has just taken something
            found, rows = holds & wide, (holds & ~wide).nonzero()[:, 0]
            found[rows] = self._has_room(place[rows], robot.xz[rows], robot.heading[rows])
            return found
        return holds & (wide | self._has_room(place, robot.xz, robot.heading))

    def _has_room(self, place: Tensor, xz: Tensor, heading: Tensor) -> Tensor:
        """Return whether the discs of bases that carry something are clear of obstacles, bool [W]."""
        forward = heading_direction(heading)
        room = least_clearance(self.grids.at(place), xz, forward, self.carrying.disc_offsets_m)
        return room >= self.carrying.disc_radius_m

    def step(self, place: Tensor, robot: RobotTensors, action: Tensor, wide: Tensor) -> RobotTensors:
        """Return the robots after ``action`` [W, 2] in the homes with numbers ``place`` [W]."""
        if _on_cpu(robot):
            return self._step_on_cpu(place, robot, action, wide)
        grids = self.grids.at(place)
        narrow = drive_robots(grids, robot, action, self.base)
        if self.carrying is self.base:
            return narrow
        broad = drive_robots(grids, robot, action, self.carrying)
        return RobotTensors(
            torch.where(wide[:, None], broad.xz, narrow.xz),
            torch.where(wide, broad.heading, narrow.heading),
            torch.where(wide, broad.contact, narrow.contact),
        )

    def _step_on_cpu(self, place: Tensor, robot: RobotTensors, action: Tensor, wide: Tensor) -> RobotTensors:
        """Return the same, a third of the time: most bases are in the open, and only the others are pushed out of obstacles."""
        xz, heading, contact = robot.xz.clone(), robot.heading.clone(), torch.zeros_like(robot.contact)
        for base, here in ((self.base, ~wide), (self.carrying, wide)):
            rows = here.nonzero()[:, 0]
            if not len(rows):
                continue
            grids, was, command = self.grids.at(place[rows]), RobotTensors(*(t[rows] for t in robot)), action[rows]
            speed, lateral, turn = velocities(torch.nan_to_num(command, 0.0, 0.0, 0.0), base)
            turned = torch.add(was.heading, turn, alpha=STEP_S)
            ahead = integrate(was.xz, heading_direction(was.heading), speed, lateral, STEP_S)
            room = least_clearance(grids, ahead, heading_direction(turned), base.disc_offsets_m)
            xz[rows], heading[rows] = ahead, turned
            near = (room < base.disc_radius_m).nonzero()[:, 0]
            if len(near):
                some = RobotTensors(*(t[near] for t in was))
                grids = self.grids.at(place[rows[near]])
                moved = drive_robots(grids, some, command[near], base)
                xz[rows[near]], heading[rows[near]], contact[rows[near]] = moved
        return RobotTensors(xz, heading, contact)


def _on_cpu(robot: RobotTensors) -> bool:
    """Return whether tensors may be looked at for free, and worlds chosen by what is in them."""
    return robot.xz.device.type == "cpu" and not torch.compiler.is_compiling()
