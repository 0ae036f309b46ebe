"""Free lines of sight around points of a recording, from small depth images without agents and carried objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.render import Renderer, look_at, pinhole
from h3data.replay.records import BodyTrack, JointTrack
from h3data.replay.replay import Replay

SIDES, SIDE_PX, SIDE_DEG = 4, 96, 130.0
"""Number, size [px] and field of view [deg] of the overlapping images of a panorama, which cover all lines up to 45
degrees off the horizon."""
AHEAD_PX, AHEAD_DEG = 48, 80.0


CARRIED_M, CLEARANCE_M = 0.6, 0.1
"""Size below which moving objects do not obstruct a view [m], and half the width of a free line, which is also its
distance from an obstacle at its end [m]."""


class Sight:
    """Lines of sight between points at any step; agents and ``hidden_layers`` do not obstruct them."""

    def __init__(self, replay: Replay, *, hidden_layers: tuple[str, ...] = ()) -> None:
        self.replay = replay
        scene = replay.stage.scene
        self._renderer = Renderer(scene)
        hidden = np.ones(len(scene.instances), np.bool_)  # instances beyond the drawables are light meshes of people
        moving = []
        for index, (drawable, track) in enumerate(zip(replay.drawables, replay.tracks, strict=True)):
            if drawable.agent >= 0 or drawable.deformable:
                continue
            if isinstance(track, BodyTrack):
                size = np.ptp(np.asarray(drawable.mesh.bounds), axis=0) * np.abs(track.scale)
                if size.max() < CARRIED_M:
                    continue
                moving.append(index)
            if isinstance(track, JointTrack):
                moving.append(index)
            # what remains obstructs: the home, its doors and large things
            hidden[index] = False
        self._moving = np.array(moving, np.intp)
        self._renderer.set_visible(np.flatnonzero(hidden), False)
        self._side = pinhole(SIDE_PX, SIDE_PX, hfov_deg=SIDE_DEG, hidden_layers=hidden_layers)
        self._ahead = pinhole(AHEAD_PX, AHEAD_PX, hfov_deg=AHEAD_DEG, hidden_layers=hidden_layers)
        self._beam = Beam(self._ahead.rays()[1].reshape(1, -1, 3), np.array([[0.0, 0.0, 1.0]]), self._ahead.fx)
        turns = np.arange(SIDES) * (2 * np.pi / SIDES)
        self._outward = np.stack([np.cos(turns), np.zeros(SIDES), -np.sin(turns)], axis=1)
        # four cameras of 130 degrees overlap: around every axis there are 20 degrees of the same image
        self._turns = np.stack([look_at(np.zeros(3), out)[:3, :3] for out in self._outward])

    def at(self, step: int) -> None:
        """Move all obstacles to their poses at a step."""
        if len(self._moving):
            rows = np.array([step])
            matrices = np.stack([self.replay.matrices(int(index), rows)[0] for index in self._moving])
            self._renderer.set_transforms(self._moving, matrices)

    def around(self, point: Array, far_m: float) -> NDArray[np.float64]:
        """Return a panorama from ``point`` [3]: z-depth [`SIDES`, `SIDE_PX`, `SIDE_PX`] [m].

        It is inf where there is no surface nearer than ``far_m`` [m].
        """
        poses = np.tile(np.eye(4), (SIDES, 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self._turns, point
        cameras = [replace(self._side, pose=pose, far=far_m) for pose in poses]
        return _with_inf(self._renderer.render_batch(cameras, outputs=("depth",))["depth"])

    def free_ahead(self, point: Array, direction: Array, max_m: float) -> float:
        """Return the length of the free line from ``point`` [3] along the unit ``direction`` [3], at most ``max_m`` [m]."""
        camera = replace(self._ahead, pose=look_at(point, point + direction), far=reach_of(max_m))
        depth = _with_inf(self._renderer.render(camera, outputs=("depth",))["depth"])
        return float(self._beam.free(depth.reshape(1, -1), max_m)[0])

    def sees(self, point: Array, others: Array) -> NDArray[np.bool_]:
        """Return whether points ``others`` [N, 3] are visible from ``point`` [3]."""
        side, local = self._turned(others - point)
        u, v = np.clip(self._pixels(local), 0, SIDE_PX - 1).T
        panorama = self.around(point, float(local[:, 2].max()) + 0.1)
        # 10 cm of slack: a point on a surface would hide itself
        return panorama[side, v, u] > local[:, 2] - 0.1

    def _turned(self, offsets: Array) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return the image [N] of a panorama for offsets [N, 3], and the offsets in that camera's frame [N, 3]."""
        side = (offsets @ self._outward.T).argmax(1)
        return side, np.einsum("nji,nj->ni", self._turns[side], offsets)

    def _pixels(self, local: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return the pixels [N, 2] of points [N, 3] in the frame of a panorama camera."""
        return np.floor(np.nan_to_num(self._side.to_pixels(local))).astype(np.intp)


def reach_of(max_m: float) -> float:
    """Return the z-depth [m] of a panorama beyond which nothing obstructs lines of ``max_m`` [m]."""
    # surfaces that count lie up to 4 degrees off a line, so their depth is hardly larger than their distance along it
    return 1.01 * (max_m + CLEARANCE_M)


class Fan:
    """Free distances in many panoramas along fixed unit directions [D, 3], at most 45 degrees off the horizon."""

    def __init__(self, sight: Sight, directions: Array) -> None:
        self._side, axes = sight._turned(directions)
        pixels = sight._pixels(axes)
        # at 25 degrees off the axis, only points nearer than a quarter of a metre are within the beam
        reach = int(np.radians(25) * sight._side.fx) + 1
        rows, columns = (a.ravel() for a in np.mgrid[-reach : reach + 1, -reach : reach + 1])
        # every pixel close to the axis, every second one farther out
        kept = (np.maximum(np.abs(rows), np.abs(columns)) <= 3) | ((rows % 2 == 0) & (columns % 2 == 0))
        self._v = np.clip(pixels[:, 1:] + rows[kept], 0, SIDE_PX - 1)
        self._u = np.clip(pixels[:, :1] + columns[kept], 0, SIDE_PX - 1)
        self._beam = Beam(sight._side.rays()[1][self._v, self._u], axes, sight._side.fx)

    def free(self, panorama: NDArray[np.float64], max_m: float) -> NDArray[np.float64]:
        """Return the length [D] of the free line along each direction, at most ``max_m`` [m]."""
        return self._beam.free(panorama[self._side[:, None], self._v, self._u], max_m)


class Beam:
    """Computation of free distances along beams with unit ``axes`` [D, 3].

    Beams are tested against the surface points of pixels with ``rays`` [D, P, 3] (z = 1)."""

    def __init__(self, rays: Array, axes: Array, focal_px: float) -> None:
        length = np.linalg.norm(rays, axis=-1)
        # along and across the beam, for a depth of 1: both grow in proportion to the depth
        cosine = np.clip(np.einsum("dpk,dk->dp", rays, axes) / length, 0.0, 1.0)
        self._along, self._across = length * cosine, length * np.sqrt(1 - cosine**2)
        self._on_axis = self._across < 1.5 / focal_px * self._along
        """Pixels on the axis or next to it."""

    def free(self, depth: NDArray[np.float64], max_m: float) -> NDArray[np.float64]:
        """Return the free length [D] [m] of each beam, at most ``max_m``, given z-depth [D, P].

        Points within `CLEARANCE_M` of the axis obstruct.
        """
        blocks = self._on_axis | (depth * self._across < CLEARANCE_M)
        first = np.where(blocks, depth * self._along, np.inf).min(1)
        return np.clip(first - CLEARANCE_M, 0.0, max_m)


def _with_inf(depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the depth with infinity instead of 0 for misses."""
    return np.where(depth > 0, depth, np.inf).astype(np.float64)
