"""Compilation of steps into few kernels and into CUDA graphs."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")


def fused(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of tensors without branches into a few kernels (`torch.compile`).

    The first call compiles, which takes about 20 s, or a few seconds if compiled files exist. Products and sums may be
    contracted, so that the last bits differ from those of ``function``.
    """

    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        return function(*args, **kwargs)

    alone.__code__ = alone.__code__.replace()  # torch keeps what it compiles, eight times at most, by code object
    return torch.compile(alone, fullgraph=True, dynamic=False)


def can_fuse() -> bool:
    """Return whether the requirements of `torch.compile` on a GPU are installed, as with torch for CUDA on Linux."""
    return importlib.util.find_spec("triton") is not None


def overwrite(kept: Iterable[Tensor], new: Iterable[Tensor]) -> None:
    """Write new values into tensors that a graph reads and writes, one after the other."""
    for tensor, value in zip(kept, new, strict=True):
        tensor.copy_(value)


def keep_row(kept: dict[str, Tensor], row: Tensor, values: Mapping[str, Tensor], *, rows: int) -> None:
    """Copy values [W, ...] into row ``row`` [1] of the buffers ``kept`` [rows, W, ...].

    A buffer is created when it is first needed, which must not happen while a graph is captured.
    """
    for name, value in values.items():
        if name not in kept:
            kept[name] = torch.empty(rows, *value.shape, dtype=value.dtype, device=value.device)
        kept[name].index_copy_(0, row, value[None])


def captured(step: Callable[[], object], kept: Sequence[Tensor]) -> Callable[[], None]:
    """Return ``step`` captured as a CUDA graph, which reads and writes the same tensors at each call.

    The tensors in ``kept`` are restored after the trial runs.
    """
    was = [t.clone() for t in kept]
    device = kept[0].device
    aside = torch.cuda.Stream(device)
    aside.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(aside):
        for _ in range(3):
            step()
    torch.cuda.current_stream(device).wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.device(device), torch.cuda.graph(graph):
        step()
    overwrite(kept, was)
    return graph.replay
