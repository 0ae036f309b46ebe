"""Command ``h3data play``: people play live in a browser, and their actions are recorded."""

from __future__ import annotations

import os
import time
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tyro

from h3data.commands.command import (
    JsonFlag,
    ObserveOption,
    Outcome,
    OverridesOption,
    RuleSetOption,
    claim_folder,
    keeping,
    read_overrides,
)
from h3data.errors import InputError
from h3data.files import part_file
from h3data.progress import say
from h3data.terminal import counted
from h3data_play.commands.serving import (
    AllowHostOption,
    CertOption,
    HostOption,
    KeyOption,
    NoBrowserFlag,
    PortOption,
    ProxyFlag,
    run_server,
    say_disk,
    serving_options,
)

PLAN = "plan.json"
DEFAULT_OUT = Path("out/play")


@dataclass(frozen=True)
class Play:
    """Play an episode live in the browser, and record it.

    The command opens the page and prints its address. Ctrl-C ends the session and saves what was played. The same
    command on the folder of a killed session continues it. Needs the extra hitl.

    Examples:
        h3data play rearrange
        h3data play rearrange --partner same_object --scenes small:3 -o rec/
        h3data play rearrange --as robot --partner both
        h3data play social_nav --partner rollout_expert --episodes 3
        h3data play rearrange --as person,robot
        h3data play social_nav --human female_1+dance=dance.bvh
        h3data play tutorial
        h3data play teleop --partner both
        h3data play my_app.py_module:MyApp --no-browser --port 8080
    """

    app: tyro.conf.Positional[str]
    """rearrange: bring two objects to their places. social_nav: walk freely while a robot has to find and follow you.
    tutorial: learn to walk, look, take and place. teleop: drive the robot, take and place with its arm. crowd: walk about
    among other people. language: carry out an instruction in words. module:Class: a custom app or task (h3data docs play)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder of the recordings (default: a new one below out/play)."""
    seats: Annotated[tuple[str, ...], tyro.conf.arg(name="as")] = ()
    """person, robot, or several, each with a link of its own: person,robot or person,person. spectator adds a link for
    watching (default: the role of the app: robot for teleop, person for the others)."""
    partner: str | None = None
    """Policy of the agents without a player: a name as in generate, weights:FILE, or solo for no such agents (the
    default of tutorial and teleop)."""
    scenes: tuple[str, ...] = ("small",)
    """Homes to play in, as in generate."""
    seed: int = 0
    """Random seed for homes and episodes."""
    episodes: int = 1
    """Number of episodes, one after the other."""
    seconds: float | None = None
    """Length limit of an episode (default: the app's; rearrange and teleop 180, social_nav 90, tutorial 600)."""
    motion: Path | None = None
    """Motion file that sets how people walk, as for h3data generate."""
    human: str = ""
    """Body of people, as for h3data generate. Motions that follow it, as in female_1+dance=dance.bvh, can be performed by
    players (h3data docs motion)."""
    names: bool = False
    """Show a name over the head of every other person and robot."""
    observe: ObserveOption = None
    overrides: OverridesOption = ()
    rules: RuleSetOption = None
    port: PortOption = 0
    host: HostOption = "127.0.0.1"
    cert: CertOption = None
    key: KeyOption = None
    behind_proxy: ProxyFlag = False
    allow_hosts: AllowHostOption = ()
    no_browser: NoBrowserFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Serve the session until it is over, and return the recordings."""
        self._check()
        out = self.out or DEFAULT_OUT / time.strftime("%Y%m%d-%H%M%S")
        goes_on = self._claim(out)
        with keeping(lambda: f"{counted(len(_recordings(out)), 'recording')} in {out}"):
            say(f"Setting up the {'session again' if goes_on else 'first home'} ...")
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
        self._serving()
        if self.episodes < 1 or self.seed < 0:
            raise InputError("Expected --episodes of at least 1 and a --seed of at least 0.", code="H3-PLAY-002")
        if self.seconds is not None and not 1 <= self.seconds <= 36000:
            raise InputError(f"--seconds must be 1 to 36000, got {self.seconds}.", code="H3-PLAY-003")

    def _serving(self) -> dict[str, Any]:
        return serving_options(
            "h3data play",
            host=self.host,
            port=self.port,
            cert=self.cert,
            key=self.key,
            behind_proxy=self.behind_proxy,
            allow_hosts=self.allow_hosts,
        )

    def _plan(self, out: Path) -> dict[str, Any]:
        from h3data_play.app import find_app
        from h3data_play.plan import SEATS
        from sim_kinematic.tasks.episode import rule_value
        from sim_kinematic.tasks.registry import find_task

        seats = self.seats or find_app(self.app).seats
        strange = [name for name in seats if name not in SEATS]
        if strange or not set(seats) & {"person", "robot"}:
            raise InputError(
                f"Expected --as with some of {', '.join(SEATS)}, somebody who plays among them, got: {','.join(seats)}",
                code="H3-PLAY-027",
            )
        spec = find_task(find_app(self.app).task).Spec()
        overrides = read_overrides(self.overrides, observe=self.observe)
        rules: dict[str, Any] = {name: rule_value(spec, name, value) for name, value in overrides}
        if self.seconds is not None and "max_steps" in rules:
            raise InputError("Expected --seconds or --set max_steps=..., got both.", code="H3-PLAY-028")
        if self.seconds is not None:
            rules["max_steps"] = round(self.seconds * 30)
        if self.rules is not None:
            rules["rules"] = self.rules
        if self.motion is not None:
            from h3data.bodies.names import JOIN, stored_name

            stored_name(f"{JOIN}{self.motion.resolve()}")  # refuses what cannot be played
        if self.human:
            from sim_kinematic.agents.roster import make_roster

            make_roster("human", human=self.human)  # refuses what there is not
        return {
            **({"human": self.human} if self.human else {}),
            **({} if self.motion is None else {"motion": str(self.motion.resolve())}),
            **({"names": True} if self.names else {}),
            "app": self.app,
            "out": str(out.resolve()),
            "seats": sorted(seats, key=lambda name: name == "spectator"),
            "partner": self.partner,
            "scenes": self.scenes[0] if len(self.scenes) == 1 else list(self.scenes),
            "seed": self.seed,
            "episodes": self.episodes,
            "rules": rules,
        }

    def _claim(self, out: Path) -> bool:
        """Create the folder; return True if it holds a killed session, which is continued."""
        from h3data_play.seats import JOURNAL

        plan, file = msgspec.json.encode(self._plan(out)), out / PLAN
        if (out / JOURNAL).is_file() and file.is_file():
            if file.read_bytes() != plan:
                raise InputError(
                    f"{out} holds an unfinished session that was started with other options ({file}). Use the same ones, or "
                    "another -o.",
                    code="H3-PLAY-005",
                )
            return True
        claim_folder(out, force=False)
        with part_file(file) as part:
            part.write_bytes(plan)
        return False

    def _serve(self, out: Path) -> tuple[list[list[str]], list[dict[str, Any]]]:
        """Run the server until it ends; return the links of the seats and how the episodes ended."""
        links: list[list[str]] = []
        overs: list[dict[str, Any]] = []
        run_server(
            "h3data_play.serve",
            {"plan": self._plan(out), **self._serving()},
            lambda report: self._heard(report, links, overs, out),
        )
        return links, overs

    def _heard(self, report: dict[str, Any], links: list[list[str]], overs: list[dict[str, Any]], out: Path) -> None:
        if "refused" in report:
            raise InputError(report["refused"], code=report.get("code", ""))
        if "ready" in report:
            links += report["ready"]["links"]
            for seat, link in links:
                say(f"Play as the {seat}: {link}" if seat != "spectator" else f"Watch: {link}")
            say("Ctrl-C ends the session.")
            if not self.no_browser:
                webbrowser.open(links[0][1])
        elif "over" in report:
            overs.append(report["over"])
            left = self.episodes - report["over"]["episode"] - 1
            more = f", {left} to go" if left > 0 else ""
            say(f"Episode {report['over']['episode']}: {report['over']['ended']}{more}")
        elif "lost" in report:
            say("A worker process ended; another one takes over.")
        elif "disk" in report:
            say_disk(report["disk"], out)


def _recordings(out: Path) -> list[Path]:
    return sorted(out.glob("*.mcap"))


def _named(overs: list[dict[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    return [(os.path.relpath(over["path"]), over) for over in overs if over["path"]]


def _measured(files: list[Path]) -> Any:
    """Return the metrics of the recordings; None where there are none."""
    from h3data.metrics import measure_many
    from h3data.recording import read_mcap

    recordings = [read_mcap(file) for file in files]
    return measure_many(recordings) if recordings else None
