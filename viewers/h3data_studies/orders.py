"""Orders of games for a study: the episode that a worker plays for a stage, and the file of its recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from h3data_play.plan import GameOrder
from h3data_studies.design import StudyPlan
from h3data_studies.flow import Stage
from h3data_studies.store import Participant

RECORDINGS, TUTORIALS = "recordings", "tutorial"


def game_key(participant: Participant, stage: Stage) -> str:
    """Return the key of the game in which a participant plays a stage: ``P-.../episode/1/3``, ``P-.../tutorial/2``."""
    name = f"tutorial/{participant.progress.attempts + 1}" if stage.kind == "tutorial" else stage.key
    return f"{participant.id}/{name}"


def row_of(key: str) -> str:
    """Return the name of the row that is stored when the game with a key ends."""
    return key.partition("/")[2]


def recording_path(folder: Path, pseudonym: str, row: str) -> Path:
    """Return the file of the recording of an episode or of an attempt at the tutorial.

    Args:
        folder: Folder of the study.
        pseudonym: Pseudonym of the participant, or both pseudonyms of a pair, joined by ``_``.
        row: Row of the episode.
    """
    return folder / f"{_name(pseudonym, row)}.mcap"


def _name(pseudonym: str, row: str) -> str:
    kind, *numbers = row.split("/")
    if kind == "tutorial":
        return f"{TUTORIALS}/{pseudonym}_{numbers[0]}"
    return f"{RECORDINGS}/{pseudonym}_{numbers[0]}-{int(numbers[1]):02d}"


def _facts(participant: Participant) -> dict[str, Any]:
    device = participant.progress.rows.get("device", {})
    return {
        "consent": participant.consent,
        "language": participant.language,
        "client": {k: device[k] for k in ("browser", "system", "gpu", "touch", "headset") if k in device},
    }


def order_of(study: StudyPlan, participant: Participant, key: str, company: Participant | None = None) -> GameOrder:
    """Return the order of a game for a worker, and the entries of its recording.

    Args:
        study: Plan of the study.
        participant: Player of the game; for a pair, the one in the first seat.
        key: Key of the game.
        company: Player in the second seat, for a pair.
    """
    place, design, row = study.places[participant.place], study.design, row_of(key)
    hitl: dict[str, Any] = {"study": {"name": design.name, "version": design.version}, **_facts(participant)}
    players = [participant.id] if company is None else [participant.id, company.id]
    kind, *numbers = row.split("/")
    name = _name("_".join(players), row)
    if kind == "tutorial":
        number = study.number("", place.blocks[0].scene)
        hitl |= {"participant": participant.id, "tutorial": int(numbers[0])}
        return GameOrder(index=place.practice[0], name=name, plan=number, hitl=hitl)
    k, trial = map(int, numbers)
    block = place.blocks[k - 1]
    info: dict[str, Any] = {"participant": "+".join(players), "condition": block.condition}
    if company is not None:
        info["participants"] = players
        hitl["company"] = _facts(company)
    return GameOrder(
        index=block.episodes[trial - 1],
        name=name,
        plan=study.number(block.condition, block.scene),
        info=info,
        hitl={**hitl, "block": k, "trial": trial},
    )
