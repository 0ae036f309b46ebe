"""Videos and PNG files: what is read back equals what was written, and nothing half-written keeps its name."""

from __future__ import annotations

import io
import timeit
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from h3data.errors import InputError
from h3data.render import VideoWriter, write_depth_png, write_png
from h3data.render.image_files import depth_to_mm, png_bytes, stored_ids
from h3data_pipelines.pictures.id_png import id_png_bytes


def frame(k: int, width: int, height: int) -> np.ndarray:
    """A smooth picture that changes with k."""
    y, x = np.mgrid[0:height, 0:width]
    return np.stack([x * 200 // width, y * 200 // height, np.full_like(x, 20 + 8 * k)], -1).astype(np.uint8)


@pytest.mark.parametrize("size", [(64, 48), (171, 93), (33, 64)])
def test_a_video_reads_back(tmp_path: Path, size):
    width, height = size
    path = tmp_path / "a.mp4"
    with VideoWriter(path, width, height, 24) as video:
        for k in range(12):
            video.write(frame(k, width, height))
        assert not path.exists()
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.average_rate == 24
        assert (stream.width, stream.height) == (width + width % 2, height + height % 2)
        decoded = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
    assert len(decoded) == 12
    for k, picture in enumerate(decoded):
        assert np.abs(picture[:height, :width].astype(int) - frame(k, width, height)).mean() < 6


@pytest.mark.parametrize(("codec", "threads"), [("h264", 1), ("h264", 3), ("av1", 1), ("ffv1", 1)])
def test_the_same_frames_make_the_same_file(tmp_path: Path, codec, threads):
    rng = np.random.default_rng(1)
    suffix = "mkv" if codec == "ffv1" else "mp4"
    frames = [
        rng.integers(0, 65536, (48, 64)).astype(np.uint16) if codec == "ffv1" else frame(k, 64, 48) for k in range(9)
    ]
    for name in ("a", "b"):
        with VideoWriter(tmp_path / f"{name}.{suffix}", 64, 48, codec=codec, threads=threads) as video:
            for image in frames:
                video.write(image)
    assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()
    with av.open(str(tmp_path / f"a.{suffix}")) as container:
        form = "gray16le" if codec == "ffv1" else "rgb24"
        decoded = [f.to_ndarray(format=form) for f in container.decode(video=0)]
    assert len(decoded) == len(frames)
    for image, expected in zip(decoded, frames, strict=True):
        if codec == "ffv1":
            np.testing.assert_array_equal(image, expected)
        else:
            assert np.abs(image.astype(int) - expected).mean() < 6


def test_depth_is_encoded_by_the_thread_that_has_it(tmp_path: Path):
    """Threads encode frames of one FFV1 video side by side; the file is that of one thread, and its frames are key frames."""
    rng = np.random.default_rng(2)
    frames = [rng.integers(0, 300, (48, 64)).astype(np.uint16) for _ in range(12)]
    with VideoWriter(tmp_path / "a.mkv", 64, 48, 29.97, codec="ffv1") as video, ThreadPoolExecutor(3) as pool:
        for packet in pool.map(video.planes, frames):
            video.write_planes(packet)
    with VideoWriter(tmp_path / "b.mkv", 64, 48, 29.97, codec="ffv1") as video:
        for image in frames:
            video.write(image)
    assert (tmp_path / "a.mkv").read_bytes() == (tmp_path / "b.mkv").read_bytes()
    with av.open(str(tmp_path / "a.mkv")) as container:
        assert container.streams.video[0].average_rate == Fraction(29.97).limit_denominator(1001)
        assert [packet.is_keyframe for packet in container.demux(video=0) if packet.size] == [True] * 12


def test_depth_in_millimetres_is_small(tmp_path: Path):
    """Surfaces that recede, as a home shows: 1.3 bits a pixel, and what is read back is what was written."""
    y, x = np.mgrid[0:240, 0:320]
    surfaces = [(y - 100 + 0.1 * x) / 250.0, (x - 200 + 0.2 * y) / 460.0, (150 - x + 0.15 * y) / 510.0]
    depth = depth_to_mm((1 / np.maximum.reduce([*surfaces, 0.21 + 1e-4 * (x + y)])).astype(np.float32))
    with VideoWriter(tmp_path / "a.mkv", 320, 240, codec="ffv1") as video:
        video.write(depth)
    with av.open(str(tmp_path / "a.mkv")) as container:
        np.testing.assert_array_equal(next(container.decode(video=0)).to_ndarray(format="gray16le"), depth)
    assert 8 * (tmp_path / "a.mkv").stat().st_size < 1.3 * depth.size


@pytest.mark.parametrize(("width", "height"), [(64, 48), (38, 22)])  # FFmpeg pads the rows of the second
def test_colours_become_yuv_as_ffmpeg_has_it(tmp_path: Path, width: int, height: int):
    """Within the rounding of FFmpeg's own conversion: luma of any picture, chroma of plain ones."""
    writer, rng = VideoWriter(tmp_path / "a.mp4", width, height), np.random.default_rng(0)
    shape = (height, width, 3)
    pictures = [rng.integers(0, 256, shape), *(np.full(shape, c) for c in rng.integers(0, 256, (20, 3)))]
    for k, picture in enumerate(pictures):
        rgb = picture.astype(np.uint8)
        theirs = av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(format="yuv420p").to_ndarray().astype(int)
        rows = slice(height if k == 0 else None)
        assert np.abs(writer.planes(rgb).to_ndarray()[rows] - theirs[rows]).max() <= 1


def test_the_index_comes_first(tmp_path: Path):
    with VideoWriter(tmp_path / "a.mp4", 32, 32) as video:
        video.write(frame(0, 32, 32))
    data = (tmp_path / "a.mp4").read_bytes()
    assert 0 < data.find(b"moov") < data.find(b"mdat"), "browsers could not start to play before the end"


def _interrupted(path: Path, error: type[BaseException]) -> None:
    with VideoWriter(path, 64, 48) as video:
        video.write(frame(0, 64, 48))
        raise error


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_video_leaves_nothing(tmp_path: Path, error):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"the old one")
    with pytest.raises(error):
        _interrupted(path, error)
    assert path.read_bytes() == b"the old one"
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_wrong_frames_and_no_frames_are_refused(tmp_path: Path):
    with (
        pytest.raises(InputError, match=r"(?s) 0 .*\[48, 64, 3\].*H3-RENDER-075"),
        VideoWriter(tmp_path / "a.mp4", 64, 48) as v,
    ):
        v.write(frame(0, 48, 64))
    with pytest.raises(InputError, match="H3-RENDER-078"), VideoWriter(tmp_path / "a.mp4", 64, 48):
        pass
    with pytest.raises(InputError, match="H3-RENDER-073"):
        VideoWriter(tmp_path / "a.mp4", 0, 48)
    with pytest.raises(InputError, match="H3-FILE-009"), VideoWriter(tmp_path / "no" / "a.mp4", 64, 48):
        pass
    with pytest.raises(InputError, match="H3-RENDER-076"):
        VideoWriter(tmp_path / "a.mp4", 64, 48).write(frame(0, 64, 48))
    assert list(tmp_path.iterdir()) == []


def test_png_round_trips(tmp_path: Path):
    rgb = frame(3, 31, 17)
    write_png(tmp_path / "rgb.png", rgb)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "rgb.png"))[..., ::-1], rgb)
    depth = np.float32([[0, 0.0001, 1.2344], [70, np.nan, 3.0006]])
    write_depth_png(tmp_path / "depth.png", depth)
    stored = cv2.imread(str(tmp_path / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    np.testing.assert_array_equal(stored, [[0, 1, 1234], [65535, 0, 3001]])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["depth.png", "rgb.png"]


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (3, 16), (5, 17), (40, 33), (3, 700)])
def test_pictures_of_ids_round_trip(size: tuple[int, int]):
    height, width = size
    rng = np.random.default_rng(height)
    columns = np.repeat(rng.integers(0, 600, (height, -(-width // 3))), 3, 1)[:, :width]
    pictures = [
        rng.integers(0, 65536, size),
        257 * rng.integers(0, 2, size),
        np.zeros(size),
        np.repeat(rng.integers(0, 600, (height, 1)), width, 1),
        columns,
        np.full(size, 65535),
    ]
    for picture in pictures:
        stored = picture.astype(np.uint16)
        read = cv2.imdecode(np.frombuffer(id_png_bytes(stored), np.uint8), cv2.IMREAD_UNCHANGED)
        assert read.dtype == np.uint16
        np.testing.assert_array_equal(read, stored)
        with Image.open(
            io.BytesIO(id_png_bytes(stored[:, ::-1]))
        ) as other:  # another reader, and a picture with strides
            np.testing.assert_array_equal(np.array(other), stored[:, ::-1])


def test_pictures_of_ids_are_smaller_than_those_of_zlib():
    """Rectangles and discs before each other, as a home shows: three quarters of what zlib makes of them, and less time."""
    rng, (y, x) = np.random.default_rng(4), np.mgrid[0:480, 0:640]
    ids = np.zeros((480, 640), np.uint16)
    for k in range(60):
        column, row, side = rng.integers(0, 640), rng.integers(0, 480), rng.integers(10, 120)
        inside = np.hypot(x - column, y - row) < side if k % 2 else (abs(x - column) < side) & (abs(y - row) < side)
        ids[inside] = rng.integers(1, 400)
    assert len(id_png_bytes(ids)) < 0.75 * len(png_bytes(ids))
    for encode in (id_png_bytes, png_bytes):
        encode(ids)
    seconds = [min(timeit.repeat(lambda e=encode: e(ids), number=1, repeat=9)) for encode in (id_png_bytes, png_bytes)]
    assert seconds[0] < 0.6 * seconds[1]


def test_ids_are_stored_one_up(tmp_path: Path):
    np.testing.assert_array_equal(stored_ids(np.array([[-1, 0, 65533]])), [[0, 1, 65534]])
    assert stored_ids(np.zeros((2, 3), np.int32)).dtype == np.uint16
    for bad in (np.array([[65535]]), np.zeros((2, 2)), np.zeros(3, np.int32)):
        with pytest.raises(InputError, match=r"(?s)65534.*H3-RENDER-045|H3-RENDER-044"):
            stored_ids(bad)
    with pytest.raises(InputError, match="H3-RENDER-074"):
        VideoWriter(tmp_path / "a.mp4", 64, 48, codec="vp9")  # type: ignore[arg-type]


def test_bad_pictures_are_refused(tmp_path: Path):
    for bad in (np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4)), np.zeros((0, 4, 3), np.uint8)):
        with pytest.raises(InputError, match="H3-RENDER-039"):
            write_png(tmp_path / "a.png", bad)
    with pytest.raises(InputError, match="H3-RENDER-043"):
        write_depth_png(tmp_path / "a.png", np.zeros((4, 4), np.int32))
    with pytest.raises(InputError, match="H3-FILE-009"):
        write_png(tmp_path / "no" / "a.png", np.zeros((4, 4), np.uint8))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["walk:1.mp4", "data:x", "file:x", "2026-11-27T10:30:05"])
def test_a_relative_name_with_a_colon_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    with VideoWriter(name, 16, 16) as video:
        video.write(np.zeros((16, 16, 3), np.uint8))
    assert [path.name for path in tmp_path.iterdir()] == [name]
