"""Motion files of every kind that is read, and our own: one npz without pickle."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from h3data.bodies.people.skeleton import HABITAT_JOINTS, JOINT_COUNT, JOINT_INDEX, JOINT_NAMES
from h3data.errors import FormatError, InputError
from h3data.files import part_file
from h3data.geometry import normalized, quat_from_matrix
from h3data.npz_arrays import npz_arrays, npz_names
from h3data.safe_pickle import is_pickle
from h3data_motion.amass import Up, is_amass, read_amass
from h3data_motion.bvh_motion import read_bvh
from h3data_motion.clip import Motion, in_start_frame
from h3data_motion.habitat_humanoid import HabitatClip
from h3data_motion.habitat_motion import motion_parts, read_habitat_motion, read_habitat_sequence

MotionKind = Literal["motion", "amass", "habitat", "bvh"]
FORMAT = "h3data-motion/1"
SUFFIXES = (".npz", ".pkl", ".bvh")


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Facts that a motion file may not contain."""

    up: Up = "z"
    """AMASS: axis of the file's world that points up."""
    fps: float | None = None
    """AMASS: frames per second, for files that do not say."""
    names: str | Path | None = None
    """BVH: table of joint names, built-in or TOML; None takes the built-in one that fits."""
    unit_m: float | None = None
    """BVH: metres per unit; None guesses it from the legs."""
    source: str = ""
    """Origin and licence, kept with the motion."""


def motion_kind(path: str | Path) -> MotionKind:
    """Format of a motion file, detected by its content.

    Raises:
        FormatError: it holds no motion that is read; the message says what it looks like.
        InputError: there is no such file.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            start = stream.read(256)
    except OSError as error:
        raise InputError(f"Cannot read a motion file ({error.strerror or error}): {path}", code="H3-BODY-052") from None
    if not start:
        raise FormatError(f"Expected a motion file, this one is empty: {path}", code="H3-BODY-046")
    if start.removeprefix(b"\xef\xbb\xbf").lstrip()[:9].upper() == b"HIERARCHY":
        return "bvh"
    if is_pickle(start):
        return "habitat"
    if not start.startswith(b"PK"):
        raise FormatError(
            f"Expected a motion file (npz, pickle or BVH), this is something else: {path}", code="H3-BODY-047"
        )
    names = npz_names(path)
    if {"format", "quats", "pelvis"} <= set(names):
        return "motion"
    if "pose_motion" in names or "walk_motion" in names:
        return "habitat"
    if is_amass(names):
        return "amass"
    shape_only = "betas" in names
    what = "the shape of a person, without motion" if shape_only else "no motion that is known"
    raise FormatError(f"This npz holds {what}: {', '.join(names[:12]) or 'no arrays'}: {path}", code="H3-BODY-045")


def read_motion(
    path: str | Path, *, kind: MotionKind | Literal["auto"] = "auto", options: ReadOptions | None = None
) -> Motion:
    """The motion in a file of any kind that is read: ours, AMASS, Habitat (sequence or walk), BVH.

    Raises:
        FormatError: it is of another kind, or damaged; the message names the file and the key or line.
        InputError: there is no such file.
    """
    path, o = Path(path), options or ReadOptions()
    kind = motion_kind(path) if kind == "auto" else kind
    if kind == "motion":
        return load_motion(path)
    if kind == "amass":
        return read_amass(path, up=o.up, fps=o.fps, source=o.source)
    if kind == "bvh":
        return read_bvh(path, names=o.names, unit_m=o.unit_m, source=o.source)
    return _habitat(path, o.source)


def _habitat(path: Path, source: str) -> Motion:
    """A Habitat sequence, or the walk of its motion file."""
    if "pose_motion" in motion_parts(path):
        clip = read_habitat_sequence(path)
    else:
        clip = read_habitat_motion(path).walk
    return habitat_clip_motion(
        clip, name=path.stem, source=source or f"Habitat motion file {path.name}; licence unknown"
    )


def habitat_clip_motion(clip: HabitatClip, *, name: str, source: str = "") -> Motion:
    """A clip of Habitat's humanoids as motion; its root frames have y up and the axes of our body frame.

    Raises:
        FormatError: a root is no rotation.
    """
    rotation = clip.roots[:, :3, :3]
    if np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation).min() < 0:
        raise FormatError(
            f"transform_array: Expected rotations and places, one is sheared, scaled or mirrored: {name}",
            code="H3-BODY-048",
        )
    quats = np.empty((len(clip.joints), JOINT_COUNT, 4))
    quats[:, 0] = quat_from_matrix(rotation)
    quats[:, [JOINT_INDEX[joint] for joint in HABITAT_JOINTS]] = clip.joints
    return in_start_frame(
        Motion(name=name, fps=clip.fps, quats=normalized(quats), pelvis=clip.roots[:, :3, 3].copy(), source=source)
    )


# --- ours -----------------------------------------------------------------------------------------------------------------
def save_motion(motion: Motion, path: str | Path) -> None:
    """Write a motion as npz (compressed, no pickle); equal motions give equal bytes."""
    with part_file(path) as part:
        part.write_bytes(motion_bytes(motion))


def motion_bytes(motion: Motion) -> bytes:
    """Content of the file that `save_motion` writes."""
    stream = io.BytesIO()
    np.savez_compressed(
        stream, format=np.array(FORMAT), name=np.array(motion.name), fps=np.float64(motion.fps),
        joint_names=np.array(JOINT_NAMES), quats=motion.quats.astype(np.float64),
        pelvis=motion.pelvis.astype(np.float64), leg_m=np.float64(np.nan if motion.leg_m is None else motion.leg_m),
        body=np.array(motion.body), source=np.array(motion.source),
    )  # fmt: skip
    return stream.getvalue()


def load_motion(path: str | Path | io.BytesIO) -> Motion:
    """Read what `save_motion` wrote.

    Raises:
        FormatError: it is something else, of a newer version, or damaged.
        InputError: there is no such file.
    """
    path = path if isinstance(path, io.BytesIO) else Path(path)
    data = npz_arrays(path)
    found = str(data.get("format", "another npz file"))
    if found != FORMAT:
        raise FormatError(f"Expected motion ({FORMAT}), got {found[:40]}: {path}", code="H3-BODY-049")
    missing = [k for k in ("name", "fps", "joint_names", "quats", "pelvis", "leg_m", "body", "source") if k not in data]
    if missing:
        raise FormatError(f"The motion file lacks {', '.join(missing)}: {path}", code="H3-BODY-050")
    if tuple(map(str, data["joint_names"].ravel())) != JOINT_NAMES:
        raise FormatError(f"joint_names: Expected the 55 SMPL-X joints in their order: {path}", code="H3-BODY-051")
    for key in ("fps", "leg_m", "quats", "pelvis"):
        if data[key].dtype.kind != "f" or (key in ("fps", "leg_m") and data[key].size != 1):
            raise FormatError(
                f"{key}: Expected numbers, got {data[key].dtype} {list(data[key].shape)}: {path}", code="H3-BODY-053"
            )
    leg = float(data["leg_m"].reshape(()))
    try:
        return Motion(
            name=str(data["name"]), fps=float(data["fps"].reshape(())), quats=data["quats"].astype(np.float64),
            pelvis=data["pelvis"].astype(np.float64), leg_m=None if np.isnan(leg) else leg, body=str(data["body"]),
            source=str(data["source"]),
        )  # fmt: skip
    except FormatError as error:
        raise FormatError(f"{error} File: {path}", code=error.code) from None
