"""Process that plays many games, each at its own phase of the 30 steps per second.

The web server runs it as ``python -m h3data_play.worker FD``.
"""

from __future__ import annotations

import contextlib
import gc
import gzip
import logging
import signal
import socket
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from h3data.errors import H3DataError, InputError, with_code
from h3data.recording import Recording, pack_mcap, write_mcap
from h3data.scene.articulation import joints_of
from h3data_play import assets
from h3data_play.channel import Channel, Closed
from h3data_play.live import EpisodeFactory, LiveGame, disk_fault
from h3data_play.messages import (
    PERIOD_S,
    Act,
    Answer,
    Bring,
    Chore,
    Close,
    Drop,
    GoTo,
    Hand,
    Head,
    Leave,
    Move,
    Open,
    Pick,
    Place,
    Sit,
    Use,
    decode,
)
from h3data_play.plan import GameOrder, PlayPlan, prepared_key

MOST_BEHIND = 3
"""Largest number of steps that a late game catches up at once; a later game skips steps, which the recording states."""
MOST_WAITING = 200
"""Largest number of messages of one game that wait for their step."""
FARTHEST_STEPS = 15
"""Largest number of steps by which a message can be ahead; one that is meant for a later step takes effect then."""
WHOLE_EVERY = 30
"""Number of steps between states with all objects; other states contain only objects that have moved."""
PLAN_STEPS = 6
"""Number of steps between two searches for a path to an object; each may take 50 ms of the worker that all players
share."""
BEGIN_S = 2.0
"""Time after which a game starts even if some players are late [s]."""
MOST_AHEAD = 12
"""Number of episodes whose homes are built in advance."""
REPORT_S = 1.0
LEFT_S = 60.0
"""Time without connected players after which a game counts as left [s]; it is longer than a page takes to load."""
MEASURED_STEPS = 60
DISK_S = 1.0
"""Time between attempts to write data that a full disk did not accept [s]."""
DISK_FULL = "The disk of the server is full. The home stands still until there is space again; nothing is lost."
ANSWER_S = 120.0
"""Time limit for players' answers to the question at the end of an episode [s]."""
HUD_S = 10.0
"""Time between two messages about the remaining time [s]."""

log = logging.getLogger("h3data.hitl.worker")


@dataclass
class Running:
    """Running game of a worker with its clock."""

    key: str
    game: LiveGame
    began: float = field(default_factory=time.monotonic)
    due: float = 0.0
    stepped: float = field(default_factory=time.monotonic)
    """Monotonic time of the latest step, or of the start of the game [s]."""
    here: set[int] = field(default_factory=set)
    """Numbers of agents whose players are connected; -1: spectators."""
    waiting: deque[tuple[int, int, Act, str, float]] = field(default_factory=deque)
    """Messages that wait for their step, as agent, step, message, text and time of arrival."""
    whole: bool = True
    over: bool = False
    seconds: float = 0.0
    """CPU time of the game's steps [s]."""
    latest_s: deque[float] = field(default_factory=lambda: deque(maxlen=MEASURED_STEPS))
    """CPU times of the latest steps, including packing and sending [s]."""
    huds: dict[int, Any] = field(default_factory=dict)
    barriers: dict[int, Any] = field(default_factory=dict)
    chores: dict[int, Any] = field(default_factory=dict)
    seen: dict[int, Any] = field(default_factory=dict)
    """State of the page's status line, barriers, chores and seen objects as last sent to each player, by agent."""
    floors: dict[int, Any] = field(default_factory=dict)
    """Floor that was last sent to each player; None if the page's floor is unknown, and no entry if it never changed."""
    is_stuck: bool = False
    """True if the game waits for space on the disk, and the front has been informed."""
    recording: Recording | None = None
    """Recording of the game once it is over; its end may still have to be written."""
    planned: dict[int, int] = field(default_factory=dict)
    """Step at which each player last asked to be guided to an object, by agent."""
    heard: dict[int, int] = field(default_factory=dict)
    """Number of agents' messages that have been sent to each player, by agent."""
    left: int = -1
    """Number of the agent whose player ended the game by leaving it; -1 if no player did."""
    asked: dict[int, float] = field(default_factory=dict)
    """Times at which the final question was asked, by the players who have not answered it yet."""

    @property
    def clock_ms(self) -> float:
        """Time since the game began [ms]."""
        return (time.monotonic() - self.began) * 1e3

    @property
    def runs(self) -> bool:
        """Return whether all players are connected and the disk accepts the data."""
        ended = self.over or bool(self.game.ended)
        return not ended and not self.is_stuck and all(number in self.here for number in self.game.drivers)

    @property
    def is_left(self) -> bool:
        """Return whether the game has stood still for `LEFT_S` because its players have closed their pages."""
        return not self.runs and time.monotonic() - self.stepped > LEFT_S


class Worker:
    """Worker process that plays games; an error in one game ends only that game."""

    def __init__(self, channel: Channel, plans: Sequence[PlayPlan]) -> None:
        self.channel = channel
        self.plans, self.tables = plans, {0: EpisodeFactory(plans[0])}
        self.period = PERIOD_S / plans[0].speed if plans[0].speed else 0.0
        self.games: dict[str, Running] = {}
        self.stops, self.finishes = False, True
        self._reported = time.monotonic()
        self._prepared: dict[tuple[int, int], dict[str, Any]] = {}
        self._homes_ahead = self.homes_ahead()
        self._waiting: deque[tuple[str, dict[str, Any], float]] = deque()
        """Games that are about to begin: key, order, and time since which they wait."""
        self._no_room: dict[str, dict[str, Any]] = {}
        """Orders of games that cannot begin because the disk is full."""
        self._tried = time.monotonic()

    def table(self, number: int) -> EpisodeFactory:
        """Return the episode factory of plan ``number``."""
        if number not in self.tables:
            self.tables[number] = EpisodeFactory(self.plans[number])
        return self.tables[number]

    def made(self, plan: int, index: int) -> dict[str, Any]:
        """Return the manifest, GLB and distance grid of an episode, compressed, and the data that its end needs.

        The result is cached.
        """
        if (plan, index) not in self._prepared:
            table = self.table(plan)
            game = LiveGame(table, index)
            grid, entry = assets.distance_grid(game.session)
            glb = assets.world_glb(game.session)
            prepared = {
                "manifest": assets.manifest(game.session, game.app, entry),
                "glb": [f"{assets.digest(glb)}.glb", gzip.compress(glb, 6, mtime=0)],
                "grid": [entry["url"].rpartition("/")[2], gzip.compress(grid, 6, mtime=0)],
                "agents": list(table.numbers),
                "facts": table.task.codec.precompute(game.session.episode),
            }
            game.abort()
            self._prepared = {(plan, index): prepared} | dict(list(self._prepared.items())[:7])
        return self._prepared[plan, index]

    def warm_up(self) -> None:
        """Compile or load all kernels, and prepare the first episode.

        Raises:
            H3DataError: one of the plans cannot be played.
        """
        kinds: set[tuple[Any, ...]] = set()
        for number, plan in enumerate(self.plans):
            kind = plan.app, plan.seats, plan.partner, repr(plan.rules)
            if kind not in kinds:  # plans that differ in their homes run the same kernels
                kinds.add(kind)
                self.made(number, 0)
                rehearse(self.table(number))
        # all that is alive now stays: the collector need not look at it 30 times a second
        gc.collect()
        gc.freeze()

    # --- the loop -----------------------------------------------------------------------------------------------------
    def run(self) -> None:
        """Serve until the process is asked to stop or the front process has gone."""
        while not self.stops:
            now = time.monotonic()
            due = min((r.due for r in self.games.values() if r.runs), default=now + 0.5)
            letters = self.channel.receive(0.0 if self._waiting else min(due - now, REPORT_S))
            for kind, key, body in letters:
                if kind == "begin":
                    self._waiting.append((key, body, time.monotonic()))
                else:
                    self.guarded(key, _HANDLERS[kind], body)
            for running in sorted(self.games.values(), key=lambda running: running.due):
                if running.runs and running.due <= time.monotonic():
                    self.guarded(running.key, Worker.step, None)
            if self._waiting:
                self.begin_next()
            elif not letters and not any(running.runs for running in self.games.values()):
                next(self._homes_ahead, None)
            self.try_disk()
            self.end_unanswered()
            self.report()

    def try_disk(self) -> None:
        """Continue, end or start games that wait for space on the disk, if there is some."""
        now = time.monotonic()
        if now - self._tried < DISK_S:
            return
        self._tried = now
        for running in [running for running in self.games.values() if running.is_stuck]:
            self.guarded(running.key, Worker.go_on, None)
        waiting = {key for key, *_ in self._waiting}
        self._waiting += [(key, body, now) for key, body in self._no_room.items() if key not in waiting]

    def begin_next(self) -> None:
        """Start the game that has waited longest, if no other game is late.

        A start takes as long as three steps, and several at once would stop the running games.
        """
        now = time.monotonic()
        key, body, since = self._waiting[0]
        if now - since > BEGIN_S or all(not running.runs or running.due > now for running in self.games.values()):
            del self._waiting[0]
            self.guarded(key, Worker.begin, body)

    def homes_ahead(self) -> Iterator[None]:
        """Build the homes of each plan's first episodes, one per iteration.

        Each takes half a second, which is available while no game is running.
        """
        for number, plan in enumerate(self.plans):
            source = self.table(number).source
            for index in range(min(plan.episodes, MOST_AHEAD)):
                home = source.homes[source.home_of(plan.seed, index)]
                if not home.is_ready:
                    with contextlib.suppress(H3DataError):  # when the episode begins, its player gets a message
                        _ = home.scene, home.free
                    yield

    def guarded(self, key: str, act: Callable[..., None], body: Any) -> None:
        """Run a function for one game; an error there ends only that game, whose log can be recovered."""
        try:
            act(self, key, body)
        except Closed:
            raise
        except Exception as fault:
            log.exception("game %s failed", key)
            running = self.games.pop(key, None)
            self._no_room.pop(key, None)
            if running is not None:
                running.game.abort()
            text = with_code(fault) if isinstance(fault, H3DataError) else f"{type(fault).__name__}: {fault}"
            self.channel.send("failed", key, text)

    def _free_time(self, newcomer: Running) -> float:
        """Return the time at which a new game should take its first step.

        It is the middle of the longest interval in which no other game takes a step, so that a long step of one game
        delays few others.
        """
        now, period = time.monotonic(), self.period
        taken = sorted((r.due - now) % period for r in self.games.values() if period and r.runs and r is not newcomer)
        if not taken:
            return now + period
        gaps = [b - a for a, b in pairwise([*taken, taken[0] + period])]
        longest = gaps.index(max(gaps))
        return now + period + (taken[longest] + gaps[longest] / 2) % period

    def report(self) -> None:
        """Report once a second which share of a core the games use.

        The share is CPU time with the median step of each game, so that neither other programs nor a single planning
        step turn players away. Games that all players have left do not count.
        """
        now = time.monotonic()
        if now - self._reported < REPORT_S:
            return
        counted = [running for running in self.games.values() if not running.is_left]
        steps = [median(running.latest_s) for running in counted if running.latest_s]
        busy = sum(steps) / self.period if self.period else 0.0
        self.channel.send("load", "", {"busy": busy, "games": len(steps), "left": len(self.games) - len(counted)})
        self._reported = now

    def close_all(self, *, finish: bool) -> None:
        """Finish all recordings, or leave them as logs that a later process can continue."""
        closed = []
        for running in self.games.values():
            try:
                if not finish:
                    running.game.abort()
                elif running.over or running.game.close() is not None:
                    running.game.retry()
                    if not running.game.fault:
                        closed.append(running.game)
                        continue
                    log.warning(
                        "%s is not finished (%s); the same command goes on with it", running.key, running.game.fault
                    )
                    running.game.abort()
            except Exception:
                log.exception("game %s could not be closed", running.key)
        self.games.clear()
        for game in closed:  # only now: every recording is whole already
            self.guarded("", Worker.pack, {"path": str(game.path), "share_in": game.share_in})

    # --- letters of the front -----------------------------------------------------------------------------------------
    def prepare(self, key: str, body: dict[str, Any]) -> None:
        """Send the files that pages need to show an episode."""
        self.channel.send("prepared", key, self.made(int(body["plan"]), int(body["index"])))

    def begin(self, key: str, body: dict[str, Any]) -> None:
        """Start or continue a game, or report the end of a game that had ended when the server was killed."""
        order = msgspec.convert(body, GameOrder)
        if order.facts is None and key not in self._no_room:
            self.prepare(prepared_key(order), {"plan": order.plan, "index": order.index})
        try:
            ended = self.table(order.plan).finished(order) if order.resumes else None
            if ended is not None:  # its end had not been noted when the server was killed
                self._no_room.pop(key, None)
                self.channel.send("over", key, ended)
                return
            game = self.table(order.plan).begin(order)
        except (H3DataError, OSError) as fault:
            why = disk_fault(fault)
            if not why:
                raise
            if key not in self._no_room:
                self._no_room[key] = body
                self.channel.send("stuck", key, {"why": why, "text": DISK_FULL})
            return
        self._no_room.pop(key, None)
        running = self.games[key] = Running(key, game)
        self.channel.send("begun", key, {"steps": len(game.session.recorder)})
        self._note_disk(running)
        if game.ended:  # the process before was killed between the last step and the end
            self._end(running)

    def _note_disk(self, running: Running) -> None:
        """Note that the disk does not accept the data of a game, which stands still."""
        if running.game.fault and not running.is_stuck:
            running.is_stuck = True
            self.channel.send("stuck", running.key, {"why": running.game.fault, "text": DISK_FULL})
            self._tell_pause(running)

    def go_on(self, key: str, body: Any) -> None:
        """Try again to write the rest of a game to the disk."""
        running = self.games[key]
        running.game.retry()
        if running.game.fault:
            return
        running.is_stuck = False
        self.channel.send("free", key, {})
        if running.over:
            self._say_over(running)
            return
        running.due = self._free_time(running)
        self._tell_pause(running, goes_on=True)

    def here(self, key: str, body: dict[str, Any]) -> None:
        """Handle a player who has connected or left; the world stands still until all players are connected."""
        running = self.games.get(key)
        if running is None or running.over:
            return
        number, here, ran = int(body["agent"]), bool(body["here"]), running.runs
        if number in running.game.drivers and here != (number in running.here):
            running.game.connected(number, here)
        (running.here.add if here else running.here.discard)(number)
        running.whole = True
        running.huds.pop(number, None)
        running.barriers.pop(number, None)
        running.chores.pop(number, None)
        running.seen.pop(number, None)
        running.heard.pop(number, None)
        if number in running.floors:
            running.floors[number] = None  # the page may have been loaded again
        if running.runs and not ran:
            running.due = self._free_time(running)
        if not running.runs and running.game.packed is not None:
            self._send_states(running)
        self._tell_pause(running)
        if here and number in running.asked:
            self.channel.send("told", key, [number, {"question": running.game.app.question}])

    def input(self, key: str, body: list[Any]) -> None:
        """Queue a message of a player until its step."""
        running = self.games.get(key)
        number, text, arrived = body
        if running is None or running.over or (len(running.waiting) >= MOST_WAITING and not running.is_stuck):
            return
        message = decode(text)
        assert isinstance(message, Act)
        if isinstance(message, Leave):
            self._take(running, number, message, text, arrived)
            running.left = number
            self.finish(running)
            return
        if running.asked:
            if number in running.asked and isinstance(message, Answer):
                self._take(running, number, message, text, arrived)
                del running.asked[number]
                if not running.asked:
                    self.finish(running)
            return
        now = len(running.game.session.recorder)
        if running.is_stuck:  # nothing is done later that was asked for now; but which keys are down has to be known
            if isinstance(message, Move):
                others = (w for w in running.waiting if w[0] != number or not isinstance(w[2], Move))
                running.waiting = deque([*others, (number, now, message, text, arrived)])
            return
        step = now if message.step is None else min(message.step - 1, now + FARTHEST_STEPS)
        running.waiting.append((number, step, message, text, arrived))

    def can(self, key: str, body: list[Any]) -> None:
        """Answer whether an action is possible; nothing happens and nothing is recorded."""
        running = self.games.get(key)
        number, point = body
        if running is None or running.over or number not in running.game.drivers:
            return
        try:
            reply = {"why": running.game.drivers[number].can_place(point)}
        except InputError as fault:
            reply = {"why": str(fault), "code": fault.code}
        self.channel.send("told", key, [number, {"can": {"p": point, **reply}}])

    def pack(self, key: str, body: dict[str, str]) -> None:
        """Send a finished recording to the front process, where packing it does not delay games."""
        if Path(body["path"]).is_file():  # else it has been deleted meanwhile
            pack_mcap(Path(body["path"]), share_in=body["share_in"])

    def stop(self, key: str, body: Any) -> None:
        """Finish all recordings, or leave them as logs, and end the process."""
        self.stops, self.finishes = True, bool(body["finish"])

    # --- steps --------------------------------------------------------------------------------------------------------
    def step(self, key: str, body: Any) -> None:
        """Play one step of a game with the messages that have arrived for it."""
        running = self.games[key]
        game, cpu = running.game, time.process_time()
        now = len(game.session.recorder)
        later: deque[tuple[int, int, Act, str, float]] = deque()
        for number, step, message, text, arrived in running.waiting:
            # a player's later messages never overtake earlier ones
            if step > now or any(other[0] == number for other in later):
                later.append((number, step, message, text, arrived))
            else:
                self._take(running, number, message, text, arrived)
        running.waiting = later
        for number, why in game.step().items():
            self.channel.send("told", key, [number, {"why": why}])
        running.seconds += time.process_time() - cpu
        self._send_states(running)
        running.due += self.period
        behind = time.monotonic() - running.due
        if self.period and behind > MOST_BEHIND * self.period:
            steps = int(behind / self.period)
            game.slip(steps)
            running.due += steps * self.period
        if game.ended:
            self._end(running)
        else:
            self._note_disk(running)
        running.stepped = time.monotonic()
        running.latest_s.append(time.process_time() - cpu)

    def _take(self, running: Running, number: int, message: Act, text: str, arrived: float) -> None:
        if isinstance(message, Bring | Chore) or (
            isinstance(message, Pick | Place | Use | Open | Close) and message.lead
        ):
            now, before = len(running.game.session.recorder), running.planned.get(number, -PLAN_STEPS)
            if now - before < PLAN_STEPS:
                return
            running.planned[number] = now
        try:
            reply = {"why": running.game.take(number, message, text, arrived)}
        except InputError as fault:  # no command: it has not been recorded
            reply = {"why": str(fault), "code": fault.code}
        if reply["why"]:
            self.channel.send("told", running.key, [number, reply])

    def _send_states(self, running: Running) -> None:
        game, clock = running.game, running.clock_ms
        whole = running.whole or len(game.session.recorder) % WHOLE_EVERY == 0
        states = [[number, game.state(number, clock, whole=whole)] for number in sorted(running.here)]
        running.whole = False
        if states:
            self.channel.send("state", running.key, states)
        for number in running.here:
            barriers = game.barriers(number)
            if running.barriers.get(number, []) != barriers:
                running.barriers[number] = barriers
                self.channel.send("told", running.key, [number, {"barriers": barriers}])
            seen = game.seen(number)
            if running.seen.get(number) != seen:
                running.seen[number] = seen
                self.channel.send("told", running.key, [number, {"seen": seen}])
            driver = game.drivers.get(number)
            chores = [] if driver is None else driver.chores
            if running.chores.get(number, []) != chores:
                running.chores[number] = chores
                self.channel.send("told", running.key, [number, {"chores": chores}])
            heard, running.heard[number] = (
                running.heard.get(number, 0),
                len(getattr(game.session.play.team, "messages", ())),
            )
            if heard < running.heard[number]:
                self.channel.send("told", running.key, [number, {"said": game.messages(number, heard)}])
            if running.floors.get(number, game.session.episode.free) is not game.floor:
                running.floors[number] = game.floor
                self.channel.send("told", running.key, [number, {"floor": assets.floor_message(game.floor)}])
            hud = game.app.hud(number)
            # pages count the seconds down themselves
            words = (
                hud.task,
                hud.lines,
                hud.how,
                hud.marker,
                hud.uses,
                None if hud.left_s is None else hud.left_s // HUD_S,
            )
            if running.huds.get(number) != words:
                running.huds[number] = words
                self.channel.send("told", running.key, [number, {"hud": msgspec.to_builtins(hud)}])

    def _tell_pause(self, running: Running, *, goes_on: bool = False) -> None:
        """Inform connected players what the game waits for."""
        if len(running.game.drivers) < 2 and -1 not in running.here and not running.is_stuck and not goes_on:
            return
        if running.is_stuck:
            text = DISK_FULL
        elif all(number in running.here for number in running.game.drivers):
            text = ""
        else:
            text = "The world stands still until all players are here."
        for number in sorted(running.here):
            self.channel.send("told", running.key, [number, {"pause": text}])

    def _end(self, running: Running) -> None:
        """Begin the end of an episode: ask the players the app's question before the recording is closed."""
        game = running.game
        if game.app.question and game.ended != "skipped" and running.here & set(game.drivers):
            running.asked = dict.fromkeys(running.here & set(game.drivers), time.monotonic())
            for number in running.asked:
                self.channel.send("told", running.key, [number, {"question": game.app.question}])
        else:
            self.finish(running)

    def end_unanswered(self) -> None:
        """End the games whose players have not answered the question at the end in time."""
        for running in list(self.games.values()):
            if running.asked and time.monotonic() - max(running.asked.values()) > ANSWER_S:
                running.asked = {}
                self.guarded(running.key, lambda worker, _key, _body, running=running: worker.finish(running), None)

    def finish(self, running: Running) -> None:
        """Close the recording and inform the players, as soon as the disk accepts the data."""
        running.over = True
        running.recording = running.game.close()
        if running.game.fault:
            self._note_disk(running)
        else:
            self._say_over(running)

    def _say_over(self, running: Running) -> None:
        game, recording, steps = running.game, running.recording, len(running.game.session.recorder)
        del self.games[running.key]
        ended = recording.episode.info["ended"] if recording is not None else "closed"
        game.app.ended = game.app.ended or ended  # who leaves ends the recording, not the app
        over = {
            "ended": ended,
            "steps": steps,
            "slipped": game.slipped,
            "remarks": game.remarks,
            "agents": list(game.drivers),
            "left": running.left,
            "step_ms": round(running.seconds / max(steps, 1) * 1e3, 3),
            "path": "" if recording is None else str(game.path),
            "share_in": game.share_in,
            "texts": {str(number): game.app.over(number) for number in (*game.drivers, -1)},
        }
        self.channel.send("over", running.key, over)


_HANDLERS = {
    "prepare": Worker.prepare,
    "here": Worker.here,
    "input": Worker.input,
    "can": Worker.can,
    "pack": Worker.pack,
    "stop": Worker.stop,
}


def rehearse(table: EpisodeFactory) -> None:
    """Play an episode without players, to compile and load all kernels.

    Kernels that are loaded only when a player first walks, takes an object or gives way would stop a live world for a
    second each.
    """
    game = LiveGame(table, 0)
    for message, steps in (
        (Move(f=1.0, t=0.3), 20),
        (Hand(side="left", p=(0.3, 1.2, -0.2), q=(0.0, 0.0, 0.0, 1.0)), 3),
        (Hand(side="right", p=(0.3, 1.2, 0.2)), 3),
        (Head(yaw=0.2, pitch=0.1), 3),
        (Pick(o=0, lead=True), 150),
        (Drop(), 20),
        (Sit(), 150),
        (Open(j=0, lead=True), 90 if joints_of(game.session.episode.scene) else 0),
        (GoTo(p=(float(game.session.episode.starts[0, 0]), 0.0, float(game.session.episode.starts[0, 1]))), 60),
    ):
        for driver in game.drivers.values():
            with contextlib.suppress(InputError):  # not every task has things to take
                driver.take(message)
                driver.can_place((0.0, 1.0, 0.0))
        for _ in range(steps):
            if not game.ended:
                game.step()
                game.state(-1, 0.0, whole=True)
    recording = game.close()
    assert recording is not None
    with tempfile.TemporaryDirectory(prefix="h3data-") as folder:
        file = Path(folder, "rehearsal.mcap")
        write_mcap(recording, file)
        pack_mcap(file)


def main(descriptor: int) -> None:
    """Serve the front process over an inherited socket until either process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all processes; the front decides
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    channel = Channel(socket.socket(fileno=descriptor))
    try:
        letters = []
        while not letters:
            letters = channel.receive(10.0)
        plans = msgspec.convert(letters[0][2], list[PlayPlan])
        try:
            worker = Worker(channel, plans)
            worker.warm_up()
        except H3DataError as fault:
            channel.send("refused", "", {"text": str(fault), "code": fault.code})
            return
        channel.send("ready", "", {})
    except Closed:
        return
    try:
        worker.run()
    except Closed:  # the front was killed: a later one goes on with what is on the disk
        worker.close_all(finish=False)
        return
    worker.close_all(finish=worker.finishes)


if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="worker: %(levelname)s: %(message)s")
    main(int(sys.argv[1]))
