"""Reader of arrays in npz files of unknown origin, which runs no pickle and limits the size of arrays."""

from __future__ import annotations

import ast
import io
import zipfile
import zlib
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np

from h3data.errors import FormatError, InputError

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
