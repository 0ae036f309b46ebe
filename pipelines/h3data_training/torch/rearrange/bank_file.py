"""File of a bank of episodes that holds only arrays, executes nothing, and can be played without building homes."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.errors import FormatError, InputError
from h3data.files import part_file
from h3data.plugins import names_from_data
from h3data_training.torch.rearrange.bank import RearrangeBank
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.tasks.rearrange.episode import ORACLE_RULES, RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange

FORMAT = "h3data.rearrange_bank/1"
BESIDE = ("spec", "robot", "human", "floors", "scenes", "names")
"""Names of the fields of a bank that are not arrays."""
ARRAYS = tuple(f.name for f in fields(RearrangeBank) if f.name not in BESIDE)


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredFloor:
    """Floor (`h3data_training.torch.rearrange.bank.BankFloor`) that was read from a file."""

    sdf: NDArray[np.float32]
    """Distance to the nearest obstacle at cell centres, [nx, nz] [m]."""
    origin: NDArray[np.float64]
    cell_m: float
    floor_y: float


def save_bank(bank: RearrangeBank, path: str | Path, *, drawn_by: Mapping[str, Any]) -> None:
    """Write a bank to a compressed npz file atomically; ``drawn_by`` are the settings of the episodes."""
    about = {
        "format": FORMAT,
        "drawn_by": dict(drawn_by),
        "rules": _rules(bank.spec),
        "bodies": [bank.robot.name, bank.human.name],
        "homes": bank.names,
        "floors": [[*map(float, f.origin), float(f.cell_m), float(f.floor_y)] for f in bank.floors],
    }
    arrays = {name: getattr(bank, name) for name in ARRAYS}
    grids = {f"sdf_{k}": np.asarray(floor.sdf, np.float32) for k, floor in enumerate(bank.floors)}
    with part_file(path) as part, part.open("wb") as stream:
        np.savez_compressed(stream, about=np.array(json.dumps(about)), **arrays, **grids)  # type: ignore[arg-type]


def load_bank(path: str | Path, *, spec: RearrangeSpec = ORACLE_RULES) -> tuple[RearrangeBank, dict[str, Any]]:
    """Return the bank of a file, without scenes and pictures, and the settings of its episodes.

    Raises:
        FormatError: the file is not a bank of episodes, or is damaged.
        InputError: its episodes have other rules.
    """
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in (*ARRAYS, *(n for n in file.files if n.startswith("sdf_")))}
            about = json.loads(str(file["about"]))
        robot_name, human_name = about["bodies"]
        names = tuple(map(str, about.get("homes", ())))
        floors = tuple(
            StoredFloor(sdf=arrays.pop(f"sdf_{k}"), origin=np.array([x, z]), cell_m=cell, floor_y=y)
            for k, (x, z, cell, y) in enumerate(about["floors"])
        )
        ours = about["format"] == FORMAT and len(arrays["place"]) > 0 and set(arrays) == set(ARRAYS)
        drawn_by, rules = dict(about["drawn_by"]), about["rules"]
    except Exception as fault:  # zipfile and numpy have a dozen ways to say that bits are wrong
        why = fault if isinstance(fault, OSError) or zipfile.is_zipfile(path) else "not an npz file"
        raise FormatError(
            f"Expected a bank of episodes ({FORMAT}), this is none ({why}). File: {path}", code="H3-TRAIN-067"
        ) from None
    if not ours:
        raise FormatError(
            f"Expected a bank of episodes {FORMAT}, got {about['format']}. File: {path}", code="H3-TRAIN-065"
        )
    if rules != _rules(spec):
        raise InputError(
            f"These episodes were drawn with other rules of the task. Hint: another file. File: {path}",
            code="H3-TRAIN-066",
        )
    with names_from_data():
        roster = make_roster(Rearrange.agents, robot=robot_name, human=human_name)
    robot, human = roster[0].robot, roster[1].body
    assert isinstance(human, Humanoid)
    return RearrangeBank(spec=spec, robot=robot, human=human, floors=floors, scenes=(), names=names, **arrays), drawn_by


def _rules(spec: RearrangeSpec) -> str:
    return sha256(repr(spec).encode()).hexdigest()[:16]
