"""Steps as CUDA graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def captured(step: Callable[[], object], kept: Sequence[Tensor]) -> Callable[[], None]:
    """``step`` as a CUDA graph: it reads and writes the same tensors each time. ``kept`` are those that must not change
    while it is tried out."""
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
    for tensor, value in zip(kept, was, strict=True):
        tensor.copy_(value)
    return graph.replay
