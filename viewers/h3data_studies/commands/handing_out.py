"""Commands ``h3data study data`` and ``h3data study pay``: participants' data, completion codes and bonuses."""

from __future__ import annotations

import csv
import io
import json
import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.commands.command import ForceFlag, JsonFlag, Outcome, claim_file, claim_folder
from h3data.errors import InputError
from h3data.files import part_file
from h3data.terminal import counted
from h3data_studies.commands.managing import find_participant, payments_folder
from h3data_studies.commands.reporting import write_rows

if TYPE_CHECKING:
    from h3data_studies.design import Bonus, Design
    from h3data_studies.store import Participant

_README = """What the study {name}, version {version}, has stored about participant {who}, on {today}.

participant.json  when you took part, what you agreed to, your answers and everything else that the pages have stored
consent.txt       the text of the consent in your language
recordings/       a recording of each round that you have played, and tutorial/ of the practice, in the format MCAP
                  (https://mcap.dev): what you pressed, and how everybody moved

Ids of a recruiting platform are not stored; participant.json has the pseudonyms that were made from them.
Questions: {contact}
"""


@dataclass(frozen=True)
class StudyData:
    """Write all stored data of a participant to one file, for the participant (GDPR, articles 15 and 20).

    The ZIP file has the participant's answers, the log of their actions, their consent, and the recordings of their
    episodes. It is also a copy of the data that h3data study forget would delete. The study may be running.

    Examples:
        h3data study data study.toml P-ZBI5ZED7QR
        h3data study data study.toml 5f3c0a1b2c3d4e5f60718293 -o answer-to-request.zip
    """

    study: tyro.conf.Positional[Path]
    """Study file, or the study's folder."""
    participant: tyro.conf.Positional[str]
    """Participant number (P-...), or the id at the recruiting platform (PROLIFIC_PID)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """ZIP file to write (default: the participant's number, in the current folder)."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Write the participant's data to a zip file."""
        from h3data_studies.files import open_store, open_study
        from h3data_studies.orders import RECORDINGS, TUTORIALS

        folder, design = open_study(self.study)
        person = find_participant(folder, open_store(folder, design), self.participant)
        path = claim_file(self.out or Path(f"{person.id}.zip"), force=self.force, suffix=".zip")
        found = [
            file for below in (RECORDINGS, TUTORIALS) for file in sorted((folder / below).glob(f"*{person.id}_*.mcap"))
        ]
        today = datetime.now(UTC).date().isoformat()
        readme = _README.format(
            name=design.name, version=design.version, who=person.id, today=today, contact=design.contact
        )
        with part_file(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as file:
            file.writestr("README.txt", readme)
            file.writestr("participant.json", json.dumps(own_data(design, person), indent=2, ensure_ascii=False) + "\n")
            file.writestr("consent.txt", design.say(design.consent.text, person.language))
            for recording in found:
                file.write(recording, f"{recording.parent.name}/{recording.name}")
        text = f"{path}: {counted(len(person.progress.rows), 'row')} and {counted(len(found), 'recording')}"
        return Outcome(text=text, data={"file": str(path), "recordings": len(found)}, result=path)


def own_data(design: Design, person: Participant) -> dict[str, Any]:
    """Return all data of a participant in the database as JSON types; times are in UTC."""
    from h3data_studies.pseudonyms import IDS

    progress = person.progress
    when = lambda at: None if at is None else datetime.fromtimestamp(at, UTC).isoformat(timespec="seconds")  # noqa: E731
    return {
        "study": {"name": design.name, "version": design.version, "contact": design.contact},
        "deleted_by": design.retention.isoformat(),
        "participant": person.id,
        "pseudonyms": {name: person.ids[name] for name in IDS if name in person.ids},
        "language": person.language,
        "consent": person.consent,
        "joined": when(person.joined),
        "ended": when(person.ended),
        "minutes": round(person.used / 60, 2),
        "status": progress.status,
        "reason": progress.reason,
        "conditions": [{"condition": b.condition, "scene": b.scene} for b in progress.place.blocks],
        "entries": [
            {"what": key, "stored": when(person.times.get(key)), "data": data} for key, data in progress.rows.items()
        ],
    }


@dataclass(frozen=True)
class StudyPay:
    """Write completion codes and bonuses of the participants who have finished.

    codes.csv has a row for each participant. With --ids, the recruiting platform's own list of participants, bonus.csv
    has a line ID,AMOUNT for each who has finished, in the format of Prolific's bulk bonus payments. The list is
    necessary because the study itself stores no ids. Ids that did not finish here, and codes of other participants, are
    reported. The study file sets the bonus ([bonus]). Delete the folder when all participants have been paid.

    Examples:
        h3data study pay study.toml
        h3data study pay study.toml --ids prolific_export.csv
    """

    study: tyro.conf.Positional[Path]
    """Study file, or the study's folder."""
    ids: Path | None = None
    """CSV file with a column "Participant id" or PROLIFIC_PID, and optionally "Completion code"; or a text file with
    one id per line."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder to write to (default: NAME-VERSION-payments next to the study's folder)."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Write a table of completion codes and bonuses."""
        from h3data_studies.files import key_file, open_store, open_study
        from h3data_studies.flow import COMPLETE
        from h3data_studies.overview import is_bot, played
        from h3data_studies.pseudonyms import completion_code, read_key, recruit_ids

        folder, design = open_study(self.study)
        listed = [] if self.ids is None else _listed(self.ids)
        if self.ids is not None and design.bonus is None:
            raise InputError(
                f"The study file has no bonus. Expected [bonus] with base or per_success. Study: {folder}",
                code="H3-STUDY-006",
            )
        people = sorted(open_store(folder, design).participants.values(), key=lambda p: p.number)
        key, out = read_key(key_file(folder)), payments_folder(folder) if self.out is None else self.out
        claim_folder(out, force=self.force or self.out is None)
        own = design.recruiting.unique_codes
        codes: dict[str, str] = {}
        amounts: dict[str, str] = {}
        rows: list[list[str | float]] = [["participant", "bot", "status", "code", "successes", "bonus"]]
        for person in people:
            successes = sum(episode.ended == "success" for episode in played(person))
            done = person.progress.status == COMPLETE
            if done:
                codes[person.id] = completion_code(person.id, key) if own else design.recruiting.completion_code
                amounts[person.id] = f"{bonus_of(design.bonus, successes):.2f}"
            shown = [codes.get(person.id, ""), successes, amounts.get(person.id, "")]
            rows.append([person.id, int(is_bot(person)), person.progress.status, *shown])
        write_rows(out / "codes.csv", rows)
        made, notes, paid = [out / "codes.csv"], [], []
        for given, code in listed:
            who = recruit_ids({"PROLIFIC_PID": given}, key)["PROLIFIC_PID"]
            if who not in amounts:
                notes.append(f"{given} has not finished this study.")
            elif code and codes[who] and code != codes[who]:
                notes.append(f"{given} has finished, but gave the code {code}, which is not theirs: no bonus.")
            elif float(amounts[who]) > 0:
                paid.append([given, amounts[who]])
        if self.ids is not None:
            with part_file(out / "bonus.csv") as part, part.open("w", newline="", encoding="utf-8") as file:
                csv.writer(file, lineterminator="\n").writerows(paid)
            made.append(out / "bonus.csv")
            total = sum(float(amount) for _, amount in paid)
            notes.append(f"{counted(len(paid), 'participant')} with a bonus, {total:.2f} in all.")
        text = "\n".join(
            [f"{len(amounts)} of {counted(len(people), 'participant')} have finished.", *notes, *map(str, made)]
        )
        data = {"out": str(out), "finished": len(amounts), "bonuses": len(paid), "notes": notes}
        return Outcome(text=text, data=data, result=out)


def bonus_of(bonus: Bonus | None, successes: int) -> float:
    """Return the payment in addition to the fixed reward of a participant who has finished, rounded to two decimals."""
    if bonus is None:
        return 0.0
    amount = bonus.base + bonus.per_success * successes
    return round(amount if bonus.most is None else min(amount, bonus.most), 2)


_ID_COLUMNS = ("participant id", "prolific_pid", "participant_id", "id")
_ID = re.compile(r"\S{1,200}")


def _listed(path: Path) -> list[tuple[str, str]]:
    """Return the ids and completion codes (empty: not given) of a platform's list.

    Raises:
        InputError: it cannot be read, or has no ids.
    """
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as fault:
        raise InputError(f"Cannot read the list of ids ({fault}): {path}", code="H3-STUDY-007") from None
    rows: Sequence[list[str]] = [row for row in csv.reader(io.StringIO(text)) if row]
    heads = [cell.strip().lower() for cell in rows[0]] if rows else []
    column = next((heads.index(name) for name in _ID_COLUMNS if name in heads), None)
    if column is None and any(len(row) > 1 for row in rows):
        raise InputError(
            f'The list of ids has no column "Participant id" or PROLIFIC_PID; it has: {", ".join(rows[0])}. File: {path}',
            code="H3-STUDY-004",
        )
    code = heads.index("completion code") if "completion code" in heads else None
    found = []
    for row in rows if column is None else rows[1:]:
        given = row[column or 0].strip() if len(row) > (column or 0) else ""
        if _ID.fullmatch(given):
            found.append((given, row[code].strip() if code is not None and len(row) > code else ""))
    if not found:
        raise InputError(
            f"Expected an id in each line, or a CSV file with a column of ids, got none: {path}", code="H3-STUDY-005"
        )
    return list(dict.fromkeys(found))
