"""The HTML replay: its states are the recording's, it is small, it loads nothing, and no recorded string becomes script."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import webbrowser
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.geometry import heading_from_quat, pose_to_matrix, quat_from_axis_angle
from h3data.recording import Recording, write_mcap
from h3data.recording.records import JOINTS, Event, SkillSpan
from h3data.replay import Replay
from h3data.scene.articulation import joints_of
from h3data_exporters.gltf_skin import local_poses
from h3data_exporters.posing import posed_parts
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from h3data_viewers.html_replay import home, html_file
from h3data_viewers.html_replay.html_file import write_html
from sim_kinematic.motion.spec import SocialNavSpec
from tests.simulated import rearrange_episode, simulate_rearrange, simulate_social_nav, social_nav_episode
from tests.viewers.replays.golden import ABOUT, FILE, payload, unpacked

HOSTILE = '</script><script>window.hostile=1</script><img src=x onerror="window.hostile=1">'


class Page(HTMLParser):
    """The scripts of a page, its attributes that load or run something, and its policy."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.text = path.read_text(encoding="utf-8")
        self.scripts: list[tuple[str, str]] = []
        self.styles: list[str] = []
        self.faults: list[str] = []
        self.policy = ""
        self._inside = ""
        self.feed(self.text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self._inside = tag
        if tag == "script":
            self.scripts.append((values.get("type") or "", ""))
        self.faults += [f"{tag} {n}" for n in values if n.startswith("on") or n in ("src", "href", "style", "srcdoc")]
        if values.get("http-equiv") == "Content-Security-Policy":
            self.policy = values["content"] or ""

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            kind, text = self.scripts[-1]
            self.scripts[-1] = (kind, text + data)
        if self._inside == "style":
            self.styles.append(data)

    @property
    def block(self) -> bytes:
        return base64.b64decode(self.scripts[0][1])


@pytest.fixture(scope="module")
def walk() -> Recording:
    scene = build_home(HomeSpec(preset="small", seed=3))
    return simulate_social_nav(social_nav_episode(scene, seed=3, spec=SocialNavSpec(max_steps=60)))


@pytest.fixture(scope="module")
def walked(walk: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the walk."""
    return write_html(walk, tmp_path_factory.mktemp("walk") / "e.html").path


@pytest.fixture(scope="module")
def tidied() -> Recording:
    episode = rearrange_episode(build_home(HomeSpec(preset="small", seed=1)), seed=1)
    episode = replace(episode, spec=replace(episode.spec, max_steps=120))
    return simulate_rearrange(episode, solo_steps=1)


@pytest.fixture(scope="module")
def hostile(walk: Recording) -> Recording:
    """The walk with strings that try to be script wherever a recording has strings of its own."""
    agents = tuple(replace(agent, name=f"{agent.name}{HOSTILE}", skill_names=(HOSTILE,) * 9) for agent in walk.agents)
    events = (Event(step=3, agent=0, kind=HOSTILE, target=HOSTILE, detail=HOSTILE), *walk.events)
    skills = (
        SkillSpan(agent=0, name=HOSTILE, target=HOSTILE, start_step=0, end_step=9, outcome="failed", reason=HOSTILE),
    )
    info = {**walk.episode.info, "instruction": HOSTILE, "policy": HOSTILE, "ended": HOSTILE}
    episode = replace(walk.episode, episode_id=HOSTILE, scene=HOSTILE, task=HOSTILE, created_by=HOSTILE, info=info)
    return replace(walk, agents=agents, events=events, skills=skills, episode=episode)


def read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    return unpacked(Page(path).block)


# --- the block --------------------------------------------------------------------------------------------------------
def test_arrays_come_back_within_half_a_step() -> None:
    packed, arrays = payload()
    about, found = unpacked(packed.packed(ABOUT))
    assert about == ABOUT
    assert found["file"] == bytes(range(256))
    for name, values in arrays.items():
        assert found[name].shape == values.shape
        assert np.array_equal(np.isfinite(found[name]), np.isfinite(values))
        assert np.nanmax(np.abs(found[name] - values), initial=0) <= 2.5e-4 + 1e-9, name
    assert json.loads(FILE.read_text(encoding="utf-8"))["about"] == ABOUT


def test_numbers_too_large_for_their_step_are_kept_more_coarsely() -> None:
    packed, _ = payload()
    packed.add_array("huge", [[0.0], [-3e12]], 1e-6)
    _, found = unpacked(packed.packed({}))
    assert found["huge"][1, 0] == pytest.approx(-3e12, rel=1e-8)


# --- states -----------------------------------------------------------------------------------------------------------
def test_the_states_are_those_of_the_recording(walk: Recording, walked: Path) -> None:
    about, found = read(walked)
    stage = about["stage"]
    assert [agent["name"] for agent in stage["agents"]] == [agent.name for agent in walk.agents]
    for k in range(2):
        pose = walk.agent_column(k, "base_pose").astype(np.float64)
        assert np.abs(found[f"agent_{k}.base"] - pose[:, :3]).max() < 3e-4
        turned = found[f"agent_{k}.heading"][:, 0] - heading_from_quat(pose[:, 3:])
        assert np.abs(np.angle(np.exp(1j * turned))).max() < 3e-4
    replay = Replay(walk, detail=False)
    joints = replay.robot_joints(0, replay.model(0))  # type: ignore[arg-type]
    assert np.abs(found["agent_0.joints"] - joints).max() < 1.1e-4
    skin = next(part.skeleton for part in posed_parts(replay) if part.skeleton is not None)
    local = local_poses(skin.poses, skin.parents)
    bones = [skin.names.index(name) for name in stage["agents"][1]["bones"]]
    assert np.abs(found["agent_1.root.position"] - local[:, 0, :3]).max() < 3e-4
    quats = found["agent_1.quats"].reshape(len(walk), -1, 4)
    cosine = np.abs(np.sum(quats * local[:, bones[1:], 3:], -1)) / np.linalg.norm(quats, axis=-1)
    assert np.degrees(2 * np.arccos(np.clip(cosine, 0, 1))).max() < 0.21, "as finely as live play"


def test_things_that_move_goals_and_progress_are_there(tidied: Recording, tmp_path: Path) -> None:
    about, found = read(write_html(tidied, tmp_path / "e.html").path)
    names = [thing["name"] for thing in about["stage"]["objects"]]
    columns = {body.name: body.moving for body in tidied.bodies if body.moving >= 0}
    assert set(names) <= set(columns)
    for thing in about["stage"]["objects"]:
        poses = tidied.columns["object_pose"][:, columns[thing["name"]]]
        assert np.abs(found[f"{thing['track']}.position"] - poses[:, :3]).max() < 3e-4
    assert [goal["object"] for goal in about["goals"]] == [goal["object"] for goal in tidied.episode.info["goals"]]
    assert all(goal["object"].startswith(goal["name"].replace(" ", "_")) and goal["name"] for goal in about["goals"])
    assert not any("|" in goal["label"] or re.search(r"_\d", goal["label"]) for goal in about["goals"])
    assert "Objects at their goals, of 2" in [chart["title"] for chart in about["charts"]]
    assert any("started" in event["text"] for event in about["events"])


@pytest.mark.slow
def test_doors_and_drawers_are_moved_by_their_joints(tmp_path: Path) -> None:
    scene = build_home(HomeSpec(seed=2, articulated=True))
    episode = rearrange_episode(scene, seed=2)
    episode = replace(episode, spec=replace(episode.spec, max_steps=6))
    played, joints = simulate_rearrange(episode, solo_steps=1), joints_of(scene)
    # all of them are half open at first and move on, so that the home is not shown as the scene has it
    share = np.linspace(0.5, 1.0, len(played))[:, None]
    positions = (joints.closed + share * (joints.opened - joints.closed)).astype(np.float32)
    recording = replace(played, columns={**played.columns, JOINTS: positions})
    about, found = read(write_html(recording, tmp_path / "e.html").path)
    stage = about["stage"]
    assert np.abs(found["joints"] - positions).max() < 1.1e-4
    assert [joint["name"] for joint in stage["joints"]] == list(joints.names)
    moved = {name for joint in stage["joints"] for name in joint["nodes"]}
    assert len(moved) > len(joints)
    assert not moved & {thing["name"] for thing in stage["objects"]}
    parts = {part.name: pose_to_matrix(part.poses) for part in posed_parts(Replay(recording, detail=False))}
    for k, motion in enumerate(_motions(stage["joints"], found["joints"][-1])):
        for name in stage["joints"][k]["nodes"]:
            assert np.abs(motion @ parts[name][0] - parts[name][-1]).max() < 1e-3, name


def _motions(joints: list[dict[str, Any]], positions: np.ndarray) -> list[np.ndarray]:
    """As `web/src/scene/joints.ts` moves things from where the file has them."""
    out: list[np.ndarray] = []
    for joint, position in zip(joints, positions, strict=True):
        by, axis, own = position - joint["rest"], np.array(joint["axis"]), np.eye(4)
        if joint["kind"] == 2:
            own[:3, 3] = by * axis
        else:
            own[:3, :3] = pose_to_matrix(np.append(np.zeros(3), quat_from_axis_angle(axis, by)))[:3, :3]
            own[:3, 3] = joint["origin"] - own[:3, :3] @ joint["origin"]
        out.append(own if joint["parent"] < 0 else out[joint["parent"]] @ own)
    return out


@pytest.mark.slow
def test_what_is_absent_is_absent(tidied: Recording, tmp_path: Path) -> None:
    poses, base = tidied.columns["object_pose"].copy(), tidied.columns["agent_0.base_pose"].copy()
    poses[5:9, 0], base[:4] = np.nan, np.nan
    columns = {**tidied.columns, "object_pose": poses, "agent_0.base_pose": base}
    about, found = read(write_html(replace(tidied, columns=columns), tmp_path / "e.html").path)
    moving = {body.moving: body.name for body in tidied.bodies}
    track = next(thing["track"] for thing in about["stage"]["objects"] if thing["name"] == moving[0])
    assert np.flatnonzero(np.isnan(found[f"{track}.position"]).all(1)).tolist() == [5, 6, 7, 8]
    assert np.flatnonzero(np.isnan(found["agent_0.base"]).all(1)).tolist() == [0, 1, 2, 3]


@pytest.mark.slow
def test_contacts_are_marked_and_listed(walk: Recording, tmp_path: Path) -> None:
    touch = np.zeros(len(walk), np.bool_)
    touch[20:23] = touch[40] = True
    recording = replace(walk, columns={**walk.columns, "metrics.collision": touch}, events=())
    about, _ = read(write_html(recording, tmp_path / "e.html").path)
    assert [mark["step"] for mark in about["contacts"]] == [20, 40]
    assert [e["step"] for e in about["events"] if e["text"] == "Robot and person touch"] == [20, 40]
    middle = np.mean([walk.agent_column(k, "base_pose")[20, :3] for k in range(2)], axis=0)
    assert np.allclose(about["contacts"][0]["point"], middle, atol=1e-3)


@pytest.mark.slow
def test_long_recordings_keep_every_second_state(
    walk: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(html_file, "MOST_STATES", 30)
    written = write_html(walk, tmp_path / "e.html")
    about, found = read(written.path)
    steps = found["step"][:, 0]
    assert (written.states, written.steps) == (30, len(walk))
    assert (steps[0], steps[-1], len(steps)) == (0, len(walk) - 1, 30)
    times = (walk.columns["time_ns"] - walk.columns["time_ns"][0]) * 1e-9
    assert np.abs(found["time"][:, 0] - times[steps.astype(int)]).max() < 1e-4
    assert all(0 <= event["step"] < 30 for event in about["events"])


# --- size -------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_1500_steps_of_a_medium_home_take_less_than_3_mb(tmp_path: Path) -> None:
    scene = build_home(HomeSpec(preset="medium", seed=0))
    spec = SocialNavSpec(max_steps=1500, end_on_collision=False)
    recording = simulate_social_nav(social_nav_episode(scene, seed=0, spec=spec))
    written = write_html(recording, tmp_path / "e.html")
    assert written.states == 1500
    assert 900_000 < written.bytes < 1_500_000, "1.1 MB when this was written; the limit is 3"


@pytest.mark.slow
def test_large_homes_are_thinned(
    walk: Recording, walked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def triangles(path: Path) -> int:
        _, found = read(path)
        document = json.loads(found["home"])
        indices = [p["indices"] for mesh in document["meshes"] for p in mesh["primitives"]]
        return sum(document["accessors"][k]["count"] for k in indices) // 3

    whole = triangles(walked)
    monkeypatch.setattr(home, "MAX_VERTICES", 8_000)
    assert triangles(write_html(walk, tmp_path / "thin.html").path) < 0.7 * whole


def test_meshes_are_those_of_the_replay_to_a_quarter_of_a_millimetre(walk: Recording, walked: Path) -> None:
    _, found = read(walked)
    document = json.loads(found["home"])
    nodes = {node["name"]: node for node in document["nodes"]}
    for drawable in [d for d in Replay(walk, detail=False).drawables if not d.deformable][::7]:
        (primitive, *_) = document["meshes"][nodes[drawable.name]["mesh"]]["primitives"]
        accessor = document["accessors"][primitive["attributes"]["POSITION"]]
        points = found[f"home.{accessor['bufferView']}"]
        far = np.abs(points[:, None] - drawable.mesh.vertices[None]).max(-1).min(1)
        assert far.max() <= 2.0**-13 + 1e-6, drawable.name
        corners = found[f"home.{document['accessors'][primitive['indices']]['bufferView']}"]
        assert corners.max() == len(points) - 1


# --- the page ---------------------------------------------------------------------------------------------------------
def test_the_policy_lets_only_the_pages_own_script_run(walked: Path) -> None:
    page = Page(walked)
    assert page.faults == []
    kinds = [kind for kind, _ in page.scripts]
    assert kinds == ["application/octet-stream", "module"]
    rules = dict(rule.split(" ", 1) for rule in page.policy.split("; "))
    assert rules["default-src"] == "'none'"
    assert rules["script-src"] == f"'sha256-{_digest(page.scripts[1][1])}'"
    assert rules["style-src"] == f"'sha256-{_digest(''.join(page.styles))}'"
    assert rules["connect-src"] == "blob:"
    assert "three.js authors" in page.text
    assert "Permission is hereby granted" in page.text


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def test_no_recorded_string_becomes_markup(hostile: Recording, tmp_path: Path) -> None:
    written = write_html(hostile, tmp_path / "e.html")
    page = Page(written.path)
    assert page.faults == []
    assert len(page.scripts) == 2
    assert "hostile" not in page.text.replace("&lt;/script&gt;&lt;script&gt;window.hostile=1", "").replace(
        "&lt;img src=x onerror=&#34;window.hostile=1", ""
    )
    about, _ = unpacked(page.block)
    assert about["stage"]["agents"][0]["name"].endswith(HOSTILE)


@pytest.mark.slow
def test_the_same_recording_gives_the_same_file(walk: Recording, walked: Path, tmp_path: Path) -> None:
    assert write_html(walk, tmp_path / "again.html").path.read_bytes() == walked.read_bytes()


# --- refused ----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_replay_shows_how_far_it_is(
    walk: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("h3data.progress.LINE_EVERY_S", 0.0)
    write_html(walk, tmp_path / "again.html")
    assert re.search(r"write tracks: \d+ of \d+ things", capsys.readouterr().err)


def test_existing_files_are_kept(walk: Recording, tmp_path: Path) -> None:
    (tmp_path / "e.html").write_text("mine")
    with pytest.raises(InputError, match="H3-VIEW-001"):
        write_html(walk, tmp_path / "e.html")
    assert (tmp_path / "e.html").read_text() == "mine"
    write_html(walk, tmp_path / "e.html", overwrite=True)


def test_recordings_without_steps_are_refused(walk: Recording, tmp_path: Path) -> None:
    empty = replace(walk, columns={name: column[:0] for name, column in walk.columns.items()}, events=(), skills=())
    with pytest.raises(InputError, match="H3-VIEW-002"):
        write_html(empty, tmp_path / "e.html")


# --- the command ------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def log(walk: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "walk.mcap"
    write_mcap(walk, path)
    return path


@pytest.mark.slow
def test_view_writes_html_and_opens_it(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url: bool(opened.append(url)) or True)
    out = tmp_path / "e.html"
    assert main(["view", str(log), "-o", str(out), "--open", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["html"] == str(out)
    assert said["bytes"] == out.stat().st_size
    assert opened == [out.resolve().as_uri()]


@pytest.mark.slow
def test_a_machine_without_a_browser_says_so(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda url: False)
    assert main(["view", str(log), "-o", str(tmp_path / "e.html"), "--open"]) == 1
    assert "There is no browser" in capsys.readouterr().out
    assert (tmp_path / "e.html").is_file()


def test_open_starts_rerun(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    from h3data_viewers.commands import viewing

    started: list[list[str]] = []
    monkeypatch.setattr(viewing.subprocess, "Popen", lambda command, **_: started.append(command))
    assert main(["view", str(log), "-o", str(tmp_path / "e.rrd"), "--open"]) == 0
    ((viewer, file),) = started
    assert Path(viewer).name.startswith("rerun")
    assert file == str(tmp_path / "e.rrd")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (lambda log: ["--compare", str(log.with_name("other.mcap"))], "--compare needs a Rerun file"),
        (lambda log: ["--camera", "third_person"], "--camera needs a Rerun file"),
        (lambda log: ["-o", "e.pdf"], "ends in .rrd, .html, .png or .jpg"),
    ],
)
def test_what_html_cannot_show_is_refused(
    log: Path,
    tmp_path: Path,
    options: Callable[[Path], list[str]],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["view", str(log), "-o", str(tmp_path / "e.html"), *options(log)]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "e.html").exists()
