"""The command line under bad conditions: interrupted, killed, forced, resumed with other options, without rights or space."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.commands import command as command_parts
from h3data.commands.command import claim_folder
from h3data.errors import InputError
from h3data.recording import (
    Agent,
    DatasetWriter,
    Episode,
    Recording,
    RecordingHeader,
    RecordingWriter,
    recordings_equal,
    write_mcap,
)
from h3data.recording.mcap import part as mcap_part
from h3data_pipelines.cli import main
from h3data_pipelines.commands import generate
from h3data_pipelines.dataset_folders import remove_dataset, unfinished_dataset, uninterrupted
from h3data_pipelines.jobs import running as episode_jobs
from h3data_pipelines.jobs.generated import require_same_options
from tests.recording.strategies import simple_recording

STANDING = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (3, 1))
SHORT = ("generate", "social_nav", "--homes", "1", "--seed", "7", "--max-steps", "20", "-o")


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> Any:
    """The only thing on stdout is one JSON document."""
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def spawn(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "h3data_pipelines.cli", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def replay(name: str = "a") -> str:
    frame = {"creations": [{"instanceKey": 0, "creation": {"filepath": f"{name}.glb"}}]}
    return json.dumps({"keyframes": [frame, {}]})


# --- what the operating system refuses --------------------------------------------------------------------------------
def test_refusals_of_the_operating_system_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for path in (tmp_path / ("a" * 300), loop, tmp_path / "file" / "below"):
        (tmp_path / "file").write_text("")
        for arguments in (["metrics", path], ["import", path, "-o", tmp_path], ["rerender", path, "-o", tmp_path]):
            assert "error" in run_json(capsys, *arguments, code=2)


@pytest.mark.parametrize("words", ["report DS -o OUT/r.html", "view DS#0 -o OUT/r.rrd", "generate wander -o OUT/ds"])
def test_the_place_of_the_output_is_tried_first(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def read_only(**_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(tmp_path / "tmp123"))

    def worked(*_: object, **__: object) -> None:
        raise AssertionError("it worked before it tried")

    monkeypatch.setattr(command_parts, "NamedTemporaryFile", read_only)
    monkeypatch.setattr("h3data_viewers.html_report.report.make_report", worked)
    monkeypatch.setattr("h3data_viewers.write_rrd", worked, raising=False)
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(simple_recording())
    words = words.replace("DS", str(tmp_path / "ds")).replace("OUT", str(tmp_path))
    words = words.replace(f"{tmp_path}/ds", f"{tmp_path}/new") if words.startswith("generate") else words
    asked = words.split()[-1]
    said = run_json(capsys, *words.split(), code=2)["error"]
    assert said == f"Cannot write here (Read-only file system). Choose another -o: {asked}"


def test_a_full_disk_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "somewhere")

    monkeypatch.setattr(mcap_part, "open_part", full)
    (tmp_path / "a.json").write_text(replay())
    assert "No space left" in run_json(capsys, "import", tmp_path / "a.json", "-o", tmp_path, code=2)["error"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_that_cannot_be_written(unbuffered: str) -> None:
    command = [sys.executable, "-m", "h3data_pipelines.cli", "scenes", "list"]
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert done.returncode == 2


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], pytest.param(["--help"], marks=pytest.mark.slow)])
def test_nobody_reads_on(more: list[str]) -> None:
    """The other end of a pipe is closed, as by ``head``."""
    command = [sys.executable, "-m", "h3data_pipelines.cli", "scenes", "list", *more]
    closed, write = os.pipe()
    os.close(closed)
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, "Error" in done.stderr) == (0, False)


@pytest.mark.slow
def test_file_names_that_are_not_text(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"a\xff b.gfx_replay.json")
    path.write_text(replay())
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "from h3data_pipelines.cli import entry; entry()",
            "import",
            str(path),
            "-o",
            str(tmp_path),
        ],
        capture_output=True,
    )
    assert b"Traceback" not in done.stderr
    assert done.returncode == 2


# --- force and resume -------------------------------------------------------------------------------------------------
def test_force_deletes_nothing_that_is_not_ours(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    foreign = tmp_path / "foreign"
    (foreign / "meta").mkdir(parents=True)
    (foreign / "meta" / "info.json").write_text("{}")
    (foreign / "thesis.tex").write_text("years of work")
    assert "not an h3data dataset" in run_json(capsys, *SHORT, foreign, "--force", code=2)["error"]
    ours = tmp_path / "ours"
    run_json(capsys, *SHORT, ours, "--episodes", "1", "--mcap")
    for stranger in (ours / "thesis.tex", ours / "mcap" / "favourite.mcap"):
        stranger.write_text("years of work")
        before = sorted(ours.rglob("*"))
        assert stranger.name in run_json(capsys, *SHORT, ours, "--force", code=2)["error"]
        assert sorted(ours.rglob("*")) == before
        stranger.unlink()
    assert run_json(capsys, *SHORT, ours, "--episodes", "2", "--force")["episodes"] == 2
    assert (foreign / "thesis.tex").exists()


def test_remove_dataset_leaves_a_file_alone(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("mine")
    with pytest.raises(InputError):
        remove_dataset(tmp_path / "x")
    assert (tmp_path / "x").exists()


def test_resume_refuses_other_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ds"
    run_json(capsys, *SHORT, out, "--episodes", "2")
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    for other in (
        ["--seed", "8"],
        ["--policy", "stand_still"],
        ["--human", "male_0"],
        ["--max-steps", "30"],
        ["--scenes", "small:9"],
        ["--human-speed", "1"],
        ["--spawn-distance", "3"],
        ["--homes", "2"],
    ):
        error = run_json(capsys, *SHORT, out, "--episodes", "3", "--resume", *other, code=2)["error"]
        assert "other options" in error
        assert len(error) < 400
        assert {p: p.stat().st_mtime_ns for p in out.rglob("*")} == before
    assert "Choose one" in run_json(capsys, *SHORT, out, "--resume", "--force", code=2)["error"]
    assert run_json(capsys, *SHORT, out, "--episodes", "3", "--resume")["new"] == 1


def test_resume_completes_the_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ds"
    run_json(capsys, *SHORT, out, "--episodes", "2")
    (out / "mcap").mkdir()
    (out / "mcap" / "000000.mcap.part").write_text("of a killed run")
    run_json(capsys, *SHORT, out, "--episodes", "2", "--resume", "--mcap")
    assert sorted(p.name for p in (out / "mcap").iterdir()) == ["000000.mcap", "000001.mcap"]
    assert recordings_equal(h3data.open(out / "mcap" / "000001.mcap"), h3data.open(out).recording(1)) == []


# --- workers, signals -------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_workers_make_the_same_episodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = (
        run_json(capsys, *SHORT, tmp_path / n, "--episodes", "3", "--workers", n)["state_hashes"] for n in ("1", "2")
    )
    assert one == two
    for i in range(3):
        a, b = (h3data.open(tmp_path / n).recording(i) for n in ("1", "2"))
        assert recordings_equal(a, b) == []


FILM = episode_jobs.film_job


def die_at_the_second(job: episode_jobs.Job, filming: episode_jobs.VideoJob) -> episode_jobs.RenderedVideo:
    if job.index == 1:
        os._exit(9)
    return FILM(job, filming)


@pytest.mark.slow
def test_an_episode_that_kills_its_worker_has_failed_and_the_others_are_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(episode_jobs, "film_job", die_at_the_second)
    data = run_json(capsys, *SHORT, tmp_path / "ds", "--episodes", "3", "--workers", "2", code=1)
    (line,) = data["failed"]
    assert "000001" in line
    assert "No process survived it" in line
    monkeypatch.undo()
    run_json(capsys, *SHORT, tmp_path / "whole", "--episodes", "3")
    for i in (0, 2):
        a, b = (h3data.open(tmp_path / n).recording(i) for n in ("ds", "whole"))
        assert recordings_equal(a, b) == []


def children(pid: int) -> list[int]:
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(p) for p in text.split()]


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_for(what: Any, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.02)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    ("number", "task"),
    [
        pytest.param(
            signal.SIGTERM, "social_nav", marks=pytest.mark.slow
        ),  # quick: test_cli, an interrupted dataset goes on
        pytest.param(signal.SIGHUP, "social_nav", marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, "social_nav", marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, "wander", marks=pytest.mark.slow),
    ],
)
def test_stopped_at_any_moment_it_can_be_resumed(
    number: signal.Signals, task: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever the signal: nothing unfinished under a final name, no orphans, and --resume makes the same episodes."""
    out = tmp_path / "ds"
    options = ("generate", task, *SHORT[2:], out)
    process = spawn(*options, "--episodes", "400", "--workers", "2")
    data = out / "data" / "chunk-000" / "_file-000.parquet.part"
    wait_for(lambda: process.poll() is not None or (data.exists() and data.stat().st_size > 50_000))
    workers = children(process.pid)
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert "Traceback" not in error
    wait_for(lambda: not any(running(w) for w in workers), 20)
    done = len(h3data.open(out))
    if number != signal.SIGKILL:
        assert process.returncode == 130
        assert done > 2
        assert error.startswith("interrupted; ")
        assert f"{out} holds a dataset of {done} finished episodes" in error
        assert "--resume" in error
        assert not list(out.rglob("*.part"))
    assert done < 400
    rest = run_json(capsys, *options, "--episodes", str(done + 2), "--resume")
    assert rest["new"] == 2
    assert (
        recordings_equal(
            h3data.open(out).recording(done + 1),
            episode_jobs.simulate_job(
                generate.Generate(task=task, out=out, episodes=done + 2, seed=7, homes=1, max_steps=20).jobs()[done + 1]
            ),
        )
        == []
    )


def test_an_interrupt_while_writing_waits() -> None:
    reached = []

    def write() -> None:
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            reached.append("the end")

    with pytest.raises(KeyboardInterrupt):
        write()
    assert reached
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_before_a_row_group_keeps_the_episodes_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from h3data.recording.parquet import shard as dataset_shard

    run_json(capsys, *SHORT, tmp_path / "a", "--episodes", "1")
    recording = h3data.open(tmp_path / "a").recording(0)
    writer = DatasetWriter(tmp_path / "b")
    writer.add(recording)

    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(dataset_shard, "moments_of", interrupt)
    with pytest.raises(KeyboardInterrupt):
        writer.add(recording)
    monkeypatch.undo()
    writer.add(recording)
    writer.close()
    assert len(h3data.open(tmp_path / "b")) == 2


@pytest.mark.parametrize("begun", ["h3/", "h3/schema.json.12-ab.part", "h3/schema.json"])
def test_a_dataset_that_was_killed_at_once_is_gone_on_with_or_replaced(tmp_path: Path, begun: str) -> None:
    with DatasetWriter(tmp_path / "whole", like=[simple_recording()]):
        pass
    root = tmp_path / "ds"
    (root / "h3").mkdir(parents=True)
    if not begun.endswith("/"):
        (root / begun).write_bytes((tmp_path / "whole" / "h3" / "schema.json").read_bytes())
    with pytest.raises(InputError, match=r"(?s)a dataset without finished episodes.*H3-OPTION-009"):
        claim_folder(root, force=False, unfinished=lambda: unfinished_dataset(root))
    require_same_options(root, [])
    with DatasetWriter(root, resume=True, like=[simple_recording()]) as writer:
        writer.add(simple_recording())
    remove_dataset(root)
    assert not [path for path in root.rglob("*") if path.is_file()]


# --- import and rerender ----------------------------------------------------------------------------------------------
def test_files_of_the_same_name_do_not_overwrite_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("one", "two"):
        (tmp_path / "in" / name).mkdir(parents=True)
        (tmp_path / "in" / name / "s.gfx_replay.json").write_text(replay(name))
    (tmp_path / "in" / "one" / "s.json").write_text('{"session": 1}')  # another kind with the same stem: skipped
    data = run_json(capsys, "import", tmp_path / "in", "-o", tmp_path / "out", "--force")
    assert (data["imported"], data["skipped"]) == (2, 1)
    for name in ("one", "two"):
        assert h3data.open(tmp_path / "out" / name / "s.mcap").assets[0].name == name
    files = [tmp_path / "in" / name / "s.gfx_replay.json" for name in ("one", "two")]
    data = run_json(capsys, "import", *files, "-o", tmp_path / "flat", "--force", code=1)
    assert (data["imported"], data["failed"]) == (1, 1)
    assert [row["code"][:3] for row in data["files"] if row["status"] == "failed"] == ["H3-"]
    assert h3data.open(tmp_path / "flat" / "s.mcap").assets[0].name == "one"
    logs = [tmp_path / "out" / name / "s.mcap" for name in ("one", "two")]
    assert "'s'" in run_json(capsys, "rerender", *logs, "-o", tmp_path / "v", "--force", code=2)["error"]
    assert not (tmp_path / "v").exists()


def test_an_import_goes_on_with_the_same_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "in").mkdir()
    for name in ("one", "two", "three"):
        (tmp_path / "in" / f"{name}.gfx_replay.json").write_text(replay(name))
    run_json(capsys, "import", tmp_path / "in" / "one.gfx_replay.json", "-o", tmp_path / "out")
    run_json(capsys, "import", tmp_path / "in" / "two.gfx_replay.json", "-o", tmp_path / "other")
    (tmp_path / "other" / "two.mcap").rename(tmp_path / "out" / "three.mcap")  # another recording: not ours to replace
    data = run_json(capsys, "import", tmp_path / "in", "-o", tmp_path / "out", code=1)
    assert (data["imported"], data["kept"], data["failed"]) == (1, 1, 1)
    data = run_json(capsys, "import", tmp_path / "in" / "one.gfx_replay.json", "-o", tmp_path / "out")
    assert data["kept"] == 1


def test_pictures_are_complete_and_of_one_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "s.json").write_text(json.dumps({"keyframes": [json.loads(replay())["keyframes"][0]] + [{}] * 200}))
    run_json(capsys, "import", tmp_path / "s.json", "-o", tmp_path)
    options = ("rerender", tmp_path / "s.mcap", "-o", tmp_path / "p", "--format", "png", "--steps")
    run_json(capsys, *options, "0:3")
    folder = tmp_path / "p" / "s.top_down.rgb"
    run_json(capsys, *options, "1:2", "--force")
    assert [p.name for p in folder.iterdir()] == ["000001.png"]
    (folder / "notes.txt").write_text("mine")
    assert "notes.txt" in run_json(capsys, *options, "1:2", "--force", code=2)["error"]
    assert (folder / "notes.txt").exists()
    run_json(
        capsys, "rerender", tmp_path / "s.mcap", "-o", tmp_path / "v", "--steps", "0:200:100"
    )  # 0.3 frames a second
    assert run_json(capsys, *options, "999:", code=2)


@pytest.mark.slow
def test_cameras_wait_where_their_agent_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A robot that comes late and a person who leaves early."""
    frames: list[dict[str, Any]] = [{"creations": [], "stateUpdates": []} for _ in range(12)]
    for key, name, steps in ((0, "robots/hab_spot_arm/base.glb", range(5, 12)), (1, "humanoids/a.glb", range(6))):
        frames[steps[0]]["creations"].append({"instanceKey": key, "creation": {"filepath": name}})
        for step in steps:
            pose = {"translation": [key + 0.1 * step, 0.5, 2], "rotation": [1, 0, 0, 0]}
            frames[step]["stateUpdates"].append({"instanceKey": key, "state": {"absTransform": pose}})
    frames[6]["deletions"] = [1]
    (tmp_path / "s.json").write_text(json.dumps({"keyframes": frames}))
    (tmp_path / "c.toml").write_text('eye = [-1, 1, 0]\ntarget = [0, 1, 0]\nfollow = "robot"\n')
    run_json(capsys, "import", tmp_path / "s.json", "-o", tmp_path)
    cameras = ("--camera", "third_person", "--camera", tmp_path / "c.toml")
    data = run_json(capsys, "rerender", tmp_path / "s.mcap", "-o", tmp_path / "v", *cameras)
    assert len(data["recordings"][0]["files"]) == 2


@pytest.fixture
def killed(tmp_path: Path) -> Path:
    """What a killed demo leaves of its recording, three steps of it."""
    out = tmp_path / "demo"
    part = out / "episode.mcap.part"
    columns = {"time_ns": np.arange(3), "agent_0.base_pose": STANDING}
    episode = Episode(uid="u", episode_id="e", task="t", scene="s")
    writer = RecordingWriter(
        out / "episode.mcap", RecordingHeader(episode=episode, agents=(Agent(name="it", kind="robot"),))
    )
    writer.append(columns)
    writer.flush()
    left = part.read_bytes()
    writer.abort(keep=False)
    part.write_bytes(left)
    return part


def test_a_killed_demo_can_be_recovered(killed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved = run_json(capsys, "recover", killed, "-o", tmp_path / "saved.mcap")
    assert len(h3data.open(tmp_path / "saved.mcap")) == saved["steps"] == 3
    assert "--force" in run_json(capsys, "recover", killed, "-o", tmp_path / "saved.mcap", code=2)["error"]
    assert "recover" in run_json(capsys, "metrics", killed.with_suffix(""), code=2)["error"]


@pytest.mark.slow
def test_a_killed_demo_can_be_repeated(killed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = killed.parent
    assert run_json(capsys, "demo", "-o", out, "--steps", "5", "--size", "320x240", "--force")["steps"] == 5
    assert not list(out.rglob("*.part"))


@pytest.mark.parametrize("model", ["robot/quad_arm", "humanoid/female_0"])
def test_a_model_without_its_motion_is_refused(model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = {"time_ns": np.arange(3), "agent_0.base_pose": STANDING}
    agent = Agent(name="it", kind="robot", model=model)
    episode = Episode(uid="u", episode_id="e", task="t", scene="s")
    write_mcap(Recording(episode=episode, agents=(agent,), columns=columns), tmp_path / "e.mcap")
    for command in ("rerender", "view"):
        assert (
            "lacks the columns"
            in run_json(capsys, command, tmp_path / "e.mcap", "-o", tmp_path / "o.rrd", code=2)["error"]
        )
