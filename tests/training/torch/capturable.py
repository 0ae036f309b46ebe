"""Work of a device, checked without one."""

from __future__ import annotations

from typing import Any

from torch.utils._python_dispatch import TorchDispatchMode


class CapturableOnly(TorchDispatchMode):
    """Refuses operations that cannot be part of a CUDA graph: values that the host reads, or makes, and shapes that follow from
    values."""

    NO = ("_local_scalar_dense", "lift_fresh", "nonzero", "masked_select", "unique")

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        assert not any(name in str(func) for name in self.NO), func
        return func(*args, **(kwargs or {}))
