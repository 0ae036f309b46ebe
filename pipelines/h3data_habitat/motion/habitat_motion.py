"""Habitat's humanoid motion files: ``*_motion_data_smplx.pkl`` (walk, stop, reach) and sequences as ``.pkl`` or ``.npz``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data_habitat.motion.habitat_humanoid import HabitatClip, HabitatMotion, Hand, ReachGrid
from h3data_habitat.safe_pickle import is_pickle, load_pickle
from h3data_motion.amass import MAX_BYTES, npz_arrays

HANDS: tuple[Hand, ...] = ("left", "right")


def read_habitat_motion(path: str | Path) -> HabitatMotion:
    """Read the walk, standing pose and reaching poses of a motion file (spec/habitat.md 3.2). Nothing in it is executed.

    Raises:
        FormatError: the file has another format or is damaged, or a pickle contains more than arrays.
        InputError: there is no such file.
    """
    content = _content(Path(path))
    where = str(path)
    walk = _clip(_part(content, "walk_motion", where), "walk_motion", where)
    if walk.displacement is None:
        raise FormatError(
            f"walk_motion.displacement: Expected the way per frame, got none: {where}", code="H3-BODY-028"
        )
    stop = _part(content, "stop_pose", where)
    hands: dict[Hand, ReachGrid] = {}
    for key in content:  # the file's order: the last hand's grid is the one that Habitat uses
        for hand in HANDS:
            if key == f"{hand}_hand":
                hands[hand] = _grid(_part(content, key, where), key, where)
    return HabitatMotion(
        walk=walk,
        stop_joints=_floats(stop, "joints", "stop_pose", where, (54, 4)),
        stop_root=_floats(stop, "transform", "stop_pose", where, (4, 4)),
        hands=hands,
    )


def read_habitat_sequence(path: str | Path) -> HabitatClip:
    """Return a recorded sequence (``pose_motion``), from a pickle or from the ``.npz`` of habitat-lab's AMASS converter."""
    return _clip(_part(_content(Path(path)), "pose_motion", str(path)), "pose_motion", str(path))


def motion_parts(path: str | Path) -> tuple[str, ...]:
    """Return the names of the parts in a motion file: ``walk_motion``, ``stop_pose``, ``pose_motion``, ..."""
    return tuple(map(str, _content(Path(path))))


# --- the file -----------------------------------------------------------------------------------------------------------
def _content(path: Path) -> dict[str, Any]:
    try:
        # before it is read
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise FormatError(
                f"A motion file of {size / 2**20:.0f} MiB is more than the {MAX_BYTES >> 20} admitted: {path}",
                code="H3-BODY-035",
            )
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"Cannot read a motion file: {error.strerror or error}. Path: {path}", code="H3-BODY-036"
        ) from None
    content = load_pickle(data, path) if is_pickle(data) else npz_arrays(path, unpickle=load_pickle)
    if not isinstance(content, dict):
        raise FormatError(
            f"Expected a motion file with its parts by name, got {type(content).__name__}: {path}", code="H3-BODY-029"
        )
    return content


# --- its parts ----------------------------------------------------------------------------------------------------------
def _part(content: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    value = _plain(content.get(name))
    if not isinstance(value, dict):
        raise FormatError(
            f"Expected {name!r} in the motion file, it has {', '.join(map(str, content)) or 'nothing'}: {where}",
            code="H3-BODY-030",
        )
    return value


def _plain(value: Any) -> Any:
    """Return the object in an array without axes, as npz files hold dicts."""
    return value.item() if isinstance(value, np.ndarray) and value.dtype.hasobject and value.ndim == 0 else value


def _clip(part: Mapping[str, Any], name: str, where: str) -> HabitatClip:
    roots = _floats(part, "transform_array", name, where, (-1, 4, 4))
    joints = _floats(part, "joints_array", name, where, (len(roots), 54, 4))
    displacement = part.get("displacement")
    if displacement is not None:
        displacement = _floats(part, "displacement", name, where, (len(roots),))
        if not displacement[-1] > 0:
            raise FormatError(
                f"{name}.displacement: Expected a way that ends beyond 0, got {displacement[-1]:g}: {where}",
                code="H3-BODY-037",
            )
    fps = part.get("fps")
    # npz files hold numbers as arrays without axes
    fps = fps.item() if isinstance(fps, np.ndarray) and fps.size == 1 else fps
    if isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 0 < fps < 1e6:
        raise FormatError(f"{name}.fps: Expected frames per second above 0, got {fps!r}: {where}", code="H3-BODY-031")
    return HabitatClip(joints=joints, roots=roots, fps=float(fps), displacement=displacement)


def _grid(part: Mapping[str, Any], name: str, where: str) -> ReachGrid:
    motion, info = _part(part, "pose_motion", where), _part(part, "coord_info", where)
    low, high, bins = (_floats(info, key, f"{name}.coord_info", where, (3,)) for key in ("min", "max", "num_bins"))
    if not (high > low).all() or not (bins >= 2).all() or (bins != bins.astype(int)).any():
        raise FormatError(
            f"{name}.coord_info: Expected min < max and at least 2 bins per axis, "
            f"got {low.tolist()}, {high.tolist()}, {bins.tolist()}: {where}",
            code="H3-BODY-032",
        )
    counts = (int(bins[0]), int(bins[1]), int(bins[2]))
    points = counts[0] * counts[1] * counts[2]
    return ReachGrid(
        joints=_floats(motion, "joints_array", name, where, (points, 54, 4)),
        roots=_floats(motion, "transform_array", name, where, (points, 4, 4)),
        low=low,
        high=high,
        bins=counts,
    )


def _floats(part: Mapping[str, Any], key: str, name: str, where: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return an array of finite numbers, brought into ``shape`` (-1: any length but 0)."""
    array = part.get(key)
    try:
        numbers = np.asarray(array, np.float64)
        numbers = numbers.reshape(shape)
    except (TypeError, ValueError, OverflowError):
        got = "nothing" if array is None else f"{type(array).__name__} {list(np.shape(array))}"
        raise FormatError(
            f"{name}.{key}: Expected numbers that fill {list(shape)}, got {got}: {where}", code="H3-BODY-038"
        ) from None
    if not numbers.size or not np.isfinite(numbers).all():
        raise FormatError(
            f"{name}.{key}: Expected finite numbers, got {'none' if not numbers.size else 'NaN'}: {where}",
            code="H3-BODY-033",
        )
    # rotations of another kind, such as matrices or angles, would fit the shape by chance
    if key in ("joints_array", "joints") and not np.allclose(np.linalg.norm(numbers, axis=-1), 1, atol=1e-2):
        raise FormatError(
            f"{name}.{key}: Expected unit quaternions xyzw, some are not of length 1: {where}", code="H3-BODY-034"
        )
    return numbers
