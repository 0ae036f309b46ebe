"""Motion on other bodies: laws of retargeting, feet that stand still, cycles that close, recordings and the command."""

from __future__ import annotations

import json
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from h3data.bodies import JOINT_INDEX, Humanoid, load_humanoid
from h3data.bodies.people.clips import clip_table, sample_clips
from h3data.bodies.people.soles import ANKLE, runs, sole_points
from h3data.errors import InputError
from h3data.geometry import ground_pose, quat_multiply
from h3data.recording import Recording, open_recording, write_mcap
from h3data.replay import Replay
from h3data_motion.amass import quat_from_rotvec
from h3data_motion.clip import Motion, same_motion
from h3data_motion.contacts import leg_frames, legs_to
from h3data_motion.cycle import find_loop, trim_to_cycle
from h3data_motion.files import load_motion, read_motion
from h3data_motion.recording import motion_columns, motion_recording
from h3data_motion.retarget import foot_report, retarget
from h3data_pipelines.cli import main
from tests.motion.motion_writers import amass_arrays, bvh_text, placed, turned, walked, write_all
from tests.paths import EXAMPLES

BODIES = ("male_1", "female_3", "neutral_2")
SPEEDS = (0.6, 1.3, 1.6, 2.5)


def _stances(source: Humanoid, motion: Motion, speed: float) -> list[tuple[int, int]]:
    """Frames in which the source's left foot rests on its ball, flat or pushing off, from the phase of its walk."""
    phase = speed * np.arange(len(motion)) / motion.fps / float(source.stride_m(speed)) % 1.0
    return [run for run in runs((phase > 0.16) & (phase < (0.5 if speed < 2 else 0.25))) if run[1] - run[0] > 3]


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("target", BODIES)
def test_planted_feet_do_not_slide(speed: float, target: str) -> None:
    source, body = load_humanoid("male_1"), load_humanoid(target)
    motion = walked(source, speed)
    fitted = retarget(motion, body)
    ball = leg_frames(body, fitted.quats, fitted.pelvis)[:, 0, 3, :3, 3]
    stances = _stances(source, motion, speed)
    assert len(stances) >= 2
    for start, end in stances:
        assert np.ptp(ball[start:end, ::2], axis=0).max() < 1e-3  # 1 mm
    lowest = sole_points(body, leg_frames(body, fitted.quats, fitted.pelvis))[..., 1].min(axis=2)
    on_floor = np.concatenate([lowest[start:end, 0] for start, end in stances])
    assert np.abs(on_floor).max() < 5e-3
    assert lowest.min() > -1e-9
    assert foot_report(fitted, body).slide_mm < 0.2


def test_a_body_keeps_its_own_walk() -> None:
    """Fitted to the body that walked it, a motion hardly changes."""
    for name in BODIES:
        body = load_humanoid(name)
        motion = walked(body, 1.3)
        angle, way = same_motion(retarget(motion, body), motion)
        assert np.degrees(angle) < 3
        assert way < 5e-3
        angle, way = same_motion(retarget(motion, body, plant=False), motion)
        assert angle < 1e-7
        assert way < 5e-3  # the floor is found to this


@settings(max_examples=10)
@given(heading=st.floats(-180, 180), x=st.floats(-9, 9), z=st.floats(-9, 9), up=st.floats(-1, 1))
def test_rigid_motion_stays_rigid(heading: float, x: float, z: float, up: float) -> None:
    """Turned and shifted motion is the same motion turned and shifted; its height does not matter."""
    body, motion = load_humanoid("female_3"), walked(load_humanoid("male_1"), seconds=1.2, fps=30)
    scale = body.gaits.legs.length / load_humanoid("male_1").gaits.legs.length
    a = retarget(placed(motion, heading, (x, up, z)), body)
    b = placed(retarget(motion, body), heading, (scale * x, 0, scale * z))
    angle, way = same_motion(a, b)
    assert angle < 1e-6
    assert way < 1e-7


def test_the_way_scales_with_the_legs() -> None:
    source, body = load_humanoid("male_1"), load_humanoid("female_3")
    motion = walked(source, 1.3)
    scale = body.gaits.legs.length / source.gaits.legs.length
    assert retarget(motion, body).path_m == pytest.approx(scale * motion.path_m, rel=1e-3)
    for target in BODIES:  # who does not say how long his legs are shows it by walking
        fitted, told = (retarget(replace(motion, leg_m=leg), load_humanoid(target)) for leg in (None, motion.leg_m))
        assert fitted.path_m == pytest.approx(told.path_m, rel=0.02)
    still = replace(motion, quats=motion.quats[:1].repeat(9, 0), pelvis=motion.pelvis[:1].repeat(9, 0), leg_m=None)
    fitted = retarget(still, body)
    assert np.abs(sole_points(body, leg_frames(body, fitted.quats, fitted.pelvis))[..., 1].min()) < 5e-3


def test_turns_step_instead_of_sliding() -> None:
    motion = turned(load_humanoid("neutral_2"))
    for target in BODIES:
        body = load_humanoid(target)
        assert foot_report(retarget(motion, body), body).slide_mm < 0.3


def test_shaky_motion_is_planted_too() -> None:
    """Half a degree of noise in every joint and 3 mm in the pelvis' place, as of optical capture."""
    body, random = load_humanoid("female_3"), np.random.default_rng(0)

    def smooth(shape: tuple[int, ...], size: float) -> np.ndarray:
        noise = gaussian_filter1d(random.normal(0, 1, shape), 5.0, axis=0)
        return noise * size / noise.std()

    for speed in (0.6, 1.3, 2.5):
        motion = walked(load_humanoid("male_1"), speed)
        shaky = quat_multiply(motion.quats, quat_from_rotvec(smooth((len(motion), 55, 3), np.radians(0.5))))
        motion = replace(motion, quats=shaky, pelvis=motion.pelvis + smooth((len(motion), 3), 0.003))
        before, after = (foot_report(retarget(motion, body, plant=plant), body) for plant in (False, True))
        assert before.slide_mm > 3
        assert after.slide_mm < 0.6
        assert after.lowest_mm > -0.01


def test_a_jump_stays_in_the_air() -> None:
    body = load_humanoid("male_1")
    stand, pelvis = body.clip_pose(np.zeros(60, int), np.zeros(60))
    rise = np.zeros(60)
    rise[20:40] = 0.4 * np.sin(np.pi * np.arange(20) / 20) ** 2
    motion = Motion(
        name="jump", fps=30, quats=stand, pelvis=pelvis + rise[:, None] * [0.0, 1, 0], leg_m=body.gaits.legs.length
    )
    fitted = retarget(motion, body)
    lowest = sole_points(body, leg_frames(body, fitted.quats, fitted.pelvis))[..., 1].min(axis=(1, 2))
    assert lowest[30] == pytest.approx(0.4, abs=0.02)
    assert np.abs(lowest[[0, 10, 50, 59]]).max() < 1e-3


@settings(max_examples=20)
@given(data=st.data())
def test_legs_reach_what_is_within_reach(data: st.DataObject) -> None:
    """Any pose, any targets within reach: the ankles are there, the feet turned as before; no move asked, none made."""
    body = load_humanoid("female_3")
    seed = data.draw(st.integers(0, 10_000))
    random = np.random.default_rng(seed)
    quats = np.tile([0.0, 0, 0, 1], (6, 55, 1))
    quats[:, :12] = quat_from_rotvec(random.normal(0, 0.3, (6, 12, 3)))
    for side in ("left", "right"):
        quats[:, JOINT_INDEX[f"{side}_knee"]] = quat_from_rotvec(random.uniform(0.2, 1.5, (6, 1)) * [1.0, 0, 0])
    pelvis = random.normal(0, 1, (6, 3))
    frames = leg_frames(body, quats, pelvis)
    ankles = frames[:, :, ANKLE, :3, 3]
    same = legs_to(body, quats, pelvis, ankles)
    assert np.abs(np.abs(np.sum(same * quats, axis=-1)) - 1).max() < 1e-9
    hips = frames[:, :, 0, :3, 3]
    aims = hips + (ankles - hips) * random.uniform(0.8, 1.0, (6, 2, 1)) + random.normal(0, 0.03, (6, 2, 3))
    far = np.linalg.norm(aims - hips, axis=-1, keepdims=True)
    aims = hips + (aims - hips) * np.minimum(1, 0.99 * body.gaits.legs.length / far)
    moved = leg_frames(body, legs_to(body, quats, pelvis, aims), pelvis)
    assert np.abs(moved[:, :, ANKLE, :3, 3] - aims).max() < 1e-6
    np.testing.assert_allclose(moved[:, :, ANKLE, :3, :3], frames[:, :, ANKLE, :3, :3], atol=1e-9)


# --- cycles ---------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("speed", SPEEDS)
def test_a_walk_is_one_cycle(speed: float) -> None:
    source = load_humanoid("male_1")
    period = float(source.stride_m(speed)) / speed
    loop = find_loop(walked(source, speed, seconds=2.6 * period), source)
    assert loop.end_s - loop.start_s == pytest.approx(period, abs=1 / 59)
    for target in ("male_1", "female_3"):
        body = load_humanoid(target)
        clip = trim_to_cycle(placed(walked(source, speed, seconds=2.6 * period), 40, (1, 0, 2)), body)
        scale = body.gaits.legs.length / source.gaits.legs.length
        assert clip.stride_m == pytest.approx(scale * speed * period, rel=0.03)
        assert clip.speed_mps == pytest.approx(scale * speed, rel=0.02)
        # it closes: the step over the seam is like the steps beside it
        steps = np.abs(np.diff(np.concatenate([clip.quats, clip.quats[:1]]), axis=0)).max(axis=(1, 2))
        assert steps[-1] < 2 * max(steps[-3], steps[0]) + 1e-3
        assert np.abs(clip.pelvis[0] - clip.pelvis[-1]).max() < 0.01
        assert clip.stance == pytest.approx(0.62 if speed < 2 else 0.36, abs=0.1)


def test_a_cycle_is_played_by_distance() -> None:
    """On the clip machinery of walks: planted feet stay put, also from standing."""
    body = load_humanoid("female_3")
    clip = trim_to_cycle(walked(load_humanoid("male_1"), 1.3, seconds=3), body)
    table = clip_table([body.clips[0], clip], body.gaits.legs)
    way = np.linspace(0, 2 * clip.stride_m, 240)
    phase = way / clip.stride_m
    quats, pelvis = sample_clips(table, np.ones(240, int), phase, 1.0)
    base = ground_pose(np.stack([way, 0 * way], axis=1), np.zeros(240))
    ball = body.joint_matrices(base, quats, pelvis)[:, JOINT_INDEX["left_foot"], :3, 3]
    for start, end in runs((phase % 1 > 0.2) & (phase % 1 < 0.45)):
        assert np.ptp(ball[start:end, ::2], axis=0).max() < 2e-3
    half = sample_clips(table, [1, 1], [clip.start_phase] * 2, [0.0, 0.6])
    assert np.isfinite(half[0]).all()
    np.testing.assert_allclose(half[0][0], body.clip_pose([0], [0.0])[0][0], atol=0.02)


def test_turns_and_rests_are_cycles_too() -> None:
    body = load_humanoid("neutral_2")
    clip = trim_to_cycle(turned(body, seconds=2.5), body)
    assert clip.speed_mps == 0
    assert clip.stride_m == 1
    assert np.degrees(clip.turn_rad) == pytest.approx(45, abs=5)
    with pytest.raises(InputError, match=r"(?s)0\.18.*H3-BODY-044"):
        trim_to_cycle(walked(body, seconds=0.2), body)
    with pytest.raises(InputError, match="H3-BODY-043"):
        find_loop(walked(body, seconds=1), body, min_s=2, max_s=1)


# --- recordings -----------------------------------------------------------------------------------------------------------
def test_a_recording_of_motion(tmp_path: Path) -> None:
    body, motion = load_humanoid("male_1"), walked(load_humanoid("male_1"), 1.3, seconds=1, fps=30)
    start = ground_pose(np.array([2.0, 3.0]), np.array(0.7), 0.5)
    columns = motion_columns(motion, body, start=start)
    assert len(columns["time_ns"]) == len(motion)
    assert columns["agent_0.base_pose"][0] == pytest.approx(start, abs=0.05)
    fitted = retarget(motion, body)
    np.testing.assert_allclose(columns["agent_0.joint_quat"], fitted.quats[:, 1:], atol=1e-6)
    truth = body.joint_matrices(np.tile(start, (len(motion), 1)), fitted.quats, fitted.pelvis)
    found = body.joint_matrices_free(columns["agent_0.root_pose"], columns["agent_0.joint_quat"])
    np.testing.assert_allclose(found, truth, atol=1e-5)
    write_mcap(motion_recording(motion, body), tmp_path / "walk.mcap")
    recording = open_recording(tmp_path / "walk.mcap")
    assert isinstance(recording, Recording)
    replay = Replay(recording)
    skin = next(k for k, d in enumerate(replay.drawables) if d.deformable)
    vertices = replay.vertices(skin, np.arange(len(recording)))
    assert np.abs(vertices[..., 1].min(axis=1)).max() < 0.02
    assert recording.episode.info["source"] == "our own walk"


# --- the command ----------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("motion")
    write_all(folder / "in")
    return folder


def test_import_walks_folders(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "in" / "sub"
    bad.mkdir(parents=True)
    for path in (folder / "in").iterdir():
        (bad / path.name).write_bytes(path.read_bytes())
    np.savez(bad / "shape.npz", betas=np.zeros(10), gender=np.array("male"))
    (bad / "cut.bvh").write_text((folder / "in" / "2_cmu_jog.bvh").read_text()[:9000])
    (bad / "notes.txt").write_text("no motion")
    arguments = ["motion", "import", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--body", "female_1", "--json"]
    assert main(arguments) == 1
    report = json.loads(capsys.readouterr().out)
    assert (report["imported"], report["skipped"], report["failed"]) == (5, 1, 1)
    kinds = {Path(row["source"]).name: row.get("kind") for row in report["files"]}
    assert [kinds[n] for n in sorted(kinds)[:5]] == ["amass", "bvh", "bvh", "bvh", "habitat"]
    reasons = {Path(row["source"]).name: row["reason"] for row in report["files"] if row["status"] != "imported"}
    assert "without motion" in reasons["shape.npz"]
    assert "cut.bvh" in reasons["cut.bvh"]
    made = load_motion(tmp_path / "out" / "sub" / "2_cmu_jog.npz")
    assert made.body == "female_1"
    assert main(["motion", "import", str(bad / "cut.bvh"), "-o", str(tmp_path / "x")]) == 2
    assert main(["motion", "import", str(bad / "1_amass_walk.npz"), "-o", str(tmp_path / "out" / "sub")]) == 2
    assert "--force" in capsys.readouterr().err
    assert (
        main(["motion", "import", str(bad / "1_amass_walk.npz"), "-o", str(tmp_path / "out" / "sub"), "--force"]) == 0
    )
    capsys.readouterr()


@pytest.mark.slow
def test_show_draws(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(p) for p in sorted((folder / "in").iterdir())[:2]]
    assert main(["motion", "show", *files, "--json", "--cycle"]) == 0
    rows = json.loads(capsys.readouterr().out)["motions"]
    assert rows[0]["stride_m"] == pytest.approx(1.3, abs=0.15)
    assert rows[1]["slide_mm"] < 0.5
    arguments = ["motion", "show", *files, "--width", "400", "--frames", "3"]
    assert main([*arguments, "-o", str(tmp_path / "strip.png")]) == 0
    assert main([*arguments, "-o", str(tmp_path / "cycle.jpg"), "--cycle"]) == 0
    assert (tmp_path / "strip.png").stat().st_size > 10_000
    assert (tmp_path / "cycle.jpg").stat().st_size > 5_000
    capsys.readouterr()
    for bad, message in (
        (["motion", "show", files[0], "-o", str(tmp_path / "a.gif")], ".png, .jpg or .mp4"),
        (["motion", "show", *files, "-o", str(tmp_path / "a.mp4")], "one motion"),
        (["motion", "show", files[0], "--frames", "0"], "--frames"),
        (["motion", "show", files[0], "--kind", "bvh"], "expected HIERARCHY"),
        (["motion", "show", files[1], "--kind", "amass"], "Expected an npz"),
        (["motion", "show", str(tmp_path / "none.bvh")], "none.bvh"),
        (["motion", "import", str(tmp_path / "none.bvh"), "-o", str(tmp_path)], "does not exist"),
        (["motion", "import", files[0], "-o", str(tmp_path), "--fps", "-3"], "--fps"),
        (["motion", "show", files[1], "--names", "my_names"], "No table of joint names"),
    ):
        assert main(bad) == 2
        assert message in capsys.readouterr().err


def test_the_example_writes_a_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = load_humanoid("male_1")
    (tmp_path / "walk.bvh").write_text(bvh_text(body, walked(body, seconds=0.2, fps=30), "mixamo"))
    example = EXAMPLES / "play_a_motion.py"
    assert len(example.read_text().splitlines()) <= 40
    monkeypatch.setattr(sys, "argv", ["x", str(tmp_path / "walk.bvh"), str(tmp_path / "walk.mp4")])
    runpy.run_path(str(example))
    assert (tmp_path / "walk.mp4").stat().st_size > 5_000


def test_import_then_show_is_the_same_motion(tmp_path: Path) -> None:
    """What the command stored reads as what the file says."""
    body = load_humanoid("male_1")
    np.savez(tmp_path / "walk.npz", **amass_arrays(walked(body, seconds=0.3)))
    assert main(["motion", "import", str(tmp_path / "walk.npz"), "-o", str(tmp_path / "out"), "--source", "mine"]) == 0
    stored = read_motion(tmp_path / "out" / "walk.npz")
    assert stored.source == "mine"
    read = read_motion(tmp_path / "walk.npz")
    assert np.array_equal(stored.quats, read.quats)
    assert np.array_equal(stored.pelvis, read.pelvis)
