"""Functions that run in a worker of Ray."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import pickle
import platform
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

PACKAGES = (
    "h3data",
    "sim_kinematic",
    "h3data_pipelines",
    "h3data_viewers",
    "h3data_training",
    "h3data_habitat",
    "h3data_gpu",
    "h3data_homes",
    "h3data_meshes",
    "h3data_motion",
    "h3data_worlds",
    "h3data_exporters",
    "h3data_crowds",
    "h3data_language",
    "h3data_light",
    "h3data_llm",
    "h3data_social",
    "h3data_rays",
    "h3data_remote",
)
_DECIDES = ("numpy", "scipy", "numba")


@dataclass(frozen=True)
class Origin:
    """Properties of the requesting process that a worker must share, and its working directory.

    A worker with the same properties computes identical bytes.
    """

    code: str
    """Digest of the source files of h3data."""
    packages: str
    """Versions of packages that affect numerical results."""
    folder: str
    """Working directory, if it also exists on the worker's machine."""

    @classmethod
    def of_this_process(cls) -> Origin:
        """Return the origin that describes this process."""
        packages = " ".join([f"python {platform.python_version()}", *(f"{name} {version(name)}" for name in _DECIDES)])
        return cls(source_digest(), packages, os.getcwd())

    def to_json(self) -> str:
        """Encode all fields as JSON types, as the inverse of `from_json`."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Origin:
        """Return the origin encoded in the JSON that `to_json` returned."""
        return cls(**json.loads(text))


@functools.cache
def source_digest() -> str:
    """Return the SHA-256 (hex) of all source files of h3data, which changes with any edit."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        spec = find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            for path in sorted(Path(folder).rglob("*.py")):
                digest.update(path.relative_to(folder).as_posix().encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


def carry_out(origin_json: str, payload: bytes) -> tuple[str, Any]:
    """Process a shard in a worker.

    Returns:
        ``("done", pickled result)``, ``("raised", pickled error)``, or ``("refused", reason)`` if the worker's code or
        packages differ from those of the process that asks.
    """
    from h3data.progress import QUIET

    origin = Origin.from_json(origin_json)
    here = Origin.of_this_process()
    node = platform.node()
    if here.packages != origin.packages:
        return "refused", f"The node {node} has {here.packages}, this machine {origin.packages}: install the same."
    if here.code != origin.code:
        return (
            "refused",
            f"The node {node} has another h3data than this machine: install the same version on all nodes.",
        )
    os.environ[QUIET] = "1"  # its stderr is a log file
    if os.path.isdir(origin.folder):
        os.chdir(origin.folder)
        if origin.folder not in sys.path:
            sys.path.append(origin.folder)  # module:name finds the user's files, as on the command line
    try:
        work, shard = pickle.loads(payload)
    except ImportError as error:
        return "refused", f"The node {node} lacks a module ({error}). Install the same packages on all nodes."
    try:
        return "done", pickle.dumps(work(shard), protocol=5)
    except Exception as error:
        return "raised", _pickled(error)


def _pickled(error: Exception) -> bytes:
    """Return an error that arrives as itself where its class can be pickled, else as its text."""
    from h3data.errors import H3DataError

    try:
        text = pickle.dumps(error)
        pickle.loads(text)
    except Exception:
        return pickle.dumps(H3DataError(f"{type(error).__name__}: {error}", code="H3-JOB-012"))
    return text


def portable_task() -> Callable[[str, bytes], tuple[str, Any]]:
    """Return the function that Ray sends to workers by value, so that it can report if a node lacks the package."""

    def h3data_shard(origin: str, payload: bytes) -> tuple[str, Any]:
        import platform

        try:
            from h3data_pipelines.execution.ray_worker import carry_out
        except ImportError as error:
            return "refused", (
                f"The node {platform.node()} cannot import h3data ({error}). Install the same version on all nodes."
            )
        return carry_out(origin, payload)

    return h3data_shard
