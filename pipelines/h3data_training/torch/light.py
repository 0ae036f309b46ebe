"""Light on robots and people in W homes with baked light, and the soft shadows that they cast, on the device.

It equals that of `h3data.replay.shadow_casters.ShadowCasters` in the light field of each world's home
(`h3data_light.field.LightField`), for one robot and one person.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from h3data.bodies import Humanoid, Robot
from h3data.render.shade.blockers import blocker_rows
from h3data.render.shade.blockers_simd import ALONG_LIGHT, PER_ACROSS2, PER_LENGTH2, RADIUS, REACH, SHARE, SPREAD, WIDTH
from h3data.replay.shadow_casters import capsule_of_box
from h3data_light.exposure import shown_light
from h3data_light.field import FROM_DISC, MOST

if TYPE_CHECKING:
    from h3data_light.bake import LitScene

STATIC, ROBOT, PERSON = -1, 0, 1
"""Groups of instances: static instances, the robot, and the person; agents do not darken themselves."""


class AgentLight:
    """Light on a robot and a person in W worlds, each in one of several homes with baked light."""

    def __init__(self, homes: Sequence[LitScene], robot: Robot, human: Humanoid, *, device: torch.device | str) -> None:
        """Copy the fields of light to the device.

        Args:
            homes: Homes with baked light, whose last instances are the links of the robot that have a mesh, and the
                person.
            robot: Body of the robot.
            human: Body of the person.
            device: Device of all tensors.
        """
        meshes = [link.mesh for link in robot.links if link.mesh is not None]
        around = np.array([capsule_of_box(*mesh.bounds.astype(np.float64)) for mesh in meshes])
        known = np.flatnonzero(np.isfinite(around).all(1))
        bones = human.capsules
        own = np.array([[*bone.start, *bone.end, bone.radius] for bone in bones])
        capsules = np.concatenate([around[known], own])
        groups = np.repeat([ROBOT, PERSON], [len(known), len(own)])
        members = [
            np.repeat([STATIC, ROBOT, PERSON], [len(home.instances) - len(meshes) - 1, len(meshes), 1])
            for home in homes
        ]
        fields = [home.field for home in homes if home.field is not None]

        def on_device(array: NDArray, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        sizes = np.array([field.reach_m.shape for field in fields])
        self._sizes = on_device(sizes, torch.int64)
        self._first = on_device(np.concatenate([[0], sizes.prod(1).cumsum()])[:-1], torch.int64)
        cubes = np.concatenate([field.cube.reshape(-1, 18) for field in fields])
        self._free = on_device(np.isfinite(cubes[:, 0]))
        self._cubes = on_device(np.nan_to_num(cubes))
        self._reaches = on_device(np.concatenate([field.reach_m.ravel() for field in fields]))
        self._origins = on_device(np.stack([field.origin for field in fields]))
        self._spacings, self._means = (
            on_device(np.array([[getattr(f, n)] for f in fields])) for n in ("spacing_m", "mean")
        )
        self._flat = on_device(np.stack([field.flat for field in fields]))
        most = max(map(len, members))
        padded = [np.pad(own, (0, most - len(own)), constant_values=STATIC) for own in members]
        self._members = on_device(np.stack(padded), torch.int64)
        # no pose changes radii and lengths; what depends on pose and light is computed for each picture
        nothing = np.zeros(len(capsules))
        self._words = on_device(
            blocker_rows(capsules, groups, np.tile([0.0, 1, 0], (len(capsules), 1)), nothing, nothing)
        )
        self._ends = on_device(np.stack([capsules[:, :3], capsules[:, 3:6]], 1))
        self._links, self._joints = (on_device(np.asarray(a), torch.int64) for a in (known, [b.joint for b in bones]))
        self._groups = on_device(groups, torch.int64)
        self._shares = on_device((np.array([[ROBOT], [PERSON]]) == groups) / np.bincount(groups)[:, None])
        self._corners = on_device(np.array(list(np.ndindex(2, 2, 2))), torch.int64)

    def cast(self, links: Tensor, joints: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rows of all capsules [W, N, 21] and the tints of all instances [W, I, 4], as in `Blockers`.

        Args:
            links: World matrices of the links of the robot that have a mesh, [W, L, 3, 4].
            joints: World matrices of the joints of the person, [W, 55, 3, 4].
            place: Number of the home of each world, [W].
        """
        frames = torch.cat([links[:, self._links], joints[:, self._joints]], 1)
        # no matrix products, which a GPU might compute with 10 bits
        ends = (frames[:, :, None, :, :3] * self._ends[..., None, :]).sum(-1) + frames[:, :, None, :, 3]
        start, along, middle = ends[:, :, 0], ends[:, :, 1] - ends[:, :, 0], ends.mean(2)
        centers = (middle[:, None] * self._shares[..., None]).sum(2)
        cubes, _ = self._at(centers, place, cubes=True)
        _, reach = self._at(middle, place, cubes=False)
        light, share = directed(cubes)
        light, share = light[:, self._groups], share[:, self._groups]
        to_light = (along * light).sum(-1)
        across2 = (along.square().sum(-1) - to_light.square()).clamp_min(0.0)
        words = list(self._words.expand(len(frames), -1, -1).unbind(-1))
        radius, width = words[RADIUS], words[RADIUS] + across2.sqrt() / 2
        words[ALONG_LIGHT], words[WIDTH], words[SHARE] = to_light, width, share
        words[PER_ACROSS2] = torch.where(across2 > 1e-6, 1 / across2.clamp_min(1e-6), 0.0)
        words[REACH] = torch.minimum(reach, (14 * radius * width).sqrt() / SPREAD)
        rows = torch.cat([start, along, light, torch.stack(words[PER_LENGTH2:], -1)], -1)
        tints = shown_light(cubes.mean(2), self._means[place][:, None], torch) / self._flat[place][:, None]
        members = self._members[place]
        # what stands still is not tinted
        own = tints.gather(1, members.clamp_min(0)[..., None].expand(-1, -1, 3))
        own = torch.where(members[..., None] < 0, 1.0, own)
        return rows, torch.cat([own, members[..., None].float()], -1)

    def _at(self, points: Tensor, place: Tensor, *, cubes: bool) -> tuple[Tensor, Tensor]:
        """Return light from six sides [W, P, 6, 3] (zeros without ``cubes``) and reach [W, P] at points [W, P, 3].

        The values are those of the field.
        """
        size = self._sizes[place][:, None]
        at = (points - self._origins[place][:, None]) / self._spacings[place][:, None] - 0.5
        at = torch.minimum(at.clamp_min(0.0), (size - 1).float())
        low = torch.minimum(at.long(), (size - 2).clamp_min(0))
        part = (at - low)[..., None, :]
        x, y, z = torch.minimum(low[..., None, :] + self._corners, size[..., None, :] - 1).unbind(-1)
        cell = self._first[place][:, None, None] + (x * size[..., None, 1] + y) * size[..., None, 2] + z
        weight = (torch.where(self._corners > 0, part, 1 - part).prod(-1) + 1e-4) * self._free[cell]
        total = weight.sum(-1, keepdim=True)
        weight = weight / torch.where(total > 0, total, 1.0)
        reach = torch.where(total[..., 0] > 0, (weight * self._reaches[cell]).sum(-1), 1.0)
        if not cubes:
            return reach.new_zeros(*reach.shape, 6, 3), reach
        seen = (weight[..., None] * self._cubes[cell]).sum(-2)
        return torch.where(total > 0, seen, self._means[place][:, None]).unflatten(-1, (6, 3)), reach


def directed(cubes: Tensor) -> tuple[Tensor, Tensor]:
    """Return direction [..., 3] and share [...] of the strongest light from six sides [..., 6, 3] (`LightField.at`)."""
    bright = cubes.mean(-1)
    vector = bright[..., 1::2] - bright[..., 0::2]
    length, everywhere = vector.square().sum(-1).sqrt(), bright.sum(-1) / 1.5
    lit = ((length > 1e-6) & (everywhere > 1e-6))[..., None]
    up = vector.new_zeros(3)
    up[1].fill_(1.0)  # an assignment would upload the number, which a CUDA graph cannot hold
    share = length / everywhere.clamp_min(1e-9) / FROM_DISC
    return torch.where(lit, vector / length.clamp_min(1e-9)[..., None], up), torch.where(
        lit[..., 0], share, 0.0
    ).clamp_max(MOST)
