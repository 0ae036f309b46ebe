"""``h3data play``: people play in a browser, live, and what they do is recorded."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tyro

from h3data.errors import H3DataError, InputError
from h3data.files import part_file
from h3data.progress import is_quiet
from h3data_pipelines.command import JsonFlag, Outcome, WalkOption, claim_folder, counted, keeping

PLAN = "plan.json"
DEFAULT_OUT = Path("out/play")


@dataclass(frozen=True)
class Play:
    """Play an episode live in the browser, and record it.

    Opens the page and prints its address. Ctrl-C ends it and keeps what was played. The same command on the folder of a
    session that was killed goes on with it. Needs the extra hitl.

    Examples:
        h3data play rearrange
        h3data play rearrange --partner same_object --scenes small:3 -o rec/
        h3data play rearrange --as robot --partner both
        h3data play social_nav --partner heuristic_expert --episodes 3
        h3data play rearrange --as person,robot
        h3data play my_app.py_module:MyApp --no-browser --port 8080
    """

    app: tyro.conf.Positional[str]
    """rearrange: bring two objects to their places. social_nav: walk about while a robot has to find and follow you. Or
    module:Class, an app of your own (docs/play.md)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder of the recordings (default: a new one below out/play)."""
    play_as: Annotated[str, tyro.conf.arg(aliases=["--as"])] = "person"
    """person, robot, or several separated by commas, each with a link of its own: person,robot or person,person. spectator
    adds the link of somebody who watches."""
    partner: str | None = None
    """Policy of everybody whom nobody plays: a name as in generate, weights:FILE, or solo (nobody is added)."""
    scenes: str = "small"
    """Homes to play in, as in generate."""
    seed: int = 0
    """Homes and episodes follow from it."""
    episodes: int = 1
    """How many, one after the other."""
    seconds: float | None = None
    """Length limit of an episode (default: the app's; rearrange 180, social_nav 90)."""
    human_walk: WalkOption | None = None
    """How fast people walk: natural is 1.3 m/s, paper 2.5 m/s (default: natural)."""
    port: int = 0
    """Port of the page (default: any free one)."""
    host: str = "127.0.0.1"
    """Address to listen on. Others than this machine's own need TLS (--cert and --key) or --behind-proxy."""
    cert: Path | None = None
    """File of the TLS certificate."""
    key: Path | None = None
    """File of its key."""
    behind_proxy: bool = False
    """A proxy in front of this server does TLS."""
    no_browser: bool = False
    """Only print the address."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        self._check()
        out = self.out or DEFAULT_OUT / time.strftime("%Y%m%d-%H%M%S")
        goes_on = self._claim(out)
        with keeping(lambda: f"{counted(len(_recordings(out)), 'recording')} in {out}"):
            self._say(f"Setting up the {'session again' if goes_on else 'first home'} ...")
            links, overs = self._serve(out)
        files = _recordings(out)
        lines = [f"{path}: {over['ended']} after {counted(over['steps'], 'step')}" for path, over in _named(overs)]
        text = "\n".join(lines or ["Nothing was played."])
        table = _measured(files)
        if table is not None:
            text += f"\n\n{table.to_text()}"
        if files:
            text += f"\n\nh3data replay {files[0]} --verify    # simulated again from what was pressed, bit for bit"
        data = {
            "out": str(out),
            "links": dict(links),
            "episodes": [{key: over[key] for key in ("ended", "steps", "path")} for over in overs],
            "metrics": table.to_dict() if table is not None else None,
        }
        return Outcome(text=text, data=data, result=files)

    def _check(self) -> None:
        if importlib.util.find_spec("aiohttp") is None:
            raise InputError("h3data play needs the package aiohttp. Hint: pip install 'h3data[hitl]'")
        if self.episodes < 1 or self.seed < 0 or not 0 <= self.port < 65536:
            raise InputError("Expected --episodes of at least 1, a --seed of at least 0 and a --port below 65536.")
        if self.seconds is not None and not 1 <= self.seconds <= 36000:
            raise InputError(f"--seconds must be 1 to 36000, got {self.seconds}.")
        if (self.cert is None) != (self.key is None):
            raise InputError("Give both --cert and --key, or neither.")
        for file in (self.cert, self.key):
            if file is not None and not file.is_file():
                raise InputError(f"There is no such file: {file}")

    def _plan(self, out: Path) -> dict[str, Any]:
        from h3data_viewers.hitl.plan import SEATS

        seats = [name.strip() for name in self.play_as.split(",")]
        strange = [name for name in seats if name not in SEATS]
        if strange or not set(seats) & {"person", "robot"}:
            raise InputError(
                f"Expected --as with some of {', '.join(SEATS)}, somebody who plays among them, got: {self.play_as}"
            )
        rules: dict[str, Any] = {}
        if self.seconds is not None:
            rules["max_steps"] = round(self.seconds * 30)
        if self.human_walk is not None:
            rules["human_walk"] = self.human_walk
        return {
            "app": self.app,
            "out": str(out.resolve()),
            "seats": sorted(seats, key=lambda name: name == "spectator"),
            "partner": self.partner,
            "scenes": self.scenes,
            "seed": self.seed,
            "episodes": self.episodes,
            "rules": rules,
        }

    def _claim(self, out: Path) -> bool:
        """Creates the folder; True if it holds a session that was killed, which goes on."""
        from h3data_viewers.hitl.seats import JOURNAL

        plan, file = msgspec.json.encode(self._plan(out)), out / PLAN
        if (out / JOURNAL).is_file() and file.is_file():
            if file.read_bytes() != plan:
                raise InputError(
                    f"{out} holds an unfinished session that was started with other options ({file}). Use the same ones, or "
                    "another -o."
                )
            return True
        claim_folder(out, force=False)
        with part_file(file) as part:
            part.write_bytes(plan)
        return False

    def _serve(self, out: Path) -> tuple[list[list[str]], list[dict[str, Any]]]:
        """Runs the server until it ends; returns the links of the seats and how the episodes ended."""
        options = {
            "plan": self._plan(out),
            "host": self.host,
            "port": self.port,
            "cert": str(self.cert or ""),
            "key": str(self.key or ""),
            "behind_proxy": self.behind_proxy,
        }
        paths = os.pathsep.join(path for path in sys.path if path)
        process = subprocess.Popen(
            [sys.executable, "-m", "h3data_viewers.hitl.serve"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": paths},
        )  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        links: list[list[str]] = []
        overs: list[dict[str, Any]] = []
        try:
            process.stdin.write(msgspec.json.encode(options) + b"\n")
            process.stdin.flush()
            for line in process.stdout:
                self._heard(msgspec.json.decode(line), links, overs)
        except KeyboardInterrupt:
            process.terminate()  # where only this process was told
            for line in process.stdout:
                self._heard(msgspec.json.decode(line), links, overs)
            process.wait()
            raise
        finally:
            process.stdin.close()
            process.wait()
        if process.returncode:
            raise H3DataError(f"The server ended with exit code {process.returncode}; its message is above.")
        return links, overs

    def _heard(self, report: dict[str, Any], links: list[list[str]], overs: list[dict[str, Any]]) -> None:
        if "refused" in report:
            raise InputError(report["refused"])
        if "ready" in report:
            links += report["ready"]["links"]
            for seat, link in links:
                self._say(f"Play as the {seat}: {link}" if seat != "spectator" else f"Watch: {link}")
            self._say("Ctrl-C ends the session.")
            if not self.no_browser:
                webbrowser.open(links[0][1])
        elif "over" in report:
            overs.append(report["over"])
            left = self.episodes - report["over"]["episode"] - 1
            more = f", {left} to go" if left > 0 else ""
            self._say(f"Episode {report['over']['episode']}: {report['over']['ended']}{more}")
        elif "lost" in report:
            self._say("A worker process ended; another one takes over.")

    def _say(self, line: str) -> None:
        if not is_quiet():
            sys.stderr.write(line + "\n")
            sys.stderr.flush()


def _recordings(out: Path) -> list[Path]:
    return sorted(out.glob("*.mcap"))


def _named(overs: list[dict[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    return [(os.path.relpath(over["path"]), over) for over in overs if over["path"]]


def _measured(files: list[Path]) -> Any:
    """Metrics of the recordings; None where there are none."""
    from h3data.metrics import measure_many
    from h3data.recording import read_mcap

    recordings = [read_mcap(file) for file in files]
    return measure_many(recordings) if recordings else None
