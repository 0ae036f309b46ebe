"""Records of an episode: its agents, its bodies, and their poses at every step.

A `Recording` is self-contained: together with its assets it can be rendered from any camera, measured and continued.
Its form does not depend on the source, be it h3data's simulator, a Habitat file, an MCAP log or a Parquet dataset.

Time-indexed data are plain arrays in `Recording.columns`, time first. Their names and contents are:

====================== ================ ================================================================================
column                 dtype, shape     meaning (frames and units as in `h3data.geometry`)
====================== ================ ================================================================================
``time_ns``            int64 [T]        nanoseconds since the episode began; row k is the state after action k
``object_pose``        float32 [T,N,7]  pose7 in the world of each body with ``moving >= 0``; NaN = absent at that step
``agent_<i>.base_pose``   float32 [T,7] pose7 of the agent's root: at the floor, x forward, y up, z right
``agent_<i>.joint_pos``   float32 [T,J] robot joint positions [rad or m], in the order of ``Agent.joint_names``
``agent_<i>.grasp_body``  int32 [T]     index of the held body, -1 for none
``agent_<i>.motion_id``   int32 [T]     clip that drives a humanoid, an index into ``Agent.motion_names``
``agent_<i>.motion_phase`` float32 [T]  position in the clip, 0..1
``agent_<i>.motion_blend`` float32 [T]  0 = standing pose, 1 = the clip
``agent_<i>.motion_arms`` float32 [T,2] how far the left and right arms are tucked in: 0 = as in the clip, 1 = close to
                                        the body; optional
``agent_<i>.motion_seat`` float32 [T,2] height of a seat above the floor [m] and share of the path from standing to
                                        sitting (1) and lying (2), of people who may sit down; absent: they stand and walk
``agent_<i>.motion_hands`` float32 [T,4,4] targets of the hands and lean of the trunk, of people who may do chores
                                        (`h3data.bodies.people.gestures.lead_hands`); optional
``agent_<i>.root_pose``   float32 [T,7] free-form humanoids only: pelvis in the world
``agent_<i>.joint_quat``  float32 [T,54,4] free-form humanoids only: local rotations without the pelvis, SMPL-X order
``agent_<i>.action``      float32 [T,A] low-level action that led to this row, named in ``Agent.action_names``
``agent_<i>.skill``       int32 [T]     running high-level skill, an index into ``Agent.skill_names``, -1 for none
``scene.joint_pos``       float32 [T,J] positions of the home's doors and drawers [rad or m], in the order of
                                        `h3data.scene.joint_names`; only where there are any
``metrics.<name>``        float32 or bool [T]  per-step scalars, e.g. ``dist_agents``, ``collision``
``metrics.collision_people`` bool [T,P] whether the first robot touches each person; with more than two agents
``input.user_<u>.<name>`` any           values that a program computed from a person's input at a step; not state
``sim.<name>``            any           further state that the simulator needs to continue from a step
``state_hash``            uint64 [T]    running hash of the state stream
====================== ================ ================================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError, suggest
from h3data.plugins import Registry

SCHEMA_VERSION = "1.7"
"""Version of the schema. Additive changes raise the second number; readers refuse a newer first number."""

JOINTS = "scene.joint_pos"
"""Name of the column with the positions of a home's doors and drawers."""

OLDEST_VERSION = (1, 6)
"""Oldest schema version that can be read. Older ones were never published, and used the same columns differently."""

STEP_NS = 33_333_333
"""Nominal step: 30 steps per second, in whole nanoseconds."""


@dataclass(frozen=True, kw_only=True)
class AssetRef:
    """Source of a body's geometry and materials."""

    name: str
    uri: str
    """Location of the asset: ``scene:<asset>`` is in the attached scene; ``primitive:<kind>`` is generated; anything
    else is a file path as recorded, to be found below the user's asset roots."""
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Axis of the file that points up."""
    front: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Axis of the file that points forward."""
    units_m: float = 1.0
    """Metres per unit of the file."""
    color: tuple[int, int, int] | None = None
    """Colour (sRGB) that replaces that of the material, if the recording has one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """Rigid body: furniture, an object, or a link of an agent without a model."""

    name: str
    asset: str
    pose: NDArray[np.float32]
    """Pose (pose7) in the world, shape [7]; for moving bodies, the first pose."""
    scale: NDArray[np.float32] = field(default_factory=lambda: np.ones(3, np.float32))
    semantic_id: int = 0
    moving: int = -1
    """Index along axis 1 of ``object_pose``; -1 = static."""
    layer: str = ""
    """Layer of the body, with the meaning of `h3data.scene.Instance.layer`."""
    agent: int = -1
    """Index of the agent that this body is part of; -1 = none."""


@dataclass(frozen=True, kw_only=True)
class Agent:
    """Agent of an episode: a robot or a person."""

    name: str
    kind: Literal["robot", "human"]
    model: str = ""
    """Model of the agent's appearance, such as ``humanoid/female_0`` or ``robot/quad_arm``; if empty, its `Body`
    records define it."""
    semantic_id: int = 0
    joint_names: tuple[str, ...] = ()
    motion_names: tuple[str, ...] = ()
    action_names: tuple[str, ...] = ()
    skill_names: tuple[str, ...] = ()


def agent_numbers(agents: Iterable[Any], kind: Literal["robot", "human"]) -> list[int]:
    """Return the numbers of all agents of a kind, of the agents of a recording or of a roster."""
    return [k for k, agent in enumerate(agents) if agent.kind == kind]


@dataclass(frozen=True, kw_only=True)
class Event:
    """Event at one step: a collision, a pick, a user's click."""

    step: int
    agent: int
    """Index of the agent that caused the event; -1 = none."""
    kind: str
    target: str = ""
    detail: str = ""


@dataclass(frozen=True, kw_only=True)
class SkillSpan:
    """High-level action of an agent from its first to its last step (inclusive)."""

    agent: int
    name: str
    target: str = ""
    start_step: int
    end_step: int
    outcome: Literal["done", "failed", "aborted", "running"] = "done"
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class InputEvent:
    """Raw message of a person's input device: a key, the mouse, an XR controller, a line of text."""

    time_ns: int
    """Time of arrival [ns since the episode began], on the clock of the column ``time_ns``; usually between two rows,
    negative before the episode. Input that arrives after row k-1 and not after row k can affect row k."""
    kind: str
    """Kind of input: ``key_down``, ``key_up``, ``mouse_move``, ``mouse_down``, ``mouse_up``, ``mouse_wheel``, ``xr``,
    ``text``, or any other word."""
    user: int = 0
    """Index of the person; ``episode.info`` or the task defines which agent the person controls."""
    payload: str = ""
    """Details as JSON text, such as ``{"key": "w"}``, stored unchanged; empty = none."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """Identity and provenance of an episode: its task, scene, seed and the program that recorded it."""

    uid: str
    """Globally unique identifier, a uuid."""
    episode_id: str
    """Name of the episode within its dataset."""
    task: str
    """Task, such as ``social_nav`` or ``gfx_replay``."""
    scene: str
    seed: int = 0
    dt_ns: int = STEP_NS
    created_by: str = ""
    """Program and version that recorded the episode."""
    schema_version: str = SCHEMA_VERSION
    info: Mapping[str, Any] = field(default_factory=dict)
    """Further information as JSON values: task parameters, start poses, waypoints, provenance, import warnings."""

    @property
    def is_lerobot_export(self) -> bool:
        """Return whether the episode was exported to LeRobot, which omits the last row and the simulator's columns."""
        return "lerobot" in self.info


class Columns(dict[str, NDArray[Any]]):
    """Columns by name. The `KeyError` of an unknown one suggests a known one."""

    def __missing__(self, name: object) -> NDArray[Any]:
        raise UnknownColumnError(
            f"No column {name!r} in this recording.{suggest(str(name), self, lead='It has')}", code="H3-RECORDING-106"
        )


class UnknownColumnError(InputError, KeyError):
    """Error about a column that a recording does not have."""

    __str__ = Exception.__str__  # a KeyError would quote the sentence


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Recording of one episode, immutable by convention; `h3data.open` reads one from a file."""

    episode: Episode
    assets: tuple[AssetRef, ...] = ()
    bodies: tuple[Body, ...] = ()
    agents: tuple[Agent, ...] = ()
    columns: Mapping[str, NDArray[Any]]
    skills: tuple[SkillSpan, ...] = ()
    events: tuple[Event, ...] = ()
    inputs: tuple[InputEvent, ...] = ()
    """Raw input of the participants, in order of arrival."""
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    """Files that travel with the recording, e.g. ``scene.glb``."""

    def __post_init__(self) -> None:
        faults = self._faults()
        if faults:
            raise FormatError(
                f"Recording {self.episode.episode_id!r} is not consistent: " + "; ".join(faults[:8]) + ".",
                code="H3-RECORDING-107",
            )
        # only a plain dict: `dataclasses.replace` hands over `Columns`, which need no second copy
        if type(self.columns) is dict:
            object.__setattr__(self, "columns", Columns(self.columns))
        _keep_walks(self.attachments)

    def __len__(self) -> int:
        return len(self.columns["time_ns"])

    @property
    def duration_s(self) -> float:
        """Time from the first to the last step [s]."""
        times = self.columns["time_ns"]
        return float(times[-1] - times[0]) * 1e-9 if len(times) else 0.0

    @property
    def moving_bodies(self) -> tuple[Body, ...]:
        """Bodies that move, in the order of axis 1 of ``object_pose``."""
        return tuple(sorted((b for b in self.bodies if b.moving >= 0), key=lambda b: b.moving))

    def agent_column(self, agent: int, name: str) -> NDArray[Any]:
        """Return column ``agent_<agent>.<name>``; raise an `UnknownColumnError` (a `KeyError`) if there is none."""
        return self.columns[f"agent_{agent}.{name}"]

    def show(self, viewer: Literal["rerun", "video"] | None = None, **options: Any) -> Any:
        """Return a Rerun viewer or a video of the recording for display in a notebook (`h3data_viewers.notebook.show`)."""
        return notebook().show(self, viewer, **options)

    def _repr_html_(self) -> str:
        return notebook().recording_html(self)

    def __repr__(self) -> str:
        e = self.episode
        inputs = f"   inputs {len(self.inputs)}" if self.inputs else ""
        agents = ", ".join(f"{a.name} ({a.kind}{', ' + a.model if a.model else ''})" for a in self.agents)
        lines = [
            f"Recording {e.episode_id!r}: task {e.task}, scene {e.scene!r}, {len(self)} steps, {self.duration_s:.1f} s",
            f"  agents   {agents or 'none'}",
            f"  bodies   {len(self.bodies)} ({len(self.moving_bodies)} moving), {len(self.assets)} assets",
            f"  skills   {len(self.skills)}   events {len(self.events)}{inputs}   attachments {list(self.attachments)}",
        ]
        lines += [f"  {name:<24} {array.dtype!s:<8} {list(array.shape)}" for name, array in self.columns.items()]
        return "\n".join(lines)

    def _faults(self) -> list[str]:
        faults = []
        columns = self.columns
        if "time_ns" not in columns:
            return ["there is no column time_ns"]
        steps = len(columns["time_ns"])
        faults += [
            f"column {name} has {len(array)} rows, time_ns has {steps}"
            for name, array in columns.items()
            if len(array) != steps
        ]
        if columns["time_ns"].dtype != np.int64:
            faults.append(f"time_ns must be int64, is {columns['time_ns'].dtype}")
        # compared and not subtracted, because differences of int64 may overflow
        elif (columns["time_ns"][1:] <= columns["time_ns"][:-1]).any():
            faults.append("time_ns does not increase strictly")
        # tracks are found by their index, so each one needs exactly one body
        moving = sorted(b.moving for b in self.bodies if b.moving >= 0)
        # a recording without moving bodies may leave the column out
        width = columns["object_pose"].shape[1] if "object_pose" in columns else 0
        if moving != list(range(width)):
            faults.append(f"{len(moving)} bodies claim tracks, object_pose holds {width}")
        unknown = sorted({b.asset for b in self.bodies} - {a.name for a in self.assets})
        if unknown:
            faults.append(f"bodies use unknown assets {unknown[:3]}")
        for i in range(len(self.agents)):
            if f"agent_{i}.base_pose" not in columns:
                faults.append(f"agent {i} ({self.agents[i].name}) has no column agent_{i}.base_pose")
        return faults


@cache
def notebook() -> Any:
    """Return the module that displays records in notebooks, which the package of viewers registers."""
    displays: Registry[Any] = Registry("h3data.notebooks", {}, what="display of records")
    return displays.get("notebook")


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordingHeader:
    """Description of an episode that is known before its first step, for `RecordingWriter`."""

    episode: Episode
    assets: tuple[AssetRef, ...] = ()
    bodies: tuple[Body, ...] = ()
    agents: tuple[Agent, ...] = ()
    columns: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Arrays whose dtypes and trailing shapes fix the columns (their rows are ignored); if empty, the first rows
    determine the columns."""
    attachments: Mapping[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _keep_walks(self.attachments)


def _keep_walks(attachments: Mapping[str, bytes]) -> None:
    """Make the imported walks of people known, which their models name."""
    if any(name != "scene.glb" for name in attachments):  # importing bodies takes a while
        from h3data.bodies.names import keep_walks

        keep_walks(attachments)
