"""`h3data view`: what the file shows is what the replay says; two episodes beside each other; what is refused."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from h3data.geometry import transform_points
from h3data.mesh.thinning import thin_mesh
from h3data.recording import DatasetWriter, Recording, open_recording, write_mcap
from h3data.recording.storage import place
from h3data.replay import Replay
from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from h3data_viewers import write_rrd
from h3data_viewers.rerun.entities import SKIN_VERTICES
from sim_kinematic.motion.spec import SocialNavSpec
from tests.simulated import simulate_social_nav, social_nav_episode
from tests.viewers.rerun_file import File

pytest.importorskip("rerun")
LONG, SHORT = 36, 21


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes in two homes: ``long.mcap``, and the second one of the dataset ``ds``."""
    out = tmp_path_factory.mktemp("view")
    recordings = [_episode(seed, steps) for seed, steps in ((3, LONG), (5, SHORT))]
    write_mcap(recordings[0], out / "long.mcap")
    with DatasetWriter(out / "ds") as writer:
        for recording in recordings:
            writer.add(recording)
    return out


def _episode(seed: int, steps: int) -> Recording:
    scene = build_home(HomeSpec(preset="small", seed=seed))
    return simulate_social_nav(social_nav_episode(scene, seed=seed, spec=SocialNavSpec(max_steps=steps)))


@pytest.fixture(scope="module")
def compared(folder: Path) -> File:
    out = folder / "two.rrd"
    command = ["view", folder / "long.mcap", "--compare", f"{folder / 'ds'}#1", "--camera", "third_person", "-o", out]
    assert main([str(part) for part in command]) == 0
    return File(out)


def _world_matrix(file: File, entity: str, step: int) -> np.ndarray:
    """Product of the transforms from an entity up to its root."""
    out = np.eye(4)
    while entity.count("/") > 1:
        if entity in file.batches:
            out = file.matrix(entity, step) @ out
        entity = entity.rpartition("/")[0]
    return out


@pytest.mark.parametrize("label", ["a", "b"])
def test_everything_is_where_the_replay_says(folder: Path, compared: File, label: str) -> None:
    recording = _of(folder, label)
    replay = Replay(recording, detail=False)
    for step in (0, SHORT // 2, SHORT - 1):
        poses = replay.at(step).poses
        for drawable in (d for d in replay.drawables if not d.deformable):
            if drawable.agent >= 0:
                entity = f"/{label}/world/{drawable.name}/mesh"
            else:
                entity = f"/{label}/world/scene/{drawable.layer + '/' if drawable.layer else ''}{drawable.name}"
            there = _world_matrix(compared, entity, step)
            assert np.allclose(there, poses[drawable.name], atol=1e-4), drawable.name
    meshes = [
        e for e in compared.batches if e.startswith(f"/{label}/") and _has(compared, e, "Mesh3D:vertex_positions")
    ]
    drawn = [d for d in replay.drawables if len(d.mesh.faces)]
    assert len([e for e in meshes if "/part_" not in e]) == len(drawn)
    textured = [e for e in meshes if _has(compared, e, "Mesh3D:albedo_texture_buffer")]
    assert len(textured) == sum(len(d.mesh.textures) for d in drawn) > 10


def _of(folder: Path, label: str) -> Recording:
    found = open_recording(folder / "long.mcap") if label == "a" else open_recording(folder / "ds")
    return found if isinstance(found, Recording) else found.recording(1)


def _has(file: File, entity: str, component: str) -> bool:
    return any(component in batch.schema.names for _, batch in file.batches[entity])


def test_two_episodes_of_other_lengths_and_homes(folder: Path, compared: File) -> None:
    first, second = _of(folder, "a"), _of(folder, "b")
    assert (len(first), len(second)) == (LONG, SHORT)
    assert first.episode.scene != second.episode.scene
    assert len(compared.column("/a/metrics/dist_agents", "Scalars:scalars")[0]) == LONG
    assert len(compared.column("/b/metrics/dist_agents", "Scalars:scalars")[0]) == SHORT
    assert compared.at("/b/actions/robot_skill", "StateChange:state", SHORT) == ["ended"]
    assert compared.at("/a/actions/robot_skill", "StateChange:state", SHORT) != ["ended"]
    for label, steps in (("a", LONG), ("b", SHORT)):
        shown, blobs = compared.column(f"/{label}/world/cameras/third_person/image", "EncodedImage:blob")
        assert shown.tolist() == list(range(0, steps, 5))
        assert all(bytes(blob[0][:2]) == b"\xff\xd8" for blob in blobs), "JPEG"


@pytest.mark.parametrize("label", ["a", "b"])
def test_the_border_of_the_free_space_and_the_goal(folder: Path, compared: File, label: str) -> None:
    recording = _of(folder, label)
    scene = Replay(recording).scene
    assert scene is not None
    space = FreeSpace.from_scene(scene)
    strips = np.concatenate([np.array(s) for s in compared.at(f"/{label}/world/free_space", "LineStrips3D:strips", 0)])
    rings = [r.coords for p in space.polygon.geoms for r in (p.exterior, *p.interiors)]
    assert np.allclose(strips[:, [0, 2]], np.concatenate([np.asarray(r) for r in rings]), atol=1e-5)
    assert (strips[:, 1] > space.floor_y).all()
    goal = compared.at(f"/{label}/world/goals/human", "Points3D:positions", 0)[0]
    assert np.allclose([goal[0], goal[2]], recording.episode.info["human_goals"][0], atol=1e-5)


@pytest.mark.parametrize("free", [False, True], ids=["clip", "free-form"])
def test_people_have_the_replays_skin(folder: Path, tmp_path: Path, free: bool) -> None:
    recording = _of(folder, "b")
    if free:
        root = recording.columns["agent_1.base_pose"].copy()
        root[:, 1] += 0.95
        quats = np.zeros((len(recording), 54, 4), np.float32)
        quats[..., 3] = 1
        quats[:, 15:20, :] = np.array([0, 0, np.sin(0.3), np.cos(0.3)], np.float32)
        columns = {**recording.columns, "agent_1.root_pose": root, "agent_1.joint_quat": quats}
        recording = replace(recording, columns=columns)
    replay = Replay(recording, detail=False)
    file = File(write_rrd(recording, tmp_path / "e.rrd", replay=replay))
    index = next(i for i, d in enumerate(replay.drawables) if d.deformable)
    keep = thin_mesh(replay.drawables[index].mesh, SKIN_VERTICES).keep
    steps, values = file.column("/world/human/body", "Mesh3D:vertex_positions")
    for step, local in list(zip(steps.tolist(), values, strict=True))[::3]:
        world = transform_points(file.matrix("/world/human", step), np.array(local))
        assert np.abs(world - replay.vertices(index, np.array([step]))[0][keep]).max() < 1e-4
    spread = np.ptp(np.array(values[0]), axis=0)
    assert spread[1] > 1.4, "a grown-up person, upright"


# --- refused ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ("long.mcap", "long.mcap", "got the first one again"),
        ("ds#1", "../{folder}/ds#1", "got the first one again"),
        ("long.mcap", "gone.mcap", "gone.mcap"),
        ("gone.mcap", "long.mcap", "gone.mcap"),
        ("long.mcap", "ds", "#0"),
        ("long.mcap", "ds#2", "no episode 2"),
        ("long.mcap", "note.txt", "note.txt"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], first: str, second: str, message: str
) -> None:
    (folder / "note.txt").write_text("not a recording")
    out = folder / "refused.rrd"
    two = str(folder / second.format(folder=folder.name))
    assert main(["view", str(folder / first), "--compare", two, "-o", str(out)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_unknown_cameras_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "refused.rrd"
    assert main(["view", str(folder / "long.mcap"), "--camera", "periscope", "-o", str(out)]) == 2
    assert "third_person" in capsys.readouterr().err, "what there is"
    assert not out.exists()


@pytest.mark.slow
def test_from_a_uri(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    uri = place("mock://memory/view/long.mcap")
    uri.put((folder / "long.mcap").read_bytes())  # type: ignore[union-attr]
    out = tmp_path / "e.rrd"
    assert main(["view", f"{folder / 'ds'}#1", "--compare", str(uri), "-o", str(out)]) == 0
    assert len(File(out).column("/b/metrics/dist_agents", "Scalars:scalars")[0]) == LONG
    assert main(["view", str(uri)]) == 2
    assert "-o" in capsys.readouterr().err
    assert main(["view", str(uri), "--compare", str(uri), "-o", str(tmp_path / "f.rrd")]) == 2
    assert "got the first one again" in capsys.readouterr().err


def test_the_default_place_is_beside_the_recording(folder: Path) -> None:
    assert main(["view", str(folder / "long.mcap"), "--compare", f"{folder / 'ds'}#1"]) == 0
    assert File(folder / "long_and_ds#1.rrd").recordings


@pytest.mark.slow
def test_long_recordings_are_exported_in_blocks(tmp_path: Path) -> None:
    """Beyond the recording itself there are 170 bytes per step: 150 for the joints of stepping legs."""
    short, few, many = _episode(seed=3, steps=400), 20_000, 100_000

    def peak(steps: int) -> int:
        """Most bytes that the export of the episode, repeated forwards and backwards, holds at a time."""
        turns = [slice(None, None, -1 if k % 2 else 1) for k in range(-(-steps // len(short)))]
        columns = {n: np.concatenate([c[turn] for turn in turns])[:steps] for n, c in short.columns.items()}
        columns["time_ns"] = np.arange(1, steps + 1) * short.episode.dt_ns
        recording = replace(short, columns=columns, skills=(), events=())
        tracemalloc.start()
        try:
            write_rrd(recording, tmp_path / "long.rrd", replay=Replay(recording), overwrite=True)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(10)  # what is loaded at first use
    assert (peak(many) - peak(few)) / (many - few) < 300


@pytest.mark.slow
def test_progress_is_shown_while_files_are_written(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("h3data.progress.LINE_EVERY_S", 0.0)
    for ending, said in ((".rrd", ("write poses: 1 of 1 blocks", "write skins: ")), (".html", ("write tracks: ",))):
        assert main(["view", str(folder / "long.mcap"), "-o", str(tmp_path / f"v{ending}")]) == 0
        shown = capsys.readouterr().err
        assert all(text in shown for text in said)
