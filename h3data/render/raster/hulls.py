"""Visibility tests of objects in an image, by convex hulls of spheres and the sides of a camera's view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.kernels import kernel
from h3data.render.camera import Camera

MARGIN_M = 1e-3
"""Distance beyond a side of the view within which objects count as visible [m], larger than rounding errors of
float32."""


def may_see(camera: Camera, centers: Array, radii: Array, starts: NDArray[np.intp]) -> bool:
    """Return whether convex hulls of spheres may be visible in the image of ``camera``.

    Args:
        camera: The camera. The result is always True for fisheye and equirectangular cameras, whose views have no
            planes as sides.
        centers: World centres of the spheres, shape [K, 3] [m].
        radii: Radii of the spheres, shape [K] [m].
        starts: The first sphere of each hull, shape [G], then K.

    Returns:
        False only if each hull lies wholly beyond one side of the view: an edge of the image, ``near`` or ``far``.
    """
    if not camera.is_planar:
        return True
    lens = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
    size, clip = (float(camera.width), float(camera.height)), (float(camera.near), float(camera.far))
    parallel = camera.projection == "orthographic"
    pose = np.ascontiguousarray(camera.pose, np.float64)
    return bool(_may_see(pose, lens, size, clip, parallel, centers, radii, starts))


@kernel(boundscheck=False)
def _may_see(pose, lens, size, clip, parallel, centers, radii, starts):
    sides = np.empty((6, 4))  # normals into the view, in the camera's frame, and offsets
    sides[:] = 0.0
    sides[0, 2], sides[0, 3] = 1.0, -clip[0]
    sides[1, 2], sides[1, 3] = -1.0, clip[1]
    for axis in range(2):
        focal, middle = lens[axis], lens[2 + axis]
        for far_side in range(2):
            along = -focal if far_side else focal
            rest = size[axis] - middle if far_side else middle
            # a unit normal, so that radii can be compared with distances
            length = focal if parallel else np.hypot(focal, rest)
            side = 2 + 2 * axis + far_side
            sides[side, axis] = along / length
            sides[side, 3 if parallel else 2] = rest / length
    # one side must have the whole hull behind it: spheres behind different sides may enclose part of the view
    for hull in range(len(starts) - 1):
        beyond_any = False
        for s in range(6):
            beyond = True
            for k in range(starts[hull], starts[hull + 1]):
                distance = sides[s, 3]
                for axis in range(3):
                    own = 0.0
                    for i in range(3):
                        own += (centers[k, i] - pose[i, 3]) * pose[i, axis]
                    distance += sides[s, axis] * own
                # written so that NaN counts as seen, which costs time but loses nothing
                if not distance < -(radii[k] + MARGIN_M):
                    beyond = False
                    break
            if beyond:
                beyond_any = True
                break
        if not beyond_any:
            return True
    return False
