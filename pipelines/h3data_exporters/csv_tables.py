"""Export of recordings as CSV tables for spreadsheets and R, and as NumPy arrays."""

from __future__ import annotations

import csv
import json
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np

from h3data.files import part_file, size_text, spreadsheet_cell
from h3data.formats import Exported, ExportRequest
from h3data.recording.records import JOINTS, Agent, Recording
from h3data.recording.schema import episode_to_dict
from h3data.scene import joint_names, load_scene

FILES = (
    "steps.csv",
    "object_pose.csv",
    "bodies.csv",
    "agents.csv",
    "skills.csv",
    "events.csv",
    "inputs.csv",
    "columns.npz",
    "recording.json",
)
"""Names of the files that `write_csv_tables` writes."""

_POSE7 = ("x", "y", "z", "qx", "qy", "qz", "qw")


def write_csv_tables(recording: Recording, folder: str | Path) -> list[Path]:
    """Write `FILES` into an existing folder and return their paths.

    - ``steps.csv``: a row per step; every column of the recording with at most 64 numbers, one CSV column each, named
      by joints and actions where these are known (``agent_0.joint_pos.<joint>``).
    - ``object_pose.csv``: a row per step and moving body that was there.
    - ``bodies.csv``, ``agents.csv``, ``skills.csv``, ``events.csv``, ``inputs.csv``: the records.
    - ``columns.npz``: every column exactly, under its own name; ``recording.json``: the episode and the names.

    Numbers in CSV have all digits, so that float32 values can be read back bit for bit. NaN is an empty field.
    """
    folder = Path(folder)
    time_s = recording.columns["time_ns"].astype(np.float64) * 1e-9
    _table(folder / "steps.csv", *_steps(recording, time_s))
    _table(folder / "object_pose.csv", ["step", "time_s", "body", *_POSE7], _poses(recording, time_s))
    bodies = [
        [b.name, b.asset, b.layer, b.semantic_id, b.agent, b.moving, *_texts(b.pose), *_texts(b.scale)]
        for b in recording.bodies
    ]
    head = ["name", "asset", "layer", "semantic_id", "agent", "moving", *_POSE7, "scale_x", "scale_y", "scale_z"]
    _table(folder / "bodies.csv", head, _harmless(bodies))
    agents = [[i, a.name, a.kind, a.model, a.semantic_id] for i, a in enumerate(recording.agents)]
    _table(folder / "agents.csv", ["agent", "name", "kind", "model", "semantic_id"], _harmless(agents))
    head = ["agent", "name", "target", "start_step", "end_step", "outcome", "reason"]
    _table(folder / "skills.csv", head, _harmless([getattr(s, name) for name in head] for s in recording.skills))
    head = ["step", "agent", "kind", "target", "detail"]
    _table(folder / "events.csv", head, _harmless([getattr(e, name) for name in head] for e in recording.events))
    head = ["time_ns", "user", "kind", "payload"]
    _table(folder / "inputs.csv", head, _harmless([getattr(i, name) for name in head] for i in recording.inputs))
    with part_file(folder / "columns.npz") as part, part.open("wb") as stream:
        _npz(stream, recording)
    record = {
        "episode": episode_to_dict(recording.episode),
        "agents": [asdict(agent) for agent in recording.agents],
        "assets": [asdict(asset) for asset in recording.assets],
        "moving_bodies": [body.name for body in recording.moving_bodies],
    }
    with part_file(folder / "recording.json") as part:
        part.write_text(json.dumps(record, indent=1, ensure_ascii=False), encoding="utf-8")
    return [folder / name for name in FILES]


def export_csv(recordings: Iterable[Recording], request: ExportRequest) -> Exported:
    """Export one recording for ``h3data export --to csv``."""
    (recording,) = recordings
    files = write_csv_tables(recording, request.out)
    lines = [f"{file}: {size_text(file.stat().st_size)}" for file in files]
    return Exported(text="\n".join(lines), data={"steps": len(recording), "files": [str(file) for file in files]})


def _npz(stream: IO[bytes], recording: Recording) -> None:
    """Write arrays as `numpy.savez_compressed`, which does not accept every name."""
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in recording.columns.items():
            # the size of a member is not known before it is written, and may be above 4 GiB
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(values), allow_pickle=False)


def _steps(recording: Recording, time_s: np.ndarray) -> tuple[list[str], Iterable[list[Any]]]:
    head, columns = ["step", "time_s"], [[str(k) for k in range(len(recording))], _texts(time_s)]
    for name, values in recording.columns.items():
        flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
        # wider ones, such as rotations of all joints, are in columns.npz only: spreadsheets end at 16,384 columns
        if name == "object_pose" or flat.shape[1] > 64:
            continue
        labels = _labels(name, flat.shape[1], values.ndim == 1, recording.agents)
        if name == JOINTS and "scene.glb" in recording.attachments:
            joints = joint_names(load_scene(recording.attachments["scene.glb"]))
            labels = [f"{name}.{joint}" for joint in joints] if len(joints) == flat.shape[1] else labels
        head += labels
        columns += [_texts(flat[:, k]) for k in range(len(labels))]
    return head, ([column[k] for column in columns] for k in range(len(recording)))


def _labels(name: str, width: int, scalar: bool, agents: Sequence[Agent]) -> list[str]:
    """Return the names of the numbers in a row of a column, for CSV."""
    if scalar:
        return [name]
    owner, _, kind = name.partition(".")
    number = owner.removeprefix("agent_")
    names: Sequence[str] = ()
    if owner.startswith("agent_") and number.isdecimal() and int(number) < len(agents):
        agent = agents[int(number)]
        names = {"joint_pos": agent.joint_names, "action": agent.action_names}.get(kind, ())
    # an arm of seven joints has names of its own, and so have the joints of a home
    if width == 7 and len(names) != 7 and name != JOINTS:
        names = _POSE7
    if len(names) != width:
        names = [str(k) for k in range(width)]
    return [f"{name}.{label}" for label in names]


def _poses(recording: Recording, time_s: np.ndarray) -> Iterable[list[str]]:
    if "object_pose" not in recording.columns:
        return
    poses, names = recording.columns["object_pose"], [b.name for b in recording.moving_bodies]
    times = _texts(time_s)
    # a body that is away has no row, rather than one of empty fields
    there = np.asarray(np.isfinite(poses).all(-1))
    for step in range(len(poses)):
        for body in np.flatnonzero(there[step]).tolist():
            yield [str(step), times[step], names[body], *_texts(poses[step, body])]


def _texts(values: np.ndarray) -> list[str]:
    """Return the shortest exact text of each number; booleans become 0 and 1, and NaN an empty text."""
    # spreadsheets compute with 0 and 1
    if values.dtype.kind == "b":
        return ["1" if v else "0" for v in values]
    if values.dtype.kind != "f":
        return [str(v) for v in values.tolist()]
    # NumPy writes the shortest text that gives the same number in the dtype of the array
    texts = values.astype(str).tolist()
    return ["" if text == "nan" else text for text in texts]


def _harmless(rows: Iterable[Sequence[Any]]) -> Iterable[list[Any]]:
    """Return rows in which names and words from the recording cannot be run as formulas by a spreadsheet."""
    return ([spreadsheet_cell(cell) for cell in row] for row in rows)


def _table(path: Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with part_file(path) as part, part.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(rows)
