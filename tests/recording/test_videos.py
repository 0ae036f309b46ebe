"""Videos in a dataset: every frame is that of its timestamp, as LeRobot's loader looks for it, wherever episodes are copied."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pyarrow.dataset as pads
import pyarrow.parquet as pq
import pytest

from h3data.errors import FormatError, InputError
from h3data.recording import Dataset, DatasetWriter, Recording
from h3data.recording.parquet import writer as dataset_writer
from h3data.recording.parquet.moments import QUANTILES, moments_of
from h3data.recording.parquet.videos import EpisodeVideo, VideoFeature
from h3data.render import VideoWriter
from tests.recording.strategies import simple_recording

WIDTH, HEIGHT, BITS = 96, 48, 12
TOLERANCE_S = 1e-4
"""LeRobot's ``tolerance_s``."""


def marked(number: int) -> np.ndarray:
    """A picture whose columns of black and white say ``number``."""
    bits = (number >> np.arange(BITS)) & 1
    line = np.repeat(bits * 255, WIDTH // BITS).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(line[None, :, None], (HEIGHT, WIDTH, 3)))


def number_in(frame: np.ndarray) -> int:
    """The inverse of `marked`."""
    columns = frame.mean((0, 2)).reshape(BITS, -1).mean(1)
    return int(((columns > 128) << np.arange(BITS)).sum())


def filmed(folder: Path, episode: int, steps: int, camera: str = "eye", **options) -> EpisodeVideo:
    """A video whose frame k says ``100 * episode + k``."""
    path = folder / f"{episode}.{camera}.mp4"
    frames = np.stack([marked(100 * episode + k) for k in range(steps)])
    with VideoWriter(path, WIDTH, HEIGHT, 30, **{"key_frames": 10, **options}) as video:
        for frame in frames:
            video.write(frame)
    feature = VideoFeature(camera=camera, width=WIDTH, height=HEIGHT)
    return EpisodeVideo(
        feature=feature, path=path, length=steps, fps=30, moments=moments_of(frames.reshape(-1, 3) / 255.0)
    )


def written(root: Path, lengths: tuple[int, ...], *, cameras: tuple[str, ...] = ("eye",), **options) -> Dataset:
    films = root.parent / "films"
    films.mkdir(exist_ok=True)
    with DatasetWriter(root, **options) as writer:
        for k, steps in enumerate(lengths):
            videos = [filmed(films, k, steps, camera) for camera in cameras] if steps else []
            writer.add(simple_recording(steps=steps, seed=k), videos=videos)
    return Dataset(root)


def looked_up(root: Path, episode: int, timestamps: np.ndarray, key: str = "observation.images.eye") -> list[int]:
    """What the frames say that LeRobot's loader gives for timestamps of an episode, after its own arithmetic."""
    rows = pads.dataset(root / "meta/episodes").to_table().sort_by("episode_index").to_pylist()
    row, info = rows[episode], json.loads((root / "meta/info.json").read_text())
    path = info["video_path"].format(
        video_key=key, chunk_index=row[f"videos/{key}/chunk_index"], file_index=row[f"videos/{key}/file_index"]
    )
    with av.open(str(root / path)) as file:
        frames = [(float(f.pts * f.time_base), number_in(f.to_ndarray(format="rgb24"))) for f in file.decode(video=0)]
    loaded = np.array([time for time, _ in frames], np.float32)
    wanted = np.array([row[f"videos/{key}/from_timestamp"] + float(t) for t in timestamps], np.float32)
    distance = np.abs(wanted[:, None] - loaded[None])
    assert (distance.min(1) < TOLERANCE_S).all()
    return [frames[k][1] for k in distance.argmin(1)]


def test_every_timestamp_finds_the_frame_of_its_step(tmp_path):
    root, lengths = tmp_path / "ds", (25, 0, 31, 7, 40)
    dataset = written(root, lengths, episodes_per_file=3)
    table = pads.dataset(root / "data", format="parquet").to_table()
    for k, steps in enumerate(lengths):
        times = table["timestamp"].to_numpy()[table["episode_index"].to_numpy() == k]
        assert len(times) == steps
        if steps:
            assert looked_up(root, k, times) == [100 * k + step for step in range(steps)]
            assert [number_in(f) for f in dataset.video(k, "eye").frames()] == [100 * k + step for step in range(steps)]


def test_the_layout_is_that_of_lerobot(tmp_path):
    root, lengths, cameras = tmp_path / "ds", (12, 20, 5), ("eye", "human_1.human_head")
    dataset = written(root, lengths, cameras=cameras, episodes_per_file=2)
    assert dataset.cameras == cameras
    info, stats = (json.loads((root / f"meta/{name}.json").read_text()) for name in ("info", "stats"))
    data = pads.dataset(root / "data", format="parquet").to_table()
    videos = {name: f for name, f in info["features"].items() if f["dtype"] == "video"}
    assert list(videos) == [f"observation.images.{camera}" for camera in cameras]
    assert {*data.column_names} == {*info["features"]} - {*videos}, "LeRobot reads frames from videos, not from tables"
    rows = pads.dataset(root / "meta/episodes").to_table().to_pylist()
    for key, feature in videos.items():
        assert feature["shape"] == [HEIGHT, WIDTH, 3]
        assert feature["names"] == ["height", "width", "channels"]
        assert feature["info"]["video.fps"] == info["fps"] == 30
        assert {name: np.shape(v) for name, v in stats[key].items()} == {
            "count": (1,),
            **dict.fromkeys(("min", "max", "mean", "std", *QUANTILES), (3, 1, 1)),
        }
        frames: dict[int, int] = {}
        for row, steps in zip(rows, lengths, strict=True):
            file, at = row[f"videos/{key}/file_index"], f"videos/{key}"
            assert (row[f"{at}/chunk_index"], file) == (row["data/chunk_index"], row["data/file_index"])
            assert row[f"{at}/from_timestamp"] == pytest.approx(frames.get(file, 0) / 30)
            assert row[f"{at}/to_timestamp"] - row[f"{at}/from_timestamp"] == pytest.approx(steps / 30)
            assert row[f"stats/{key}/count"] == [steps]
            frames[file] = frames.get(file, 0) + steps
        for file, count in frames.items():
            path = root / info["video_path"].format(video_key=key, chunk_index=0, file_index=file)
            with av.open(str(path)) as video:
                assert sum(packet.size > 0 for packet in video.demux(video=0)) == count
            with av.open(str(path)) as video:
                stream = video.streams.video[0]
                assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 30)
                assert stream.start_time == 0
        whole = np.stack([marked(100 * k + step) for k, n in enumerate(lengths) for step in range(n)]) / 255
        np.testing.assert_allclose(np.ravel(stats[key]["mean"]), whole.mean((0, 1, 2)))
        np.testing.assert_allclose(np.ravel(stats[key]["std"]), whole.std((0, 1, 2)))
        assert (np.ravel(stats[key]["min"]) == 0).all()
        assert (np.ravel(stats[key]["max"]) == 1).all()
    spacing = np.diff(data["timestamp"].to_numpy())[np.diff(data["episode_index"].to_numpy()) == 0]
    assert np.abs(spacing - 1 / 30).max() < TOLERANCE_S


def test_files_stay_below_the_length_where_float32_blurs_timestamps(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset_writer, "MAX_FILE_S", 2.0)
    dataset = written(tmp_path / "ds", (25, 30, 20, 70))
    files = [row["videos/observation.images.eye/file_index"] for row in dataset.rows]
    assert files == [0, 0, 1, 2]
    assert np.spacing(np.float32(dataset_writer.MAX_FILE_S)) < TOLERANCE_S


def test_an_interrupted_dataset_goes_on_after_its_last_commit(tmp_path):
    root = tmp_path / "ds"
    written(root, (10, 12))
    for leftover in ("file-001.mp4", "_file-001.mp4.part"):
        (root / "videos/observation.images.eye/chunk-000" / leftover).write_bytes(b"half")
    with DatasetWriter(root, resume=True) as writer:
        writer.add(simple_recording(steps=9, seed=2), videos=[filmed(tmp_path / "films", 2, 9)])
    assert looked_up(root, 2, np.arange(9) / 30) == [200 + k for k in range(9)]
    assert not list(root.rglob("*.part"))


def test_an_episode_without_steps_has_no_video_but_names_files_that_exist(tmp_path):
    root = tmp_path / "ds"
    dataset = written(root, (10, 0, 0), episodes_per_file=1)
    assert [row["videos/observation.images.eye/file_index"] for row in dataset.rows] == [0, 0, 0]
    assert dataset.videos(1) == []
    with pytest.raises(InputError, match=r"(?s)no steps.*H3-RECORDING-058"):
        dataset.video(1, "eye")
    with pytest.raises(InputError, match=r"(?s)'ear'.*eye.*H3-RECORDING-058"):
        dataset.video(0, "ear")


def test_videos_that_do_not_fit_are_refused(tmp_path):
    video = filmed(tmp_path, 0, 10)
    ten = simple_recording(steps=10)
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(ten, videos=[video])
        with pytest.raises(InputError, match=r"(?s)eye \(96x48\).*'e1'.*none.*H3-RECORDING-099"):
            writer.add(simple_recording(steps=10, seed=1))
        with pytest.raises(InputError, match=r"(?s)11.*H3-RECORDING-105"):
            writer.add(simple_recording(steps=11), videos=[video])
        with pytest.raises(InputError, match=r"(?s)eye.*H3-RECORDING-099"):
            writer.add(ten, videos=[video, replace(video, feature=replace(video.feature, camera="ear"))])
        with pytest.raises(FormatError, match=r"(?s)0.*10.*H3-RECORDING-082"):
            writer.add(simple_recording(steps=12), videos=[replace(video, length=12)])
    assert len(Dataset(tmp_path / "ds")) == 0, "a video that ends early spoils its shard"
    with DatasetWriter(tmp_path / "other") as writer:
        writer.add(ten, videos=[video])
        with pytest.raises(InputError, match="H3-RECORDING-089"):
            writer.add(ten, videos=[filmed(tmp_path, 3, 10, preset="slow")])
    with DatasetWriter(tmp_path / "plain") as writer:
        writer.add(ten)
        with pytest.raises(InputError, match=r"(?s)none.*H3-RECORDING-099"):
            writer.add(ten, videos=[video])


def test_videos_go_where_their_episodes_go(tmp_path):
    first = written(tmp_path / "first", (20, 15, 30), cameras=("eye", "ear"))
    second = written(tmp_path / "second", (8,))
    first.filter(lambda facts: facts["length"] > 15).save(tmp_path / "long")
    for k, was in enumerate((0, 2)):
        steps = len(first[was])
        assert looked_up(tmp_path / "long", k, np.arange(steps) / 30) == [100 * was + step for step in range(steps)]
    assert Dataset(tmp_path / "long").cameras == ("eye", "ear")
    changed = [replace(e, read_facts=lambda e=e: {**e.read_facts(), "uid": e.name}) for e in second.all().stored]
    first.all().merge(type(first.all())(changed)).save(tmp_path / "both")
    both = Dataset(tmp_path / "both")
    assert (len(both), both.cameras) == (4, ("eye",)), "cameras that all episodes have"
    assert [number_in(f) for f in both.video(3, "eye").frames()] == list(range(8))


def test_damaged_videos_are_named(tmp_path, capsys):
    dataset = written(tmp_path / "ds", (10,))
    (path,) = (tmp_path / "ds/videos").rglob("*.mp4")
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(FormatError, match=r"(?s)file-000\.mp4.*H3-RECORDING-080"):
        list(dataset.video(0, "eye").frames())
    from h3data_pipelines.cli import main

    assert main(["validate", str(tmp_path / "ds")]) == 1
    assert "video" in capsys.readouterr().out
    path.unlink()
    with pytest.raises(FormatError, match="H3-RECORDING-084"):
        list(dataset.video(0, "eye").frames())


def test_videos_are_stored_and_read_at_a_uri(tmp_path):
    root = f"mock://{tmp_path.name}/ds"
    with DatasetWriter(root, episodes_per_file=2) as writer:
        for k in range(3):
            writer.add(simple_recording(steps=10, seed=k), videos=[filmed(tmp_path, k, 10)])
    with DatasetWriter(root, resume=True) as writer:
        writer.add(simple_recording(steps=10, seed=3), videos=[filmed(tmp_path, 3, 10)])
    dataset = Dataset(root)
    for k in range(4):
        assert [number_in(f) for f in dataset.video(k, "eye").frames()] == [100 * k + step for step in range(10)]
    dataset.all().save(tmp_path / "ds")
    assert looked_up(tmp_path / "ds", 3, np.arange(10) / 30) == [300 + step for step in range(10)]


def test_a_dataset_is_replaced_with_its_videos(tmp_path):
    written(tmp_path / "ds", (10,))
    with DatasetWriter(tmp_path / "ds", overwrite=True) as writer:
        writer.add(simple_recording(steps=10))
    assert not list((tmp_path / "ds").rglob("*.mp4"))
    assert Dataset(tmp_path / "ds").cameras == ()


def test_the_task_of_a_frame_is_its_instruction(tmp_path):
    def told(words: str, seed: int) -> Recording:
        recording = simple_recording(steps=5, seed=seed)
        return replace(recording, episode=replace(recording.episode, info={"instruction": words} if words else {}))

    with DatasetWriter(tmp_path / "ds") as writer:
        for k, words in enumerate(("follow the person", "bring the cup to the table", "follow the person", "")):
            writer.add(told(words, k))
    dataset = Dataset(tmp_path / "ds")
    assert [row["tasks"] for row in dataset.rows] == [
        ["follow the person"],
        ["bring the cup to the table"],
        ["follow the person"],
        ["social_nav"],
    ]
    assert [row["task_index"] for row in dataset.rows] == [0, 1, 0, 2]
    assert {row["task"] for row in dataset.rows} == {"social_nav"}
    names = pq.read_table(tmp_path / "ds/meta/tasks.parquet").to_pydict()["__index_level_0__"]
    assert names == ["follow the person", "bring the cup to the table", "social_nav"]
    with DatasetWriter(tmp_path / "ds", resume=True) as writer:
        writer.add(told("bring the cup to the table", 9))
    assert Dataset(tmp_path / "ds").rows[4]["task_index"] == 1
