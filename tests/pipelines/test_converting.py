"""MCAP to Parquet and back: nothing is lost, folders are walked, an interrupted conversion goes on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.recording import (
    Agent,
    Dataset,
    DatasetWriter,
    Episode,
    Event,
    InputEvent,
    Recording,
    SkillSpan,
    read_mcap,
    recordings_equal,
    state_hash,
    write_mcap,
)
from h3data_pipelines.cli import main
from h3data_pipelines.commands import converting
from tests.random_cases import examples


def episode(name: str, steps: int = 5, *, joints: int = 3, extra: str = "", dt_ns: int = 33_333_333) -> Recording:
    rng = np.random.default_rng(len(name) + steps)
    base = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (steps, 1))
    columns: dict[str, Any] = {
        "time_ns": np.arange(1, steps + 1, dtype=np.int64) * dt_ns,
        "agent_0.base_pose": base,
        "agent_0.joint_pos": rng.normal(size=(steps, joints)).astype(np.float32),
        "metrics.collision": rng.random(steps) < 0.5,
    }
    if extra:
        columns[extra] = np.arange(steps, dtype=np.uint64) + 2**63
    columns["state_hash"] = state_hash(columns)
    return Recording(
        episode=Episode(uid=f"uid-{name}", episode_id=name, task="t", scene="s", dt_ns=dt_ns, info={"note": name}),
        agents=(Agent(name="robot", kind="robot", joint_names=tuple(map(str, range(joints)))),),
        columns=columns,
        events=(Event(step=0, agent=0, kind="x"),) if steps else (),
        skills=(SkillSpan(agent=0, name="y", start_step=0, end_step=steps - 1),) if steps else (),
        inputs=(
            InputEvent(time_ns=-1, kind="key_down", payload='{"key": "w"}'),
            InputEvent(time_ns=2**40 + 1, kind="text", user=1, payload='"caf\u00e9 ☕"'),
        )
        if name == "a"
        else (),
        attachments={"scene.glb": name.encode()},
    )


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """Logs of different widths and columns, one without steps, two folders deep."""
    folder = tmp_path / "logs"
    write_mcap(episode("a"), folder / "a.mcap")
    write_mcap(episode("b", 9, joints=5, extra="sim.counter"), folder / "b.mcap")
    write_mcap(episode("c", 0), folder / "deep" / "c.mcap")
    return folder


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def test_there_and_back_gives_equal_recordings_and_equal_files(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = run_json(capsys, "convert", logs, tmp_path / "ds", "--check")
    assert (made["to"], made["converted"], made["failed"]) == ("dataset", 3, 0)
    back = run_json(capsys, "convert", tmp_path / "ds", tmp_path / "back", "--check")
    assert (back["to"], back["converted"]) == ("mcap", 3)
    for k, log in enumerate(("a.mcap", "b.mcap", "deep/c.mcap")):
        again = tmp_path / "back" / f"{k:06d}.mcap"
        assert recordings_equal(read_mcap(logs / log), read_mcap(again)) == []
        assert again.read_bytes() == (logs / log).read_bytes()  # the same hash of the file
    run_json(capsys, "convert", tmp_path / "back", tmp_path / "ds2")
    parquet = [p.relative_to(tmp_path / "ds") for p in sorted((tmp_path / "ds").rglob("*.parquet"))]
    assert parquet
    for path in parquet:
        assert (tmp_path / "ds" / path).read_bytes() == (tmp_path / "ds2" / path).read_bytes(), path


def test_a_damaged_scene_of_a_dataset_is_reported_by_every_command(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line that names the file, its hash and what to do; nothing gets fresh checksums."""
    recording = replace(read_mcap(logs / "a.mcap"), attachments={"scene.glb": b"a scene"})
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(recording)
    (file,) = (tmp_path / "ds/h3/files").iterdir()
    file.write_bytes(b"a scen3")
    wanted = (str(file), file.stem, "copy the file of this name")
    (checked,) = run_json(capsys, "validate", tmp_path / "ds", code=1)["episodes"]
    reasons = [finding["text"] for finding in checked["findings"]]
    reasons.append(run_json(capsys, "convert", tmp_path / "ds", tmp_path / "out", code=2)["error"])
    reasons.append(run_json(capsys, "convert", f"{tmp_path / 'ds'}#0", tmp_path / "one.mcap", code=2)["error"])
    reasons.append(run_json(capsys, "rerender", f"{tmp_path / 'ds'}#0", "-o", tmp_path / "video", code=2)["error"])
    reasons.append(run_json(capsys, "replay", f"{tmp_path / 'ds'}#0", "--verify", code=2)["error"])
    assert len(reasons) == 5
    for reason in reasons:
        assert all(text in reason for text in wanted), reason
        assert "\n" not in reason
    assert not list(tmp_path.rglob("one.mcap"))
    assert not list((tmp_path / "out").rglob("*.mcap"))


def test_logs_of_one_folder_can_share_their_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = {"scene.glb": bytes(100_000)}
    with DatasetWriter(tmp_path / "ds") as writer:
        for name in "abc":
            writer.add(replace(episode(name), attachments=scene))
    done = run_json(capsys, "convert", tmp_path / "ds", tmp_path / "logs", "--share-scenes", "--check")
    assert done["converted"] == 3
    assert len(list((tmp_path / "logs/h3/files").iterdir())) == 1
    assert sum(p.stat().st_size for p in (tmp_path / "logs").glob("*.mcap")) < 100_000
    assert run_json(capsys, "convert", tmp_path / "logs", tmp_path / "ds2", "--check")["converted"] == 3
    assert Dataset(tmp_path / "ds2").recording(2).attachments == scene


@settings(max_examples=examples(10))
@given(steps=st.integers(0, 40), joints=st.integers(0, 6), extra=st.sampled_from(["", "sim.x", "agent_0.odd"]))
def test_any_shape_survives(steps: int, joints: int, extra: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("convert")
    recording = episode("x", steps, joints=joints, extra=extra)
    write_mcap(recording, folder / "x.mcap")
    assert main(["convert", str(folder / "x.mcap"), str(folder / "ds")]) == 0
    assert main(["convert", str(folder / "ds") + "#0", str(folder / "y.mcap"), "--check"]) == 0
    assert recordings_equal(read_mcap(folder / "y.mcap"), recording) == []


def test_folders_of_logs_keep_their_names(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_json(capsys, "convert", logs, tmp_path / "copy", "--to", "mcap")
    names = sorted(str(p.relative_to(tmp_path / "copy")) for p in (tmp_path / "copy").rglob("*.mcap"))
    assert names == ["a.mcap", "b.mcap", "deep/c.mcap"]


def test_other_frame_rates_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_mcap(episode("slow", dt_ns=100_000_000), tmp_path / "in" / "slow.mcap")
    run_json(capsys, "convert", tmp_path / "in", tmp_path / "ds", "--check")
    assert Dataset(tmp_path / "ds").schema.fps == 10
    write_mcap(episode("usual"), tmp_path / "in" / "usual.mcap")
    found = run_json(capsys, "convert", tmp_path / "in", tmp_path / "both", code=1)
    assert "steps of 33333333 ns" in found["episodes"][1]["reason"]
    assert found["episodes"][1]["code"] == "H3-RECORDING-091"
    found = run_json(capsys, "convert", tmp_path / "in", tmp_path / "nominal", "--nominal-fps", "30", "--check")
    assert found["converted"] == 2
    assert [r.episode.dt_ns for r in Dataset(tmp_path / "nominal")] == [100_000_000, 33_333_333]
    assert run_json(capsys, "convert", tmp_path / "in", tmp_path / "x", "--nominal-fps", "0", code=2)["error"]


@pytest.mark.parametrize("done", [0, 1, 2, 3])
def test_an_interrupted_conversion_to_a_dataset_goes_on(
    done: int, logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add = converting.Convert._add
    calls: list[str] = []

    def interrupted(self: Any, source: Any, *rest: Any) -> Any:
        if len(calls) == done:
            raise KeyboardInterrupt
        calls.append(source.name)
        return add(self, source, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(converting.Convert, "_add", interrupted)
        assert main(["convert", str(logs), str(tmp_path / "ds")]) == (130 if done < 3 else 0)
    made = run_json(capsys, "convert", logs, tmp_path / "ds", "--resume", "--check")
    assert (made["kept"], made["converted"]) == (done, 3 - done)
    stored = [r.episode.uid for r in Dataset(tmp_path / "ds")]
    assert stored == ["uid-a", "uid-b", "uid-c"]


def test_an_interrupted_conversion_to_logs_goes_on(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ds, out = tmp_path / "ds", tmp_path / "out"
    run_json(capsys, "convert", logs, ds)
    run_json(capsys, "convert", ds, out)
    (out / "000001.mcap").rename(out / "000001.mcap.part")  # as if the process had been killed here
    assert "--force" in run_json(capsys, "convert", ds, out, code=2)["error"]
    made = run_json(capsys, "convert", ds, out, "--resume")
    assert (made["kept"], made["converted"]) == (2, 1)
    assert sorted(p.name for p in out.iterdir()) == ["000000.mcap", "000001.mcap", "000002.mcap"]
    write_mcap(episode("other"), out / "000000.mcap", overwrite=True)
    assert "another episode" in run_json(capsys, "convert", ds, out, "--resume", code=1)["episodes"][0]["reason"]


def test_what_cannot_be_read_is_listed_and_the_rest_is_converted(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (logs / "b.mcap").read_bytes()
    (logs / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    (logs / "none.mcap").write_bytes(b"")
    made = run_json(capsys, "convert", logs, tmp_path / "ds", code=1)
    assert (made["converted"], made["failed"]) == (3, 2)
    assert len(Dataset(tmp_path / "ds")) == 3
    assert "recover" in next(row["reason"] for row in made["episodes"] if "cut" in row["source"])


def test_a_check_that_fails_says_so(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = replace(episode("a"), events=())
    monkeypatch.setattr(converting, "_read_log", lambda _: changed)
    assert (
        "events: 1 and 0"
        in run_json(capsys, "convert", logs / "a.mcap", tmp_path / "x.mcap", "--check", code=2)["error"]
    )


@pytest.mark.parametrize(
    "arguments",
    [
        ["none.mcap", "out"],
        ["logs/a.mcap#0", "out"],
        ["logs", "all.mcap"],
        ["logs", "logs"],
        ["logs", "logs/below"],
        ["logs/deep", "logs"],
        ["logs", "out", "--force", "--resume"],
        ["logs", "full"],
        ["logs", "full", "--force"],
        ["logs/a.mcap", "taken.mcap"],
        ["empty", "out"],
        ["text.mcap", "out"],
        ["logs/a.mcap", "x.mcap", "--to", "dataset"],
        ["mixed", "out"],
    ],
)
def test_what_cannot_be_done_is_refused_and_nothing_is_touched(
    arguments: list[str],
    logs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    (tmp_path / "taken.mcap").write_text("mine")
    (tmp_path / "text.mcap").write_text("hello")
    write_mcap(episode("a"), tmp_path / "mixed" / "a.mcap")
    with DatasetWriter(tmp_path / "mixed" / "ds") as out:
        out.add(episode("b"))
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    assert run_json(capsys, "convert", *arguments, code=2)["error"]
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()} == before
