"""Commands ``h3data study new`` and ``h3data study run``: an example study file, and the server of a study."""

from __future__ import annotations

import fcntl
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import tyro

from h3data.commands.command import ForceFlag, JsonFlag, Outcome, claim_file, keeping, write_text
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

if TYPE_CHECKING:
    from h3data_studies.design import Design

SERVER = "h3data_studies.serve"
LOCK = ".running"
"""Name of the file in a study's folder that its server locks; it contains the participants' link."""


@dataclass(frozen=True)
class StudyNew:
    """Write an example study file with comments, as a starting point.

    Examples:
        h3data study new study.toml
    """

    file: tyro.conf.Positional[Path]
    """Study file to write (.toml)."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Write the files of an example study."""
        import h3data_studies as package

        path = claim_file(self.file, force=self.force, suffix=".toml")
        text = (Path(package.__path__[0]) / "example.toml").read_text("utf-8")
        write_text(path, text)
        return Outcome(text=f"{path}\nh3data study run {path}", data={"file": str(path)}, result=path)


@dataclass(frozen=True)
class StudyRun:
    """Serve a study to its participants until Ctrl-C; run the same command again to continue.

    All data are stored in the folder NAME-VERSION next to the study file: recordings, answers, and the progress of
    participants. The secret for the pseudonyms of participants is next to that folder (NAME-VERSION.key). Needs the
    extra hitl.

    Examples:
        h3data study run study.toml
        h3data study run study.toml --host 0.0.0.0 --port 443 --cert cert.pem --key key.pem --workers 4
        h3data study run study.toml --behind-proxy --port 8080 --allow-host study.example.org
    """

    study: tyro.conf.Positional[Path]
    """Study file (.toml)."""
    workers: int = 1
    """Number of simulating processes; each serves about 12 people at once."""
    seats_per_address: int = 12
    """Largest number of simultaneous participants from one network address."""
    port: PortOption = 0
    host: HostOption = "127.0.0.1"
    cert: CertOption = None
    key: KeyOption = None
    behind_proxy: ProxyFlag = False
    allow_hosts: AllowHostOption = ()
    no_browser: NoBrowserFlag = False
    speed: Annotated[float, tyro.conf.Suppress] = 1.0
    """Speed of the clock, for scripted participants: above 1 it runs faster."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Serve the study until it is stopped, and return its recordings."""
        from h3data_studies.files import make_plan, read_design, study_folder

        serving = serving_options(
            "h3data study run",
            host=self.host,
            port=self.port,
            cert=self.cert,
            key=self.key,
            behind_proxy=self.behind_proxy,
            allow_hosts=self.allow_hosts,
        )
        if self.workers < 1 or self.seats_per_address < 1:
            raise InputError("Expected --workers and --seats-per-address of at least 1.", code="H3-STUDY-012")
        design = read_design(self.study)
        folder = study_folder(self.study, design)
        plan = make_plan(design, folder, speed=self.speed)
        with running(folder):
            plan = msgspec.structs.replace(plan, design=keep_design(folder, design))
            say(f"Study {design.name}, version {design.version}, in {folder}. Setting up its conditions ...")
            options = {"study": plan, "stays": True, "workers": self.workers, **serving}
            options["seats_per_address"] = self.seats_per_address
            with keeping(lambda: f"everything in {folder}; the same command goes on with it"):
                run_server(SERVER, options, lambda report: self._heard(report, folder))
        return Outcome(text=f"Everything is in {folder}.", data={"folder": str(folder)}, result=folder)

    def _heard(self, report: dict[str, Any], folder: Path) -> None:
        if "refused" in report:
            raise InputError(report["refused"], code=report.get("code", ""))
        if "ready" in report:
            link = report["ready"]["links"][0][1]
            (folder / LOCK).write_text(link)
            say(f"Participants open: {link}")
            say("Ctrl-C stops the study; who has begun goes on where they were when it is started again.")
            if not self.no_browser:
                webbrowser.open(link)
        elif "joined" in report:
            say(f"{report['joined']['participant']} takes part.")
        elif "released" in report:
            say(
                f"{report['released']['participant']} is gone before the check of the computer; the place is free again."
            )
        elif "ended" in report:
            ended = report["ended"]
            because = f" ({ended['reason']})" if ended["reason"] else ""
            say(f"{ended['participant']}: {ended['status'].replace('_', ' ')}{because}")
        elif "over" in report:
            over = report["over"]
            late = f", {counted(over['slipped'], 'step')} late" if over.get("slipped") else ""
            say(f"{over['key']}: {over['ended']} after {counted(over['steps'], 'step')}{late}")
        elif "lost" in report:
            say("A worker process ended; another one takes over.")
        elif "disk" in report:
            say_disk(report["disk"], folder)


def keep_design(folder: Path, design: Design) -> Design:
    """Store a copy of the study file in the folder of its recordings.

    The formats of ids may change at any time; a study that started without them continues without them.

    Returns:
        The design to serve.

    Raises:
        InputError: the folder has recordings of a study file with another content.
    """
    from h3data_studies.files import DESIGN_FILE, open_store, open_study, with_id_pattern
    from h3data_studies.pseudonyms import ANY
    from h3data_studies.store import DATABASE

    kept = folder / DESIGN_FILE
    if kept.is_file() and (folder / DATABASE).is_file():
        before = open_study(folder)[1]
        people = len(open_store(folder, before).participants)
        if people and design.recruiting.id_pattern is None:
            recruiting = msgspec.json.decode(kept.read_bytes())["recruiting"]
            design = with_id_pattern(design, recruiting.get("id_pattern", ANY))
        if people and before != with_id_pattern(design, before.recruiting.id_pattern):
            raise InputError(
                f"The file has changed since {counted(people, 'participant')} took part. Expected what is in {kept}. Undo "
                "the change, or give the study another version, which gets a folder of its own.",
                code="H3-STUDY-013",
            )
    with part_file(kept) as part:
        part.write_bytes(msgspec.json.format(msgspec.json.encode(design), indent=2))
    return design


@contextmanager
def running(folder: Path) -> Iterator[None]:
    """Lock the folder of a study for a ``with`` block, so that only one process changes it.

    Raises:
        InputError: another process has locked the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                f"The study is running in another process. Stop that first (Ctrl-C; participants go on later): {folder}",
                code="H3-STUDY-014",
            ) from None
        lock.truncate(0)
        try:
            yield
        finally:
            (folder / LOCK).write_text("")
