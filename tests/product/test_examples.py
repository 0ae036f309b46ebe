"""The examples run as printed."""

import runpy
import sys
from pathlib import Path

import pytest

from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import SocialNavSpec
from tests.paths import EXAMPLES
from tests.simulated import simulate_social_nav, social_nav_episode


def test_draw_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from h3data.recording import write_mcap

    spec = SocialNavSpec(max_steps=20, spawn_distance_m=3.0)
    recording = simulate_social_nav(social_nav_episode(build_home(HomeSpec(seed=1)), seed=1, spec=spec))
    write_mcap(recording, tmp_path / "e.mcap")
    monkeypatch.setattr(sys, "argv", ["x", str(tmp_path / "e.mcap"), str(tmp_path / "p.png")])
    runpy.run_path(str(EXAMPLES / "draw_a_recording.py"))
    assert (tmp_path / "p.png").stat().st_size > 20_000


@pytest.mark.slow
def test_measure_policies(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "measure_policies.py"))
    out = capsys.readouterr().out
    assert "rollout_expert" in out
    assert out.count("Finding success") >= 2


def test_random_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["x", str(tmp_path / "p.png")])
    runpy.run_path(str(EXAMPLES / "random_agent.py"))
    assert "100 steps" in capsys.readouterr().out
    assert (tmp_path / "p.png").stat().st_size > 20_000


@pytest.mark.slow
def test_vector_env(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "vector_env.py"))
    assert "% of the worlds found the person" in capsys.readouterr().out


@pytest.mark.slow
def test_environment_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["x", str(tmp_path / "p.jpg"), "small:1"])
    runpy.run_path(str(EXAMPLES / "environment_pictures.py"))
    assert (tmp_path / "p.jpg").stat().st_size > 20_000


@pytest.mark.slow
def test_rearrange_pair(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "rearrange_pair.py"))
    out = capsys.readouterr().out
    assert "the person alone:" in out
    assert "complement: success" in out
    assert out.count("RE ") == 3


@pytest.mark.slow
def test_learned_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["x", str(tmp_path / "net.npz")])
    runpy.run_path(str(EXAMPLES / "learned_policy.py"))
    followed = [float(line.split()[2]) for line in capsys.readouterr().out.splitlines()]
    assert followed[0] == 0 < 0.5 < followed[1] <= 1


@pytest.mark.slow
def test_behaviour_cloning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from h3data.recording import DatasetWriter

    spec = SocialNavSpec(max_steps=40, spawn_distance_m=3.0)
    with DatasetWriter(tmp_path / "ds") as writer:
        for seed in range(2):
            world = social_nav_episode(build_home(HomeSpec(seed=1)), seed=seed, spec=spec)
            writer.add(simulate_social_nav(world))
    monkeypatch.setattr(sys, "argv", ["x", str(tmp_path / "ds"), "3"])
    runpy.run_path(str(EXAMPLES / "behaviour_cloning.py"))
    errors = [float(line.rpartition(" ")[2]) for line in capsys.readouterr().out.splitlines()[1:]]
    assert len(errors) == 3
    assert errors[2] < errors[0]


@pytest.mark.parametrize(
    "name",
    ["behaviour_cloning", "cameras_picture", "contact_sheet", "draw_a_recording", "play_a_motion", "readme_picture"],
)
def test_without_arguments_they_say_what_they_want(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["x"])
    with pytest.raises(SystemExit, match=f"Usage: python examples/{name}.py"):
        runpy.run_path(str(EXAMPLES / f"{name}.py"))
