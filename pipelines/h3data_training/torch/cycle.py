"""Table of the person's walking cycle on a device, with frames of body parts by phase and blend."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from h3data.bodies import Humanoid
from h3data.geometry import IDENTITY_POSE, Array
from h3data_training.torch.state import HumanTensors
from sim_kinematic.motion.spec import STEP_S, WalkerSpec

PHASES = 128
"""Number of parts of the cycle. Within a part, motion is linear. Between parts it may jump: while the person starts or
stops walking, the posture jumps when a foot comes down (`h3data.bodies.people.kernels.legs.settle`).
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class WalkingCycle:
    """Clip of a walking person as tables, with a row for both ends of each part of the cycle and for each blend."""

    human: Humanoid
    clip: int
    blends: int
    """Number of blends in the tables, for the phases of starting and stopping."""

    @classmethod
    def of(cls, human: Humanoid, walker: WalkerSpec) -> WalkingCycle:
        """Return the walking cycle for the walker's speed."""
        clip = human.clip_for_speed(walker.speed_mps)
        return cls(human=human, clip=clip, blends=math.ceil(walker.blend_s / STEP_S - 1e-9) + 1)

    def joint_matrices(self) -> Array:
        """Return frames of joints in the frame of the root for each row of a table, [PHASES * 2 * blends, 55, 4, 4]."""
        ends = (np.arange(PHASES)[:, None] + (0.0, 1.0 - 1e-9)).ravel() / PHASES
        phase, blend = (g.ravel() for g in np.meshgrid(ends, np.linspace(0, 1, self.blends), indexing="ij"))
        posture = self.human.clip_pose(np.full(phase.size, self.clip), phase, blend)
        return self.human.joint_matrices(np.tile(IDENTITY_POSE, (phase.size, 1)), *posture)

    def look_up(self, table: Tensor, person: HumanTensors) -> Tensor:
        """Look up a table [PHASES * 2 * blends, ...] for people, as [W, ...], bilinear in phase and blend."""
        clip = self.human.clips[self.clip]
        phase = (person.distance - person.set_off) / clip.stride_m + clip.start_phase
        part = (phase - phase.floor()) * PHASES
        level = person.blend * (self.blends - 1)
        first, lower = part.floor().clamp_max(PHASES - 1.0), level.floor().clamp_max(self.blends - 2.0)
        each = (-1, *[1] * (table.ndim - 1))
        u, v = (part - first).reshape(each), (level - lower).reshape(each)
        row = first.long() * (2 * self.blends) + lower.long()
        begin, begin_above, end, end_above = (table[row + k] for k in (0, 1, self.blends, self.blends + 1))
        return torch.lerp(torch.lerp(begin, end, u), torch.lerp(begin_above, end_above, u), v)
