"""Skinning of bodies with torch, on the CPU or a GPU.

It is the sparse product of `h3data.bodies.people.skinning` with all arrays on the device.
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

    The product of one sparse matrix [V, 4J] and a palette [4J, 3 N] gives all vertices of N frames. 1,500 frames take
    0.7 ms on an H100.
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
        """Return world vertices, float32 [..., V, 3] [m], for transforms of joints to the world [..., 55, 4, 4].

        The leading axes may be worlds, frames, or both. The result is a view of vertex-major memory; call
        ``contiguous()`` if the order of the memory matters.
        """
        import torch

        lead = joint_matrices.shape[:-3]
        frames = joint_matrices.to(self.device, torch.float32).reshape(-1, *joint_matrices.shape[-3:])
        matrices = (frames @ self._inverse_bind)[:, :, :3]
        palette = matrices.permute(1, 3, 0, 2).reshape(-1, 3 * len(frames))
        points = (self._operator @ palette).reshape(self.vertex_count, len(frames), 3).transpose(0, 1)
        return points.reshape(*lead, self.vertex_count, 3) if len(lead) != 1 else points
