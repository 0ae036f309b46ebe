"""Skinning with torch, on the CPU or a GPU.

It is the sparse product of `h3data.bodies.people.skinning` with everything on the device.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch

    from h3data.bodies.people.humanoid import Humanoid


class TorchSkin:
    """The skin of one body on a torch device.

    One sparse matrix [V, 4J] times a palette [4J, 3 N] is every vertex of N frames: 1,500 full frames take 0.7 ms on an H100.
    """

    def __init__(self, body: Humanoid, *, lod: bool = True, device: str | torch.device = "cpu") -> None:
        import torch

        part = body.lod if lod else body.full
        points = part.skin.points
        self.device = torch.device(device)
        self.vertex_count = len(part.joints)
        rows, columns = (torch.from_numpy(a.astype(np.int64)) for a in (points.indptr, points.indices))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse (CSR tensor support is in beta|invariant checks)")
            self._operator = torch.sparse_csr_tensor(
                rows, columns, torch.from_numpy(points.data), points.shape, device=self.device, check_invariants=True
            )
        self._inverse_bind = torch.from_numpy(body.inverse_bind).to(self.device, torch.float32)

    def __call__(self, joint_matrices: torch.Tensor) -> torch.Tensor:
        """World vertices, float32 [..., V, 3], of joint frames [..., 55, 4, 4] (worlds, frames, or both), on their device.

        A view of vertex-major memory: call ``contiguous()`` where the order matters.
        """
        import torch

        lead = joint_matrices.shape[:-3]
        frames = joint_matrices.to(self.device, torch.float32).reshape(-1, *joint_matrices.shape[-3:])
        matrices = (frames @ self._inverse_bind)[:, :, :3]
        palette = matrices.permute(1, 3, 0, 2).reshape(-1, 3 * len(frames))
        points = (self._operator @ palette).reshape(self.vertex_count, len(frames), 3).transpose(0, 1)
        return points.reshape(*lead, self.vertex_count, 3) if len(lead) != 1 else points
