"""Cameras on the device, and how the rasteriser is compiled for so many of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data.render.gpu.layout import CAMERA_WORDS

if TYPE_CHECKING:
    import torch


class Variant(NamedTuple):
    """How the rasteriser is compiled."""

    tile: int
    """Width and height of a block's tile [px]."""
    warps: int
    blocks: int
    """That shall fit a multiprocessor at the same time."""

    def shared_bytes(self, items: int) -> int:
        """Dynamic shared memory of a block: pixels, coarse depth, every warp's scratch, list of items."""
        return self.tile**2 * 8 + max((self.tile // 8) ** 2 * 4, 16) + self.warps * 2560 + -(-items * 6 // 8) * 8


def choose_variant(worlds: int, width: int, height: int) -> Variant:
    """The fastest measured: small tiles where there are few blocks, large ones for small pictures."""
    pixels, longer = worlds * width * height, max(width, height)
    if worlds < 64:
        few = Variant(8, 8, 4) if pixels < 100_000 else Variant(16, 8, 4)
        return few if pixels < 400_000 else Variant(16, 4, 8) if pixels < 2_000_000 else Variant(32, 4, 7)
    if longer <= 64:
        return Variant(64, 8, 3)
    return Variant(32, 4, 7) if longer <= 128 else Variant(32, 3, 8)


@dataclass(frozen=True, eq=False)
class Views:
    """Cameras on the device, as the kernels read them."""

    key: tuple[Any, ...]
    cameras: torch.Tensor
    hidden: torch.Tensor
    world_of_view: torch.Tensor
    placement: torch.Tensor

    @property
    def count(self) -> int:
        return len(self.cameras)


def new_views(
    key: tuple[Any, ...], cameras: list[Camera], *, worlds: int, size: tuple[int, int], layers: Sequence[str], slots: int,
    device: torch.device,
) -> Views:  # fmt: skip
    """Views of worlds ``key[0]`` through one camera, or one each, of this ``size``; named ``layers`` have bits."""
    import torch

    seen = np.array(key[0], np.int32)
    if len(cameras) not in (1, len(seen)):
        raise InputError(f"Expected one camera or one per view ({len(seen)}), got {len(cameras)}.")
    if not len(seen) or seen.min() < 0 or seen.max() >= worlds:
        raise InputError(f"Expected views of worlds 0 to {worlds - 1}, got {key[0]}.")
    table = np.zeros((len(cameras), CAMERA_WORDS), np.float32)
    hidden = np.zeros(len(cameras), np.uint32)
    for k, camera in enumerate(cameras):
        _check_camera(camera, size)
        table[k, :12] = np.asarray(camera.pose, np.float64)[:3].ravel()
        table[k, 12:] = camera.fx, camera.fy, camera.cx, camera.cy, *depth_range(camera)
        hidden[k] = sum(1 << b for b, layer in enumerate(layers) if layer in camera.hidden_layers)
    every = (len(seen), -1)
    return Views(
        key=key,
        cameras=tensor_of(table, device).expand(every).contiguous(),
        hidden=tensor_of(hidden, device)[:, None].expand(every).contiguous(),
        world_of_view=tensor_of(seen, device),
        placement=torch.empty((len(seen), slots, 12), dtype=torch.float32, device=device),
    )


def _check_camera(camera: Camera, size: tuple[int, int]) -> None:
    camera.checked()
    if camera.projection != "perspective":
        raise InputError(f"The GPU draws perspective cameras; camera {camera.name!r} is {camera.projection}.")
    if (camera.width, camera.height) != size:
        raise InputError(
            f"Camera {camera.name!r} is {camera.width}x{camera.height}, this renderer draws {size[0]}x{size[1]}."
        )


def depth_range(camera: Camera) -> tuple[float, float]:
    """Depths between which it sees [m]."""
    return float(camera.near), float(camera.far)


def tensor_of(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """An array on the device; records as their bytes."""
    import torch

    if array.dtype.fields is not None:
        array = array.view(np.uint8)
    elif array.dtype.kind == "u" and array.itemsize == 4:
        array = array.view(np.int32)
    return torch.from_numpy(np.ascontiguousarray(array)).to(device)
