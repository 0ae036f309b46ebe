"""Live play: what a session costs the server, how soon input acts, what is sent, what a crash costs.

Clients without a browser play in this process; the server's CPU is that of its own processes (/proc/PID/stat), so the clients
do not count. On a machine that others use, CPU and bytes hold, and times are upper bounds. ``sessions_N``: N sessions at once
on two workers, of a person who walks, takes and drops beside ``complement`` in rearrangement, or walks in social navigation.
States a second are those of the time that is played: between two episodes there are none (``next_episode``).
Figures without a number are those of 20 sessions (CPU) and of 1 (times). Prediction and first frame are measured in Chromium.
"""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AsyncExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
import numpy as np
from aiohttp import ClientError

from h3data.recording import read_mcap
from h3data_pipelines.commands.informing import slipped_steps
from h3data_play.front import SEATS_PER_ADDRESS
from h3data_play.messages import PERIOD_S
from h3data_studies.bots.client import BUSY, Client
from h3data_studies.bots.participant import DEVICE
from h3data_studies.design import Design
from h3data_studies.files import make_plan

Emit = Callable[[str, float, str], None]
WEB = Path(importlib.util.find_spec("h3data_play").submodule_search_locations[0]) / "web"  # type: ignore[union-attr, index]
COUNTS, WARM_S, MEASURED_S, SIEGE_S, WORKERS = (1, 10, 20), 4.0, 15.0, 30.0, 2
PLANS: dict[str, dict[str, Any]] = {
    "rearrange": {"app": "rearrange", "partner": "complement", "scenes": "small:3"},
    "social_nav": {"app": "social_nav", "partner": "rollout_expert", "scenes": "small:2"},
}
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


class Server:
    """``python -m h3data_play.serve``, or ``h3data_studies.serve`` for the option ``study``, in a process of its own."""

    def __init__(
        self, out: Path, sessions: int = 1, workers: int = 1, options: dict[str, Any] | None = None, **plan: Any
    ) -> None:
        self.out, self.stopped_s = out, 0.0
        out.mkdir(parents=True)
        command = [sys.executable, "-m", "h3data_studies.serve" if "study" in (options or {}) else "h3data_play.serve"]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        whole = {"out": str(out), "episodes": 10 * sessions, **plan}
        options = options or {
            "plan": whole,
            "tables": sessions,
            "workers": workers,
            "stays": True,
            "seats_per_address": SEATS_PER_ADDRESS if sessions > 50 else 10 * sessions,
        }
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(options).encode() + b"\n")
        self.process.stdin.flush()
        ready = json.loads(self.process.stdout.readline())
        self.link = ready["ready"]["links"][0][1]
        self.settle()

    def settle(self) -> None:
        """Wait until the spare worker is warm: it compiles and loads for seconds."""
        idle, before = 0, -1.0
        while idle < 4:
            time.sleep(0.5)
            now = _cpu_s(self.workers[-1])
            idle, before = (idle + 1 if now - before < 0.02 else 0), now

    @property
    def workers(self) -> list[int]:
        """Process numbers of the workers, the spare one last."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text()
        return [int(number) for number in children.split()]

    def cpu_s(self) -> tuple[float, float]:
        """Return the CPU time of the workers that play, and of the front [s]."""
        return sum(_cpu_s(number) for number in self.workers[:-1]), _cpu_s(self.process.pid)

    def reports(self) -> list[dict[str, Any]]:
        """Return the messages that the server has written since it started to listen; wait until it has ended."""
        assert self.process.stdout is not None
        return [json.loads(line) for line in self.process.stdout]

    def stop(self) -> None:
        """Stop it as an operator does, and notes how long that took."""
        begun = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(60)
        self.stopped_s = time.monotonic() - begun


def _cpu_s(process: int) -> float:
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return TICK_S * (int(fields[11]) + int(fields[12]))


@contextmanager
def server(sessions: int = 1, workers: int = 1, **plan: Any) -> Iterator[Server]:
    """Return a server in a folder that is deleted."""
    with tempfile.TemporaryDirectory() as folder:
        running = Server(Path(folder, "rec"), sessions, workers, **plan)
        try:
            yield running
        finally:
            if running.process.poll() is None:
                running.stop()


# --- scripted players -------------------------------------------------------------------------------------------------
async def seated(stack: AsyncExitStack, link: str) -> Client | None:
    """Return a client that plays; None where the machine takes no more."""
    client = await stack.enter_async_context(Client(link))
    for _ in range(3):
        if await client.sit() == 200:
            await client.connect()
            await client.until(lambda: client.step, 60)
            return client
        await asyncio.sleep(1.5)
    return None


async def play(client: Client, k: int, end: float) -> None:
    """Walk by keys, and every few seconds takes or drops something; where an episode ends, the next one begins."""
    chance = np.random.default_rng(k)
    while time.monotonic() < end:
        with contextlib.suppress(ConnectionError, ClientError):
            await _episode(client, chance, end)
        ended = time.monotonic()
        if client.heard("over") and ended < end and await client.sit() == 200:
            await client.connect()
            await client.until(lambda: client.step, 60)
            client.waited_s.append(time.monotonic() - ended)
        elif client.close_code is not None:
            return


async def _episode(client: Client, chance: np.random.Generator, end: float) -> None:
    while time.monotonic() < end and client.close_code is None and not client.heard("over"):
        for _ in range(8):
            forward, turn = chance.uniform(-0.3, 1.0), chance.uniform(-0.6, 0.6)
            await client.send(k="move", f=round(forward, 2), t=round(turn, 2))
            await asyncio.sleep(chance.uniform(0.1, 0.3))
        if not client.manifest["goals"]:
            continue
        held = [k for k, thing in enumerate(client.things) if thing.held == client.manifest["me"]]
        if held:
            await client.send(k="drop")
        else:
            await client.send(k="pick", o=int(chance.integers(len(client.things))), lead=True)
        until = time.monotonic() + 3.0
        while time.monotonic() < min(until, end) and client.flags & BUSY:
            await asyncio.sleep(0.1)


# --- groups of figures ------------------------------------------------------------------------------------------------
def run(emit: Emit) -> None:
    """Emit ``hitl.*``."""
    for app, plan in PLANS.items():
        for count in COUNTS:
            with server(count, WORKERS, **plan) as running:
                asyncio.run(_sessions(emit, running, app, count))
                if (app, count) == ("rearrange", 10):
                    emit("hitl.sigterm_s", running.stopped_s, "s")
                    files = list(running.out.glob("*.mcap*"))
                    emit("hitl.sigterm_unfinished_recordings", sum(f.suffix == ".part" for f in files), "")
    _sizes(emit)
    with server(**PLANS["rearrange"]) as running:
        asyncio.run(_crash(emit, running))
    with server(60, WORKERS, **PLANS["rearrange"]) as running:
        asyncio.run(_siege(emit, running))
    hostile(emit)
    _browser(emit)


async def _sessions(emit: Emit, running: Server, app: str, count: int) -> None:
    name = f"hitl.{app}.sessions_{count}"
    async with AsyncExitStack() as stack:
        clients = [c for c in [await seated(stack, running.link) for _ in range(count)] if c is not None]
        if len(clients) < count:
            emit(f"{name}.admitted", len(clients), "")
        playing = [
            asyncio.create_task(play(c, k, time.monotonic() + WARM_S + MEASURED_S)) for k, c in enumerate(clients)
        ]
        await asyncio.sleep(WARM_S)
        for client in clients:
            client.times.clear()
            client.delays.clear()
            client.waited_s.clear()
            client.played_s = 0.0
        bytes_before = sum(c.bytes for c in clients)
        cpu, begun = running.cpu_s(), time.monotonic()
        await asyncio.sleep(MEASURED_S)
        wall = time.monotonic() - begun
        worker, front = (100 * (b - a) / wall / len(clients) for a, b in zip(cpu, running.cpu_s(), strict=True))
        rates = [len(c.times) / max(c.played_s, PERIOD_S) for c in clients]
        waits = [seconds for c in clients for seconds in c.waited_s]
        delays = 1e3 * np.concatenate([c.delays for c in clients])
        down = (sum(c.bytes for c in clients) - bytes_before) / wall / len(clients)
        states = sum(len(c.times) for c in clients)
        await asyncio.gather(*playing)
    emit(f"{name}.states_per_s", median(rates), "1/s")
    emit(f"{name}.states_per_s_worst", min(rates), "1/s")
    emit(f"{name}.session_cpu_share", worker + front, "%")
    emit(f"{name}.front_cpu_share", front, "%")
    if waits:
        emit(f"{name}.next_episode_p95_s", float(np.percentile(waits, 95)), "s")
    emit(f"{name}.input_to_state_p50_ms", float(np.percentile(delays, 50)), "ms")
    emit(f"{name}.input_to_state_p95_ms", float(np.percentile(delays, 95)), "ms")
    emit(f"{name}.down_bytes_per_s", down, "B/s")
    running.stop()
    recordings = [read_mcap(file) for file in sorted(running.out.glob("*.mcap"))]
    slips = sum(slipped_steps(r) for r in recordings)
    emit(f"{name}.slipped_share", 100 * slips / max(sum(len(r) for r in recordings) + slips, 1), "%")
    if app == "rearrange" and count == COUNTS[-1]:
        emit("hitl.session_cpu_share", worker + front, "%")
    if app == "rearrange" and count == 1:
        emit("hitl.input_to_state_p50_ms", float(np.percentile(delays, 50)), "ms")
        emit("hitl.input_to_state_p95_ms", float(np.percentile(delays, 95)), "ms")
        emit("hitl.state_bytes", down * wall / states, "B")


def _sizes(emit: Emit) -> None:
    dist = WEB / "dist"
    page = sum(len(gzip.compress(file.read_bytes(), 9)) for file in dist.rglob("*") if file.is_file())
    emit("hitl.page_gzip_kb", page / 1e3, "kB")
    for app, plan in PLANS.items():
        with server(**plan) as running:
            emit(f"hitl.{app}.home_gzip_mb", asyncio.run(_home_bytes(running.link)) / 1e6, "MB")


async def _home_bytes(link: str) -> int:
    async with Client(link) as client:
        assert await client.sit() == 200
        async with client.http.get(link + client.glb) as answer:
            await answer.read()
            return int(answer.headers["Content-Length"])


async def _crash(emit: Emit, running: Server) -> None:
    """Kill the worker, and measure when the page's seat continues and how many rows are lost."""
    async with AsyncExitStack() as stack:
        client = await seated(stack, running.link)
        assert client is not None
        await play(client, 0, time.monotonic() + 3.0)
        os.kill(running.workers[0], signal.SIGKILL)
        before, killed = client.step, time.monotonic()
        with contextlib.suppress(ConnectionError):
            await client.until(lambda: False, 60)  # until the connection is lost
        while True:
            try:  # as the page does
                await client.connect()
                await client.until(lambda: client.step, 10)
                break
            except (ConnectionError, TimeoutError, ClientError):
                await asyncio.sleep(0.25)
        emit("hitl.worker_killed_s", time.monotonic() - killed, "s")
        emit("hitl.worker_killed_rows_lost", max(0, before - client.step), "rows")


async def _attacked(
    players: Sequence[Client], *arguments: str
) -> tuple[list[asyncio.Task[None]], subprocess.Popen[bytes]]:
    """Let players play for `SIEGE_S` next to hostile clients with these arguments; count after one second."""
    end = time.monotonic() + SIEGE_S
    playing = [asyncio.create_task(play(client, k, end)) for k, client in enumerate(players)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-m", "tests.play.hostile", *arguments]
    crowd = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment)
    await asyncio.sleep(1.0)
    for client in players:
        client.times.clear()
        client.played_s = 0.0
    return playing, crowd


async def _siege(emit: Emit, running: Server) -> None:
    """Measure two players next to fifty hostile clients, which run in a separate process."""
    async with AsyncExitStack() as stack:
        players = [c for c in [await seated(stack, running.link) for _ in range(2)] if c is not None]
        playing, crowd = await _attacked(players, running.link, "50", str(SIEGE_S))
        await asyncio.sleep(SIEGE_S - 1.0)
        rates = [len(c.times) / max(c.played_s, PERIOD_S) for c in players]
        lost = sum(c.close_code is not None for c in players)
        await asyncio.gather(*playing)
        answers = json.loads((await asyncio.to_thread(crowd.communicate))[0])
    emit("hitl.siege.states_per_s_worst", min(rates), "1/s")
    emit("hitl.siege.players_lost", lost, "")
    emit("hitl.siege.attacks", sum(answers.values()), "")
    emit("hitl.siege.seats_refused", sum(n for what, n in answers.items() if what.startswith("seat ")), "")
    running.stop()
    emit("hitl.siege.failed_sessions", sum(r.get("over", {}).get("ended") == "failed" for r in running.reports()), "")


def hostile(emit: Emit) -> None:
    """Play four participants of a study next to 40 hostile clients, and emit ``hitl.hostile_*``."""
    said = {
        "name": "siege",
        "version": "1",
        "title": "Siege",
        "participants": 60,
        "retention": "2030-01-31",
        "contact": "nobody",
        "scenes": ["small:3"],
        "episodes": 20,
        "conditions": [{"name": "still", "partner": "still"}],
        "consent": {"version": "1", "text": "Yes?"},
        "tutorial": {"skip": True},
    }
    with tempfile.TemporaryDirectory() as folder:
        plan = make_plan(msgspec.convert(said, Design), Path(folder, "siege-1"))
        options = {"study": msgspec.to_builtins(plan), "workers": WORKERS, "stays": True}
        running = Server(Path(folder, "siege-1"), options=options)
        try:
            asyncio.run(_besieged_study(emit, running))
        finally:
            if running.process.poll() is None:
                running.stop()


async def _besieged_study(emit: Emit, running: Server) -> None:
    pids = [f"{k:024x}" for k in range(1, 5)]
    async with AsyncExitStack() as stack:
        players = []
        for pid in pids:
            client = await stack.enter_async_context(Client(running.link))
            view = await _asked(client, "api/study", {"ids": {"PROLIFIC_PID": pid}})
            agreed = {"accept": True, "hash": view["stage"]["hash"], "ids": {"PROLIFIC_PID": pid}}
            await _asked(client, "api/study/consent", agreed)
            await _asked(client, "api/study/device", DEVICE)
            while await client.sit() == 503:
                await asyncio.sleep(1.5)
            await client.connect()
            await client.until(lambda client=client: client.step, 60)
            players.append(client)
        playing, crowd = await _attacked(players, running.link, "40", str(SIEGE_S), ",".join(pids))
        cpu, begun = running.cpu_s(), time.monotonic()
        await asyncio.sleep(SIEGE_S - 1.0)
        wall = time.monotonic() - begun
        worker, front = (100 * (b - a) / wall for a, b in zip(cpu, running.cpu_s(), strict=True))
        rates = [len(c.times) / max(c.played_s, PERIOD_S) for c in players]
        await asyncio.gather(*playing)
        answers = json.loads((await asyncio.to_thread(crowd.communicate))[0])
        kept = [(await _asked(client, "api/study", {}))["stage"]["kind"] == "episode" for client in players]
    emit("hitl.hostile_states_per_s", min(rates), "1/s")
    emit("hitl.hostile_front_cpu_share", front, "%")
    emit("hitl.hostile_workers_cpu_share", worker, "%")
    emit("hitl.hostile_players_out", kept.count(False), "")
    emit("hitl.hostile_clients_in", sum(n for what, n in answers.items() if what.startswith("IN ")), "")
    emit("hitl.hostile_errors_500", sum(n for what, n in answers.items() if what.endswith(" 500")), "")
    emit("hitl.hostile_attacks", sum(answers.values()), "")
    running.stop()
    overs = [r["over"] for r in running.reports() if "over" in r]
    emit("hitl.hostile_failed_episodes", sum(over["ended"] == "failed" for over in overs), "")


async def _asked(client: Client, path: str, body: dict[str, Any]) -> dict[str, Any]:
    async with client.http.post(client.link + path, json=body) as answer:
        return await answer.json()


# --- a browser --------------------------------------------------------------------------------------------------------
def _browser(emit: Emit) -> None:
    chromium = shutil.which(os.environ.get("CHROMIUM", "chromium"))
    lacks = [name for name, has in (("chromium", chromium), ("node", shutil.which("node"))) if not has]
    lacks += [] if (WEB / "node_modules" / "playwright-core").is_dir() else ["node packages (make check-web)"]
    if lacks:
        sys.stderr.write(f"hitl: prediction and first frame are not measured: there is no {', no '.join(lacks)}\n")
        return
    with server(5, app="rearrange", partner="still", scenes="small:1") as running:
        for lag in (0, 100):
            said = _in_browser("walk", f"{running.link}?lag={lag}", str(chromium))
            emit(f"hitl.prediction_error_p95_cm.lag_{lag}", 100 * said["errorM"][1], "cm")
            emit(f"hitl.key_to_body_p95_ms.lag_{lag}", said["keyMs"][1], "ms")
            if not lag:
                emit("hitl.first_frame_s", said["firstFrameMs"] / 1e3, "s")


def _in_browser(scenario: str, url: str, chromium: str) -> dict[str, Any]:
    command = ["node", str(WEB / "test" / "browser" / "play.mjs"), scenario, url]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=400, env={**os.environ, "CHROMIUM": chromium}
    )
    return json.loads(done.stdout.splitlines()[-1])
