"""Commands ``h3data study status`` and ``h3data study forget``: the state of a study, and deletion of data."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from h3data.commands.command import DryRunFlag, JsonFlag, Outcome
from h3data.errors import InputError, did_you_mean
from h3data.terminal import counted
from h3data_studies.commands.running import LOCK, running

if TYPE_CHECKING:
    from h3data_studies.store import Participant, StudyStore

REPORT = "report"
"""Name of the folder in a study's folder with the results of ``study report``."""


@dataclass(frozen=True)
class StudyStatus:
    """Show the progress of a study's participants by condition, also while the study is running.

    For every active participant there is a link with which they can continue once in another browser. Send it only to
    this person, because it gives access to their place.

    Examples:
        h3data study status study.toml
        h3data study status kitchen-help-1/ --json
    """

    study: tyro.conf.Positional[Path]
    """Study file, or the study's folder."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return the number of participants in each state and condition."""
        from h3data_studies.files import open_store, open_study
        from h3data_studies.overview import overview

        folder, design = open_study(self.study)
        store = open_store(folder, design)
        data = {**overview(design, store), "rejoin": _rejoin_links(folder, store)}
        return Outcome(text=_status_text(data), data=data, result=data)


def _rejoin_links(folder: Path, store: StudyStore) -> dict[str, str]:
    """Return the links by which active participants continue in another browser; without a host if no server runs."""
    from h3data_studies.files import key_file
    from h3data_studies.pseudonyms import read_key, rejoin_code

    if not key_file(folder).is_file():
        return {}
    key, lock, links = read_key(key_file(folder)), folder / LOCK, {}
    base = lock.read_text("utf-8") if lock.is_file() else ""
    for person in sorted(store.participants.values(), key=lambda p: p.number):
        seat = store.seat_of(person)
        if person.is_active and seat is not None:
            links[person.id] = f"{base}?rejoin={rejoin_code(person.id, seat.token, key)}"
    return links


def _status_text(data: dict[str, Any]) -> str:
    from h3data.metrics.table import aligned

    statuses = [f"{count} {name.replace('_', ' ')}" for name, count in data["statuses"].items() if count]
    head = f"{data['study']}, version {data['version']}: {', '.join(statuses) or 'nobody has begun'}; "
    head += f"{counted(data['places'], 'place')}, {data['declined']} declined"
    if data["bots"]:
        head += f"; {counted(data['bots'], 'participant')} scripted (bots)"
    lines = [["condition", "episodes", "success", "left out", "late steps"]]
    for c in data["conditions"]:
        cells = [f"{c['episodes']} of {c['planned']}", str(c["success"]), str(c["left_out"]), f"{c['late']:.2%}"]
        lines.append([c["condition"], *cells])
    blocks = [head, aligned(lines)]
    if data["participants"]:
        names = list(data["participants"][0]["episodes"])
        lines = [["participant", "place", "status", "done", "practice", *names, "late steps", "minutes", "now"]]
        for p in data["participants"]:
            status = p["status"].replace("_", " ") + (f" ({p['reason']})" if p["reason"] else "")
            now = f"{p['stage']}, idle {p['idle_minutes']:.0f} min" if p["stage"] else ""
            counts = [str(p["episodes"][name]) for name in names]
            who, done = p["participant"] + (" (bot)" if p["bot"] else ""), f"{p['done']} of {p['of']}"
            times = [f"{p['late']:.2%}", f"{p['minutes']:.0f}", now]
            lines.append([who, str(p["place"]), status, done, str(p["practice"]), *counts, *times])
        blocks.append(aligned(lines))
    if data["rejoin"]:
        lines = [
            "To go on in another browser, once (for the participant alone; behind a proxy with its address in front):"
        ]
        blocks.append("\n".join(lines + [f"  {who}  {link}" for who, link in data["rejoin"].items()]))
    if data["overdue"]:
        blocks.append(f"The retention date, {data['retention']}, is over: recordings and answers are to be deleted.")
    return "\n\n".join(blocks)


@dataclass(frozen=True)
class StudyForget:
    """Delete all data of a participant (recordings, answers, seat) and list what was deleted.

    The results of h3data study report and h3data study pay are deleted as well, because they contain data of all
    participants; run these commands again. Copies elsewhere are not deleted. The study must not be running;
    participants can continue when it is started again.

    Examples:
        h3data study forget study.toml P-ZBI5ZED7QR
        h3data study forget study.toml 5f3c0a1b2c3d4e5f60718293 --dry-run
    """

    study: tyro.conf.Positional[Path]
    """Study file, or the study's folder."""
    participant: tyro.conf.Positional[str]
    """Participant number (P-...), or the id at the recruiting platform (PROLIFIC_PID)."""
    dry_run: DryRunFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Delete the participant's data and return what was deleted."""
        from h3data_studies.files import open_store, open_study

        folder, design = open_study(self.study)
        with running(folder):
            store = open_store(folder, design, read_only=self.dry_run)
            try:
                person = find_participant(folder, store, self.participant)
                pseudonym, files = person.id, sorted(_files(folder, person.id))
                forms = sum(row.startswith("form/") for row in person.progress.rows)
                entries = store.forget(person)
                if not self.dry_run:
                    for file in files:
                        shutil.rmtree(file) if file.is_dir() else file.unlink()
            finally:
                store.close(done=False)
        words = {"participants": "participant", "rows": "row", "seats": "seat", "games": "game"}
        removed = [str(file) for file in files]
        said = ", ".join(counted(count, words[what]) for what, count in entries.items() if count)
        verb = "Would delete" if self.dry_run else "Deleted"
        text = "\n".join(
            [
                f"{verb} of {pseudonym}, in the database: {said} ({counted(forms, 'questionnaire')} among them).",
                f"{verb}:",
            ]
            + [f"  {file}" for file in removed or ["no files"]]
        )
        data = {
            "participant": pseudonym,
            "dry_run": self.dry_run,
            "database": entries,
            "forms": forms,
            "files": removed,
        }
        return Outcome(text=text, data=data, result=data)


def find_participant(folder: Path, store: StudyStore, name: str) -> Participant:
    """Return the participant with a number (P-...) or an id at the recruiting platform.

    Raises:
        InputError: there is no such participant.
    """
    from h3data_studies.files import key_file
    from h3data_studies.pseudonyms import read_key, recruit_ids

    person = store.by_id(name)
    if person is None and key_file(folder).is_file():
        ids = recruit_ids({"PROLIFIC_PID": name}, read_key(key_file(folder)))
        person = store.by_id(ids.get("PROLIFIC_PID", ""))
    if person is None:
        names = [p.id for p in store.participants.values()]
        raise InputError(
            f"Nobody in this study is {name!r}.{did_you_mean(name, names)} Hint: h3data study status {folder}",
            code="H3-STUDY-008",
        )
    return person


def _files(folder: Path, pseudonym: str) -> Iterator[Path]:
    """Yield all files of a participant, also unfinished and damaged ones, and files with data of all participants."""
    from h3data_studies.orders import RECORDINGS, TUTORIALS

    for below in (RECORDINGS, TUTORIALS):
        for file in (folder / below).glob("*"):
            if f"{pseudonym}_" in file.name:
                yield file
    for made in (folder / REPORT, payments_folder(folder)):
        if made.is_dir():
            yield made


def payments_folder(folder: Path) -> Path:
    """Return the folder of ``study pay``, outside the study's folder because it has ids of the recruiting platform."""
    folder = folder.resolve()
    return folder.with_name(folder.name + "-payments")
