"""Worlds of any task with one robot and the people of a crowd on a device, as tensor operations.

The task and its sensors are those of the CPU (`h3data_training.torch.task_worlds`), and so are the rules of people, but for
those that need a search (`h3data_training.torch.crowd.people`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from h3data_training.torch.crowd.bank import CrowdBank
from h3data_training.torch.crowd.people import CrowdRules, CrowdTensors, Paths, Surroundings
from h3data_training.torch.geodesic import ShortestPath
from h3data_training.torch.state import HumanTensors, RobotTensors
from h3data_training.torch.step import heading_direction, step_cycle
from h3data_training.torch.task_worlds import Play, TaskTensors
from sim_kinematic.crowd.crowd import VERSION, CrowdModel
from sim_kinematic.crowd.traits import CrowdSpec, Traits
from sim_kinematic.motion.spec import STEP_S, StrideSpec
from sim_kinematic.sensing.table import Pose


class CrowdWorlds(TaskTensors):
    """W worlds with P people of a crowd each, whose state is [P, W, ...]."""

    def __init__(self, bank: CrowdBank, *, model: CrowdModel, **options: Any) -> None:
        """Create the worlds with the options of `TaskTensors`; people follow a crowd model, by the present rules."""
        people = [member.model for member in bank.roster[1:]]
        episodes: Any = bank
        super().__init__(
            episodes, **{**options, "robot": bank.roster[0].model, **({"human": people[0]} if people else {})}
        )
        self.roster, self.people = bank.roster, len(people)
        # as for `sim_kinematic.crowd.crowd.Crowd` of people without routine, company or reaction
        version = VERSION if model == "orca" else min(VERSION, 5)
        self._rules = CrowdRules(
            spec=CrowdSpec.of_version(version),
            stride=self.spec.human.stride or StrideSpec(),
            forces=model == "social_force",
        )

    def _take_people(self, bank: Any) -> None:
        def numbers(values: Any) -> Tensor:
            return torch.as_tensor(np.asarray(values, np.float64), dtype=self.dtype, device=self.device)

        # each leg and the same in reverse
        counts = np.array([len(leg) for leg in bank.legs], np.int64)
        most, begins, last = max(counts, default=2), np.cumsum(counts) - counts, np.repeat(counts - 1, 2)
        along = np.minimum(np.arange(most), counts[:, None] - 1)
        which = np.stack([begins[:, None] + along, (begins + counts)[:, None] - 1 - along], 1).reshape(-1, most)
        points = np.concatenate([*bank.legs, np.zeros((0, 2))])[which]
        gaps = np.diff(points, axis=1, prepend=points[:, :1])
        lengths = np.hypot(gaps[..., 0], gaps[..., 1]).cumsum(1)
        self._paths = Paths(
            points=numbers(points),
            lengths=numbers(np.where(np.arange(most) > last[:, None], np.inf, lengths)),
            last=torch.as_tensor(last, device=self.device),
            total=numbers(lengths[:, -1]),
        )
        first = 2 * (np.cumsum(bank.leg_counts) - bank.leg_counts.ravel()).reshape(bank.leg_counts.shape)
        self._first_rows = torch.as_tensor(first, device=self.device)
        self._leg_counts = torch.as_tensor(bank.leg_counts, device=self.device)
        self._traits = numbers(bank.traits)

    def _blank(self, episode: Tensor) -> Play:
        play = super()._blank(episode)
        people = HumanTensors(*(t.expand(self.people, *t.shape) for t in play.human))
        crowd = CrowdTensors.standing(people.heading)
        # of their own memory, as each is written in place
        return play._replace(
            human=HumanTensors(*(t.clone() for t in people)),
            human_before_xz=people.xz.clone(),
            crowd=CrowdTensors(*(t.clone() for t in crowd)),
        )

    def _each(self, people: Any) -> tuple[Any, ...]:
        return tuple(type(people)(*(None if t is None else t[k] for t in people)) for k in range(self.people))

    def _touching(self, play: Play) -> Tensor:
        crowd: Any = play.crowd
        return crowd.touching.movedim(0, 1)

    def path_to_person(self, play: Play) -> ShortestPath:
        """Return the shortest paths from robots to the first person."""
        return self.path_between(play, play.robot.xz, play.human.xz[0])

    def _with_people(self, play: Play, episode: Tensor, robot: RobotTensors) -> Play:
        if not self.people:
            return play
        fresh, start = play.ended, self._starts[episode][:, 1:].movedim(1, 0)
        crowd: Any = play.crowd
        step = play.steps.to(self.dtype)
        xz, heading, walked = self._rules.step(
            self._grids.at(self._place[episode]),
            self._paths,
            self._first_rows[episode].movedim(1, 0),
            self._leg_counts[episode].movedim(1, 0),
            Traits._make(self._traits[episode].movedim(1, 0).unbind(-1)),
            crowd,
            play.human.xz,
            play.human.heading,
            self._surroundings(play),
            step,
        )
        # in the first step people join the crowd, and stand still
        stands = (play.steps == 0) | fresh
        walks = ~stands[:, None]
        xz = torch.where(walks, xz, play.human.xz)
        heading = torch.where(stands, play.human.heading, heading)
        gone = torch.hypot(*(xz - play.human.xz).unbind(-1))
        gait = step_cycle(play.human, gone, gone > 0.0, STEP_S / self.spec.human.blend_s)
        human = HumanTensors(xz, heading, *gait).begun(start, fresh)
        before: Any = CrowdTensors.standing(human.heading)
        crowd = CrowdTensors(
            *(
                torch.where(_rows(fresh, new), begun, torch.where(_rows(stands, new), old, new))
                for begun, old, new in zip(before, crowd, walked, strict=True)
            )
        )
        one = RobotTensors(*(t.expand(self.people, *t.shape).flatten(0, 1) for t in robot))
        everybody = HumanTensors(*(t.flatten(0, 1) for t in human))
        touching = self.touch.touching(one, everybody).reshape(self.people, -1)
        return play._replace(human=human, collides=touching.any(0), crowd=crowd._replace(touching=touching))

    def _surroundings(self, play: Play) -> Surroundings:
        """Return the places of people and of the robot's discs now, and their velocities."""
        offsets = self._outlines.offsets[:, None, None]

        def discs(pose: Any) -> Tensor:
            return pose.xz + heading_direction(pose.heading) * offsets

        now = torch.cat([play.human.xz, discs(play.robot)])
        before = torch.cat([play.human_before_xz, discs(Pose(play.before_xz, play.before_heading))])
        people = self._traits[play.episode, :, Traits._fields.index("radius_m")].movedim(1, 0)
        radius = torch.cat(
            [people, people.new_full((len(now) - self.people, people.shape[1]), self.base.disc_radius_m)]
        )
        return Surroundings(now, (now - before) / STEP_S, radius)


def _rows(flags: Tensor, like: Tensor) -> Tensor:
    """Return flags of worlds [W] for values [P, W, ...]."""
    return flags.reshape(-1, *[1] * (like.ndim - 2))
