"""Reading of habitat-lab's pickled episode datasets (spec/habitat.md 6.5) without running anything that they name.

The file holds ``{all_transforms, idx_to_name, all_eps}`` with NumPy arrays.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError
from h3data_habitat.safe_pickle import builtin, load_pickle


def unpickle_episodes(data: bytes, path: Path) -> Sequence[msgspec.Raw]:
    """Return the episodes of a pickled dataset as JSON text, in the form of a JSON dataset."""
    content = load_pickle(data, path)
    if not isinstance(content, dict) or not {"all_transforms", "idx_to_name", "all_eps"} <= set(content):
        keys = list(map(str, content))[:5] if isinstance(content, dict) else type(content).__name__
        raise FormatError(
            f"Expected a pickle with all_transforms, idx_to_name and all_eps, got {keys}: {path}", code="H3-HABITAT-025"
        )
    names, transforms, episodes = (content[key] for key in ("idx_to_name", "all_transforms", "all_eps"))
    transforms = _transforms(transforms, path)
    if not isinstance(names, dict) or not all(isinstance(name, str) for name in names.values()):
        raise FormatError(f"idx_to_name: Expected names by index: {path}", code="H3-HABITAT-026")
    if not isinstance(episodes, list) or not all(isinstance(episode, dict) for episode in episodes):
        raise FormatError(f"all_eps: Expected a list of objects: {path}", code="H3-HABITAT-027")
    return [_resolved(episode, k, names, transforms, path) for k, episode in enumerate(episodes)]


def _transforms(value: Any, path: Path) -> NDArray[Any]:
    array = value if isinstance(value, np.ndarray) else None
    if array is not None and array.size == 0:
        array = np.zeros((0, 4, 4))
    if array is None or array.dtype.kind != "f" or array.ndim != 3 or array.shape[1:] != (4, 4):
        got = type(value).__name__ if array is None else f"{array.dtype} {list(array.shape)}"
        raise FormatError(f"all_transforms: Expected a float array [N, 4, 4], got {got}: {path}", code="H3-HABITAT-028")
    finite = np.isfinite(array).all(axis=(1, 2))
    if not finite.all():
        raise FormatError(
            f"all_transforms[{int(np.argmin(finite))}]: Expected finite numbers: {path}", code="H3-HABITAT-029"
        )
    return array


def _resolved(
    episode: dict[Any, Any], index: int, names: dict[Any, str], transforms: NDArray[Any], path: Path
) -> msgspec.Raw:
    """Return the episode with names and matrices in place of their indices."""
    where = f"all_eps[{index}]"
    try:
        content = msgspec.to_builtins(episode, str_keys=True, enc_hook=builtin)
        # the pickle has each name and each matrix once, and episodes refer to them by number
        if "rigid_objs" in content:
            content["rigid_objs"] = [
                [names[name], transforms[_inside(at, len(transforms))].tolist()] for name, at in content["rigid_objs"]
            ]
        if "ao_states" in content:
            content["ao_states"] = {names[int(name)]: states for name, states in content["ao_states"].items()}
        if "name_to_receptacle" in content:
            pairs = content["name_to_receptacle"]
            content["name_to_receptacle"] = {names[name]: names[receptacle] for name, receptacle in pairs}
        if "markers" in content:
            content["markers"] = [
                {"name": names[n], "type": names[t], "params": {"offset": p, "link": names[k], "object": names[o]}}
                for n, t, p, k, o in content["markers"]
            ]
        return msgspec.Raw(_json(content))
    except KeyError as fault:
        raise FormatError(f"{where}: index {fault} is not in idx_to_name: {path}", code="H3-HABITAT-030") from None
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError) as fault:
        raise FormatError(
            f"{where} does not have the layout of a pickled episode ({fault}): {path}", code="H3-HABITAT-031"
        ) from None


def _json(content: Any) -> bytes:
    try:
        return json.dumps(content, allow_nan=False, ensure_ascii=False).encode()  # msgspec would write NaN as null
    except ValueError as fault:
        surrogates = isinstance(fault, UnicodeEncodeError)
        raise ValueError("a text is not Unicode" if surrogates else "a number is NaN or infinity") from None


def _inside(at: Any, size: int) -> int:
    # a negative index would silently count from the end
    if type(at) is not int or not 0 <= at < size:
        raise IndexError(f"there is no transform {at}, all_transforms has {size}")
    return at
