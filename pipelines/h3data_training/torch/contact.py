"""Contacts of the resting robot with the walking person, as balls in the robot's distance field, by tensors.

`sim_kinematic.contact.clearance.RobotHumanContact` (FCL on the exact shapes) is the reference. This module differs from
it only if the distance is within `TOLERANCE_M` of contact (tests/training/torch/test_social_nav.py), and if arms are
pulled in, because here they always swing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from h3data.bodies import Humanoid, Robot
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, Array, pose_to_matrix
from h3data.scene.records import Box, Capsule, Shape
from h3data_training.torch.cycle import WalkingCycle
from h3data_training.torch.state import HumanTensors, RobotTensors
from h3data_training.torch.step import heading_direction
from sim_kinematic.motion.spec import PersonContact, WalkerSpec

TOLERANCE_M = 0.004
CELL_M = 0.02
"""Side of a cell of the robot's distance field [m]."""
SCALLOP_M = 0.003
"""Depth of the notches between balls [m]: a row of balls may be this much thinner than the capsule that it replaces."""
BONE_TOLERANCE_M = 0.007
"""Tolerance of the distance for boxes of bones, whose corners protrude 4 mm from the balls at their ends [m]."""
BONE_RADIUS_M, BONE_END_M = 0.0125, 0.0085
"""Radius of the balls that replace a box of 2 x 2 cm, which is between the radii of its section's incircle and
circumcircle, and distance of the last balls from the ends of the box [m].
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class TouchTest:
    """Contact test on a device, with the robot's distance field and the person's balls."""

    field: Tensor
    """Coefficients of the trilinear distance in each cube between eight cell centres, [cubes, 8] [m]."""
    low: Tensor
    """Position of the first cell centre in the frame of the robot's base, [3] [m]."""
    last: Tensor
    """Number of cubes minus one along each axis, [3]."""
    strides: tuple[int, int]
    balls: Tensor
    """Centres of the balls in the frame of the root, one row for each posture, [rows, S, 3] [m]."""
    radii: Tensor
    """Radii of the balls [S] [m]."""
    cycle: WalkingCycle

    @classmethod
    def of(
        cls,
        robot: Robot,
        human: Humanoid,
        walker: WalkerSpec,
        device: torch.device | str,
        dtype: torch.dtype,
        *,
        person_contact: PersonContact = "body",
    ) -> TouchTest:
        """Return the test for a robot at rest and a person with the gait of the spec, with the given collision shapes.

        Raises:
            InputError: a shape of the robot is neither box nor capsule.
        """
        joints = np.asarray(robot.rest, np.float64)
        links = robot.link_matrices(IDENTITY_POSE[None], joints[None])[0]
        placed = [(shape, matrix) for matrix, link in zip(links, robot.links, strict=True) for shape in link.shapes]
        cycle = WalkingCycle.of(human, walker)
        centres, radii = _bone_balls(cycle) if person_contact == "bones" else _balls(cycle)
        margin = radii.max() + 2 * CELL_M
        reach = [_bounds(shape, matrix) for shape, matrix in placed]
        low = np.min([r[0] for r in reach], axis=0) - margin
        high = np.max([r[1] for r in reach], axis=0) + margin
        near = (centres[..., 1].min(0) - radii) < high[1]  # the others are above the robot in every phase
        counts = np.ceil((high - low) / CELL_M).astype(int) + 1
        grid = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1) * CELL_M + low
        distance = np.min([_distance(shape, matrix, grid) for shape, matrix in placed], axis=0)

        def on_device(array: Array) -> Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        return cls(
            field=on_device(_trilinear(distance)),
            low=on_device(low),
            last=on_device(counts - 2.0),
            strides=(int((counts[1] - 1) * (counts[2] - 1)), int(counts[2] - 1)),
            balls=on_device(centres[:, near]),
            radii=on_device(radii[near]),
            cycle=cycle,
        )

    def touching(self, robot: RobotTensors, human: HumanTensors) -> Tensor:
        """Return whether robot and person touch, bool [W]."""
        return self.gap(robot, human) <= 0.0

    def gap(self, robot: RobotTensors, human: HumanTensors) -> Tensor:
        """Return the gap between robot and person [W] [m], exact below 4 cm and negative if they overlap."""
        gap = human.xz - robot.xz
        ahead = heading_direction(robot.heading)
        turn = human.heading - robot.heading
        c, s = turn.cos()[:, None], turn.sin()[:, None]
        x, y, z = self.cycle.look_up(self.balls, human).unbind(-1)
        gx = gap[:, 0] * ahead[:, 0] + gap[:, 1] * ahead[:, 1]
        gz = gap[:, 1] * ahead[:, 0] - gap[:, 0] * ahead[:, 1]
        at = torch.stack([gx[:, None] + x * c + z * s, y, gz[:, None] + z * c - x * s], -1)
        return (self._distance(at) - self.radii).amin(-1)

    def _distance(self, points: Tensor) -> Tensor:
        """Return the distance from points [..., 3] in the robot's frame to its shapes.

        Beyond the field, it is that of the field's border.
        """
        f = (points - self.low) / CELL_M
        cube = torch.minimum(f.floor().clamp_min(0.0), self.last)
        a, b, c = (f - cube).clamp(0.0, 1.0).unbind(-1)
        i, j, k = cube.long().unbind(-1)
        v = self.field[i * self.strides[0] + j * self.strides[1] + k]
        flat = v[..., :4] + v[..., 4:] * a[..., None]
        line = flat[..., :2] + flat[..., 2:] * b[..., None]
        return line[..., 0] + line[..., 1] * c


def _balls(cycle: WalkingCycle) -> tuple[Array, Array]:
    """Return the centres [rows, S, 3] in the root's frame and radii [S] of balls along the capsules."""
    start, end, radius = cycle.human.capsules_world(cycle.joint_matrices())
    length = np.linalg.norm(end - start, axis=-1).max(0)
    apart = 2 * np.sqrt(2 * radius * SCALLOP_M)  # of balls whose union is thinner than the capsule by that much
    centres, radii = [], []
    for k in range(len(radius)):
        for t in np.linspace(0, 1, max(int(np.ceil(length[k] / apart[k])), 1) + 1):
            centres.append(start[:, k] + t * (end[:, k] - start[:, k]))
            radii.append(radius[k])
    return np.stack(centres, 1), np.array(radii)


def _bone_balls(cycle: WalkingCycle) -> tuple[Array, Array]:
    """Return the centres [rows, S, 3] in the root's frame and radii [S] of balls along the boxes of the bones."""
    frames, sizes = cycle.human.bone_boxes_world(cycle.joint_matrices())
    apart = 2 * np.sqrt(2 * BONE_RADIUS_M * SCALLOP_M)
    centres: list[Array] = []
    for k, size in enumerate(sizes):
        end = max(float(size[1]) / 2 - BONE_END_M, 0.0)
        along = np.linspace(-end, end, int(np.ceil(2 * end / apart)) + 1)
        centres += [frames[:, k, :3, 3] + y * frames[:, k, :3, 1] for y in along]
    return np.stack(centres, 1), np.full(len(centres), BONE_RADIUS_M)


def _bounds(shape: Shape, matrix: Array) -> tuple[Array, Array]:
    if isinstance(shape, Capsule):
        ends = np.stack([shape.start, shape.end]) @ matrix[:3, :3].T + matrix[:3, 3]
        return ends.min(0) - shape.radius, ends.max(0) + shape.radius
    if isinstance(shape, Box):
        frame = matrix @ pose_to_matrix(shape.pose)
        half = np.abs(frame[:3, :3]) @ np.asarray(shape.half_extents)
        return frame[:3, 3] - half, frame[:3, 3] + half
    raise InputError(
        f"On a device, robots are boxes and capsules; this one has a {type(shape).__name__}.", code="H3-TRAIN-059"
    )


def _distance(shape: Shape, matrix: Array, points: Array) -> Array:
    """Return the signed distance [...] [m] of points [..., 3] to a shape whose frame is ``matrix``."""
    if isinstance(shape, Capsule):
        a, b = (matrix[:3, :3] @ np.asarray(p) + matrix[:3, 3] for p in (shape.start, shape.end))
        axis = b - a
        t = ((points - a) @ axis / max(axis @ axis, 1e-12)).clip(0, 1)
        return np.linalg.norm(points - a - t[..., None] * axis, axis=-1) - shape.radius
    assert isinstance(shape, Box)
    frame = matrix @ pose_to_matrix(shape.pose)
    beyond = np.abs((points - frame[:3, 3]) @ frame[:3, :3]) - shape.half_extents
    return np.linalg.norm(beyond.clip(0), axis=-1) + beyond.max(-1).clip(max=0)


def _trilinear(v: Array) -> Array:
    """Return the coefficients of ``(k0 + k4 a) + (k2 + k6 a) b + ((k1 + k5 a) + (k3 + k7 a) b) c``, [cubes, 8]."""
    c0, c1 = v[..., :-1], np.diff(v, axis=2)  # along c
    lines = [part for c in (c0, c1) for part in (c[:, :-1], np.diff(c, axis=1))]  # 1, b, c, bc
    one, b, c, bc = lines
    flat = [one, c, b, bc]
    return np.stack([p[:-1] for p in flat] + [np.diff(p, axis=0) for p in flat], -1).reshape(-1, 8)
