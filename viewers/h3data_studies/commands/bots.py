"""Command ``h3data study bots``: scripted participants play a whole study, to test it and to measure its size."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.commands.command import JsonFlag, Outcome, keeping
from h3data.errors import H3DataError, InputError
from h3data.progress import progress, say
from h3data.terminal import counted
from h3data_play.commands.serving import require_aiohttp, started_server
from h3data_studies.commands.running import SERVER, keep_design, running

if TYPE_CHECKING:
    from h3data_studies.design import Design

AT_ONCE_EACH = 5
"""Number of simultaneous participants per simulating process; more would only wait for each other."""


@dataclass(frozen=True)
class StudyBots:
    """Let scripted participants play a whole study, through the same server and pages as people.

    They consent, pass checks and tutorial, play every episode and fill in the forms, at random. Their data are marked
    as made by bots (client.browser is bot) in recordings, status and report. The data go into a separate folder,
    NAME-VERSION-bots, so that no place of the study is taken. The clock runs as fast as possible, which recordings
    state. If the command is stopped or killed, the same command continues.

    Examples:
        h3data study bots study.toml --participants 3
        h3data study bots study.toml --workers 2
        h3data study bots study.toml --speed 1 --participants 2
        h3data study bots study.toml --link http://127.0.0.1:8080/
    """

    study: tyro.conf.Positional[Path]
    """The study file (.toml)."""
    participants: int | None = None
    """Number of participants (default: the number of places of the study)."""
    workers: int = 1
    """Number of simulating processes."""
    at_once: int | None = None
    """Number of participants at the same time (default: 5 for each process)."""
    speed: float = 0.0
    """Speed of the clock relative to real time; 0 means as fast as possible."""
    link: Annotated[str | None, tyro.conf.arg(metavar="URL")] = None
    """Link of a study that is already being served, with its own clock; no server is started then."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Play the study and return the results of the bots, with the size of the recordings."""
        from h3data_studies.files import bots_folder, make_plan, read_design, study_folder, with_id_pattern
        from h3data_studies.forms import right_answers
        from h3data_studies.pseudonyms import ANY

        require_aiohttp("h3data study bots")
        design = read_design(self.study)
        count = design.participants if self.participants is None else self.participants
        if not 1 <= count <= design.participants:
            raise InputError(
                f"Expected --participants from 1 to {design.participants}, the places of the study, got {count}.",
                code="H3-STUDY-001",
            )
        if design.has_pairs and (count % 2 or (self.at_once or 2) % 2):
            raise InputError(
                "Expected even --participants and --at-once: a condition of the study is played by two together.",
                code="H3-STUDY-050",
            )
        if self.workers < 1 or (self.at_once is not None and self.at_once < 1) or not 0 <= self.speed <= 100:
            raise InputError(
                "Expected --workers and --at-once of at least 1, and a --speed from 0 to 100.", code="H3-STUDY-002"
            )
        episodes = count * len(design.conditions) * design.episodes
        together = 2 if design.has_pairs else 1
        crowd = Crowd(count, self.at_once or AT_ONCE_EACH * self.workers * together, right=right_answers(design))
        began = time.monotonic()
        if self.link is not None:
            folder = None
            asyncio.run(crowd.take_part(self.link.rstrip("/") + "/", episodes))
        else:
            folder = bots_folder(study_folder(self.study, design))
            with running(folder), keeping(lambda: f"everything in {folder}; the same command goes on with it"):
                design = keep_design(folder, with_id_pattern(design, ANY))
                plan = make_plan(design, folder, speed=self.speed)
                crowd.known = known_bots(folder, design, count)
                say(f"Bots play {design.name}, version {design.version}, in {folder}. Setting up its conditions ...")
                options = {"study": plan, "stays": True, "workers": self.workers, "seats_per_address": count}
                with started_server(SERVER, options) as (links, reports):
                    late = Late(reports)
                    asyncio.run(crowd.take_part(links[0][1], episodes))
                late.thread.join()
                crowd.slipped = late.slipped
        seconds = time.monotonic() - began
        statuses = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in crowd.statuses.most_common())
        ends = ", ".join(f"{number} {end}" for end, number in crowd.ends.most_common())
        lines = [
            f"{counted(count, 'bot')}: {statuses}",
            f"Episodes played now: {ends or 'none'}; {seconds / 60:.1f} min",
        ]
        if crowd.slipped:
            lines.append(f"{counted(crowd.slipped, 'step')} late: the machine was too slow for --speed {self.speed:g}.")
        if folder is not None:
            lines.append(f"Everything is in {folder}.\nh3data study report {folder}")
        data = {
            "folder": None if folder is None else str(folder),
            "statuses": dict(crowd.statuses),
            "episodes": dict(crowd.ends),
            "seconds": seconds,
            "slipped": crowd.slipped,
        }
        return Outcome(text="\n".join(lines), data=data, exit_code=int(crowd.faults > 0), result=folder)


def bot_name(k: int) -> str:
    """Return the name of bot ``k``, from 0."""
    return f"bot-{k + 1:03d}"


def known_bots(folder: Path, design: Design, count: int) -> dict[str, tuple[str, str]]:
    """Return the status of each bot that has started before, and the code by which it continues without its cookie."""
    from h3data_studies.files import key_file, open_store
    from h3data_studies.pseudonyms import read_key, recruit_ids, rejoin_code
    from h3data_studies.store import DATABASE

    known: dict[str, tuple[str, str]] = {}
    if not (folder / DATABASE).is_file():
        return known
    store, key = open_store(folder, design), read_key(key_file(folder))
    for name in map(bot_name, range(count)):
        person = store.by_id(recruit_ids({"PROLIFIC_PID": name}, key)["PROLIFIC_PID"])
        seat = None if person is None else store.seat_of(person)
        if person is not None and seat is not None:
            known[name] = person.progress.status, rejoin_code(person.id, seat.token, key)
    return known


@dataclass
class Crowd:
    """Group of scripted participants, several of whom take part at a time."""

    count: int
    at_once: int
    statuses: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)
    faults: int = 0
    slipped: int = 0
    right: dict[tuple[str, str], float] = field(default_factory=dict)
    """Right answers to checks, by form and item."""
    known: dict[str, tuple[str, str]] | None = None
    """Status and rejoin code of participants who started before, by name. None for a served study, which asks for ids
    of its own format."""

    async def take_part(self, link: str, episodes: int) -> None:
        """Let all scripted participants take part.

        Raises:
            H3DataError: no participant could take part.
        """
        places = asyncio.Semaphore(self.at_once)
        with progress(desc="Bots", unit="episode", total=episodes) as bar:

            def ended(why: str) -> None:
                self.ends[why] += 1
                if why != "tutorial":
                    bar.update(1)

            await asyncio.gather(*(self._one(link, k, places, ended) for k in range(self.count)))
        if self.faults == self.count:
            raise H3DataError("No bot could take part; what they were told is above.", code="H3-STUDY-003")

    async def _one(self, link: str, k: int, places: asyncio.Semaphore, ended: Any) -> None:
        from aiohttp import ClientError

        from h3data_studies.bots.participant import ScriptedParticipant
        from h3data_studies.flow import ACTIVE

        name = bot_name(k)
        status, rejoin = (self.known or {}).get(name, (ACTIVE, ""))
        if status != ACTIVE:
            self.statuses[status] += 1
            return
        pid = secrets.token_hex(12) if self.known is None else name
        async with places, ScriptedParticipant(link, name, ended, pid=pid, rejoin=rejoin, right=self.right) as bot:
            try:
                self.statuses[await bot.take_part()] += 1
            except (ConnectionError, TimeoutError, ClientError) as fault:
                self.statuses["failed"] += 1
                self.faults += 1
                say(f"{bot.name}: {fault}")


class Late:
    """Listener to the server's reports of late steps and lost workers while the bots play."""

    def __init__(self, reports: Any) -> None:
        self.slipped = 0
        self._reports = reports
        self.thread = Thread(target=self._listen, daemon=True)
        self.thread.start()

    def _listen(self) -> None:
        for report in self._reports:
            self.slipped += report.get("over", {}).get("slipped") or 0
            if "lost" in report:
                say("A worker process ended; another one takes over.")
