"""Reader of AMASS and other SMPL motion: npz files of axis-angle rotations for SMPL-X, SMPL-H and SMPL skeletons.

The SMPL skeletons differ in the number of joints, not in their meaning, so their rotations apply to ours by index
(research/humanoids.md 2). ``trans`` is not the position of the pelvis, which is ``J0(betas) + trans``, and J0 is only
in the model file. It is a constant, so only heights are wrong, and retargeting to a body corrects them.

Npz files may be of unknown origin: no pickle in them is run, and the size of their arrays is limited (`npz_arrays`).
"""

from __future__ import annotations

import ast
import io
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.skeleton import JOINT_COUNT
from h3data.errors import FormatError, InputError
from h3data.geometry import Array, normalized, quat_from_axis_angle
from h3data_motion.clip import Motion, in_start_frame, turned_frames

FPS_KEYS = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "framerate", "fps")
ROOT_KEYS, BODY_KEYS, TRANS_KEYS = ("root_orient", "global_orient"), ("pose_body", "body_pose"), ("trans", "transl")
HAND_KEY, JAW_KEY, EYE_KEY, POSES_KEY = "pose_hand", "pose_jaw", "pose_eye", "poses"
READ_KEYS = (*FPS_KEYS, *ROOT_KEYS, *BODY_KEYS, *TRANS_KEYS, HAND_KEY, JAW_KEY, EYE_KEY, POSES_KEY)

_BODY, _HANDS = range(22), range(25, 55)
LAYOUTS: dict[int, tuple[tuple[int, int], ...]] = {
    55: tuple((j, j) for j in range(55)),
    52: tuple(zip(range(52), (*_BODY, *_HANDS), strict=True)),
    24: tuple((j, j) for j in _BODY),  # joints 22 and 23 are SMPL's hands, which ours has no place for
    22: tuple((j, j) for j in _BODY),
}
"""Indices of the joints of a file in SMPL-X order, by the number of joints in the file."""
MAX_ANGLE_RAD = 8 * np.pi
"""Length above which a rotation vector is not in radians."""

Up = Literal["z", "y"]


def is_amass(names: tuple[str, ...]) -> bool:
    """Return whether an npz file with these array names contains SMPL motion."""
    return POSES_KEY in names or any(k in names for k in BODY_KEYS)


def read_amass(path: str | Path, *, up: Up = "z", fps: float | None = None, source: str = "") -> Motion:
    """Read motion from an npz file in the layout of AMASS.

    The file has ``poses`` [T, 3n] of 55, 52, 24 or 22 joints, or ``root_orient`` with ``pose_body`` (and ``pose_hand``,
    ``pose_jaw``, ``pose_eye``); further ``trans`` and the frame rate.

    Args:
        path: npz file; pickled members are not read.
        up: axis of the file's world that points up: z in AMASS, y in some other sets.
        fps: frames per second, if the file does not state them.
        source: origin and licence; AMASS' own terms are named if empty.

    Raises:
        FormatError: an array is missing or of the wrong shape, or a number is not finite; the message names its key.
        InputError: there is no such file.
    """
    path = Path(path)
    data = npz_arrays(path, READ_KEYS)
    where = str(path)
    if not is_amass(tuple(data)):
        held = ", ".join(npz_names(path)[:12]) or "nothing"
        raise FormatError(
            f"Expected poses, or root_orient with pose_body; the file has {held}: {where}", code="H3-BODY-003"
        )
    rotvecs = _joint_rotvecs(data, where)
    trans = _numbers(data, _key(data, TRANS_KEYS, where), (len(rotvecs), 3), where)
    quats = np.tile([0.0, 0, 0, 1], (len(rotvecs), JOINT_COUNT, 1))
    for theirs, ours in LAYOUTS[rotvecs.shape[1]]:
        quats[:, ours] = quat_from_rotvec(rotvecs[:, theirs])
    turn = quat_from_axis_angle(np.array([1.0, 0, 0]), -np.pi / 2 if up == "z" else 0.0)
    quats, pelvis = turned_frames(turn, quats, trans)
    return in_start_frame(
        Motion(
            name=path.stem,
            fps=_fps(data, where) if fps is None else fps,
            quats=normalized(quats),
            pelvis=pelvis,
            source=source or f"AMASS layout, {path.name}; under the terms of its data set",
        )
    )


def _joint_rotvecs(data: Mapping[str, NDArray[Any]], where: str) -> Array:
    """Return the axis-angle vectors [T, n, 3] of n joints, n a key of `LAYOUTS`."""
    if any(k in data for k in BODY_KEYS):
        body_key = _key(data, BODY_KEYS, where)
        body = _flat(data, body_key, where)
        if body.shape[1] not in (63, 69):
            raise FormatError(
                f"{body_key}: Expected 21 (or SMPL's 23) joints times 3, got {body.shape[1]} columns: {where}",
                code="H3-BODY-010",
            )
        parts = [_numbers(data, _key(data, ROOT_KEYS, where), (len(body), 3), where), body[:, :63]]
        extra = (JAW_KEY, 3), (EYE_KEY, 6), (HAND_KEY, 90)
        if HAND_KEY in data or JAW_KEY in data:
            parts += [
                _numbers(data, key, (len(body), width), where) if key in data else np.zeros((len(body), width))
                for key, width in extra
            ]
        return np.concatenate(parts, axis=1).reshape(len(body), -1, 3)
    poses = _flat(data, POSES_KEY, where)
    if poses.shape[1] % 3 or poses.shape[1] // 3 not in LAYOUTS:
        known = ", ".join(f"{3 * n} ({n} joints)" for n in LAYOUTS)
        raise FormatError(
            f"{POSES_KEY}: Expected columns for one of {known}, got {poses.shape[1]}: {where}", code="H3-BODY-004"
        )
    return poses.reshape(len(poses), -1, 3)


def _key(data: Mapping[str, NDArray[Any]], keys: tuple[str, ...], where: str) -> str:
    for key in keys:
        if key in data:
            return key
    raise FormatError(
        f"Expected {' or '.join(keys)}, found only {', '.join(data) or 'nothing known'}: {where}", code="H3-BODY-001"
    )


def _flat(data: Mapping[str, NDArray[Any]], key: str, where: str) -> Array:
    """Return an array [T, ...] as [T, n], with at least one frame; rotations in radians."""
    array = data[key]
    if array.ndim < 2 or not array.size:
        raise FormatError(
            f"{key}: Expected one row per frame, got shape {list(array.shape)}: {where}", code="H3-BODY-005"
        )
    flat = _numbers(data, key, (len(array), -1), where)
    if np.abs(flat).max() > MAX_ANGLE_RAD:
        raise FormatError(
            f"{key}: Expected axis-angle vectors in radians, got {np.abs(flat).max():.1f}: {where}", code="H3-BODY-006"
        )
    return flat


def _numbers(data: Mapping[str, NDArray[Any]], key: str, shape: tuple[int, ...], where: str) -> Array:
    array = data[key]
    if array.dtype.kind not in "fiu":
        raise FormatError(f"{key}: Expected numbers, got {array.dtype}: {where}", code="H3-BODY-007")
    try:
        out = array.astype(np.float64).reshape(shape)
    except ValueError:
        raise FormatError(
            f"{key}: Expected shape {list(shape)}, got {list(array.shape)}: {where}", code="H3-BODY-011"
        ) from None
    if not np.isfinite(out).all():
        frame = int(np.nonzero(~np.isfinite(out).all(axis=1))[0][0])
        raise FormatError(f"{key}: Expected finite numbers, frame {frame} has others: {where}", code="H3-BODY-008")
    if np.abs(out).max(initial=0) > 1e6:
        raise FormatError(
            f"{key}: Expected metres or radians, got {np.abs(out).max():.3g}: {where}", code="H3-BODY-009"
        )
    return out


def _fps(data: Mapping[str, NDArray[Any]], where: str) -> float:
    for key in FPS_KEYS:
        if key in data:
            array = data[key]
            if array.size != 1 or array.dtype.kind not in "fiu" or not 0 < float(array.reshape(())) < 1e4:
                raise FormatError(f"{key}: Expected frames per second, got {array!r}: {where}", code="H3-BODY-012")
            return float(array.reshape(()))
    raise FormatError(
        f"No frame rate: expected one of {', '.join(FPS_KEYS)}. Hint: give it yourself, h3data motion import --fps 120. "
        f"File: {where}",
        code="H3-BODY-002",
    )


def quat_from_rotvec(rotvec: Array) -> Array:
    """Return quaternions [..., 4] of axis-angle vectors [..., 3] [rad]."""
    r = np.asarray(rotvec, np.float64)
    return quat_from_axis_angle(r, np.linalg.norm(r, axis=-1))


# --- arrays of npz files ------------------------------------------------------------------------------------------------
MAX_BYTES = 1 << 30
"""Largest total size of the requested members after unpacking [bytes]; real motion files have 1 to 100 MB."""

_DAMAGES = (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError, zlib.error, ValueError)


def npz_names(path: Path | io.BytesIO) -> tuple[str, ...]:
    """Return the names of the arrays in an npz file.

    Raises:
        FormatError: the file is not a zip file.
        InputError: there is no such file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return tuple(n.removesuffix(".npy") for n in archive.namelist() if n.endswith(".npy"))
    except FileNotFoundError:
        raise InputError(f"There is no such file: {path}", code="H3-FORMAT-013") from None
    except _DAMAGES as error:
        raise FormatError(f"Expected an npz file, this is none ({error}): {path}", code="H3-FORMAT-020") from None


def npz_arrays(
    path: Path | io.BytesIO,
    names: Collection[str] | None = None,
    *,
    unpickle: Callable[[bytes, Path | io.BytesIO], Any] | None = None,
) -> dict[str, Any]:
    """Read those arrays of an npz file that are among ``names`` (default: all).

    Args:
        path: the npz file.
        names: names of the requested arrays.
        unpickle: function that reads the bytes of a pickled member; None refuses pickled members.

    Raises:
        FormatError: the file is not an npz file or is damaged, or a member is pickled.
        InputError: there is no such file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
            if names is not None:
                members = [m for m in members if m.filename.removesuffix(".npy") in names]
            total = sum(member.file_size for member in members)
            if total > MAX_BYTES:
                raise FormatError(
                    f"The npz unpacks to {total / 2**20:.0f} MiB, more than is admitted: {path}", code="H3-FORMAT-024"
                )
            return {m.filename.removesuffix(".npy"): _npy(archive.read(m), m.filename, path, unpickle) for m in members}
    except FileNotFoundError:
        raise InputError(f"There is no such file: {path}", code="H3-FORMAT-013") from None
    except _DAMAGES as error:
        raise FormatError(
            f"Expected an npz file, this is none or it is damaged ({error}): {path}", code="H3-FORMAT-021"
        ) from None


def _npy(
    data: bytes,
    name: str,
    path: Path | io.BytesIO,
    unpickle: Callable[[bytes, Path | io.BytesIO], Any] | None,
) -> Any:
    width = 2 if data[6:7] == b"\x01" else 4
    length = int.from_bytes(data[8 : 8 + width], "little")
    try:
        if data[:6] != b"\x93NUMPY":
            raise ValueError("not an npy")
        header = ast.literal_eval(data[8 + width : 8 + width + length].decode("latin1"))
        body = data[8 + width + length :]
        dtype, shape = np.dtype(header["descr"]), tuple(header["shape"])
        if dtype.hasobject:
            if unpickle is not None:
                return unpickle(body, path)
            raise FormatError(
                f"{name.removesuffix('.npy')}: Expected an array of numbers or text, got pickled objects: {path}",
                code="H3-FORMAT-022",
            )
        return np.frombuffer(body, dtype).reshape(shape, order="F" if header["fortran_order"] else "C")
    except (ValueError, KeyError, TypeError, SyntaxError, RecursionError, MemoryError) as error:
        raise FormatError(f"{name} in the npz is damaged ({error}): {path}", code="H3-FORMAT-023") from None
