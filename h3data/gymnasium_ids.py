"""Gymnasium's ids of the tasks of h3data, whichever of the two packages is imported first.

Gymnasium 1 asks no other package for its ids, and ``import h3data`` must not import Gymnasium, so that it stays quick.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType


class GymnasiumFinder(PathFinder):
    """Finder that lets Gymnasium, when it is imported, be followed by `h3data.envs`, which registers the ids."""

    @classmethod
    def find_spec(
        cls, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Returns Gymnasium's own specification; None for all other modules."""
        spec = super().find_spec(fullname, path, target) if fullname == "gymnasium" else None
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_register(module: ModuleType) -> None:
                run(module)
                importlib.import_module("h3data.envs")

            spec.loader.exec_module = run_and_register
        return spec


def register_ids() -> None:
    """Registers the ids now if Gymnasium is there, else as soon as it is imported in this process."""
    if "gymnasium" in sys.modules:
        importlib.import_module("h3data.envs")
    elif GymnasiumFinder not in sys.meta_path:
        sys.meta_path.insert(0, GymnasiumFinder)
