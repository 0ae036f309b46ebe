"""Cameras on the device, and the variant of the rasteriser that is compiled for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data_gpu.layout import CAMERA_WORDS

if TYPE_CHECKING:
    import torch


class Variant(NamedTuple):
    """Compile-time parameters of the rasteriser."""

    tile: int
    """Width and height of a block's tile [px]."""
    warps: int
    """Number of warps per block."""
    blocks: int
    """Number of blocks that should fit on a multiprocessor at the same time."""

    def shared_bytes(self, items: int) -> int:
        """Return the dynamic shared memory of a block for pixels, depth, scratch and list of items [bytes]."""
        return self.tile**2 * 8 + max((self.tile // 8) ** 2 * 4, 16) + self.warps * 2560 + -(-items * 6 // 8) * 8


def choose_variant(worlds: int, width: int, height: int) -> Variant:
    """Return the fastest variant by measurement: small tiles if there are few blocks, large ones for small images."""
    pixels, longer = worlds * width * height, max(width, height)
    if worlds < 64:
        few = Variant(8, 8, 4) if pixels < 100_000 else Variant(16, 8, 4)
        return few if pixels < 400_000 else Variant(16, 4, 8) if pixels < 2_000_000 else Variant(32, 4, 7)
    if longer <= 64:
        return Variant(64, 8, 3)
    return Variant(32, 4, 7) if longer <= 128 else Variant(32, 3, 8)


@dataclass(frozen=True, eq=False)
class Views:
    """Cameras on the device, in the form that the kernels read."""

    key: tuple[Any, ...]
    cameras: torch.Tensor
    hidden: torch.Tensor
    world_of_view: torch.Tensor
    placement: torch.Tensor

    @property
    def count(self) -> int:
        """Number of cameras."""
        return len(self.cameras)


def new_views(
    key: tuple[Any, ...],
    cameras: list[Camera],
    *,
    worlds: int,
    size: tuple[int, int],
    layers: Sequence[str],
    slots: int,
    device: torch.device,
) -> Views:
    """Return views of the worlds ``key[0]`` through one camera of ``size``, or through one camera each.

    Layer k of ``layers`` is bit k of the layer word.
    """
    import torch

    world_of_view = np.array(key[0], np.int32)
    if len(cameras) not in (1, len(world_of_view)):
        raise InputError(
            f"Expected one camera or one per view ({len(world_of_view)}), got {len(cameras)}.", code="H3-RENDER-035"
        )
    if not len(world_of_view) or world_of_view.min() < 0 or world_of_view.max() >= worlds:
        raise InputError(f"Expected views of worlds 0 to {worlds - 1}, got {key[0]}.", code="H3-RENDER-036")
    table = np.zeros((len(cameras), CAMERA_WORDS), np.float32)
    hidden = np.zeros(len(cameras), np.uint32)
    for k, camera in enumerate(cameras):
        _check_camera(camera, size)
        table[k, :12] = np.asarray(camera.pose, np.float64)[:3].ravel()
        table[k, 12:] = camera.fx, camera.fy, camera.cx, camera.cy, *depth_range(camera)
        hidden[k] = sum(1 << b for b, layer in enumerate(layers) if layer in camera.hidden_layers)
    every = (len(world_of_view), -1)
    return Views(
        key=key,
        cameras=tensor_of(table, device).expand(every).contiguous(),
        hidden=tensor_of(hidden, device)[:, None].expand(every).contiguous(),
        world_of_view=tensor_of(world_of_view, device),
        placement=torch.empty((len(world_of_view), slots, 12), dtype=torch.float32, device=device),
    )


def _check_camera(camera: Camera, size: tuple[int, int]) -> None:
    camera.checked()
    if camera.projection != "perspective":
        raise InputError(
            f"The GPU renders perspective cameras only; camera {camera.name!r} is {camera.projection}.",
            code="H3-RENDER-037",
        )
    if (camera.width, camera.height) != size:
        raise InputError(
            f"Camera {camera.name!r} is {camera.width}x{camera.height}, but this renderer is {size[0]}x{size[1]}.",
            code="H3-RENDER-038",
        )


def depth_range(camera: Camera) -> tuple[float, float]:
    """Return the near and far limits of a camera [m]."""
    return float(camera.near), float(camera.far)


def tensor_of(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """Return an array as a tensor on the device.

    Structured arrays become bytes, and uint32 becomes int32, because torch lacks most unsigned operations.
    """
    import torch

    if array.dtype.fields is not None:
        array = array.view(np.uint8)
    elif array.dtype.kind == "u" and array.itemsize == 4:
        array = array.view(np.int32)
    return torch.from_numpy(np.ascontiguousarray(array)).to(device)
