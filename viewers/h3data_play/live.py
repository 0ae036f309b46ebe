"""Live episode: one `Session`, a driver for each player, and a recording of all their messages as they were sent."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from h3data.errors import H3DataError, InputError
from h3data.recording import (
    STEP_NS,
    Event,
    InputEvent,
    Recording,
    RecordingHeader,
    RecordingWriter,
    SkillSpan,
    read_mcap,
    recover_mcap,
)
from h3data.recording.live_input import CLIENT, CONNECTED, DISCONNECTED, SLIP, rtt_column
from h3data.scene import FreeSpace
from h3data_play.app import App, find_app
from h3data_play.drivers import Driver
from h3data_play.messages import Act, Answer, End, Problem, Remark, decode
from h3data_play.plan import VERSION, GameOrder, PlayPlan
from h3data_play.wire import BUSY, ENDED, TOUCH, WALL, Columns, PackedStep, StatePacker
from sim_kinematic.agents.roster import HUMAN_BODY
from sim_kinematic.policies.assignment import AssignedPolicy, make_policy, resolve_policy
from sim_kinematic.policies.policy import External
from sim_kinematic.policies.recorded import recorded_commands
from sim_kinematic.tasks.episode import Episode, with_options
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.sessions import Session, StepResult
from sim_kinematic.tasks.sources import EpisodeSource

MOST_RTT_MS = 1e6
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)


def disk_fault(fault: BaseException | None) -> str:
    """Return a description of the disk error that caused an exception; empty if there is none."""
    while fault is not None:
        if isinstance(fault, OSError) and fault.errno in FULL:
            return fault.strerror or str(fault)
        fault = fault.__cause__ or fault.__context__
    return ""


class PatientSink:
    """Recording sink for a live game that waits while the disk accepts no data.

    The data stay in the writer, and the game waits until they are written.
    """

    def __init__(self, writer: RecordingWriter) -> None:
        self.writer, self.fault = writer, ""
        """``fault``: reason why the disk does not accept the waiting data; empty while it does."""
        self._info: dict[str, Any] | None = None

    def append(self, rows: dict[str, Any]) -> None:
        """Append steps; if the disk does not accept them, they stay in the writer."""
        self._try(partial(self.writer.append, rows))

    def event(self, event: Event) -> None:
        """Append an event."""
        self.writer.event(event)

    def skill(self, span: SkillSpan) -> int:
        """Append a skill and return its number."""
        return self.writer.skill(span)

    def input(self, event: InputEvent) -> None:
        """Append a raw input event."""
        self.writer.input(event)

    def close(self, *, info: dict[str, Any]) -> None:
        """Complete the recording as soon as the disk accepts it."""
        self._info = info
        self.retry()

    def abort(self) -> None:
        """End the recording early."""
        self.writer.abort()

    def retry(self) -> None:
        """Try again to write the data that wait."""
        info = self._info
        self._try(self.writer.flush if info is None else partial(self.writer.close, info=info))

    def _try(self, act: Callable[[], object]) -> None:
        try:
            act()
            self.fault = ""
        except InputError as fault:
            if not isinstance(fault.__cause__, OSError):
                raise
            self.fault = fault.__cause__.strerror or str(fault.__cause__)


class EpisodeFactory:
    """Source of the episodes of a plan within one process."""

    def __init__(self, plan: PlayPlan) -> None:
        """Load the app, task and scenes of a plan.

        Raises:
            InputError: there is no such app, task, scene, agent or policy.
        """
        self.app = find_app(plan.app)
        if plan.partner is None and plan.players.count("person") < 2:  # several people play among themselves
            plan = msgspec.structs.replace(plan, partner=self.app.partner)
        self.plan = plan
        self.task = find_task(self.app.task)
        rules = {name: tuple(value) if isinstance(value, list) else value for name, value in plan.rules.items()}
        self.spec = with_options(self.task.Spec(), **{**self.app.rules, **rules})
        self.roster = plan.roster(tuple(self.task.agents))
        body = plan.human or HUMAN_BODY
        human = body if plan.motion is None else f"{body}+{plan.motion}"
        self.source = EpisodeSource(self.task, plan.scenes, spec=self.spec, agents=self.roster, human=human)
        self.numbers = self._numbers()
        """Agent of each player, in the order of `PlayPlan.players`."""
        self.partnered = self._partnered()
        """Kinds of agents without a player that have the plan's policy; others have the task's default."""

    def _partnered(self) -> list[str]:
        plan, fits, faults = self.plan, [], []
        if plan.partner not in (None, "solo"):
            for kind in dict.fromkeys(kind for k, kind in enumerate(self.roster) if k not in self.numbers):
                try:
                    resolve_policy(self.task, kind, plan.partner_here or plan.partner, self.spec)
                    fits.append(kind)
                except InputError as fault:
                    faults.append(fault)
        if faults and not fits:
            raise faults[0]
        return fits

    def _numbers(self) -> tuple[int, ...]:
        numbers = []
        for k, seat in enumerate(self.plan.players):
            kind = "human" if seat == "person" else "robot"
            nth = self.plan.players[:k].count(seat)
            agents = [number for number, member in enumerate(self.roster) if member == kind]
            if nth >= len(agents):
                raise InputError(
                    f"Nobody can play as the {seat}: {self.plan.app} has {', '.join(self.roster)}.", code="H3-PLAY-022"
                )
            numbers.append(agents[nth])
        return tuple(numbers)

    def partner_of(self, episode: Episode, number: int) -> str | AssignedPolicy:
        """Return the policy of an agent without a player.

        Its name is that of the plan, because recordings must not contain paths of this machine.
        """
        plan = self.plan
        assert plan.partner is not None
        if plan.partner_here == plan.partner:
            return plan.partner
        assert plan.partner_here is not None
        return make_policy(self.task, episode, number, plan.partner_here)._replace(name=plan.partner)

    def episode(self, index: int) -> Episode:
        """Sample episode ``index``."""
        return self.source.sample(self.plan.seed, index)

    def finished(self, order: GameOrder) -> dict[str, Any] | None:
        """Return how an episode ended if its complete recording already exists; else None."""
        path = Path(self.plan.out, order.name + ".mcap")
        if not path.exists() or path.with_name(path.name + ".part").exists():
            return None
        recording = read_mcap(path)
        info = recording.episode.info
        return {
            "ended": info["ended"],
            "steps": len(recording),
            "slipped": info["hitl"]["slipped"],
            "remarks": info["hitl"].get("remarks", []),
            "agents": list(self.numbers),
            "step_ms": None,
            "path": str(path),
            "share_in": self.plan.out,
            "texts": {},
        }

    def begin(self, order: GameOrder) -> LiveGame:
        """Start an episode, or continue one that has an unfinished log."""
        path = Path(self.plan.out, order.name + ".mcap")
        path.parent.mkdir(parents=True, exist_ok=True)
        part, saved = path.with_name(path.name + ".part"), path.with_name(f".{path.name}.saved.mcap")
        recording = _unfinished(part, saved)
        game = LiveGame(self, order.index, path, order)
        if recording is not None:
            game.play_again(recording)
            game.leftover = saved
            game.retry()
        return game


def _unfinished(part: Path, saved: Path) -> Recording | None:
    """Return the steps that were played of an unfinished episode, from its log or from an earlier attempt.

    They are stored in ``saved`` until they are in the log again.

    Raises:
        InputError: there is no room to save them.
    """
    found, again = _read(saved), saved.with_name(f"{saved.stem}.again.mcap")
    if part.exists():
        try:
            recover_mcap(part, again, overwrite=True)
        except H3DataError as fault:
            if disk_fault(fault):
                raise
            if found is None:  # killed before anything was written
                os.replace(part, part.with_name(part.name + ".broken"))
        else:
            log = read_mcap(again)
            if found is None or len(log) > len(found):
                found = log
                os.replace(again, saved)
            again.unlink(missing_ok=True)
    return found


def _read(path: Path) -> Recording | None:
    try:
        return read_mcap(path) if path.exists() else None
    except H3DataError:
        return None


class LiveGame:
    """Episode that is being played live."""

    def __init__(
        self, table: EpisodeFactory, index: int, path: Path | None = None, order: GameOrder | None = None
    ) -> None:
        plan, episode = table.plan, table.episode(index)
        names = {episode.roster[k].name: External(interrupts_when_close=False) for k in table.numbers}
        policies: dict[str, Any] = dict(names)
        self.waited_for: dict[int, Any] = {}
        """Policies behind servers, by agent; the clock does not wait for them, and their commands are recorded like
        those of players."""
        for k, member in enumerate(episode.roster):
            if k in table.numbers or member.kind not in table.partnered:
                continue
            assigned = make_policy(table.task, episode, k, table.partner_of(episode, k))
            in_background = getattr(assigned.policy, "in_background", None)
            if in_background is not None:
                self.waited_for[k] = in_background()
                assigned = assigned._replace(policy=External(interrupts_when_close=False))
            policies[member.name] = assigned
        self._told_until = 0
        self._told: dict[int, dict[int, Any]] = {}
        """Recorded commands of policies behind servers by agent and step, while a game is played again."""
        self.sink: PatientSink | None = None
        self.leftover: Path | None = None
        """Recording that the game resumes, until its content is in its own log."""

        def sink(header: RecordingHeader) -> PatientSink:
            # one home is stored once for all episodes that are played in it
            # and the file is packed by a process in which nobody plays (`Worker.pack`)
            assert path is not None
            self.sink = PatientSink(RecordingWriter(path, header, overwrite=True, share_in=plan.out, compact=False))
            return self.sink

        info: dict[str, Any] = {"hitl": {"app": plan.app, "seats": list(plan.seats), "protocol": VERSION}}
        if plan.speed != 1:
            info["hitl"]["speed"] = plan.speed
        if order is not None:
            info = {**order.info, "hitl": {**info["hitl"], **order.hitl}}
        self.index, self.path, self.share_in, self.slipped = index, path, plan.out, 0
        if order is not None and order.facts:
            table.task.codec.load_precomputed(episode, order.facts)
        self.session = Session(
            table.task, episode, policies, sink=None if path is None else sink, episode_id=str(index), info=info
        )
        self.app: App = table.app()
        self.app.names |= plan.names
        self.app.reset(self.session)
        self.drivers: dict[int, Driver] = {k: self.app.driver(k) for k in table.numbers}
        for k in table.numbers:
            self.session.recorder.beside |= {f"input.user_{k}.seq": np.int32(-1), rtt_column(k): np.float32(np.nan)}
        bodies = tuple(m.body for m in episode.roster)
        self.packer = StatePacker(self.session.recorder.header, bodies, episode.scene)
        self.packed: PackedStep | None = None
        """The last step."""
        self.columns: Columns = {}
        self.ended = ""
        """Cause of the end of the episode."""
        self._stopped = ""
        """Reason for which a player ends the episode with the next step."""
        self.remarks: list[dict[str, Any]] = []
        """Problems that players have reported, and their answers to the app's question."""
        self._barriers: dict[int, tuple[FreeSpace, bytes, list[list[int]]]] = {}
        """Things that players have to open, by agent, with the floor and the state of doors and hands for which they were
        found."""

    # --- the disk -----------------------------------------------------------------------------------------------------
    @property
    def fault(self) -> str:
        """Reason why the disk does not accept the game's data; empty while it does."""
        return "" if self.sink is None else self.sink.fault

    def retry(self) -> None:
        """Write all pending data of the game to the disk, including the end of a game that has been closed."""
        if self.sink is not None:
            self.session.recorder.flush()
            self.sink.retry()
        if self.leftover is not None and not self.fault:
            self.leftover.unlink(missing_ok=True)
            self.leftover = None

    def abort(self) -> None:
        """Stop the game and leave its log on the disk, so that a later server can continue it."""
        self.session.abort()
        self._let_go()
        if self.sink is not None:
            self.sink.abort()

    # --- from players -------------------------------------------------------------------------------------------------
    def take(self, number: int, message: Act, text: str, server_ms: float) -> str:
        """Accept a message of a player, which takes effect in the next step and is recorded as it was sent.

        Returns:
            A sentence for the player if the message cannot be carried out.

        Raises:
            InputError: the message is not a command; nothing is recorded.
        """
        if isinstance(message, Remark) and not self.app.question:
            raise InputError(f"This cannot be done here: {type(message).__name__.lower()}.", code="H3-PLAY-013")
        why = self.drivers[number].take(message, self.app.refusal(number, message))
        self.app.on_input(number, message)
        if isinstance(message, End):
            self._stopped = message.why
        elif isinstance(message, Problem | Answer):
            said = {"agent": number, "step": len(self.session.recorder), "text": message.text}
            if isinstance(message, Answer):
                said |= {"question": self.app.question, "answer": message.answer}
            self.remarks.append(said)
        beside = self.session.recorder.beside
        if message.seq is not None:
            beside[f"input.user_{number}.seq"] = np.int32(message.seq)
        if message.rtt > 0:
            beside[rtt_column(number)] = np.float32(min(message.rtt, MOST_RTT_MS))
        # what the message makes the agent do is recorded beside it (kind ``command``), so that verifying needs no app
        self._record(CLIENT, number, f'{{"server_ms":{server_ms:.1f},"message":{text}}}')
        return why

    def connected(self, number: int, here: bool) -> None:
        """Record that a player came or left; the keys of a player who left count as released."""
        if not here:
            self.drivers[number].release()
        self._record(CONNECTED if here else DISCONNECTED, number)

    def slip(self, steps: int) -> None:
        """Record that the clock of the game has skipped some steps."""
        self.slipped += steps
        self._record(SLIP, 0, msgspec.json.encode({"steps": steps}).decode())

    def _record(self, kind: str, number: int, payload: str = "") -> None:
        recorder = self.session.recorder
        recorder.input(InputEvent(time_ns=len(recorder) * STEP_NS, kind=kind, user=number, payload=payload))

    # --- steps --------------------------------------------------------------------------------------------------------
    def step(self) -> dict[int, str]:
        """Play one step; return sentences for players, by agent number."""
        session = self.session
        for driver in self.drivers.values():
            command = driver.command()
            if command is not None:
                session.act(driver.name, command)
        step = len(session.recorder)
        for number, policy in self.waited_for.items():
            name, told = session.episode.roster[number].name, self._told.get(number, {})
            command = told.get(step) if step < self._told_until else policy.command(session.observe(name))
            if command is not None:
                session.act(name, command)
        result: StepResult = session.step()
        for number, policy in self.waited_for.items():
            policy.after([span for span in result.skills if span.agent == number])
        sentences = {number: driver.after(result) for number, driver in self.drivers.items()}
        self.ended = self.app.ended = self.app.step(result) or result.ended or self._stopped
        self.columns = session.recorder.latest_columns()
        activities = {number: shown for number, driver in self.drivers.items() if (shown := driver.activity)}
        self.packed = self.packer.pack(self.columns, self.carried, activities)
        return {number: text for number, text in sentences.items() if text}

    def state(self, number: int, clock_ms: float, *, whole: bool) -> bytes:
        """Return the state message of the last step for the player of agent ``number``, or for a spectator (-1)."""
        assert self.packed is not None, "a step has been played"
        driver, columns = self.drivers.get(number), self.columns
        flags = ENDED if self.ended else 0
        flags |= TOUCH if bool(columns.get("metrics.collision", _NO)[-1]) else 0
        flags |= WALL if bool(columns.get("metrics.robot_contact", _NO)[-1]) else 0
        if driver is not None:
            flags |= driver.offers | (BUSY if driver.busy else 0)
        ack = -1 if driver is None else driver.ack
        return self.packed.state(flags, len(self.session.recorder), ack, clock_ms, whole=whole)

    @property
    def carried(self) -> dict[int, int]:
        """Return the agents that hold things of chores in their hands, by the number of the thing among what moves."""
        found, first = dict[int, int](), len(getattr(self.session.play.team, "starts", ()))
        hands: Any
        for hands in filter(None, (policy.hands for policy in self.session.play.policies)):
            found |= {first + k: hands.number for k in hands.held}
            first += len(hands.things)
        return found

    def barriers(self, number: int) -> list[list[int]]:
        """Return doors and drawers that the player of agent ``number`` has to open first, for each object.

        For each object there are two numbers: the part to open before taking it, and before putting it at its goal. The
        part is a door or drawer that encloses the object, or a closed door on the only path to it; -1 if there is none.
        The list is empty in homes without such parts, and for spectators.
        """
        team: Any = self.session.play.team
        openables = getattr(team, "openables", None)
        if openables is None or number not in self.drivers:
            return []
        # found again, in up to 50 ms, only when something has been opened, closed, taken or put down: nobody gets from one
        # side of a closed door to the other without
        sight = team.objects.sight
        seen = np.ones(len(team.objects.names), np.bool_) if sight is None else sight.known[number]
        key = openables.joints.is_open(openables.positions).tobytes() + team.objects.held_by.tobytes() + seen.tobytes()
        known = self._barriers.get(number)
        if known is None or known[0] is not team.floor or known[1] != key:
            barrier = partial(team.barrier, team.actors[number], detour_m=np.inf)
            # where players are not told the goals, nothing tells what is before them
            told = bool(self.app.goals())
            found = [[barrier(k, False) if s else -1, barrier(k, True) if told else -1] for k, s in enumerate(seen)]
            self._barriers[number] = known = team.floor, key, found
        return known[2]

    def seen(self, number: int) -> list[list[float] | None] | None:
        """Return the points [m] where the player of agent ``number`` last saw each object.

        An entry is None if the player never saw the object, or if it was no longer there. The result is None for
        spectators, and if players know where everything is (the rule ``observe``).
        """
        sight = getattr(getattr(self.session.play.team, "objects", None), "sight", None)
        if sight is None or number not in self.drivers:
            return None
        points = zip(sight.known[number], sight.where[number].round(1).tolist(), strict=True)
        return [point if known else None for known, point in points]

    def messages(self, number: int, since: int = 0) -> list[dict[str, Any]]:
        """Return the messages that the player of agent ``number`` has sent or received, from message ``since`` on.

        For spectators (-1) all messages are returned.
        """
        said = getattr(self.session.play.team, "messages", ())
        name = self.session.episode.roster[number].name if number >= 0 else None
        return [
            {"n": n, "agent": e.agent, "to": e.target, "text": text, "own": text == e.detail}
            for n, e in enumerate(said[since:], since)
            for text in [self.app.spoken(e.detail)]
            if name is None or e.agent == number or e.target in ("", name)
        ]

    @property
    def floor(self) -> FreeSpace:
        """Return the current free floor, on which pages predict the motion of their players.

        It changes with the doors if agents have skills.
        """
        return getattr(self.session.play.team, "floor", self.session.episode.free)

    # --- the end ------------------------------------------------------------------------------------------------------
    def close(self, info: Mapping[str, Any] | None = None) -> Recording | None:
        """Finish the recording; it has its final name once there is no `fault`.

        The result is None, and no file remains, if no step was played.
        """
        session, facts = self.session, self._let_go()
        if len(session.recorder) == 0:
            session.recorder.abort()
            if self.path is not None:
                self.path.with_name(self.path.name + ".part").unlink(missing_ok=True)
            return None
        hitl = session.recorder.header.episode.info["hitl"]
        ended = {"ended": self.ended} if self.ended and not session.ended else {}
        said = {"remarks": self.remarks} if self.remarks else {}
        return session.close({**ended, "hitl": {**hitl, "slipped": self.slipped, **said}, **facts, **(info or {})})

    def _let_go(self) -> dict[str, Any]:
        """End the conversations with servers; return what the recording says about them."""
        found: dict[str, Any] = {}
        for policy in self.waited_for.values():
            for name, facts in policy.recorded_info().items():
                found[name] = [*found.get(name, []), *facts]
            policy.close()
        return found

    # --- after a crash ------------------------------------------------------------------------------------------------
    def play_again(self, recording: Recording) -> None:
        """Bring a new game to the end of an unfinished recording by replaying its raw input.

        Raises:
            H3DataError: the states differ, because another version of the simulator recorded them.
        """
        commands = recorded_commands(recording, self.session.task.control.from_json)
        # the first one of a step: after a choice that takes no time the agent goes on by itself
        self._told = {k: {one.step: one.choice for one in reversed(commands.get(k, ()))} for k in self.waited_for}
        self._told_until = len(recording)
        events = [event for event in recording.inputs if event.kind in (CLIENT, CONNECTED, DISCONNECTED, SLIP)]
        at = 0
        for step in range(len(recording) + 1):
            while at < len(events) and (events[at].time_ns <= step * STEP_NS or step == len(recording)):
                self._take_again(events[at])
                at += 1
            if step < len(recording):
                self.step()
        rows = self.session.recorder.columns()["state_hash"] if len(recording) else np.zeros(0)
        if len(recording) and not np.array_equal(rows, recording.columns["state_hash"]):
            raise H3DataError(
                "What was played does not come out again from its raw input: was h3data updated meanwhile?",
                code="H3-PLAY-021",
            )

    def _take_again(self, event: InputEvent) -> None:
        if event.kind == CLIENT:
            payload = msgspec.json.decode(event.payload, type=_Payload)
            text = bytes(payload.message).decode()
            message = decode(text)
            assert isinstance(message, Act)
            self.take(event.user, message, text, payload.server_ms)
        elif event.kind == SLIP:
            self.slip(int(msgspec.json.decode(event.payload)["steps"]))
        else:
            self.connected(event.user, event.kind == CONNECTED)


class _Payload(msgspec.Struct):
    """Payload of the raw input ``client``."""

    server_ms: float
    message: msgspec.Raw


_NO = np.zeros(1, np.bool_)


def seq_column(user: int) -> str:
    """Return the name of the column that numbers a player's messages."""
    return f"input.user_{user}.seq"
