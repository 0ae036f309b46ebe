"""Parts that all tasks need to simulate a recording again.

The parts are the first difference between two runs, the scene and map of a recording, and the header of a recording
that is made from another one.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.plugins import own_version
from h3data.recording import SCHEMA_VERSION, Recording, RecordingHeader, state_hash
from h3data.scene import FreeSpace, Scene, load_scene

Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, kw_only=True)
class Difference:
    """First place at which a recording and its simulation differ."""

    step: int
    column: str
    recorded: str
    simulated: str

    def __str__(self) -> str:
        return f"step {self.step}, {self.column}: recorded {self.recorded}, simulated {self.simulated}"


@dataclass(frozen=True, kw_only=True)
class Verification:
    """Result of `sim_kinematic.tasks.resume.verify`."""

    steps: int
    """Number of steps that agree: all of them, or those before the first difference."""
    difference: Difference | None

    @property
    def equal(self) -> bool:
        """Return whether every stored value was reproduced, bit for bit."""
        return self.difference is None


def compared(recording: Recording, simulated: Columns, ended: str) -> Verification:
    """Return the comparison of a recording with its simulation, which ended for the reason ``ended``."""
    steps = len(recording)
    found = first_difference(recording.columns, simulated)
    done = len(simulated["time_ns"])
    if found is None and done < steps:
        found = Difference(step=done, column="time_ns", recorded="goes on", simulated=f"ended by {ended}")
    return Verification(steps=steps if found is None else found.step, difference=found)


def require_recorded(
    recording: Recording, step: int, simulated: Columns, ended: str, names: list[str] | None = None
) -> None:
    """Check that the first ``step`` steps were reproduced, in the columns ``names`` (default: all simulated ones).

    Raises:
        InputError: The steps differ, so the recording cannot be continued.
    """
    done = len(simulated["time_ns"])
    if done < step:
        raise InputError(
            f"The steps before {step} do not come out again: simulated, it ended at {done} ({ended}).",
            code="H3-TASK-033",
        )
    kept = {name: array[:step] for name, array in recording.columns.items()}
    found = first_difference(kept, simulated, names)
    if found is not None:
        raise InputError(
            f"The recorded steps do not come out again, so nothing can follow them: {found}.", code="H3-TASK-034"
        )


def require_step(recording: Recording, step: int) -> None:
    """Check that a recording has a step of this number.

    Raises:
        InputError: The recording has fewer steps, or ``step`` is negative.
    """
    if not 0 <= step <= len(recording):
        raise InputError(
            f"Expected a step from 0 to {len(recording)}, the number of recorded steps, got {step}.", code="H3-TASK-035"
        )


def require(recording: Recording, *, info: Iterable[str] = (), columns: Iterable[str] = ()) -> None:
    """Check that a recording holds everything needed to simulate it again.

    Raises:
        InputError: The recording lacks entries of its info, columns or its scene; the message names them.
    """
    lacks = [name for name in info if name not in recording.episode.info]
    lacks += ["scene.glb"] if "scene.glb" not in recording.attachments else []
    lacks += [name for name in columns if name not in recording.columns]
    if lacks:
        raise InputError(f"The recording cannot be simulated again, it lacks: {', '.join(lacks)}.", code="H3-TASK-023")


def first_difference(recorded: Columns, simulated: Columns, names: Iterable[str] | None = None) -> Difference | None:
    """Return the first step at which columns differ in any bit, in the rows that both have; None if there is none.

    ``names`` are by default all simulated columns. A column that is missing in the recording differs from step 0 on,
    unless recordings of earlier versions do not have it. Columns that the simulator does not produce are checked only
    by the hash.
    """
    rows = min(len(recorded["time_ns"]), len(simulated["time_ns"]))
    first: Difference | None = None
    # columns of measurements that recordings of earlier versions lack
    added = ("metrics.collision_people", "metrics.collision_robots")
    for name in simulated if names is None else names:
        ours = simulated[name][:rows]
        if name not in recorded and name in added:
            continue
        if name not in recorded:
            return Difference(step=0, column=name, recorded="no such column", simulated=_text(ours[:1]))
        theirs = np.asarray(recorded[name])[:rows]
        if name == "state_hash":
            # not the hash of the simulation: columns that the simulator does not make are part of the recorded one
            ours = state_hash({n: np.asarray(a)[:rows] for n, a in recorded.items()})
        if theirs.dtype != ours.dtype or theirs.shape != ours.shape:
            kinds = (f"{a.dtype} {list(a.shape[1:])}" for a in (theirs, ours))
            return Difference(step=0, column=name, recorded=next(kinds), simulated=next(kinds))
        # by bits, so that NaN equals NaN, and 0.0 does not equal -0.0
        differ = np.flatnonzero(_bits(theirs) != _bits(ours)) if theirs.size else np.zeros(0, int)
        # elements of a row follow each other, so the index over the width is the row
        step = int(differ[0]) // (theirs.size // rows) if len(differ) else rows
        if step < (rows if first is None else first.step):
            first = Difference(step=step, column=name, recorded=_text(theirs[step]), simulated=_text(ours[step]))
    return first


def _bits(array: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(array).view(f"u{array.dtype.itemsize}").ravel()


def _text(values: NDArray[Any]) -> str:
    # all digits, as numbers may differ in the last bit alone
    return np.array2string(np.asarray(values), max_line_width=10_000, threshold=12, floatmode="unique")


@lru_cache(maxsize=4)
def scene_and_map(file: bytes, radius_m: float, height_m: float) -> tuple[Scene, FreeSpace]:
    """Return the scene and free floor from a scene file, which all recordings in one home share."""
    scene = load_scene(file)
    return scene, FreeSpace.from_scene(scene, radius_m=radius_m, height_m=height_m)


def is_counterfactual(recording: Recording) -> bool:
    """Return whether the people in a recording follow recorded tracks and do not react."""
    # recordings of people who react have no such entry
    return recording.episode.info.get("human_reactive") is False


def origin(recording: Recording, step: int) -> dict[str, Any]:
    """Return entries of info about the recording from which another recording is made."""
    return {"uid": recording.episode.uid, "step": step, "policy": recording.episode.info.get("policy")}


def header_from(recording: Recording, what: str) -> RecordingHeader:
    """Return the header of a new episode with the bodies, agents and files of another one; its uid is a digest of ``what``."""
    old = recording.episode
    # entries of ``info`` on the origin of a recording, which do not hold for one made from it
    episode = replace(
        old,
        uid=str(uuid.uuid5(uuid.NAMESPACE_URL, f"{old.uid}:{what}")),
        # this version writes the new recording, whichever wrote the old one
        schema_version=SCHEMA_VERSION,
        created_by=f"h3data {own_version()}",
        info={
            k: v
            for k, v in old.info.items()
            if k not in ("job", "recovered", "resumed_from", "counterfactual", "human_reactive", "deciding_since")
        },
    )
    return RecordingHeader(
        episode=episode,
        assets=recording.assets,
        bodies=recording.bodies,
        agents=recording.agents,
        attachments=recording.attachments,
    )
