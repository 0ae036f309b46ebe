"""Opening of USD stages without side effects, with a list of missing files and faults."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, MissingExtraError

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
"""File name endings of USD files, in lower case."""
_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_X_UP = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_UNITS_M = (1e-6, 1e6)


def pxr(module: str) -> Any:
    """Return a module of usd-core, such as ``UsdGeom``.

    Raises:
        MissingExtraError: the extra ``usd`` is not installed.
    """
    try:
        return importlib.import_module(f"pxr.{module}")
    except ModuleNotFoundError:
        raise MissingExtraError("USD files need usd-core: pip install 'h3data[usd]'", code="H3-WORLD-009") from None


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress the messages of USD within a ``with`` block."""
    delegate = pxr("UsdUtils").CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        del delegate


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Suppress the messages of USD in a ``with`` block, and report damaged files, which are decoded when used.

    Raises:
        FormatError: the file, or one that it refers to, is damaged.
    """
    try:
        with quiet():
            yield
    except (pxr("Tf").ErrorException, RuntimeError, UnicodeDecodeError) as fault:
        raise FormatError(
            f"Expected a USD file, this cannot be read as one ({_reason(fault)}). File: {path}", code="H3-WORLD-010"
        ) from None


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenStage:
    """Open stage with its units, axes, missing files and faults."""

    path: Path
    stage: Any
    """Stage of OpenUSD, a `Usd.Stage`."""
    metres: float
    """Length of one unit of the stage [m]."""
    turn: NDArray[np.float64]
    """Rotation from the stage's axes to +Y up, shape [4, 4]."""
    missing: tuple[str, ...]
    """Referenced files that do not exist."""
    faults: tuple[str, ...]
    """Descriptions of other faults of composition, such as circular references."""

    def in_metres(self, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a transform [4, 4] between frames of the stage, converted to metres and +Y up."""
        out = self.turn @ matrix @ self.turn.T
        out[:3, 3] *= self.metres
        return out

    def points(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return points [N, 3] in a frame of the stage, converted to metres and +Y up."""
        return self.metres * (np.asarray(points, np.float64) @ self.turn[:3, :3].T)

    def directions(self, vectors: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return directions [N, 3] in a frame of the stage, converted to +Y up."""
        return np.asarray(vectors, np.float64) @ self.turn[:3, :3].T


def open_stage(path: Path) -> OpenStage:
    """Open a USD file with all its payloads.

    Raises:
        MissingExtraError: usd-core is not installed.
        FormatError: the file is not a USD file, its units are invalid, or a package refers to files outside itself.
    """
    usd, geom = pxr("Usd"), pxr("UsdGeom")
    if not path.is_file():
        raise FormatError(f"Expected a USD file, there is none at this path: {path}", code="H3-WORLD-006")
    with reading(path):
        stage = usd.Stage.Open(str(path))
        errors = [str(error).strip() for error in stage.GetCompositionErrors()]
    missing = tuple(dict.fromkeys(_asset(text) for text in errors if "Could not open asset" in text))
    faults = tuple(dict.fromkeys(" ".join(text.split())[:200] for text in errors if "Could not open asset" not in text))
    if path.suffix.lower() == ".usdz":
        _refuse_outside(stage, path)
    metres = float(geom.GetStageMetersPerUnit(stage))
    if not _UNITS_M[0] <= metres <= _UNITS_M[1]:
        raise FormatError(
            f"Expected metersPerUnit from {_UNITS_M[0]:g} to {_UNITS_M[1]:g}, got {metres:g}. "
            f"Hint: correct it in the file. File: {path}",
            code="H3-WORLD-007",
        )
    turn = {"Y": np.eye(4), "Z": _Z_UP, "X": _X_UP}.get(str(geom.GetStageUpAxis(stage)))
    if turn is None:
        raise FormatError(
            f"Expected upAxis Y or Z, got {geom.GetStageUpAxis(stage)}. File: {path}", code="H3-WORLD-008"
        )
    return OpenStage(path=path, stage=stage, metres=metres, turn=turn, missing=missing, faults=faults)


def _refuse_outside(stage: Any, path: Path) -> None:
    """Refuse a package that refers to layers outside itself, because its author cannot know the files there."""
    inside = (f"{path.resolve()}[", f"{path}[", f"{path.absolute()}[")
    for layer in stage.GetUsedLayers():
        name = layer.realPath or layer.identifier
        if not layer.anonymous and not name.startswith(inside) and Path(name).resolve() != path.resolve():
            raise FormatError(
                f"Expected a usdz package that holds all it needs, this refers to {name!r}. File: {path}",
                code="H3-WORLD-011",
            )


def is_inside(resolved: str, path: Path) -> bool:
    """Return whether a file to which a stage refers may be read; files of a package must be inside it."""
    return path.suffix.lower() != ".usdz" or resolved.startswith(
        (f"{path.resolve()}[", f"{path}[", f"{path.absolute()}[")
    )


def _asset(text: str) -> str:
    """Return the path of the missing file in an error of composition: ``Could not open asset @path@ ...``."""
    return text.partition("@")[2].partition("@")[0] or text[:120]


def _reason(fault: BaseException) -> str:
    """Return the first thing that USD says about a file, without the places in its own source."""
    try:
        text = " ".join(str(fault).split())
    except UnicodeDecodeError as undecoded:  # USD quotes the file in its words
        fault, text = undecoded, ""
    if isinstance(fault, UnicodeDecodeError):
        return "text in it is not UTF-8"
    return text.partition(" : '")[2].partition("' Error in")[0].strip(" '")[:160] or type(fault).__name__
