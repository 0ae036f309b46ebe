"""Adapter of a policy server: the keys of its observations and the meanings of its answers, for a robot and a model."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.render.light.sources import LightMode
from h3data_remote.wire import PolicyServerError
from sim_kinematic.contact.frames import Body
from sim_kinematic.sensing.agent_pictures import DETECTORS, AgentPictures, picture_names

FOLDER = Path(__file__).parent / "adapters"
Pixels = Annotated[int, msgspec.Meta(ge=1, le=4096)]
Seconds = Annotated[float, msgspec.Meta(gt=0, le=3600)]


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Entry of an observation that is sent to a policy server."""

    sensor: str | Annotated[list[str], msgspec.Meta(min_length=1)]
    """Name of an observation (h3data docs environments); several are concatenated."""
    size: tuple[Pixels, Pixels] | None = None
    """Width and height of a picture [px]; None for those of the camera."""
    pad: bool = False
    """True if a picture keeps its aspect ratio between black bars instead of being stretched."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the observations in the entry."""
        return (self.sensor,) if isinstance(self.sensor, str) else tuple(self.sensor)


class Adapter(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Format of a policy server's requests and answers."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_.-]{1,40}$")] = "adapter"
    """Name of the policy in recordings, for servers that state none."""
    observation: dict[str, Entry] = {}
    """Observations by key. In GR00T's protocol, keys such as ``video.arm`` consist of a group and an entry."""
    light: LightMode = "flat"
    """Light in colour pictures: ``baked`` is light from windows, sun and lamps, ``flat`` is the same everywhere."""
    prompt: str = ""
    """Key of the instruction in words; if it is empty, no instruction is sent."""
    session: bool = False
    """True if requests also contain the episode's seed, the step, whether it is the first, and a name of the episode's
    run, as ``h3data/seed``, ``h3data/step``, ``h3data/reset`` and ``h3data/session``."""
    actions: str | Annotated[list[str], msgspec.Meta(min_length=1)] = "actions"
    """Key of the action chunk in an answer; the columns of several keys are concatenated."""
    columns: list[Annotated[int, msgspec.Meta(ge=0)]] = []
    """Indices of the columns of a chunk that are the robot's, in order; empty for all."""
    action: Literal["base", "control"] = "base"
    """Kind of action. ``base`` has forward velocity and turn, in -1..1 of the limits. ``control``, in tasks with
    objects, also has a number in -1..1 for each arm joint and one for the grip."""
    hold: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 1
    """Number of actions of a chunk that are carried out before the next request, one per step of 1/30 s."""
    timeout_s: Seconds = 30.0
    first_timeout_s: Seconds = 300.0
    """Timeout of the first answer of a server, which may have to compile its model [s]."""
    deadline_s: Annotated[float, msgspec.Meta(ge=0, le=60)] = 0.5
    """Time in live play for which the last action continues while an answer is late [s]; then the robot stops."""


DEFAULTS: Mapping[str, str] = {"ws": "h3data", "wss": "h3data", "zmq": "gr00t"}
"""Name of the default adapter by the scheme of an address, for servers that state no adapter."""


def built_in_adapters() -> tuple[str, ...]:
    """Return the names of the adapters that are included in the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def read_adapter(name: str) -> Adapter:
    """Read the adapter with a name or from a TOML file.

    Raises:
        InputError: the adapter does not exist or is malformed; the message names the field.
    """
    file = FOLDER / f"{name}.toml" if name in built_in_adapters() else Path(name)
    try:
        data = tomllib.loads(file.read_text("utf-8"))
    except OSError:
        raise InputError(
            f"There is no adapter {name!r}. Expected a TOML file or one of: {', '.join(built_in_adapters())}.",
            code="H3-REMOTE-006",
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise InputError(f"The adapter {name} is no TOML file: {fault}", code="H3-REMOTE-007") from None
    return adapter_of({"name": file.stem, **data}, f"The adapter {name}")


def adapter_of(table: Any, what: str) -> Adapter:
    """Return the adapter that a parsed TOML table describes.

    Raises:
        InputError: the table is malformed; the message starts with ``what``.
    """
    try:
        return msgspec.convert(table, Adapter)
    except msgspec.ValidationError as fault:
        raise InputError(f"{what} is malformed: {str(fault).replace('`', '')}", code="H3-REMOTE-008") from None


class Observer:
    """Source of the observations of a robot that an adapter requests."""

    def __init__(self, adapter: Adapter, body: Body, *, batched: bool) -> None:
        """Look up cameras and sizes.

        Args:
            adapter: Adapter that lists the observations to send.
            body: Body of the robot.
            batched: True if the first axes of arrays are for worlds and time, as in GR00T.

        Raises:
            InputError: a picture is requested in two sizes, or concatenated with others.
        """
        self._entries, self._light, self._batched = adapter.observation, adapter.light, batched
        pictures = picture_names(body)
        self._padded: dict[str, tuple[int, int]] = {}
        self.sizes: dict[str, tuple[int, int]] = {}
        """Width and height at which pictures are rendered, by name."""
        self.names = tuple(dict.fromkeys(name for entry in self._entries.values() for name in entry.names))
        for key, entry in self._entries.items():
            drawn = [name for name in entry.names if name in pictures]
            if drawn and len(entry.names) > 1:
                raise InputError(
                    f"The adapter {adapter.name} joins the picture {drawn[0]} with others in {key!r}.",
                    code="H3-REMOTE-010",
                )
            if not drawn or entry.size is None:
                continue
            size = _fitting(body, drawn[0], entry.size) if entry.pad else entry.size
            if self.sizes.setdefault(drawn[0], size) != size:
                raise InputError(f"The adapter {adapter.name} shows {drawn[0]} in two sizes.", code="H3-REMOTE-011")
            if entry.pad:
                self._padded[key] = entry.size

    def observation(self, view: Any) -> dict[str, Any]:
        """Return the observation for a view of `sim_kinematic.policies.views`, by key.

        Raises:
            InputError: the robot has no such observation.
        """
        if not self.names:
            return {}
        if getattr(view, "observe", None) is None:
            raise InputError(
                "This task's views show nothing by name (observe), which a policy server needs.", code="H3-REMOTE-009"
            )
        shown = view.observe(self.names, self.sizes, self._light)
        return {key: self._entry(key, [shown[name] for name in entry.names]) for key, entry in self._entries.items()}

    def _entry(self, key: str, parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        values = parts[0] if len(parts) == 1 else np.concatenate([part.ravel() for part in parts])
        if key in self._padded:
            values = padded(values, self._padded[key])
        return values[None, None] if self._batched else values


def _fitting(body: Body, name: str, size: tuple[int, int]) -> tuple[int, int]:
    """Return the largest size within ``size`` that has the proportions of the camera."""
    if name in DETECTORS and name == "humanoid_detector":
        return size
    height, width = AgentPictures(body, (name,), agent=0).limits(name).shape[:2]
    scale = min(size[0] / width, size[1] / height)
    return max(round(width * scale), 1), max(round(height * scale), 1)


def padded(picture: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """Return a picture [h, w, n] in the middle of a black picture of ``size`` (width, height) [px], shape [H, W, n]."""
    height, width = picture.shape[:2]
    out = np.zeros((size[1], size[0], *picture.shape[2:]), picture.dtype)
    top, left = (size[1] - height) // 2, (size[0] - width) // 2
    out[top : top + height, left : left + width] = picture
    return out


def nested(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return entries named ``group.name`` as dictionaries within a dictionary."""
    found: dict[str, Any] = {}
    for key, value in entries.items():
        group, dot, name = key.partition(".")
        if dot:
            found.setdefault(group, {})[name] = value
        else:
            found[key] = value
    return found


def chunk_of(
    answer: Mapping[str, Any], adapter: Adapter, width: int, server: str, *, batched: bool
) -> NDArray[np.float32]:
    """Return the actions of an answer that are carried out, shape [hold, width], in -1..1.

    Args:
        answer: Answer of the server.
        adapter: Adapter that describes the answer.
        width: Number of values of one action.
        server: Address of the server, for error messages.
        batched: True if the first axis of an answer is for worlds.

    Raises:
        PolicyServerError: the answer has no actions, or they have another shape or are not finite.
    """
    keys = [adapter.actions] if isinstance(adapter.actions, str) else adapter.actions
    parts = [_part(answer, key, server, batched=batched) for key in keys]
    if len({len(part) for part in parts}) > 1:
        raise PolicyServerError(
            f"The policy server at {server} gives chunks of different lengths for {', '.join(keys)}.",
            code="H3-REMOTE-001",
        )
    chunk = np.concatenate(parts, axis=1)
    if adapter.columns and max(adapter.columns) < chunk.shape[1]:
        chunk = chunk[:, adapter.columns]
    if chunk.shape[1] != width or len(chunk) < adapter.hold:
        raise PolicyServerError(
            f"Expected at least {adapter.hold} actions of {width} numbers in {', '.join(keys)} from the policy server at "
            f"{server}, got shape {list(chunk.shape)}. Hint: actions, columns and hold of the adapter say which are meant.",
            code="H3-REMOTE-002",
        )
    chunk = chunk[: adapter.hold]
    if not np.isfinite(chunk).all():
        raise PolicyServerError(
            f"The policy server at {server} answers with numbers that are not finite in {', '.join(keys)}.",
            code="H3-REMOTE-003",
        )
    return np.clip(chunk, -1.0, 1.0).astype(np.float32)


def _part(answer: Mapping[str, Any], key: str, server: str, *, batched: bool) -> NDArray[np.float64]:
    if key not in answer:
        there = ", ".join(map(str, list(answer)[:10])) or "nothing"
        raise PolicyServerError(
            f"Expected {key!r} in the answer of the policy server at {server}, got: {there}.", code="H3-REMOTE-004"
        )
    try:
        values = np.asarray(answer[key], np.float64)
    except (TypeError, ValueError):
        values = np.zeros(())
    # GR00T answers [B, H, D]; elsewhere a single action [D] is a chunk of one
    values = values[0] if batched and values.ndim == 3 and len(values) else values
    values = values[None] if values.ndim == 1 and not batched else values
    if values.ndim != 2:
        raise PolicyServerError(
            f"Expected actions [H, D] in {key!r} from the policy server at {server}, got shape {list(values.shape)}.",
            code="H3-REMOTE-005",
        )
    return values
