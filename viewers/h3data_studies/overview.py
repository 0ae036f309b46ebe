"""Overview of a running study: its participants, conditions, and late steps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date, datetime
from typing import Any

from h3data_studies.design import Design
from h3data_studies.flow import ACTIVE, STATUSES
from h3data_studies.store import Participant, StudyStore

BOT = "bot"
"""Browser class of scripted participants."""


@dataclass(frozen=True)
class PlayedEpisode:
    """Episode of a participant that has ended."""

    participant: str
    condition: str
    block: int
    trial: int
    row: str
    """Key of the episode's row (`Participant.progress`)."""
    ended: str
    steps: int
    slipped: int
    pair: tuple[str, ...] = ()
    """Pseudonyms of both participants, in the order of their seats, if they played the episode together."""
    remarks: tuple[Mapping[str, Any], ...] = ()
    """Reported problems, and the answer to the question at the end, from the recording."""

    @property
    def late(self) -> float:
        """Share of steps that the machine was too slow to play in time."""
        return self.slipped / max(self.steps + self.slipped, 1)


def is_bot(participant: Participant) -> bool:
    """Return whether a participant declares that it is a script."""
    return participant.progress.rows.get("device", {}).get("browser") == BOT


def played(participant: Participant) -> list[PlayedEpisode]:
    """Return a participant's episodes in order, without practice episodes."""
    episodes = []
    for row, result in participant.progress.rows.items():
        kind, *numbers = row.split("/")
        if kind == "episode":
            block, trial = map(int, numbers)
            condition = participant.progress.place.blocks[block - 1].condition
            steps, slipped = int(result.get("steps") or 0), int(result.get("slipped") or 0)
            episodes.append(
                PlayedEpisode(
                    participant.id,
                    condition,
                    block,
                    trial,
                    row,
                    str(result["ended"]),
                    steps,
                    slipped,
                    tuple(result.get("pair") or ()),
                    tuple(result.get("remarks") or ()),
                )
            )
    return episodes


def usable(design: Design, episode: PlayedEpisode) -> str:
    """Return the reason why the report excludes an episode; empty if it is included."""
    if episode.ended == "failed":
        return "the simulator failed"
    if episode.ended == "closed":
        return "left before the end"
    if episode.late > design.dropout.max_slip:
        return f"more than {design.dropout.max_slip:.0%} of the steps came late"
    return ""


def overview(design: Design, store: StudyStore) -> dict[str, Any]:
    """Return everything that ``study status`` prints, as JSON types."""
    people = sorted(store.participants.values(), key=lambda p: p.number)
    episodes = [episode for person in people for episode in played(person)]
    return {
        "study": design.name,
        "version": design.version,
        "retention": design.retention.isoformat(),
        "overdue": date.today() > design.retention and bool(people),
        "places": design.participants,
        "statuses": {status: sum(p.progress.status == status for p in people) for status in STATUSES},
        "bots": sum(map(is_bot, people)),
        "declined": store.counted("declined"),
        "participants": [_person(design, person) for person in people],
        "conditions": [
            _condition(design, c.name, [e for e in episodes if e.condition == c.name]) for c in design.conditions
        ],
    }


def _person(design: Design, person: Participant) -> dict[str, Any]:
    progress, episodes = person.progress, played(person)
    late = sum(e.slipped for e in episodes) / max(sum(e.steps + e.slipped for e in episodes), 1)
    counts = Counter(e.condition for e in episodes)
    return {
        "participant": person.id,
        "bot": is_bot(person),
        "place": person.place + 1,
        "status": progress.status,
        "reason": progress.reason,
        "stage": progress.stage.key if progress.status == ACTIVE else "",
        "done": progress.done,
        "of": len(progress.stages),
        "practice": progress.attempts,
        "episodes": {c.name: counts[c.name] for c in design.conditions},
        "late": late,
        "minutes": person.used / 60,
        "idle_minutes": person.idle / 60 if progress.status == ACTIVE else None,
        "joined": datetime.fromtimestamp(person.joined).isoformat(timespec="minutes"),
    }


def _condition(design: Design, name: str, episodes: list[PlayedEpisode]) -> dict[str, Any]:
    return {
        "condition": name,
        "episodes": len(episodes),
        "planned": design.participants * design.episodes,
        "success": sum(e.ended == "success" for e in episodes),
        "left_out": sum(bool(usable(design, e)) for e in episodes),
        "late": sum(e.slipped for e in episodes) / max(sum(e.steps + e.slipped for e in episodes), 1),
    }
