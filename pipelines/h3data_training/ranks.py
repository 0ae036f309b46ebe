"""Distributed training of one policy by several processes, one per GPU, over `torch.distributed`."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch._utils import _flatten_dense_tensors, _unflatten_dense_tensors

from h3data.errors import InputError

TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")
"""Variables that torchrun sets in the processes it starts."""


@dataclass(frozen=True)
class Ranks:
    """One process among those of a run; if it is the only one, every method returns its argument unchanged."""

    rank: int = 0
    count: int = 1

    @property
    def is_first(self) -> bool:
        """Return whether this process writes the files and prints messages."""
        return self.rank == 0

    def sum(self, tensor: Tensor) -> Tensor:
        """Return the sum over all processes, with the same bits in each of them."""
        if self.count > 1:
            tensor = tensor.contiguous().clone()
            dist.all_reduce(tensor)
        return tensor

    def mean(self, tensor: Tensor) -> Tensor:
        """Return the mean over all processes."""
        return self.sum(tensor) / self.count if self.count > 1 else tensor

    def variance(self, tensor: Tensor) -> Tensor:
        """Return the variance of all elements in all processes, which hold the same number of elements."""
        if self.count == 1:
            return tensor.var()
        number = tensor.numel() * self.count
        middle = self.sum(tensor.sum()) / number
        return self.sum((tensor - middle).square().sum()) / (number - 1)

    def first(self, tensor: Tensor) -> Tensor:
        """Return the value that the first process holds."""
        if self.count > 1:
            tensor = tensor.contiguous().clone()
            dist.broadcast(tensor, 0)
        return tensor

    def gathered(self, tensor: Tensor) -> Tensor:
        """Return the rows of all processes, concatenated in the order of the processes."""
        if self.count == 1:
            return tensor
        rows = tensor.to(torch.uint8) if tensor.dtype == torch.bool else tensor
        parts = [torch.empty_like(rows, memory_format=torch.contiguous_format) for _ in range(self.count)]
        dist.all_gather(parts, rows.contiguous())
        return torch.cat(parts).to(tensor.dtype)

    def own(self, tensor: Tensor) -> Tensor:
        """Return this process's share of the rows of all processes."""
        return tensor.chunk(self.count)[self.rank] if self.count > 1 else tensor

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace gradients by their means over all processes, with one all-reduce of a single flat tensor."""
        if self.count == 1:
            return
        given = [p.grad for p in parameters if p.grad is not None]
        flat = _flatten_dense_tensors(given)
        dist.all_reduce(flat)
        flat /= self.count
        for gradient, mean in zip(given, _unflatten_dense_tensors(flat, given), strict=True):
            gradient.copy_(mean)


def torchrun_place() -> tuple[int, int] | None:
    """Return the rank and number of processes from torchrun, or None if torchrun did not start this process."""
    if any(name not in os.environ for name in TORCHRUN):
        return None
    return int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])


def own_place(device: str) -> tuple[Ranks, str]:
    """Return this process's `Ranks` and its device, one of several GPUs; call it before CUDA is initialised.

    Raises:
        InputError: there is no GPU for this process.
    """
    place = torchrun_place()
    if place is not None and device.startswith("cuda"):
        local = int(os.environ["LOCAL_RANK"])
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        chosen = visible.split(",") if visible else [str(k) for k in range(local + 1)]
        os.environ["CUDA_VISIBLE_DEVICES"] = chosen[local] if local < len(chosen) else ""
        device = "cuda"
    if device.startswith("cuda") and not torch.cuda.is_available():
        if place is not None and place[1] > 1:
            raise InputError(
                f"Expected a GPU for each of {place[1]} processes, found none for number {place[0]}.",
                code="H3-TRAIN-040",
            )
        raise InputError(
            "There is no GPU that this torch can use. Hint: --device cpu with --recipe tiny.", code="H3-ENV-013"
        )
    return Ranks(*place) if place else Ranks(), device


def connect(ranks: Ranks, device: torch.device) -> None:
    """Connect to the other processes.

    Call this function after CUDA graphs have been captured, because NCCL's threads would disturb the capture.
    """
    if ranks.count == 1:
        return
    if device.type == "cuda":
        # NVLink multicast may put the GPUs of a shared host out of service, and gains nothing for a few MB
        os.environ["NCCL_NVLS_ENABLE"] = "0"
        dist.init_process_group("nccl", rank=ranks.rank, world_size=ranks.count)
    else:
        dist.init_process_group("gloo", rank=ranks.rank, world_size=ranks.count)


def leave() -> None:
    """Disconnect from the other processes."""
    if dist.is_initialized():
        dist.destroy_process_group()
