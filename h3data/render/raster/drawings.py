"""Image buffers of one thread with a record of their contents, so that a static camera renders only changes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.render.raster.raster import Target, View, new_target
from h3data.render.shade.shading import KeptPicture

_REMEMBERED = 32
"""Number of images after which an unused camera loses its buffers; views are remembered to recognize static cameras."""


class Shown(NamedTuple):
    """Part of a world's state on which images depend."""

    matrix: NDArray[np.float64]
    """Matrix from mesh to world of every instance, shape [I, 3, 4]."""
    visible: NDArray[np.bool_]
    """True if the camera sees the instance, shape [I]."""
    vertices: dict[int, NDArray[np.float32]]
    """Vertices [V, 3] [m] of the deformed meshes, by mesh."""
    tints: NDArray[np.float32]
    """Factors on the colours of instances (`Blockers.tints`), shape [I, 4]; 1 without blockers."""


@dataclass(eq=False)
class Drawing:
    """Image buffers of a camera, with a record of their contents."""

    target: Target
    stands: bool = False
    """True if the buffers belong to a static camera."""
    shown: Shown | None = None
    """State in the last image, from which the next image can start; None if there is none, as for all moving
    cameras."""
    picture: KeptPicture | None = None
    """Shaded image of the current contents of the buffers."""
    last_used: int = 0

    def changed(self, now: Shown | None, mesh: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return which instances [I] differ from the last image, for their meshes ``mesh`` [I]; shape [0] means all."""
        before = self.shown
        if before is None or now is None:
            return np.zeros(0, np.bool_)
        changed = before.visible != now.visible
        changed |= (before.matrix.view(np.int64) != now.matrix.view(np.int64)).any((1, 2))  # NaN is equal to itself
        changed |= (before.tints != now.tints).any(1)
        for number, vertices in now.vertices.items():
            earlier = before.vertices.get(number)
            # the same array first, without comparing numbers: engines keep it and never write into it
            if earlier is not vertices and not (earlier is not None and np.array_equal(earlier, vertices)):
                changed |= mesh == number
        return changed


@dataclass(eq=False)
class Drawings:
    """Image buffers of one thread: one for each static camera, and one for each image size, which all moving cameras share."""

    still: dict[bytes, Drawing] = field(default_factory=dict)
    moving: dict[tuple[int, int], Drawing] = field(default_factory=dict)
    _seen: dict[bytes, int] = field(default_factory=dict)
    _count: int = 0

    def of(self, key: bytes, view: View, *, draws: int, instances: int) -> Drawing:
        """Return the drawing for an image.

        Images with equal keys may differ only in what `Shown` records.
        """
        self._count += 1
        standing = key in self._seen
        # removed and put back, so that the dictionary is in the order of the last use and the first one is dropped
        self._seen.pop(key, None)
        self._seen[key] = self._count
        while len(self._seen) > _REMEMBERED:
            del self._seen[next(iter(self._seen))]
        if key in self.still:
            self.still[key].last_used = self._count
            return self.still[key]
        size = (view.width, view.height)
        if standing and self._has_room():
            target = new_target(*size, draws=draws, instances=instances)
            drawing = Drawing(target, stands=True, last_used=self._count)
            self.still[key] = drawing
            return drawing
        drawing = self.moving.pop(size, None) or Drawing(new_target(*size, draws=draws, instances=instances))
        # other cameras of this size have drawn into it
        drawing.shown = None
        self.moving[size] = drawing  # most recently used last
        # of four sizes at most
        while len(self.moving) > 4:
            del self.moving[next(iter(self.moving))]
        return drawing

    def _has_room(self) -> bool:
        # only here, when somebody needs a place: a camera that pauses keeps its buffers until another one wants them
        for key, drawing in list(self.still.items()):
            if drawing.last_used < self._count - _REMEMBERED:
                del self.still[key]
        # 8: cameras that stand still for which a thread keeps buffers
        return len(self.still) < 8
