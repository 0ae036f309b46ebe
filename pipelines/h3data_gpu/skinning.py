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
        joints, parents, bind = body.half_joints
        self._halves = torch.from_numpy(joints).to(self.device), torch.from_numpy(parents).to(self.device)
        self._half_bind, self._bind = (
            torch.from_numpy(matrices).to(self.device, torch.float32) for matrices in (bind, body.skin_bind)
        )

    def __call__(self, joint_matrices: torch.Tensor) -> torch.Tensor:
        """Return world vertices, float32 [..., V, 3] [m], for transforms of joints to the world [..., 55, 4, 4].

        The leading axes may be worlds, frames, or both. The result is a view of vertex-major memory; call
        ``contiguous()`` if the order of the memory matters.
        """
        import torch

        lead = joint_matrices.shape[:-3]
        frames = joint_matrices.to(self.device, torch.float32).reshape(-1, *joint_matrices.shape[-3:])
        matrices = (torch.cat([frames, self._half_frames(frames)], 1) @ self._bind)[:, :, :3]
        palette = matrices.permute(1, 3, 0, 2).reshape(-1, 3 * len(frames))
        points = (self._operator @ palette).reshape(self.vertex_count, len(frames), 3).transpose(0, 1)
        return points.reshape(*lead, self.vertex_count, 3) if len(lead) != 1 else points

    def _half_frames(self, frames: torch.Tensor) -> torch.Tensor:
        """Return the frames of the half joints [N, H, 4, 4], as `h3data.bodies.people.kernels.skin` computes them."""
        import torch

        joint, parent = (frames[:, which, :3, :3] for which in self._halves)
        turn = (parent @ self._half_bind).mT @ joint
        w = (1 + turn.diagonal(dim1=-2, dim2=-1).sum(-1)).clamp(min=1e-6).sqrt() / 2
        x = (turn - turn.mT) / (4 * w)[..., None, None]
        # the matrix of the cross product with the vector of the quaternion, whose scalar is 1 + w
        w = (1 + w)[..., None, None]
        halved = torch.eye(3, device=self.device) + (w * x + x @ x) * 2 / (w * w + (x * x).sum((-2, -1), True) / 2)
        out = frames[:, self._halves[0]].clone()
        out[..., :3, :3] = parent @ self._half_bind @ halved
        return out
