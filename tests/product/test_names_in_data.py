"""Files that name Python of the working directory: no command runs it, unless the user says so."""

import sys
from dataclasses import replace

import pytest

from h3data import plugins
from h3data.errors import UntrustedNameError
from h3data.recording import write_mcap
from h3data.scene import HomeSpec, build_home
from h3data_pipelines.cli import main
from h3data_pipelines.command import Group
from h3data_pipelines.commands.table import COMMANDS
from tests.simulated import simulate_wander

CANARY = """
from pathlib import Path
Path("ran").write_text("")
from h3data.metrics.any_task import PROFILE
from sim_kinematic.tasks.wander import Wander
class Mine(Wander):
    name = "mine"
"""
HOSTILE = {
    "profile": {"profile": "canary:PROFILE"},
    "task": {"task": "canary:Mine"},
    "policy": {"policy": "canary:Mine", "partner": "canary:Mine", "policies": ["canary:Mine", "canary:Mine"]},
}


@pytest.fixture(scope="module")
def small_home():
    return build_home(HomeSpec(preset="small", seed=5))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with the canary, which is on ``sys.path`` as in `main`."""
    (tmp_path / "canary.py").write_text(CANARY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    monkeypatch.setenv(plugins.TRUST_VARIABLE, "")
    yield tmp_path
    sys.modules.pop("canary", None)


def _hostile(small_home, what):
    recording = simulate_wander(small_home, steps=3)
    if what == "robot":
        return replace(recording, agents=tuple(replace(a, model=f"{a.kind}/canary:Mine") for a in recording.agents))
    return replace(recording, episode=replace(recording.episode, info={**recording.episode.info, **HOSTILE[what]}))


@pytest.mark.parametrize("what", [*HOSTILE, "robot"])
def test_no_reading_command_runs_what_a_recording_names(folder, small_home, monkeypatch, what):
    write_mcap(_hostile(small_home, what), folder / "a.mcap")
    for words in (
        ["metrics"],
        ["report", "-o", "r.html"],
        ["replay", "--verify"],
        ["info"],
        ["validate"],
        ["card", "--dry-run"],
    ):
        assert words[0] in COMMANDS
        assert not isinstance(COMMANDS[words[0]], Group)
        main([words[0], "a.mcap", *words[1:]])
        assert not (folder / "ran").exists(), words


def test_the_refusal_names_the_command_and_trust_lifts_it(folder, small_home, monkeypatch, capsys):
    write_mcap(_hostile(small_home, "task"), folder / "a.mcap")
    monkeypatch.setattr(sys, "argv", ["h3data", "replay", "a.mcap", "--verify"])
    assert main() == 2
    assert "h3data replay a.mcap --verify --trust canary" in capsys.readouterr().err
    main(["replay", "a.mcap", "--verify", "--trust", "canary"])
    assert (folder / "ran").exists()


def test_a_profile_is_refused_in_python_until_its_module_is_trusted(folder, small_home):
    from h3data.metrics import measure

    recording = _hostile(small_home, "profile")
    with pytest.raises(UntrustedNameError, match="canary"):
        measure(recording)
    assert not (folder / "ran").exists()
    plugins.trust("canary")
    assert measure(recording).profile == "task"


def test_an_entry_point_in_the_working_directory_is_not_installed(folder):
    info = folder / "evil-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[h3data.test_kind]\nevil = canary:PROFILE\n")
    registry = plugins.Registry("h3data.test_kind", {}, what="thing")
    assert registry.names() == ()
    assert registry.load_all() == {}
    assert not (folder / "ran").exists()
