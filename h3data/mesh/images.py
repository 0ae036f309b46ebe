"""Decoding of images in mesh files: PNG, JPEG, WebP and other formats of Pillow, and KTX2 with Basis Universal.

The size is read from the header and checked before anything is decoded.
"""

from __future__ import annotations

import hashlib
import io
import struct
from typing import Any, Literal
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.mesh.mesh import Texture
from h3data.mesh.png import MAX_PX
from h3data.srgb import bytes_to_linear, linear_to_bytes

MAX_SIDE_PX, MAX_FILE_PX = 2048, 1 << 27
"""Largest side of an image, and largest number of texels in all images of one file (512 MiB). Larger images are reduced
by 2, 4, ... until they fit; images of rooms need no more detail."""

_KTX2 = b"\xabKTX 20\xbb\r\n\x1a\n"

Alpha = Literal["OPAQUE", "MASK", "BLEND"]
"""Meaning of an image's fourth channel, as glTF's ``alphaMode``."""

_textures: WeakValueDictionary[tuple[Any, ...], Texture] = WeakValueDictionary()
"""Textures in use, by content: files with the same image share one."""


def image_size(data: bytes | memoryview) -> tuple[int, int]:
    """Return the width and height [px] from an image's header. Raises `SceneError` if it cannot be read."""
    if data[:12] == _KTX2:
        if len(data) < 80:
            raise SceneError("it is cut off", code="H3-MESH-016")
        width, height = struct.unpack_from("<II", data, 20)
        return _acceptable(width, height)
    return _opened(data).size


def largest_side(sizes: list[tuple[int, int]]) -> int:
    """Return the largest side [px], at most `MAX_SIDE_PX`, with which all images of one file fit into `MAX_FILE_PX`."""
    side = MAX_SIDE_PX
    while side > 1 and sum(np.prod(reduced_size(w, h, side), dtype=np.int64) for w, h in sizes) > MAX_FILE_PX:
        side //= 2
    return side


def reduced_size(width: int, height: int, side: int) -> tuple[int, int]:
    """Return the size of an image divided by the least power of two that makes it fit into ``side``."""
    divisor = 1
    while max(width, height) > side * divisor:
        divisor *= 2
    return -(-width // divisor), -(-height // divisor)


def image_texture(
    data: bytes | memoryview,
    *,
    name: str = "",
    side: int = MAX_SIDE_PX,
    alpha: Alpha = "BLEND",
    cutoff: float = 0.5,
    opacity: float = 1.0,
) -> Texture:
    """Decode an image, reduced to fit into ``side`` x ``side``; equal content gives the same object.

    The opacity of every texel is first multiplied by ``opacity``. ``OPAQUE`` then makes all texels opaque; ``MASK``
    makes texels with at least ``cutoff`` opaque, and all others transparent.

    Raises:
        SceneError: the image cannot be read; the message is the reason alone.
    """
    # what does not matter is left out of the key, so that more files share a texture
    key = (hashlib.sha256(data).digest(), side, alpha)
    key += (cutoff if alpha == "MASK" else 0.0, opacity if alpha != "OPAQUE" else 1.0)
    texture = _textures.get(key)
    if texture is None:
        pixels = _ktx2_pixels(data, side) if data[:12] == _KTX2 else _pixels(_opened(data), side)
        texture = Texture(pixels=_with_alpha(reduced(pixels, side), alpha, cutoff, opacity), name=name)
        _textures[key] = texture
    return texture


def picture_texture(picture: Any, *, name: str = "", side: int = MAX_SIDE_PX) -> Texture:
    """Return the opaque texture of an open Pillow image; with the limits of `image_texture`."""
    _acceptable(*picture.size)
    pixels = reduced(_pixels(picture, side), side)
    key = (hashlib.sha256(pixels.tobytes()).digest(), pixels.shape, "picture")
    texture = _textures.get(key)
    if texture is None:
        texture = _textures[key] = Texture(pixels=_with_alpha(pixels, "OPAQUE"), name=name)
    return texture


def reduced(pixels: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """Return sRGB texels [H, W, 4] averaged in linear light and by opacity until they fit into ``side`` x ``side``."""
    import cv2

    height, width = pixels.shape[:2]
    columns, rows = reduced_size(width, height, side)
    if (columns, rows) == (width, height):
        return pixels
    divisor = 1
    while -(-height // divisor) != rows or -(-width // divisor) != columns:
        divisor *= 2
    linear_of_byte = bytes_to_linear(np.arange(256)).astype(np.float32)
    out = np.empty((rows, columns, 4), np.uint8)
    # in bands of about a million texels: in float32 the whole image would take four times its memory
    band = max((1 << 20) // (width * divisor), 1)
    for start in range(0, rows, band):
        part = pixels[start * divisor : (start + band) * divisor]
        opacity = part[..., 3:].astype(np.float32) / 255
        seen = np.concatenate([linear_of_byte[part[..., :3]] * opacity, opacity], -1)
        small = cv2.resize(seen, (columns, -(-len(part) // divisor)), interpolation=cv2.INTER_AREA)
        out[start : start + band, :, :3] = linear_to_bytes(small[..., :3] / np.maximum(small[..., 3:], 1e-6))
        out[start : start + band, :, 3] = np.rint(small[..., 3] * 255)
    return out


def _acceptable(width: int, height: int) -> tuple[int, int]:
    if not 0 < width * height <= MAX_PX:
        raise SceneError(f"{width} x {height} texels, the limit is {MAX_PX}", code="H3-MESH-015")
    return width, height


def _opened(data: bytes | memoryview) -> Any:
    """Return the image opened by Pillow: its size is known, its texels are not decoded yet."""
    from PIL import Image

    try:
        picture = Image.open(io.BytesIO(data))
    except Exception as fault:  # Pillow's readers raise many types
        raise SceneError("it is empty" if not len(data) else _reason(fault), code="H3-MESH-017") from None
    _acceptable(*picture.size)
    return picture


def _pixels(picture: Any, side: int) -> NDArray[np.uint8]:
    """Return the RGBA texels [H, W, 4] of a Pillow image; a JPEG that is too large is reduced while it is decoded."""
    try:
        width, height = picture.size
        # has no effect on other formats than JPEG
        picture.draft("RGB", reduced_size(width, height, side))
        if picture.mode.startswith("I"):  # 16 bits
            gray = (np.asarray(picture).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8)
            return np.dstack([gray, gray, gray, np.full_like(gray, 255)])
        return np.array(picture.convert("RGBA"))
    except Exception as fault:
        raise SceneError(_reason(fault), code="H3-MESH-018") from None


def _ktx2_pixels(data: bytes | memoryview, side: int) -> NDArray[np.uint8]:
    """Return the RGBA texels of the largest level of a KTX2 image that fits into ``side``, or of its smallest."""
    try:
        import opengl_basisu
    except ModuleNotFoundError:
        raise SceneError("it is a KTX2 image. Hint: pip install 'h3data[gltf]'", code="H3-MESH-019") from None
    width, height = image_size(data)
    try:
        texture = opengl_basisu.open(bytes(data))
        # a coarser level of the file itself, which costs nothing, instead of reducing the finest
        level = 0
        while level + 1 < texture.levels and max(width, height) >> level > side:
            level += 1
        return np.array(texture.transcode("rgba8", level=level).data, np.uint8)
    except Exception as fault:
        raise SceneError(
            f"its KTX2 content is not Basis Universal or is damaged ({_reason(fault)})", code="H3-MESH-020"
        ) from None


def _with_alpha(
    pixels: NDArray[np.uint8], alpha: Alpha, cutoff: float = 0.5, opacity: float = 1.0
) -> NDArray[np.uint8]:
    if alpha == "OPAQUE":
        pixels[..., 3] = 255
    elif alpha == "MASK":
        pixels[..., 3] = np.where(pixels[..., 3] * opacity >= cutoff * 255, 255, 0)
    elif opacity < 1:
        pixels[..., 3] = np.round(pixels[..., 3] * opacity)
    return pixels


def _reason(fault: Exception) -> str:
    return f"{type(fault).__name__}: {fault}".splitlines()[0][:200]
