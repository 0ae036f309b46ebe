"""What is wrong with a recording is found, named and counted; what is right is left alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import load_humanoid
from h3data.errors import H3DataError
from h3data.geometry import pose_multiply
from h3data.recording import DatasetWriter, Event, InputEvent, Recording, SkillSpan, state_hash, write_mcap
from h3data.recording.episodes import StoredEpisode
from h3data.scene import load_scene
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from h3data_pipelines.commands.validating import read_ahead
from h3data_pipelines.validation import recordings as validation
from h3data_pipelines.validation.recordings import Finding, validate_recording
from sim_kinematic.motion.spec import SocialNavSpec, WalkerSpec
from sim_kinematic.tasks.resume import verify
from tests.random_cases import examples
from tests.recording.strategies import random_bits, recordings
from tests.simulated import simulate_social_nav, social_nav_episode


@pytest.fixture(scope="module")
def episode() -> Recording:
    spec = SocialNavSpec(max_steps=120, human=WalkerSpec(speed_mps=1.2))
    return simulate_social_nav(social_nav_episode(build_home(HomeSpec(seed=1)), seed=5, spec=spec))


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def hashed(recording: Recording, **columns: Any) -> Recording:
    """With these columns changed, and the hash made anew: only the change itself is wrong."""
    changed = {**recording.columns, **{n.replace("__", "."): a for n, a in columns.items()}}
    return replace(recording, columns={**changed, "state_hash": state_hash(changed)})


def gliding(recording: Recording) -> Recording:
    """The same, with a person who stands as they get on."""
    body = load_humanoid(recording.agents[1].model.partition("/")[2])
    quats, pelvis = (part[0] for part in body.clip_pose([0], [0.0]))
    base = recording.columns["agent_1.base_pose"].astype(np.float64)
    root = np.stack([pose_multiply(pose, np.concatenate([pelvis, quats[0]])) for pose in base])
    joints = np.tile(quats[1:], (len(base), 1, 1))
    columns = {"agent_1.root_pose": root.astype(np.float32), "agent_1.joint_quat": joints.astype(np.float32)}
    return hashed(recording, **columns)


def edited(recording: Recording, name: str, index: Any, value: Any) -> Recording:
    array = recording.columns[name].copy()
    array[index] = value
    return hashed(recording, **{name: array})


def only(recording: Recording, check: str, severity: str) -> Finding:
    """The one finding that there is of this kind; there is no other error."""
    findings = validate_recording(recording)
    assert {f.check for f in findings if f.severity == "error"} <= {check}, findings
    found = [f for f in findings if (f.check, f.severity) == (check, severity)]
    assert len(found) == 1, findings
    return found[0]


def test_our_own_recordings_are_sound(episode: Recording) -> None:
    assert validate_recording(episode) == []


def test_a_changed_state_breaks_the_chain_from_there_on(episode: Recording) -> None:
    base = episode.columns["agent_0.base_pose"].copy()
    base[50, 0] += 1e-4
    found = only(replace(episode, columns={**episode.columns, "agent_0.base_pose": base}), "hash", "error")
    assert (found.step, found.count) == (50, 70)
    rows = [k for k in range(120) if k != 30]
    cut = replace(episode, columns={n: a[rows] for n, a in episode.columns.items()}, events=(), skills=())
    assert only(cut, "hash", "error").step == 30


@pytest.mark.parametrize(
    ("name", "index", "value", "check", "severity"),
    [
        ("agent_0.base_pose", (20, slice(3, 7)), [0, 0.5, 0, 0], "quaternions", "error"),
        ("agent_0.base_pose", (20, slice(3, 7)), [0, 1.005, 0, 0], "quaternions", "warning"),
        ("agent_0.base_pose", (20, 1), np.nan, "values", "error"),
        ("agent_0.base_pose", (20, 1), np.inf, "values", "error"),
        ("agent_0.joint_pos", (20, 3), np.nan, "values", "error"),
        ("agent_0.skill", 20, 99, "schema", "error"),
        ("agent_0.grasp_body", 20, -2, "schema", "error"),
        ("agent_1.motion_id", 20, 500, "schema", "error"),
        ("agent_1.motion_phase", 20, 1.5, "schema", "error"),
        ("agent_0.joint_pos", (20, 3), 9.0, "jumps", "warning"),
        ("agent_0.base_pose", (slice(20, None), 1), 2.0, "jumps", "warning"),
    ],
)
def test_a_bad_value_is_found_where_it_is(
    episode: Recording, name: str, index: Any, value: Any, check: str, severity: str
) -> None:
    found = only(edited(episode, name, index, value), check, severity)
    assert found.step == 20
    assert name.split(".")[0] in found.subject or found.subject == "robot"


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("agent_0.base_pose", np.zeros((120, 6), np.float32)),
        ("agent_0.base_pose", np.tile([0.0, 0, 0, 0, 0, 0, 1], (120, 1))),
        ("agent_0.joint_pos", np.zeros((120, 3), np.float32)),
        ("agent_0.skill", np.zeros(120, np.float32)),
        ("agent_0.action", np.zeros((120, 5), np.float32)),
        ("agent_7.skill", np.zeros(120, np.int32)),
        ("agent_1.joint_quat", np.zeros((120, 4), np.float32)),
    ],
)
def test_columns_of_another_kind_are_named(episode: Recording, name: str, array: np.ndarray) -> None:
    assert only(hashed(episode, **{name: array}), "schema", "error").subject == name


def test_records_that_point_nowhere_are_found(episode: Recording) -> None:
    body = episode.bodies[0]
    for broken in (
        replace(episode, events=(Event(step=120, agent=0, kind="x"),)),
        replace(episode, inputs=(InputEvent(time_ns=0, kind="key_down", payload="w"),)),
        replace(episode, skills=(SkillSpan(agent=0, name="x", start_step=9, end_step=3),)),
        replace(episode, bodies=(replace(body, agent=5), *episode.bodies[1:])),
        replace(episode, bodies=(replace(body, pose=np.full(7, np.nan, np.float32)), *episode.bodies[1:])),
    ):
        only(broken, "schema", "error")


def test_a_gap_and_a_wrong_step_are_told(episode: Recording) -> None:
    late = episode.columns["time_ns"].copy()
    late[60:] += 10**9
    assert only(replace(episode, columns={**episode.columns, "time_ns": late}), "time", "warning").step == 60
    slow = replace(episode, columns={**episode.columns, "time_ns": episode.columns["time_ns"] * 3})
    assert only(slow, "time", "warning").subject == "dt_ns"


def test_walls_and_each_other_are_not_entered(episode: Recording) -> None:
    outside = edited(episode, "agent_0.base_pose", (slice(100, None), 0), 50.0)
    found = only(outside, "penetration", "error")
    assert (found.subject, found.step, found.count) == ("robot", 100, 20)
    together = hashed(episode, **{"agent_0.base_pose": episode.columns["agent_1.base_pose"]})
    assert only(together, "penetration", "error").subject == "robot, human"
    played = replace(together, episode=replace(together.episode, info={**together.episode.info, "hitl": {}}))
    assert only(played, "penetration", "warning").subject == "robot, human", "people may walk into robots"


def test_feet_that_slide_and_sink_are_told(episode: Recording) -> None:
    assert "slides at 1.2" in only(gliding(episode), "feet", "warning").text
    base = np.tile(episode.columns["agent_1.base_pose"][:1], (120, 1))
    quat = np.zeros((120, 54, 4), np.float32)
    quat[..., 3] = 1  # stands with straight legs
    root = base.copy()
    root[:, 1] = 0.5
    columns = {"agent_1.base_pose": base, "agent_1.root_pose": root, "agent_1.joint_quat": quat}
    assert "below the root" in only(hashed(episode, **columns), "penetration", "warning").text


def test_missing_assets_are_told(episode: Recording) -> None:
    asset = replace(episode.assets[0], uri="chairs/none.glb")
    found = only(replace(episode, assets=(asset, *episode.assets[1:])), "assets", "warning")
    assert found.subject == "chairs/none.glb"
    only(replace(episode, attachments={"scene.glb": b"no scene"}), "assets", "error")


def test_an_episode_without_steps_is_sound(episode: Recording) -> None:
    empty = replace(episode, columns={n: a[:0] for n, a in episode.columns.items()}, events=(), skills=())
    assert validate_recording(empty) == []


def test_real_recordings_have_no_errors(real: Path) -> None:
    rooms = sorted(real.glob("habitat-sim/reference/replays/*/replay.gfx_replay.json"))
    for path in (*rooms, real / "hitl/my_session.gfx_replay.json"):
        findings = validate_recording(read_gfx_replay(path))
        assert [f for f in findings if f.severity == "error"] == []
        assert {f.check for f in findings} <= {"assets", "jumps"}
        assert any(f.check == "assets" for f in findings)  # none are at hand


# --- hostile ----------------------------------------------------------------------------------------------------------
@given(recordings())
def test_any_recording_can_be_judged(recording: Recording) -> None:
    for finding in validate_recording(recording):
        assert finding.step < max(len(recording), 1)
        assert finding.subject in str(finding)


@settings(max_examples=examples(12))
@given(which=st.integers(0, 2**16), row=st.integers(0, 119), seed=st.integers(0, 2**32))
def test_flipped_bits_are_found(episode: Recording, which: int, row: int, seed: int) -> None:
    """Neither the validation nor the simulator stumbles over them, and both notice."""
    names = [n for n in episode.columns if n.startswith(("agent_", "sim."))]
    name, rng = names[which % len(names)], np.random.default_rng(seed)
    array = episode.columns[name].copy()
    array[row] = random_bits(rng, array.dtype.name, array.shape[1:])
    broken = replace(episode, columns={**episode.columns, name: array})
    same = array.tobytes() == episode.columns[name].tobytes()
    found = validate_recording(broken)
    assert same or name == "agent_0.action" or any(f.check == "hash" and f.step == row for f in found)
    try:
        with np.errstate(all="ignore"):
            assert verify(broken).equal == same
    except H3DataError:
        assert not same


# --- command ----------------------------------------------------------------------------------------------------------
def test_the_command(episode: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with DatasetWriter(tmp_path / "in" / "ds") as out:
        out.add(episode)
        out.add(edited(episode, "agent_0.joint_pos", (20, 3), 9.0))
    whole = write_mcap(episode, tmp_path / "in" / "a.mcap")
    assert run_json(capsys, "validate", whole)["episodes"][0]["verdict"] == "sound"
    found = run_json(capsys, "validate", tmp_path / "in")
    assert [row["verdict"] for row in found["episodes"]] == ["sound", "sound", "warnings"]
    assert found["warning"] == {"jumps": 1}
    assert run_json(capsys, "validate", tmp_path / "in", "--strict", code=1)["failed"] == 1
    (tmp_path / "in" / "cut.mcap").write_bytes(whole.read_bytes()[:-200])
    (tmp_path / "in" / "none.mcap").write_bytes(b"")
    (tmp_path / "in" / "old" / "meta").mkdir(parents=True)
    (tmp_path / "in" / "old" / "meta" / "info.json").write_text("{")
    found = run_json(capsys, "validate", tmp_path / "in", code=1)
    assert (found["recordings"], found["failed"], found["error"]) == (6, 3, {"unreadable": 3})
    assert main(["validate", str(tmp_path / "in")]) == 1
    assert "6 recordings, 3 failed" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["none.mcap", "empty", "ds#4", ""])
def test_what_is_not_there_is_refused(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert run_json(capsys, "validate", *([tmp_path / name] if name else []), code=2)["error"]


# --- one planted fault for each check, through the command ------------------------------------------------------------
def swapped_steps(source: Path, target: Path, first: int, second: int) -> None:
    """A copy of a log in which two steps have changed places: time goes back."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out)
        writer.start(profile="h3data")
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for file in reader.iter_attachments():
            writer.add_attachment(file.create_time, file.log_time, file.name, file.media_type, file.data)
        messages = list(reader.iter_messages())
        channels: dict[int, int] = {}
        for schema, channel, _ in messages:
            if channel.id not in channels:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
        data = [m.data for _, _, m in messages]
        steps = [k for k, (_, channel, _) in enumerate(messages) if channel.topic == "/h3/state"]
        a, b = steps[first], steps[second]
        data[a], data[b] = data[b], data[a]
        for (_, channel, message), content in zip(messages, data, strict=True):
            number = channels[channel.id]
            writer.add_message(number, message.log_time, content, message.publish_time, message.sequence)
        writer.finish()


def late(rec: Recording) -> Recording:
    time_ns = rec.columns["time_ns"].copy()
    time_ns[60:] += 10**9
    return replace(rec, columns={**rec.columns, "time_ns": time_ns})


def forged(rec: Recording) -> Recording:
    base = rec.columns["agent_0.base_pose"].copy()
    base[50, 0] += 1e-4
    return replace(rec, columns={**rec.columns, "agent_0.base_pose": base})


def lost(rec: Recording) -> Recording:
    return replace(rec, assets=(replace(rec.assets[0], uri="chairs/none.glb"), *rec.assets[1:]))


def thrown(rec: Recording) -> Recording:
    """A thing that is elsewhere from step 30 on, and one that turns over at step 40."""
    poses = np.zeros((len(rec), 2, 7), np.float32)
    poses[:, :, 6] = 1
    poses[:, :, 1] = 3
    poses[30:, 0, 0] = 5
    poses[40:, 1, 3:] = [1, 0, 0, 0]
    body = replace(rec.bodies[0], agent=-1)
    things = tuple(replace(body, name=n, moving=k) for k, n in enumerate(("thrown", "turned")))
    columns = {**rec.columns, "object_pose": poses}
    return hashed(replace(rec, bodies=(*rec.bodies, *things), columns=columns))


PLANTED: dict[str, tuple[Callable[[Recording], Recording], str, list[tuple[str, int]]]] = {
    "schema": (lambda r: edited(r, "agent_0.skill", 20, 99), "error", [("agent_0.skill", 20)]),
    "time": (late, "warning", [("time_ns", 60)]),
    "values": (lambda r: edited(r, "agent_0.joint_pos", (20, 3), np.nan), "error", [("agent_0.joint_pos", 20)]),
    "quaternions": (
        lambda r: edited(r, "agent_1.base_pose", (20, slice(3, 7)), [0, 0.5, 0, 0]),
        "error",
        [("agent_1.base_pose", 20)],
    ),
    "hash": (forged, "error", [("state_hash", 50)]),
    "jumps": (thrown, "warning", [("thrown", 30), ("turned", 40)]),
    "penetration": (lambda r: edited(r, "agent_0.base_pose", (slice(100, None), 0), 50.0), "error", [("robot", 100)]),
    "feet": (gliding, "warning", [("human", 10)]),
    "assets": (lost, "warning", [("chairs/none.glb", -1)]),
}


@pytest.mark.parametrize("check", PLANTED)
def test_a_planted_fault_is_found_by_the_command(
    episode: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str], check: str
) -> None:
    plant, severity, expected = PLANTED[check]
    path = tmp_path / "x.mcap"
    write_mcap(plant(episode), path)
    report = run_json(capsys, "validate", path, code=int(severity == "error"))
    found = [f for f in report["episodes"][0]["findings"] if f["check"] == check]
    assert [(f["subject"], f["step"]) for f in found] == expected
    assert {f["severity"] for f in found} == {severity}
    assert report[severity][check] == len(expected)
    assert main(["validate", str(path)]) == int(severity == "error")
    assert check in capsys.readouterr().out


def test_time_that_goes_back_is_found(episode: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = tmp_path / "whole.mcap"
    write_mcap(episode, whole)
    swapped_steps(whole, tmp_path / "same.mcap", 10, 10)
    assert run_json(capsys, "validate", tmp_path / "same.mcap")["failed"] == 0
    swapped_steps(whole, tmp_path / "x.mcap", 10, 11)
    report = run_json(capsys, "validate", tmp_path / "x.mcap", code=1)
    (found,) = report["episodes"][0]["findings"]
    assert found["check"] == "unreadable"
    assert "in order" in found["text"]


def test_a_home_that_episodes_share_is_read_once(
    episode: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []

    def counted(glb: bytes) -> Any:
        read.append(len(glb))
        return load_scene(glb)

    monkeypatch.setattr(validation, "load_scene", counted)
    validation._scene_of.cache_clear()
    with DatasetWriter(tmp_path / "ds") as writer:
        for k in range(4):
            writer.add(replace(episode, episode=replace(episode.episode, uid=f"u{k}")))
    assert main(["validate", str(tmp_path / "ds")]) == 0
    assert len(read) == 1


def test_episodes_are_read_together_and_a_damaged_one_alone() -> None:
    asked: list[object] = []

    def stored(k: int, path: str = "ds", length: int = 40, damaged: range = range(0)) -> StoredEpisode:
        def together(indices: range) -> Iterator[Any]:
            asked.append(indices)
            if set(indices) & set(damaged):
                raise H3DataError("damaged")
            return iter([(path, n) for n in indices])

        def alone() -> Any:
            asked.append(k)
            return path, k

        return StoredEpisode(
            f"{path}#{k}", Path(path), alone, lambda: {"length": length, "info": {}}, k, read_together=together
        )

    found = [stored(0), stored(1), stored(2), stored(4), stored(5), stored(0, "other"), stored(1, "other")]
    got = [read() for read in read_ahead(found, most_steps=100)]
    assert got == [("ds", 0), ("ds", 1), ("ds", 2), ("ds", 4), ("ds", 5), ("other", 0), ("other", 1)]
    assert asked == [range(2), 2, range(4, 6), range(2)]
    asked.clear()
    got = [read() for read in read_ahead([stored(k, damaged=range(1, 2)) for k in range(2)], most_steps=100)]
    assert got == [("ds", 0), ("ds", 1)]
    assert asked == [range(2), 0, 1]
