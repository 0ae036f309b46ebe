"""Seats of players, the tokens by which browsers own them, and a journal of both on the disk.

With the journal, players keep their seats when the server is killed.
"""

from __future__ import annotations

import hashlib
import secrets
import sqlite3
import time
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

JOURNAL = "seats.sqlite"
_TABLES = """
create table if not exists links (number integer primary key, key text not null);
create table if not exists seats (
    sid text primary key, token text not null, place integer not null, number integer not null, game text not null
);
create table if not exists games (key text primary key, place integer not null, episode integer not null, over text not null);
"""


@dataclass(eq=False)
class Seat:
    """Seat of one browser at a table."""

    sid: str
    token: str
    """Digest of the browser's cookie."""
    place: int
    """Number of the table at which the seat is."""
    number: int
    """Index into `PlayPlan.seats`."""
    game: str
    """Key of the game to which the seat was last assigned."""


@dataclass(eq=False)
class Game:
    """Game at a table that has started."""

    key: str
    place: int
    episode: int
    over: str = ""
    """Reason why the game has ended; empty while it continues."""


_BOOT = getattr(time, "CLOCK_BOOTTIME", None)


def uptime() -> float:
    """Return the time of a monotonic clock [s], which includes time in suspend if the system has such a clock."""
    return time.monotonic() if _BOOT is None else time.clock_gettime(_BOOT)


def new_token() -> str:
    """Return a new secret of 192 random bits."""
    return secrets.token_urlsafe(24)


def token_digest(token: str) -> str:
    """Return the digest of a token for the journal; a reader of the journal cannot take a seat with it."""
    return hashlib.sha256(token.encode()).hexdigest()


@dataclass
class SeatLog:
    """Journal of the seats and games of a folder, in memory and in an SQLite file.

    Every change is on the disk before it is in memory.
    """

    folder: Path
    name: str = JOURNAL
    """Name of the journal's file."""
    read_only: bool = False
    """True if changes are made to a copy in memory only, because the file may belong to another process."""
    seats: dict[str, Seat] = field(default_factory=dict)
    games: dict[str, Game] = field(default_factory=dict)
    links: list[str] = field(default_factory=list)
    """Secret key in the link of each of `PlayPlan.seats`."""

    def __post_init__(self) -> None:
        # one process writes; a commit is with the operating system before a browser hears of it, so that it outlives this
        # process. To wait for the disk as well stops all players for 30 ms (a log that is written ahead stays whole anyway)
        self._db = sqlite3.connect(":memory:" if self.read_only else self.folder / self.name, isolation_level=None)
        if self.read_only:
            with closing(sqlite3.connect(f"{(self.folder / self.name).resolve().as_uri()}?mode=ro", uri=True)) as file:
                file.backup(self._db)
        else:
            self._db.executescript("pragma journal_mode = wal; pragma synchronous = normal;")
        self._db.executescript(_TABLES)
        for sid, token, place, number, game in self._db.execute("select sid, token, place, number, game from seats"):
            self.seats[sid] = Seat(sid, token, place, number, game)
        for key, place, episode, over in self._db.execute("select key, place, episode, over from games"):
            self.games[key] = Game(key, place, episode, over)
        self.links = [key for _, key in self._db.execute("select number, key from links order by number")]

    def make_links(self, count: int) -> None:
        """Create ``count`` secret keys for links, unless the folder already has them."""
        for number in range(len(self.links), count):
            link = secrets.token_urlsafe(9)
            self._db.execute("insert into links values (?, ?)", (number, link))
            self.links.append(link)

    def sit(self, token: str, place: int, number: int) -> Seat:
        """Add a new seat for the browser that will hold ``token``."""
        seat = Seat(secrets.token_hex(8), token_digest(token), place, number, "")
        self._db.execute("insert into seats values (?, ?, ?, ?, ?)", (seat.sid, seat.token, place, number, ""))
        self.seats[seat.sid] = seat
        return seat

    def hand_over(self, seat: Seat, token: str) -> Seat:
        """Give the seat to another browser, which will hold ``token``; the previous browser loses access."""
        new = Seat(secrets.token_hex(8), token_digest(token), seat.place, seat.number, seat.game)
        self._db.execute("update seats set sid = ?, token = ? where sid = ?", (new.sid, new.token, seat.sid))
        del self.seats[seat.sid]
        self.seats[new.sid] = new
        return new

    def assign(self, seat: Seat, game: Game) -> None:
        """Store the game to which a seat is now assigned."""
        self._db.execute("update seats set game = ? where sid = ?", (game.key, seat.sid))
        seat.game = game.key

    def begin(self, place: int) -> Game:
        """Start the next episode at a table."""
        episode = len(self.games)
        game = Game(f"{episode:06d}", place, episode)
        self._db.execute("insert into games values (?, ?, ?, ?)", (game.key, place, episode, ""))
        self.games[game.key] = game
        return game

    def end(self, game: Game, why: str) -> None:
        """Store that a game has ended, and the reason."""
        self._db.execute("update games set over = ? where key = ?", (why, game.key))
        game.over = why

    def open_game(self, place: int) -> Game | None:
        """Return the game that is running at a table."""
        return next((game for game in self.games.values() if game.place == place and not game.over), None)

    def owner(self, token: str, number: int) -> Seat | None:
        """Return the seat with this number whose owner has a token; None if there is none."""
        digest = token_digest(token)
        return next((s for s in self.seats.values() if s.token == digest and s.number == number), None)

    def taken(self, place: int, number: int) -> Seat | None:
        """Return the holder of seat ``number`` at a table."""
        return next((s for s in self.seats.values() if (s.place, s.number) == (place, number)), None)

    def close(self, *, done: bool) -> None:
        """Close the journal; delete it if everything is ``done``."""
        self._db.close()
        if done:
            (self.folder / self.name).unlink(missing_ok=True)
