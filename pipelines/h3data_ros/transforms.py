"""Trees of frames over time, built from messages of tf2."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import pose_inverse, pose_multiply, quat_nlerp

IDENTITY = np.array([0, 0, 0, 0, 0, 0, 1.0])


@dataclass
class _Edge:
    parent: str
    times: list[int] = field(default_factory=list)
    poses: list[tuple[float, ...]] = field(default_factory=list)
    still: bool = False
    arrays: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None

    def sorted(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return times [N], all different, and poses [N, 7]."""
        if self.arrays is None:
            # stamps may come twice and out of order, as several nodes may send one transform
            times, first = np.unique(np.array(self.times, np.int64), return_index=True)
            poses = np.array(self.poses, np.float64).reshape(-1, 7)[first]
            known = np.isfinite(poses).all(axis=1)
            self.arrays = times[known], poses[known]
        return self.arrays


class TransformTree:
    """Tree of frames with the poses that were received for each frame."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def __contains__(self, frame: str) -> bool:
        return frame in self._edges or any(edge.parent == frame for edge in self._edges.values())

    def add(self, parent: str, child: str, time_ns: int, pose: tuple[float, ...], *, still: bool = False) -> None:
        """Add the pose [7] of a frame in its parent at a time [ns]; static (``still``) ones are valid at all times."""
        edge = self._edges.get(child)
        # a frame has one parent for the whole bag, the last one received; poses in other parents are dropped
        if edge is None or edge.parent != parent:
            edge = self._edges[child] = _Edge(parent)
        edge.times.append(time_ns)
        edge.poses.append(pose)
        edge.still, edge.arrays = still, None

    def times_of(self, frame: str, root: str) -> NDArray[np.int64]:
        """Return the stamps [N] of the most frequent transform between ``root`` and ``frame``."""
        most = np.zeros(0, np.int64)
        for child in (*self._chain(frame), *self._chain(root)):
            edge = self._edges.get(child)
            if edge is not None and not edge.still and len(edge.times) > len(most):
                most = edge.sorted()[0]
        return most

    def connected(self, frame: str, root: str) -> bool:
        """Return whether two frames are in the same tree."""
        return self._chain(frame)[-1] == self._chain(root)[-1]

    def poses(self, frame: str, root: str, times: NDArray[np.int64], gap_ns: int) -> NDArray[np.float64]:
        """Return the poses [T, 7] of ``frame`` in ``root`` at times [T]; both must be connected.

        Poses are interpolated between stamps. Where stamps of the most frequent transform are farther apart than
        ``gap_ns``, the pose is NaN. Slower transforms, such as corrections of a localization, are interpolated over any
        time, and held before their first and after their last stamp.
        """
        ours, theirs = self._chain(frame), self._chain(root)
        # what both have above them cancels out, and multiplying by it would cost digits
        while ours and theirs and ours[-1] == theirs[-1]:
            ours.pop()
            theirs.pop()
        counts = [len(self._edges[child].times) for child in (*ours, *theirs) if not self._edges[child].still]
        fastest = max(counts, default=0)
        up = self._composed(ours, times, gap_ns, fastest)
        down = self._composed(theirs, times, gap_ns, fastest)
        if down is None:
            return np.tile(IDENTITY, (len(times), 1)) if up is None else up
        back = pose_inverse(down)
        return np.asarray(back if up is None else pose_multiply(back, up), np.float64)

    def _chain(self, frame: str) -> list[str]:
        """Return the frame and those that it hangs in, the root last."""
        chain = [frame]
        # a broken bag may have a circle of frames
        while chain[-1] in self._edges and self._edges[chain[-1]].parent not in chain:
            chain.append(self._edges[chain[-1]].parent)
        return chain

    def _composed(
        self, children: list[str], times: NDArray[np.int64], gap_ns: int, fastest: int
    ) -> NDArray[np.float64] | None:
        total: NDArray[np.float64] | None = None
        for child in reversed(children):
            edge = self._edges[child]
            stamps, poses = edge.sorted()
            if not len(stamps):
                return np.full((len(times), 7), np.nan)
            if edge.still:
                if np.array_equal(poses[-1], IDENTITY):
                    continue  # exact: nothing is multiplied
                here = np.tile(poses[-1], (len(times), 1))
            else:
                here = at_times(stamps, poses, times, gap_ns if len(edge.times) >= fastest else None)
            total = here if total is None else np.asarray(pose_multiply(total, here), np.float64)
        return total


def at_times(
    stamps: NDArray[np.int64], poses: NDArray[np.float64], times: NDArray[np.int64], gap_ns: int | None
) -> NDArray[np.float64]:
    """Return poses [T, 7] at times [T] from poses [N, 7] at stamps [N], which increase.

    At a stamp the pose is exactly the one given. Between stamps up to ``gap_ns`` apart it is interpolated, and
    elsewhere it is NaN. Without ``gap_ns``, every time has a pose; before the first and after the last stamp it is the
    nearest one.
    """
    after = np.clip(np.searchsorted(stamps, times), 0, len(stamps) - 1)
    exact = stamps[after] == times
    before = np.where(exact, after, np.maximum(after - 1, 0))
    inside = (times >= stamps[0]) & (times <= stamps[-1])
    span = stamps[after] - stamps[before]
    share = np.clip((times - stamps[before]) / np.maximum(span, 1), 0.0, 1.0)[:, None]
    found = poses[after].copy()
    between = ~exact & inside
    a, b, w = poses[before[between]], poses[after[between]], share[between]
    found[between, :3] = a[:, :3] + w * (b[:, :3] - a[:, :3])
    if between.any():
        found[between, 3:] = quat_nlerp(a[:, 3:], b[:, 3:], w[:, 0])
    if gap_ns is None:
        found[times > stamps[-1]] = poses[-1]
    else:
        found[~exact & (~inside | (span > gap_ns))] = np.nan
    return found
