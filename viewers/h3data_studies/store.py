"""Store of a study's participants on the disk: their consent, progress and seats.

There is one SQLite file per study. Every commit is on the disk before a browser learns of it.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec

from h3data_play.seats import Game, Seat, SeatLog, uptime
from h3data_studies.design import Design, Place
from h3data_studies.flow import ACTIVE, COMPLETE, Progress

DATABASE = "study.sqlite"
_TABLES = """
create table if not exists participants (
    number integer primary key, id text not null unique, place integer not null, status text not null, reason text not null,
    joined real not null, used real not null, idle real not null, ended real, language text not null, consent text not null,
    ids text not null
);
create table if not exists rows (
    participant integer not null, stage text not null, at real not null, data text not null, primary key (participant, stage)
);
create table if not exists counts (name text primary key, value integer not null);
"""
GAP_S = 15.0
"""Longest interval that counts as participants' time [s]; after a longer one the server was suspended or stopped."""


@dataclass(eq=False)
class Participant:
    """Person who has consented to take part in a study."""

    number: int
    id: str
    """Pseudonym of the participant."""
    place: int
    """Index into `StudyPlan.places`."""
    joined: float
    """Unix time at which the participant joined [s]; it is informative, and no duration is computed from it."""
    used: float
    """Time since the participant's consent during which the study was served [s]."""
    idle: float
    """Time since the participant's last activity [s], counted like ``used``."""
    language: str
    consent: dict[str, str]
    """Version and SHA-256 of the text that the participant agreed to."""
    ids: dict[str, str]
    """Pseudonyms of the recruiting platform's ids."""
    progress: Progress
    ended: float | None = None
    """Unix time of the end of the participation [s]."""
    times: dict[str, float] = field(default_factory=dict)
    """Unix time at which each row was written [s], by row."""

    @property
    def is_active(self) -> bool:
        """Return whether the participant is taking part, and has neither finished nor left."""
        return self.progress.status == ACTIVE


class StudyStore(SeatLog):
    """Journal of the seats and games of a study, with its participants."""

    def __init__(
        self,
        design: Design,
        places: Sequence[Place],
        folder: Path,
        *,
        read_only: bool = False,
        clock: Callable[[], float] = uptime,
    ) -> None:
        """Open or create the store of a study.

        Args:
            design: study file.
            places: conditions and episodes of each participant.
            folder: folder of the study.
            read_only: whether to work on a copy in memory, because the file may belong to another process.
            clock: clock in seconds by which participants' time is counted.
        """
        self.design, self.places = design, places
        self.participants: dict[int, Participant] = {}
        self._clock, self._counted = clock, clock()
        super().__init__(folder, name=DATABASE, read_only=read_only)
        self._db.execute("pragma secure_delete = on")
        self._db.executescript(_TABLES)
        self._migrate()
        self._load()

    def _migrate(self) -> None:
        """Bring a database of an earlier version up to date."""
        with self._transaction():
            if "seen" in {name for _, name, *_ in self._db.execute("pragma table_info(participants)")}:
                self._count_from_stamps()

    def _count_from_stamps(self) -> None:
        """Compute the time that participants have used from dates, as versions before 0.3 stored them.

        It is the time between a participant's rows. A gap in which they would have dropped out, had the study been
        served, is the server's and does not count, nor does a step of the clock.
        """
        times: dict[int, list[float]] = {}
        for number, at in self._db.execute("select participant, at from rows"):
            times.setdefault(number, []).append(at)
        used, longest = {}, self.design.dropout.idle_minutes * 60
        for number, joined, seen, ended in self._db.execute("select number, joined, seen, ended from participants"):
            stamps = sorted([joined, *times.get(number, ()), seen if ended is None else ended])
            used[number] = sum(b - a for a, b in pairwise(stamps) if b - a <= longest)
        self._db.execute("alter table participants rename to stamped")
        self._db.execute(_TABLES.partition(";")[0])
        self._db.execute(
            "insert into participants select number, id, place, status, reason, joined, 0, 0, ended, language, consent, ids "
            "from stamped"
        )
        self._db.execute("drop table stamped")
        self._db.executemany("update participants set used = ? where number = ?", [(s, n) for n, s in used.items()])

    def _load(self) -> None:
        rows: dict[int, dict[str, Any]] = {}
        times: dict[int, dict[str, float]] = {}
        for number, stage, at, data in self._db.execute("select participant, stage, at, data from rows order by at"):
            rows.setdefault(number, {})[stage] = msgspec.json.decode(data)
            times.setdefault(number, {})[stage] = at
        for (
            number,
            pseudonym,
            place,
            status,
            reason,
            joined,
            used,
            idle,
            ended,
            language,
            consent,
            ids,
        ) in self._db.execute(
            "select number, id, place, status, reason, joined, used, idle, ended, language, consent, ids from participants"
        ):
            progress = Progress(self.design, self.places[place], rows.get(number, {}), status, reason)
            self.participants[number] = Participant(
                number=number,
                id=pseudonym,
                place=place,
                joined=joined,
                used=used,
                idle=idle,
                ended=ended,
                language=language,
                consent=msgspec.json.decode(consent),
                ids=msgspec.json.decode(ids),
                progress=progress,
                times=times.get(number, {}),
            )
        for game in self.games.values():  # killed between the end of an episode and its row
            players = self.players(game) if game.over else ()
            for participant in players:
                result = {"ended": game.over, **pair_entry(players)}
                self.save(participant, participant.progress.over(game.key.partition("/")[2], result))

    # --- participants -------------------------------------------------------------------------------------------------
    def by_id(self, pseudonym: str) -> Participant | None:
        """Return the participant with a pseudonym."""
        return next((p for p in self.participants.values() if p.id == pseudonym), None)

    def free_place(self) -> int | None:
        """Return the first free place; places of people who dropped out are free again.

        In a study of pairs, a place stays empty if the participant at the other place of the pair has started to play
        with the person who has left.
        """
        taken = {p.place for p in self.participants.values() if p.progress.status in (ACTIVE, COMPLETE)}
        return next((k for k in range(len(self.places)) if k not in taken and self._is_open(k)), None)

    def _is_open(self, place: int) -> bool:
        other = self._last_at(place ^ 1) if self.design.has_pairs else None
        if other is None or other.progress.status not in (ACTIVE, COMPLETE):
            return True
        return other.is_active and not other.progress.has_met and self.shared_game(other) is None

    def _last_at(self, place: int) -> Participant | None:
        """Return the last holder of a place."""
        return max((p for p in self.participants.values() if p.place == place), key=lambda p: p.number, default=None)

    # --- pairs --------------------------------------------------------------------------------------------------------
    def company(self, participant: Participant) -> Participant | None:
        """Return the other participant of a pair, the current or last holder of the pair's other place."""
        return self._last_at(participant.place ^ 1) if self.design.has_pairs else None

    def players(self, game: Game) -> tuple[Participant, ...]:
        """Return the participants who play a game, in the order of its seats.

        In a pair, the participant with the even place is first.
        """
        first = self.participants.get(game.place)
        if first is None:
            return ()
        second = self.company(first) if first.progress.is_shared(game.key.partition("/")[2]) else None
        return (first,) if second is None else (first, second)

    def shared_game(self, participant: Participant) -> Game | None:
        """Return the running game of a participant, which may be stored with the other member of the pair."""
        game = self.open_game(participant.number)
        other = self.company(participant) if game is None else None
        game = self.open_game(other.number) if other is not None else game
        return game if game is not None and participant in self.players(game) else None

    def join(
        self, pseudonym: str, place: int, *, language: str, consent: dict[str, str], ids: dict[str, str]
    ) -> Participant:
        """Add a participant who has consented."""
        self.count_time()
        now = time.time()
        number = 1 + self._last_number()
        participant = Participant(
            number=number,
            id=pseudonym,
            place=place,
            joined=now,
            used=0.0,
            idle=0.0,
            language=language,
            consent=consent,
            ids=ids,
            progress=Progress(self.design, self.places[place]),
        )
        with self._transaction():
            self._db.execute(
                "insert into participants values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (number, pseudonym, place, ACTIVE, "", now, 0.0, 0.0, None, language, _json(consent), _json(ids)),
            )
            self.count("last number", number - self._last_number())
        self.participants[number] = participant
        return participant

    def _last_number(self) -> int:
        """Return the number of the last participant; numbers of forgotten people are not given again."""
        return self.counted("last number")

    def count(self, name: str, by: int = 1) -> None:
        """Increase the counter of an event that belongs to no participant."""
        self._db.execute(
            "insert into counts values (?, ?) on conflict (name) do update set value = value + excluded.value",
            (name, by),
        )

    def counted(self, name: str) -> int:
        """Return the counter of an event."""
        row = self._db.execute("select value from counts where name = ?", (name,)).fetchone()
        return 0 if row is None else int(row[0])

    def saw(self, participant: Participant) -> None:
        """Record that a participant was active now."""
        self.count_time()
        if participant.is_active:
            participant.idle = 0.0
            self._db.execute(
                "update participants set used = ?, idle = 0 where number = ?", (participant.used, participant.number)
            )

    def count_time(self) -> None:
        """Add the time since the last call to the time of all active participants.

        It is called every few seconds; `keep_time` writes the times to the disk.
        """
        now = self._clock()
        passed, self._counted = now - self._counted, now
        if 0 < passed <= GAP_S:
            for participant in self.participants.values():
                if participant.is_active:
                    participant.used += passed
                    participant.idle += passed

    def keep_time(self) -> None:
        """Store the time that active participants have used."""
        now = [(p.used, p.idle, p.number) for p in self.participants.values() if p.is_active]
        with self._transaction():
            self._db.executemany("update participants set used = ?, idle = ? where number = ?", now)

    def save(self, participant: Participant, rows: dict[str, dict[str, Any]]) -> None:
        """Write new rows and the status of a participant in one transaction."""
        self.count_time()
        try:
            self._save(participant, rows)
        except sqlite3.Error:  # what is not on the disk has not happened
            self._restore(participant)
            raise

    def _restore(self, participant: Participant) -> None:
        """Bring a participant back to what is on the disk."""
        progress = participant.progress
        progress.rows.clear()
        participant.times.clear()
        for stage, at, data in self._db.execute(
            "select stage, at, data from rows where participant = ? order by at, rowid", (participant.number,)
        ):
            progress.rows[stage], participant.times[stage] = msgspec.json.decode(data), at
        ((progress.status, progress.reason, participant.ended),) = self._db.execute(
            "select status, reason, ended from participants where number = ?", (participant.number,)
        )

    def _save(self, participant: Participant, rows: dict[str, dict[str, Any]]) -> None:
        now, progress = time.time(), participant.progress
        if not participant.is_active and participant.ended is None:
            participant.ended = now
        with self._transaction():
            for stage, data in rows.items():
                participant.times[stage] = now
                self._db.execute(
                    "insert or replace into rows values (?, ?, ?, ?)", (participant.number, stage, now, _json(data))
                )
            self._db.execute(
                "update participants set status = ?, reason = ?, ended = ?, used = ?, idle = ? where number = ?",
                (
                    progress.status,
                    progress.reason,
                    participant.ended,
                    participant.used,
                    participant.idle,
                    participant.number,
                ),
            )

    def _transaction(self) -> _Transaction:
        return _Transaction(self._db)

    def forget(self, participant: Participant) -> dict[str, int]:
        """Delete a participant and overwrite the data; return the number of deleted entries of each kind."""
        removed = self.remove(participant)
        self._db.execute("vacuum")
        return removed

    def remove(self, participant: Participant) -> dict[str, int]:
        """Delete a participant's data without shrinking the file, so that games are not interrupted.

        Use `forget` to overwrite the data as well.
        """
        number = participant.number
        removed: dict[str, int] = {}
        other = self.company(participant)
        with self._transaction():
            for stage, data in other.progress.rows.items() if other is not None else ():
                if other is not None and participant.id in data.get("pair", ()):
                    data["pair"] = ["" if who == participant.id else who for who in data["pair"]]
                    self._db.execute(
                        "update rows set data = ? where participant = ? and stage = ?",
                        (_json(data), other.number, stage),
                    )
            for what, statement in (
                ("participants", "delete from participants where number = ?"),
                ("rows", "delete from rows where participant = ?"),
                ("seats", "delete from seats where place = ?"),
                ("games", "delete from games where place = ?"),
            ):
                removed[what] = self._db.execute(statement, (number,)).rowcount
        del self.participants[number]
        self.seats = {sid: seat for sid, seat in self.seats.items() if seat.place != number}
        self.games = {key: game for key, game in self.games.items() if game.place != number}
        return removed

    # --- seats --------------------------------------------------------------------------------------------------------
    def seat_of(self, participant: Participant) -> Seat | None:
        """Return the seat of a participant."""
        return self.taken(participant.number, 0)

    def move(self, participant: Participant, token: str) -> Seat:
        """Give a participant a new seat for the browser that holds ``token``; the old seat becomes invalid."""
        old = self.seat_of(participant)
        return self.sit(token, participant.number, 0) if old is None else self.hand_over(old, token)

    def begin_episode(self, participant: Participant, key: str) -> Game:
        """Start an episode and return its game."""
        game = Game(key, participant.number, 0)
        self._db.execute("insert into games values (?, ?, ?, ?)", (key, game.place, 0, ""))
        self.games[key] = game
        return game


def pair_entry(players: Sequence[Participant]) -> dict[str, list[str]]:
    """Return the entry that the row of an episode has about two participants who played it together."""
    return {"pair": [player.id for player in players]} if len(players) > 1 else {}


class _Transaction:
    """All or nothing."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def __enter__(self) -> None:
        self._db.execute("begin immediate")

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self._db.execute("commit")
        finally:
            if self._db.in_transaction:  # a full disk may have rolled it back already
                self._db.execute("rollback")


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()
