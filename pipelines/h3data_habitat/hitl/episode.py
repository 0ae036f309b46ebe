"""Code for both generations of HITL logs: objects, metrics, and the assembly of a recording."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError
from h3data.formats import FORMATS, json_format
from h3data.formats.builtin_formats import JSON
from h3data.formats.source_file import decode_json
from h3data.geometry import quat_sign_continuous
from h3data.recording.assets.handles import HANDLE
from h3data.recording.records import AssetRef, Body, Episode, Event, Recording
from h3data_habitat.hitl.agents import AgentKind, AgentTrack, JointOrder, add_agents, agent_kinds, root_height_m
from h3data_habitat.hitl.scenes import Place
from h3data_habitat.json_files import not_json
from h3data_habitat.limits import check_size

Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Vec3 = tuple[Number, Number, Number]
Quat = tuple[Number, Number, Number, Number]
Id = Annotated[int, msgspec.Meta(ge=-(2**62), le=2**62)]

MAX_METRICS = 256
MAX_FLOAT = 3e38
"""Largest value of a float32."""

T = TypeVar("T")
Scalar = TypeVar("Scalar", bound=np.number[Any])


def decoded(data: bytes, kind: type[T], path: Path, *, expected: str) -> T:
    """Return the JSON document as ``kind``; a `FormatError` states where it differs from the format ``expected``."""
    try:
        return decode_json(data, kind)
    except msgspec.ValidationError as fault:
        title = FORMATS.get(expected).title
        try:
            other = json_format(decode_json(data), name=path.name)
        except msgspec.DecodeError:  # such as a number that msgspec takes for text only
            other = JSON
        if other is not JSON and other.name != expected:
            raise FormatError(f"Expected {title}, this is {other.title}: {path}", code="H3-HABITAT-070") from None
        raise FormatError(f"Not {title}: {fault}: {path}", code="H3-HABITAT-069") from None
    except msgspec.DecodeError as fault:
        raise not_json(path, data, fault) from None


@dataclass(eq=False)
class PoseTracks:
    """Poses of many things by name, which are collected step by step and then converted to arrays."""

    steps: int
    names: list[str] = field(default_factory=list)
    _rows: dict[str, list[int]] = field(default_factory=dict)
    _poses: dict[str, list[tuple[float, ...]]] = field(default_factory=dict)

    def add(self, name: str, step: int, position: Vec3, rotation: Quat) -> None:
        """Add one pose7; a later one of the same step replaces an earlier one."""
        if name not in self._rows:
            self.names.append(name)
            self._rows[name], self._poses[name] = [], []
        self._rows[name].append(step)
        self._poses[name].append((*position, *rotation))

    def arrays(self, path: Path) -> list[NDArray[np.float64]]:
        """Return poses (pose7) [T, 7] by name, NaN where there is none; quaternions as logged, scaled to unit length."""
        check_size(self.steps, len(self.names), path)
        out = []
        for name in self.names:
            track = np.full((self.steps, 7), np.nan)
            # of equal rows NumPy keeps the last, as `add` says
            track[self._rows[name]] = self._poses[name]
            out.append(unit_rotations(track, name, path))
        return out


def unit_rotations(track: NDArray[np.float64], name: str, path: Path) -> NDArray[np.float64]:
    """Return the track [T, 7] with unit quaternions (logs are rounded); a quaternion of length 0 is a `FormatError`."""
    length = np.linalg.norm(track[:, 3:], axis=1)
    bad = np.flatnonzero(length < 1e-3)
    if len(bad):
        raise FormatError(
            f"The rotation of {name!r} at step {bad[0]} is not a quaternion (length 0): {path}", code="H3-HABITAT-068"
        )
    track[:, 3:] /= length[:, None]
    return track


def held(track: NDArray[Scalar], known: NDArray[np.bool_]) -> NDArray[Scalar]:
    """Extend a track to all steps [T, ...], with the row of the latest ``known`` step [T].

    Steps before the first known step have the row of that step.
    """
    if not known.any():
        return track
    # running maximum of the known steps: the latest one at or before each
    latest = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    return track[np.where(latest >= 0, latest, int(np.argmax(known)))]


def object_bodies(
    names: Sequence[str], tracks: Sequence[NDArray[np.float64]]
) -> tuple[list[AssetRef], list[Body], dict[str, NDArray[Any]]]:
    """Return the assets, bodies and the column ``object_pose`` of the objects that a task moves.

    A handle ``can_:0000`` is an instance of the template ``can``, which is searched under that name; names without a
    number come from logs that have ids only.
    """
    assets: dict[str, AssetRef] = {}
    bodies = []
    for k, (name, track) in enumerate(zip(names, tracks, strict=True)):
        stem = template_of(name)
        uri = f"{HANDLE}{stem}" if "_:" in name else f"rearranged_objects/{stem}.glb"
        assets.setdefault(stem, AssetRef(name=stem, uri=uri))
        known = np.isfinite(track).all(1)
        # the first known pose, as bodies have one also before they appear
        first = track[int(np.argmax(known))] if known.any() else np.array([0, 0, 0, 0, 0, 0, 1.0])
        track[known, 3:] = quat_sign_continuous(track[known, 3:])
        bodies.append(Body(name=name, asset=stem, pose=first.astype(np.float32), moving=k, layer="object"))
    columns = {"object_pose": np.stack(tracks, axis=1).astype(np.float32)} if tracks else {}
    return list(assets.values()), bodies, columns


def scalar_columns(rows: Sequence[Mapping[str, Any] | None], prefix: str) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Return the columns ``<prefix><name>`` of the numbers in dicts, one dict per step, and warnings.

    Nested names are joined by dots. float32 with NaN where a step lacks it; bool if every step has True or False.
    """
    values: dict[str, dict[int, bool | float]] = {}
    cut = False
    for step, row in enumerate(rows):
        for name, value in _leaves(row or {}, "", 0):
            # the names come from the file: a log of random keys must not fill the memory
            if name in values or len(values) < MAX_METRICS:
                values.setdefault(name, {})[step] = value
            else:
                cut = True
    columns: dict[str, NDArray[Any]] = {}
    for name, by_step in values.items():
        if len(by_step) == len(rows) and all(isinstance(v, bool) for v in by_step.values()):
            columns[prefix + name] = np.array(list(by_step.values()), np.bool_)
        else:
            column = np.full(len(rows), np.nan, np.float32)
            column[list(by_step)] = list(by_step.values())
            columns[prefix + name] = column
    return columns, [f"only the first {MAX_METRICS} names of {prefix}* were read"] if cut else []


def _leaves(row: Mapping[str, Any], at: str, depth: int) -> Iterable[tuple[str, bool | float]]:
    for name, value in row.items():
        if isinstance(value, bool):
            yield at + name, value
        elif isinstance(value, (int, float)):
            yield at + name, max(-MAX_FLOAT, min(MAX_FLOAT, value))
        elif isinstance(value, dict) and depth < 8:
            yield from _leaves(value, f"{at}{name}.", depth + 1)


@dataclass(kw_only=True, eq=False)
class HitlEpisode:
    """Parts of a HITL log in h3data's terms, which `recording` assembles to a recording."""

    path: Path
    data: bytes
    form: str
    """Format of the file, ``hitl_log`` or ``hitl_episode``."""
    episode_id: str
    created_by: str
    dt_ns: int
    time_ns: NDArray[np.int64]
    tracks: list[AgentTrack]
    object_names: list[str]
    object_tracks: list[NDArray[np.float64]]
    object_of_id: Mapping[int, str]
    robot: str
    joint_order: JointOrder | None = None
    columns: dict[str, NDArray[Any]] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    info: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def kinds(self) -> list[AgentKind]:
        """Return the kind of each agent, in their order."""
        return agent_kinds(self.tracks)

    def floor_y(self) -> float:
        """Return the height on which the agents stand most of the time [m]; 0 without agents."""
        heights = [t.roots[:, 1] - root_height_m(k, self.robot) for t, k in zip(self.tracks, self.kinds(), strict=True)]
        known = np.concatenate([h[np.isfinite(h)] for h in heights]) if heights else np.zeros(0)
        return float(np.median(known)) if len(known) else 0.0

    def recording(self, place: Place) -> Recording:
        """Return the episode as a recording in ``place``."""
        check_size(len(self.time_ns), len(self.tracks), self.path)
        kinds = self.kinds()
        agents, columns, notes = add_agents(
            self.tracks, kinds, self.time_ns, robot=self.robot, joint_order=self.joint_order
        )
        assets, bodies, object_columns = object_bodies(self.object_names, self.object_tracks)
        index = {body.name: k for k, body in enumerate(bodies)}
        for i, track in enumerate(self.tracks):
            columns[f"agent_{i}.grasp_body"] = self._grasped(track, index)
            columns[f"agent_{i}.grasp_id"] = track.grasp_id
        # objects of the log keep their names, by which its events know them
        taken = {ref.name for ref in assets}
        renamed = {ref.name: f"scene/{ref.name}" if ref.name in taken else ref.name for ref in place.assets}
        digest = hashlib.sha256(self.data).hexdigest()
        return Recording(
            episode=Episode(
                uid=str(uuid.uuid5(uuid.NAMESPACE_URL, f"{self.form}:{digest}")),
                episode_id=self.episode_id or self.path.name,
                task="hitl_rearrange",
                scene=place.name,
                dt_ns=self.dt_ns,
                created_by=self.created_by,
                info={
                    "source": {"format": self.form, "file": self.path.name, "sha256": digest},
                    "agents": notes,
                    "synthesised": {n["name"]: n["synthesised"] for n in notes},
                    "object_ids": {name: number for number, name in self.object_of_id.items()},
                    **self.info,
                    "warnings": [*self.warnings, *place.warnings],
                },
            ),
            assets=(*assets, *(replace(r, name=renamed[r.name]) for r in place.assets)),
            bodies=(*bodies, *(self._housed(b, renamed, index) for b in place.bodies)),
            agents=tuple(agents),
            columns={"time_ns": self.time_ns, **object_columns, **columns, **self.columns},
            events=tuple(self.events),
            attachments=place.attachments,
        )

    def _grasped(self, track: AgentTrack, index: Mapping[str, int]) -> NDArray[np.int32]:
        out = np.full(len(track.grasp_id), -1, np.int32)
        for identity in np.unique(track.grasp_id[track.grasp_id >= 0]):
            out[track.grasp_id == identity] = index.get(self.object_of_id.get(int(identity), ""), -1)
        return out

    @staticmethod
    def _housed(body: Body, renamed: Mapping[str, str], index: Mapping[str, int]) -> Body:
        """Return a body of the place, renamed if an object has its name."""
        return replace(body, name=f"scene/{body.name}" if body.name in index else body.name, asset=renamed[body.asset])


def template_of(handle: str) -> str:
    """Return the template's name in a handle: without the number of the instance and without folders."""
    return handle.split("_:")[0].rsplit("/", 1)[-1] or "object"
