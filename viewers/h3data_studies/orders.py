"""Orders of episodes: which one a worker plays for a stage, and where its recording lies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from h3data_play.plan import GameOrder
from h3data_studies.design import StudyPlan
from h3data_studies.flow import Stage
from h3data_studies.store import Participant

RECORDINGS, TUTORIALS = "recordings", "tutorial"


def game_key(participant: Participant, stage: Stage) -> str:
    """Key of the game in which a participant plays a stage: ``P-.../episode/1/3``, ``P-.../tutorial/2``."""
    name = f"tutorial/{participant.progress.attempts + 1}" if stage.kind == "tutorial" else stage.key
    return f"{participant.id}/{name}"


def row_of(key: str) -> str:
    """The row that the end of a game writes."""
    return key.partition("/")[2]


def recording_path(folder: Path, pseudonym: str, row: str) -> Path:
    """File of the recording of an episode or of an attempt at the tutorial."""
    return folder / f"{_name(pseudonym, row)}.mcap"


def _name(pseudonym: str, row: str) -> str:
    kind, *numbers = row.split("/")
    if kind == "tutorial":
        return f"{TUTORIALS}/{pseudonym}_{numbers[0]}"
    return f"{RECORDINGS}/{pseudonym}_{numbers[0]}-{int(numbers[1]):02d}"


def order_of(study: StudyPlan, participant: Participant, key: str) -> GameOrder:
    """Returns the order of a game for a worker, and the entries of its recording."""
    place, design, row = study.places[participant.place], study.design, row_of(key)
    device = participant.progress.rows.get("device", {})
    hitl: dict[str, Any] = {
        "study": {"name": design.name, "version": design.version},
        "consent": participant.consent,
        "language": participant.language,
        "client": {k: device[k] for k in ("browser", "system", "gpu", "touch", "headset") if k in device},
    }
    kind, *numbers = row.split("/")
    name = _name(participant.id, row)
    if kind == "tutorial":
        number = study.number("", place.blocks[0].scene)
        hitl |= {"participant": participant.id, "tutorial": int(numbers[0])}
        return GameOrder(index=place.practice[0], name=name, plan=number, hitl=hitl)
    k, trial = map(int, numbers)
    block = place.blocks[k - 1]
    return GameOrder(
        index=block.episodes[trial - 1],
        name=name,
        plan=study.number(block.condition, block.scene),
        info={"participant": participant.id, "condition": block.condition},
        hitl={**hitl, "block": k, "trial": trial},
    )
