"""Files that name Python of the working directory: no command runs it, unless the user says so."""

import contextlib
import sys
from dataclasses import replace

import msgspec
import pytest

from h3data import plugins
from h3data.bodies import load_robot
from h3data.commands.command import Group
from h3data.errors import H3DataError, PluginError, UntrustedNameError
from h3data.metrics.registry import find_profile, profile_for, profiles_named
from h3data.recording import DatasetWriter, write_mcap
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from h3data_pipelines.commands.table import all_commands
from sim_kinematic.policies.assignment import plugin_policies
from sim_kinematic.tasks.codec import EpisodePlace
from sim_kinematic.tasks.registry import _find, find_task
from sim_kinematic.tasks.resume import resume
from tests.simulated import simulate_wander

COMMANDS = all_commands()

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

READING = {
    "card": [["PATH", "--dry-run"]],
    "convert": [["PATH", "converted"], ["PATH", "converted.mcap"]],
    "export": [
        ["ONE", "--to", form, "-o", f"exported{ending}"]
        for form, ending in {
            "gfx-replay": ".gfx.json",
            "gltf": ".glb",
            "foxglove": ".foxglove.mcap",
            "lerobot": "_lerobot",
            "robomimic": ".hdf5",
            "minari": "-v0",
            "habitat-episodes": "_episodes",
            "csv": "_csv",
            "rosbag2": "_bag",
        }.items()
    ],
    "import": [["PATH", "-o", "imported"]],
    "info": [["PATH"]],
    "metrics": [["PATH"], ["PATH", "--profile", "field"]],
    "recover": [["PATH", "-o", "recovered.mcap"]],
    "replay": [["PATH", "--verify"], ["ONE", "--resume-from", "1", "-o", "resumed.mcap"]],
    "report": [["PATH", "-o", "r.html"]],
    "rerender": [["PATH", "--camera", "third_person", "--outputs", "depth", "-o", "pictures"]],
    "sql": [["select * from episodes", "PATH"]],
    "sync": [["PATH", "synced"]],
    "push": [["PATH", "user/name"]],
    "validate": [["PATH"]],
    "view": [["ONE", "-o", "v.rrd"], ["ONE", "-o", "v.html"]],
    "evaluate": [["wander", "--episodes-file", "PATH", "-o", "table"]],
    "generate": [["wander", "--episodes-file", "PATH", "-o", "more"], ["wander", "--resume", "-o", "PATH"]],
}
"""Command lines by command; PATH is the hostile file or dataset, ONE its episode."""
NOT_OF_RECORDINGS = {
    "bench",
    "completion",
    "demo",
    "docs",
    "doctor",
    "plan",
    "play",
    "pull",
    "serve",
    "train",
    "warmup",
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
    profiles_named.cache_clear()
    _find.cache_clear()


def _in_data(look_up, name):
    with plugins.names_from_data():
        return look_up(name)


def _hostile(small_home, what):
    recording = simulate_wander(small_home, steps=3)
    if what == "robot":
        return replace(recording, agents=tuple(replace(a, model=f"{a.kind}/canary:Mine") for a in recording.agents))
    return replace(recording, episode=replace(recording.episode, info={**recording.episode.info, **HOSTILE[what]}))


@pytest.mark.slow
@pytest.mark.parametrize("form", ["mcap", "dataset"])
@pytest.mark.parametrize("what", [*HOSTILE, "robot"])
def test_no_reading_command_runs_what_a_recording_names(folder, small_home, what, form, monkeypatch):
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")  # nobody listens there
    recording, path = _hostile(small_home, what), "a.mcap" if form == "mcap" else "ds"
    if form == "mcap":
        write_mcap(recording, folder / path)
    else:
        with DatasetWriter(folder / path) as writer:
            writer.add(recording)
    others = {name: [] for name, command in COMMANDS.items() if isinstance(command, Group) or name in NOT_OF_RECORDINGS}
    assert {*READING, *others} == {*COMMANDS}, "a new command reads recordings or does not: say which"
    for name, *words in ((name, *line) for name, lines in READING.items() for line in lines):
        one = path if form == "mcap" else f"{path}#0"
        main([name, *({"PATH": path, "ONE": one}.get(word, word) for word in words)])
        assert not (folder / "ran").exists(), (name, *words)


@pytest.mark.parametrize(
    "look_up",
    [
        lambda: profile_for("social_nav", {"profile": "canary:PROFILE"}),
        lambda: _in_data(find_task, "canary:Mine"),
        lambda: _in_data(load_robot, "canary:ROBOT"),
        lambda: _in_data(plugin_policies().get, "canary:Mine"),
    ],
    ids=["profile", "task", "robot", "policy"],
)
def test_a_name_of_each_kind_is_refused_before_its_module_runs(folder, look_up):
    with pytest.raises(UntrustedNameError, match=r"(?s)canary.*H3-FILE-014"):
        look_up()
    assert not (folder / "ran").exists()


@pytest.mark.parametrize("what", ["policy", "robot", "task"])
def test_a_recording_is_not_taken_up_with_what_it_names(folder, small_home, what):
    recording = _hostile(small_home, what)
    with contextlib.suppress(H3DataError):
        resume(recording, 1)
    assert not (folder / "ran").exists()


@pytest.mark.parametrize("name", ["wander", "social_nav"])
def test_an_episode_file_names_no_module_either(folder, small_home, name):
    task = find_task(name)
    episode = task.episode(small_home, seed=1)
    codec = task.codec
    record = codec.record(episode)
    bad = {"agents": ("robot:canary:ROBOT",)} if name == "wander" else {"robot": "robot/canary:ROBOT"}
    place = EpisodePlace(scene=episode.scene, free=episode.free, spec=episode.spec)
    assert codec.episode(record, place).roster
    with pytest.raises(UntrustedNameError, match=r"(?s)canary.*H3-FILE-014"):
        codec.episode(msgspec.structs.replace(record, **bad), place)
    assert not (folder / "ran").exists()


def test_a_module_that_the_user_names_is_used_and_trusted_from_then_on(folder):
    assert find_profile("canary:PROFILE", "social_nav").name == "task"
    assert (folder / "ran").exists()
    assert profile_for("social_nav", {"profile": "canary:PROFILE"}).name == "task"


def test_commands_find_modules_of_the_working_directory_only_when_one_is_named(folder, monkeypatch):
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place != str(folder)])
    assert main(["completion", "bash"]) == 0
    assert str(folder) not in sys.path, "a torch.py beside a dataset would be imported where torch is not installed"
    assert find_profile("canary:PROFILE", "social_nav").name == "task"


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
    with pytest.raises(UntrustedNameError, match=r"(?s)canary.*H3-FILE-014"):
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


@pytest.mark.parametrize("editable", [True, False])
def test_an_installed_package_is_used_from_the_working_directory_only_if_it_is_editable(folder, monkeypatch, editable):
    info = folder / "site" / "mine-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[h3data.test_kind]\nmine = canary:PROFILE\n")
    if editable:
        (info / "direct_url.json").write_text('{"url": "file:///mine", "dir_info": {"editable": true}}')
    monkeypatch.setattr(sys, "path", [str(folder / "site"), *sys.path])
    registry = plugins.Registry("h3data.test_kind", {}, what="thing")
    with contextlib.nullcontext() if editable else pytest.raises(PluginError, match=r"(?s)canary.*H3-FILE-015"):
        _in_data(registry.get, "mine")
    assert (folder / "ran").exists() is editable
