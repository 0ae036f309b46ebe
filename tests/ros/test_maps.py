"""Occupancy maps as scenes: their floor keeps its outline, and damaged ones are refused in a sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from h3data.errors import H3DataError
from h3data.formats import ImportRequest
from h3data.scene import FreeSpace, load_scene
from h3data_pipelines.cli import main
from h3data_ros import occupancy
from h3data_ros.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyMap, map_of, read_map, scene_of_map
from h3data_ros.track_import import read_tracks
from tests.ros.recordings import crossing

YAML = """image: map.pgm
mode: trinary
resolution: 0.05
origin: [-1.5, -2.0, 0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def write_map(folder: Path, pixels: np.ndarray, yaml: str = YAML) -> Path:
    folder.mkdir(exist_ok=True)
    Image.fromarray(pixels.astype(np.uint8)).save(folder / "map.pgm")
    (folder / "map.yaml").write_text(yaml)
    return folder / "map.yaml"


def rooms() -> np.ndarray:
    """Two rooms of 4 x 3 m with a door of 0.9 m, as grey values from the top: free 254, occupied 0, unknown 205."""
    pixels = np.full((84, 190), 205, np.uint8)
    pixels[10:74, 10:180] = 0
    pixels[12:72, 12:92] = pixels[12:72, 98:178] = 254
    pixels[34:52, 92:98] = 254
    return pixels


def test_a_map_lies_where_its_origin_says(tmp_path: Path) -> None:
    grid = read_map(write_map(tmp_path, rooms()))
    assert grid.cells.shape == (84, 190)
    assert {FREE, OCCUPIED, UNKNOWN} == set(np.unique(grid.cells).tolist())
    assert grid.cells[83, 20] == UNKNOWN  # rows go up
    free = FreeSpace.from_scene(scene_of_map(grid, "map"), cache=False)
    x = -1.5 + 0.05 * 22
    y = -2.0 + 0.05 * (84 - 42)
    assert free.signed_distance(np.array([x, -y])) == pytest.approx(10 * 0.05, abs=1e-3)
    path = free.geodesic(np.array([[x, -y]]), np.array([[x + 86 * 0.05, -y]]))
    assert path[0] == pytest.approx(86 * 0.05, abs=0.01)


@pytest.mark.parametrize("change", ["negate", "alpha", "raw", "block list"])
def test_the_ways_of_map_server(change: str, tmp_path: Path) -> None:
    pixels, yaml = rooms(), YAML
    if change == "negate":
        pixels, yaml = 255 - pixels, YAML.replace("negate: 0", "negate: 1")
    elif change == "raw":
        pixels, yaml = np.select([pixels == 0, pixels == 254], [100, 0], 255), YAML.replace("trinary", "raw")
    elif change == "block list":
        yaml = YAML.replace("[-1.5, -2.0, 0]", "\n  - -1.5\n  - -2.0\n  - 0")
    path = write_map(tmp_path, pixels, yaml)
    if change == "alpha":
        seen = np.where(pixels == 205, 0, 255).astype(np.uint8)
        Image.fromarray(np.dstack([np.where(pixels == 205, 254, pixels)] * 3 + [seen]).astype(np.uint8)).save(
            tmp_path / "a.png"
        )
        path.write_text(YAML.replace("map.pgm", "a.png"))
    grid = read_map(path)
    expected = read_map(write_map(tmp_path / "plain", rooms()))
    np.testing.assert_array_equal(grid.cells, expected.cells)
    assert grid.origin == expected.origin


def test_an_extruded_map_keeps_its_outline_within_a_cell() -> None:
    scene = load_scene(crossing().attachments["scene.glb"])
    free = FreeSpace.from_scene(scene)
    grid = map_of(free)
    again = FreeSpace.from_scene(scene_of_map(grid, "map"), cache=False)
    rng = np.random.default_rng(1)
    points = free.sample(rng, 2000)
    error = again.signed_distance(points) - free.signed_distance(points)
    assert np.abs(error).max() < grid.resolution
    assert abs(np.median(error)) < grid.resolution / 2
    a, b = points[:200], points[200:400]
    there = again.is_navigable(a) & again.is_navigable(b)
    assert there.mean() > 0.9
    lengths, truth = again.geodesic(a[there], b[there]), free.geodesic(a[there], b[there])
    both = np.isfinite(lengths) & np.isfinite(truth) & (truth > 0.5)
    assert (np.isfinite(lengths) == np.isfinite(truth)).mean() > 0.97
    errors = np.abs(lengths - truth)[both] / truth[both]
    assert np.median(errors) < 0.003
    assert np.percentile(errors, 95) < 0.01


def test_a_recording_in_a_map_is_drawn_and_measured(tmp_path: Path) -> None:
    write_map(tmp_path / "m", rooms())
    rows = "".join(f"{k / 10},{p},{0.5 + k / 10},{0.4 + i}\n" for k in range(30) for i, p in enumerate("ra"))
    (tmp_path / "t.csv").write_text("t,id,x,y\n" + rows)
    recording = read_tracks(tmp_path / "t.csv", tracks=ImportRequest(robot="r", map=tmp_path / "m" / "map.yaml"))
    assert recording.episode.scene == "map"
    assert "scene.glb" in recording.attachments
    log = tmp_path / "rec" / "t.csv.mcap"
    arguments = [
        "import",
        tmp_path / "t.csv",
        "--robot",
        "r",
        "--map",
        tmp_path / "m" / "map.yaml",
        "-o",
        tmp_path / "rec",
    ]
    assert main([*map(str, arguments)]) == 0
    assert (
        main(["rerender", str(log), "--camera", "top_down", "--size", "160x120", "-o", str(tmp_path / "pictures")]) == 0
    )
    images = sorted(tmp_path.rglob("*.png")) or sorted(tmp_path.rglob("*.mp4"))
    assert images
    if images[0].suffix == ".png":
        assert np.asarray(Image.open(images[0])).std() > 5


HOSTILE = {
    "no file": ("", "H3-ROS-022"),
    "no keys": ("hello: 1\n", "H3-ROS-016"),
    "words": (YAML.replace("0.05", "fine"), "H3-ROS-016"),
    "no size": (YAML.replace("0.05", "0"), "H3-ROS-017"),
    "turned": (YAML.replace("-2.0, 0]", "-2.0, 0.5]"), "H3-ROS-018"),
    "no picture": (YAML.replace("map.pgm", "other.pgm"), "H3-ROS-024"),
    "damaged": (YAML.replace("map.pgm", "map.yaml"), "H3-ROS-025"),
    "huge": (YAML, "H3-ROS-023"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_damaged_map_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    yaml, code = HOSTILE[name]
    path = write_map(tmp_path, rooms(), yaml)
    if name == "no file":
        path.unlink()
    if name == "huge":
        monkeypatch.setattr(occupancy, "CELLS_MAX", 1000)
    with pytest.raises(H3DataError, match=code) as caught:
        read_map(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("resolution", "x"), [(1e9, 0.0), (1e-9, 0.0), (0.05, 1e12), (float("nan"), 0.0)])
def test_maps_that_are_no_building_are_refused(resolution: float, x: float) -> None:
    grid = OccupancyMap(cells=np.full((40, 40), FREE, np.int8), resolution=resolution, origin=(x, 0.0))
    with pytest.raises(H3DataError, match="H3-ROS-061"):
        scene_of_map(grid, "m")


def test_maps_without_a_floor_or_with_too_much_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    cells = np.full((40, 40), OCCUPIED, np.int8)
    grid = OccupancyMap(cells=cells, resolution=0.05, origin=(0.0, 0.0))
    with pytest.raises(H3DataError, match="H3-ROS-020"):
        scene_of_map(grid, "m")
    cells[::2, ::2] = FREE
    monkeypatch.setattr(occupancy, "RECTANGLES_MAX", 100)
    with pytest.raises(H3DataError, match="H3-ROS-021"):
        scene_of_map(grid, "m")
    monkeypatch.setattr(occupancy, "CELLS_MAX", 100)
    with pytest.raises(H3DataError, match="H3-ROS-019"):
        scene_of_map(grid, "m")
