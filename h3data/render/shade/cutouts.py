"""Cut-outs: holes of a surface in all outputs, where its texture is less than half opaque.

Only triangles that overlap a hole of their texture are *cut out*; they have clusters of their own, which the rasteriser
draws after all others, pixel by pixel. Opacity is interpolated bilinearly in the finest mip level, because whether a
point is solid must not depend on the viewing distance. A texture that is nowhere half opaque (a tinted pane) has no
holes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel_part
from h3data.mesh.mesh import Texture
from h3data.render.shade.surface import Surface

SOLID = 127.5
"""Smallest opacity, 0..255, of a solid surface."""


class Cutouts(NamedTuple):
    """Cut-out clusters in the form that the rasteriser reads."""

    first: NDArray[np.int32]
    """Row of each cluster's first packet in ``uv`` and ``textures``, -1 = not cut out; shape [C], or [0] if there are
    none."""
    uv: NDArray[np.float32]
    """Texture coordinates of packets, s t of the three vertices [repeats], shape [Q, 6, 8]."""
    textures: NDArray[np.int32]
    """Texture of every lane, -1 = padding, shape [Q, 8]."""
    maps: NDArray[np.int32]
    """Each texture's first value in ``opacity`` (-1 = no holes), width and height [texels], shape [T, 3]."""
    opacity: NDArray[np.uint8]
    """Opacity of the textures with holes, row by row, with the first column and row repeated at the end, shape [O]."""


def cut_out_faces(uv: NDArray[np.floating], pixels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return whether triangles with texture coordinates [F, 3, 2] may overlap a hole of a texture [H, W, 4], shape [F].

    The test is conservative: it counts transparent texels in the triangles' bounding boxes by a summed-area table.
    """
    opacity = pixels[..., 3]
    if not len(uv) or not has_holes(opacity):
        return np.zeros(len(uv), np.bool_)
    clear, size = opacity < SOLID, np.array(opacity.shape[::-1])
    # clipped first, since a float that no integer can hold has no defined value as one
    low = np.floor(np.clip(uv.min(1), -1e6, 1e6) * size - 0.5).astype(np.int64)  # range of texels that may contribute
    high = np.floor(np.clip(uv.max(1), -1e6, 1e6) * size - 0.5).astype(np.int64) + 1
    x0, y0 = (low % size).T
    x1, y1 = (low % size + np.minimum(high - low + 1, size)).T
    count = np.zeros((clear.shape[0] + 1, clear.shape[1] + 1), np.int32)
    clear.cumsum(0, dtype=np.int32).cumsum(1, out=count[1:, 1:])

    def before(y: NDArray[np.int64], x: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the number of transparent texels in rows below y and columns below x of the repeated texture."""
        (rows, y), (columns, x) = np.divmod(y, clear.shape[0]), np.divmod(x, clear.shape[1])
        return rows * (columns * np.int64(count[-1, -1]) + count[-1, x]) + columns * count[y, -1] + count[y, x]

    return before(y1, x1) - before(y0, x1) - before(y1, x0) + before(y0, x0) > 0


def pack_cutouts(
    cut_out: NDArray[np.bool_], surface: Surface, cluster_packets: NDArray[np.int32], textures: Sequence[Texture]
) -> Cutouts:
    """Build the tables of cut-outs of a scene; ``cut_out`` [F] marks the cut-out faces, all or none of each cluster."""
    if not cut_out.any():
        return Cutouts(
            first=np.zeros(0, np.int32),
            uv=np.zeros((0, 6, 8), np.float32),
            textures=np.zeros((0, 8), np.int32),
            maps=np.zeros((0, 3), np.int32),
            opacity=np.zeros(0, np.uint8),
        )
    # the first triangle speaks for its cluster (`clusters.build_clusters` keeps both kinds apart)
    chosen = np.flatnonzero(cut_out[surface.packet_faces[cluster_packets[:, 0], 0]])
    packets = [np.arange(start, end) for start, end in cluster_packets[chosen]]
    first = np.full(len(cluster_packets), -1, np.int32)
    first[chosen] = np.cumsum([0, *map(len, packets[:-1])])
    lanes = surface.packet_faces[np.concatenate(packets)]  # [Q, 8]
    corners = surface.uv[surface.faces[np.maximum(lanes, 0)]].astype(np.float64)  # [Q, 8, 3, 2]
    corners -= np.floor(corners[:, :, :1])  # close to 0, for precision in float32
    maps, opacity = pack_opacity(textures)
    return Cutouts(
        first=first,
        uv=np.ascontiguousarray(corners.reshape(*lanes.shape, 6).swapaxes(1, 2), np.float32),
        textures=np.where(lanes >= 0, surface.face_textures[lanes], -1).astype(np.int32),
        maps=maps,
        opacity=opacity,
    )


def pack_opacity(textures: Sequence[Texture]) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Return `Cutouts.maps` and `Cutouts.opacity` of some textures."""
    maps, values = np.full((len(textures), 3), -1, np.int32), [np.zeros(0, np.uint8)]
    for number, texture in enumerate(textures):
        opacity = texture.pixels[..., 3]
        if has_holes(opacity):
            # padded by the first row and column, so that interpolation never has to wrap around
            maps[number] = sum(map(len, values)), opacity.shape[1], opacity.shape[0]
            values.append(np.pad(opacity, ((0, 1), (0, 1)), mode="wrap").ravel())
    return maps, np.concatenate(values)


def has_holes(opacity: NDArray[np.uint8]) -> bool:
    """Return whether some but not all texels [H, W] are less than half opaque."""
    clear = opacity < SOLID
    return bool(clear.any() and not clear.all())


@kernel_part(forceinline=True)
def _texel_before(coordinate, size):
    """Return the texel whose centre lies just before a coordinate [repeats], and the fraction beyond it.

    Always within the texture, even for NaN and infinite coordinates.
    """
    place = (coordinate - np.floor(coordinate)) * size - 0.5
    # left of the first texel's centre lies the last texel of the repetition before
    if place < 0:
        place += size
    if not 0 <= place < size:
        place = 0.0
    return int(place), place - int(place)


@kernel_part()
def is_solid(maps, opacity, texture, s, t):
    """Return whether a texture with holes is at least half opaque at (s, t), in repeats of the texture."""
    first, width, height = maps[texture, 0], maps[texture, 1], maps[texture, 2]
    column, right = _texel_before(s, width)
    row, lower = _texel_before(t, height)
    at = first + row * (width + 1) + column
    upper_value = opacity[at] + (float(opacity[at + 1]) - opacity[at]) * right
    at += width + 1
    lower_value = opacity[at] + (float(opacity[at + 1]) - opacity[at]) * right
    return upper_value + (lower_value - upper_value) * lower >= SOLID
