"""Readers of motion files of all supported formats, and the format of this package: an npz file without pickle."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from h3data.bodies.people.skeleton import JOINT_NAMES
from h3data.errors import FormatError, InputError
from h3data.files import part_file
from h3data.plugins import Registry
from h3data_motion.amass import Up, is_amass, npz_arrays, npz_names, read_amass
from h3data_motion.bvh_motion import read_bvh
from h3data_motion.clip import Motion

FORMAT = "h3data-motion/1"


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Facts about a motion that its file may not contain."""

    up: Up = "z"
    """Axis of an AMASS file's world that points up."""
    fps: float | None = None
    """Frames per second of AMASS files that do not state them."""
    names: str | Path | None = None
    """Table of joint names for BVH, built-in or a TOML file; None selects the built-in table that fits."""
    unit_m: float | None = None
    """Metres per unit of BVH files; None guesses it from the legs."""
    source: str = ""
    """Origin and licence, stored with the motion."""


@dataclass(frozen=True, kw_only=True)
class MotionReader:
    """Reader of motion files of one kind; other packages add readers as entry points of the group ``h3data.motions``."""

    fits: Callable[[bytes, Sequence[str]], bool]
    """Function that returns whether a file has this format, from its first 256 bytes and, for an npz file, its array
    names."""
    read: Callable[[Path, ReadOptions], Motion]
    """Function that reads the motion in a file."""
    suffixes: tuple[str, ...]
    """File name endings of this format in lower case; `h3data motion import` collects such files from folders."""


def motion_kind(path: str | Path) -> str:
    """Return the format of a motion file from its content: ``motion`` (h3data), ``bvh``, ``amass`` or a plug-in's.

    Raises:
        FormatError: the file has no supported motion; the message states what it seems to contain.
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
    names = npz_names(path) if start.startswith(b"PK") else ()
    for kind, reader in _readers(tuple(sys.path)).items():
        if reader.fits(start, names):
            return kind
    missing = ", ".join(f"{package} ({kind})" for kind, package in MOTIONS.missing().items())
    hint = f" Hint: this installation lacks {missing}; install h3data as a whole." if missing else ""
    if not start.startswith(b"PK"):
        raise FormatError(
            f"Expected a motion file (npz, pickle or BVH), this is something else: {path}{hint}", code="H3-BODY-047"
        )
    shape_only = "betas" in names
    what = "the shape of a person, without motion" if shape_only else "no motion that is known"
    raise FormatError(
        f"This npz holds {what}: {', '.join(names[:12]) or 'no arrays'}: {path}{hint}", code="H3-BODY-045"
    )


def read_motion(path: str | Path, *, kind: str = "auto", options: ReadOptions | None = None) -> Motion:
    """Return the motion in a file of any supported format: h3data, AMASS, BVH, Habitat, or a plug-in's.

    Raises:
        FormatError: the file has another format, or is damaged; the message names the file and the key or line.
        InputError: there is no such file.
    """
    path = Path(path)
    reader = MOTIONS.get(motion_kind(path) if kind == "auto" else kind)
    return reader.read(path, options or ReadOptions())


# --- ours -----------------------------------------------------------------------------------------------------------------
def save_motion(motion: Motion, path: str | Path) -> None:
    """Write a motion as npz (compressed, no pickle); equal motions give equal bytes."""
    with part_file(path) as part:
        part.write_bytes(motion_bytes(motion))


def motion_bytes(motion: Motion) -> bytes:
    """Return a motion as the bytes of a file, as `save_motion` writes it."""
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        format=np.array(FORMAT),
        name=np.array(motion.name),
        fps=np.float64(motion.fps),
        joint_names=np.array(JOINT_NAMES),
        quats=motion.quats.astype(np.float64),
        pelvis=motion.pelvis.astype(np.float64),
        leg_m=np.float64(np.nan if motion.leg_m is None else motion.leg_m),
        body=np.array(motion.body),
        source=np.array(motion.source),
    )
    return stream.getvalue()


def load_motion(path: str | Path | io.BytesIO) -> Motion:
    """Read a motion file that `save_motion` has written.

    Raises:
        FormatError: the file has another format or a newer version, or is damaged.
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
            name=str(data["name"]),
            fps=float(data["fps"].reshape(())),
            quats=data["quats"].astype(np.float64),
            pelvis=data["pelvis"].astype(np.float64),
            leg_m=None if np.isnan(leg) else leg,
            body=str(data["body"]),
            source=str(data["source"]),
        )
    except FormatError as error:
        raise FormatError(f"{error} File: {path}", code=error.code) from None


# --- kinds ----------------------------------------------------------------------------------------------------------------
def _is_ours(start: bytes, names: Sequence[str]) -> bool:
    return {"format", "quats", "pelvis"} <= set(names)


def _is_bvh(start: bytes, names: Sequence[str]) -> bool:
    return start.removeprefix(b"\xef\xbb\xbf").lstrip()[:9].upper() == b"HIERARCHY"


def _check(entry: Any) -> None:
    if not isinstance(entry, MotionReader):
        raise InputError(f"Expected an h3data_motion.files.MotionReader, got {entry!r:.60}.", code="H3-BODY-158")


MOTIONS: Registry[MotionReader] = Registry(
    "h3data.motions",
    {
        "motion": MotionReader(fits=_is_ours, read=lambda path, options: load_motion(path), suffixes=(".npz",)),
        "habitat": "",  # of h3data_habitat
        "bvh": MotionReader(
            fits=_is_bvh,
            read=lambda path, o: read_bvh(path, names=o.names, unit_m=o.unit_m, source=o.source),
            suffixes=(".bvh",),
        ),
        "amass": MotionReader(
            fits=lambda start, names: is_amass(tuple(names)),
            read=lambda path, o: read_amass(path, up=o.up, fps=o.fps, source=o.source),
            suffixes=(".npz",),
        ),
    },
    what="kind of motion file",
    check=_check,
)
"""Readers of motion files by format; the first reader that fits is used."""


@cache
def _readers(path: tuple[str, ...]) -> dict[str, MotionReader]:
    """Return all readers, as of one ``sys.path``: looking for installed packages takes 30 ms."""
    return MOTIONS.load_all()


def motion_suffixes() -> tuple[str, ...]:
    """Return the endings of the motion files that can be read."""
    readers = _readers(tuple(sys.path)).values()
    return tuple(dict.fromkeys(suffix for reader in readers for suffix in reader.suffixes))
