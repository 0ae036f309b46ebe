"""Work of a device, checked without one."""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

from torch.utils._python_dispatch import TorchDispatchMode


class CapturableOnly(TorchDispatchMode):
    """Refuses operations that cannot be part of a CUDA graph: values that the host reads, or makes, and shapes that follow from
    values. Code takes the branches of a device, not those of a CPU."""

    NO = ("_local_scalar_dense", "lift_fresh", "nonzero", "masked_select", "unique")

    def __init__(self) -> None:
        super().__init__()
        self._device = patch("torch.compiler.is_compiling", lambda: True)

    def __enter__(self) -> Any:
        self._device.start()
        return super().__enter__()

    def __exit__(self, *fault: Any) -> None:
        super().__exit__(*fault)
        self._device.stop()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        assert not any(name in str(func) for name in self.NO), func
        return func(*args, **(kwargs or {}))
