"""Houses in the JSON of ProcTHOR: one of our own making becomes a scene, and others are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.errors import FormatError, SceneError
from h3data.scene import Box, FreeSpace
from h3data.scene.sources import SceneFile, reader_of
from h3data_worlds.procthor import DATABASE, read_house


def point(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def wall(room: str, x0: float, z0: float, x1: float, z1: float) -> dict[str, Any]:
    corners = [point(x0, 0, z0), point(x1, 0, z1), point(x1, 2.5, z1), point(x0, 2.5, z0)]
    return {"id": f"wall|{room}|{x0}|{z0}|{x1}|{z1}", "roomId": room, "polygon": corners}


def house() -> dict[str, Any]:
    """A room of 4 x 4 m and one in the shape of an L east of it, with a door of 1 m in between, 1 m from the south end."""
    return {
        "metadata": {"schema": "1.0.0"},
        "rooms": [
            {
                "id": "room|1",
                "roomType": "LivingRoom",
                "floorPolygon": [point(0, 0, 0), point(0, 0, 4), point(4, 0, 4), point(4, 0, 0)],
            },
            {
                "id": "room|2",
                "roomType": "Kitchen",
                "floorPolygon": [
                    point(4, 0, 0), point(4, 0, 4), point(6, 0, 4), point(6, 0, 2), point(8, 0, 2), point(8, 0, 0),
                ],
            },
        ],
        "walls": [
            wall("room|1", 4, 0, 4, 4),
            wall("room|2", 4, 4, 4, 0),
            wall("room|1", 0, 0, 0, 4),
            wall("room|1", 0, 4, 4, 4),
            wall("room|1", 4, 0, 0, 0),
        ],
        "doors": [
            {
                "id": "door|1|2",
                "assetId": "Doorway_1",
                "room0": "room|1",
                "room1": "room|2",
                "wall0": "wall|room|1|4|0|4|4",
                "wall1": "wall|room|2|4|4|4|0",
                "holePolygon": [point(1, 0, 0), point(2, 2, 0)],
            }
        ],
        "windows": [
            {"id": "window|1", "wall0": "wall|room|1|0|0|0|4", "holePolygon": [point(1, 1, 0), point(3, 2, 0)]}
        ],
        "objects": [
            {
                "id": "DiningTable|1|0",
                "assetId": "Table_1",
                "kinematic": True,
                "position": point(1, 0.4, 3),
                "rotation": point(0, 90, 0),
                "children": [{"id": "Mug|surface|1", "assetId": "Mug_1", "position": point(1, 0.85, 3)}],
            },
            {"id": "Rug|1|1", "assetId": "Rug_1", "kinematic": True, "position": point(2, 0.005, 1)},
        ],
    }  # fmt: skip


DATABASE_OF_OURS = {
    "DiningTable": [{"assetId": "Table_1", "boundingBox": point(2, 0.8, 1)}],
    "Mug": [{"assetId": "Mug_1", "boundingBox": point(0.1, 0.1, 0.1)}],
    "Rug": [{"assetId": "Rug_1", "boundingBox": point(2, 0.01, 1)}],
}


def stored(folder: Path, document: Any, *, database: Any = DATABASE_OF_OURS) -> Path:
    path = folder / "house.json"
    path.write_text(json.dumps(document))
    if database is not None:
        (folder / DATABASE).write_text(json.dumps(database))
    return path


def test_a_house_is_a_scene_with_a_floor(tmp_path: Path) -> None:
    scene = h3data.load_scene(stored(tmp_path, house()))
    assert [(room.name, room.category) for room in scene.rooms] == [("room_1", "living_room"), ("room_2", "kitchen")]
    area = sum((r[:, 2] - r[:, 0]) @ (r[:, 3] - r[:, 1]) for r in (room.rectangles for room in scene.rooms))
    assert area == pytest.approx(16 + 12)
    by_name = {one.name: one for one in scene.instances}
    table, mug = by_name["DiningTable_1_0"], by_name["Mug_surface_1"]
    assert (table.motion, mug.motion) == ("static", "kinematic")
    np.testing.assert_allclose(table.pose[:3], [1, 0.4, -3])
    assert not scene.assets["Rug_1"].shapes
    free = FreeSpace.from_scene(scene, radius_m=0.2, height_m=1.4)
    points = np.array([[1.0, -1.5], [5.0, -3.5], [7.5, -1.0], [7.0, -3.0], [1.4, -3.9], [1.0, -3.8]])
    np.testing.assert_array_equal(free.signed_distance(points) > 0, [True, True, True, False, False, False])
    assert free.signed_distance(np.array([[1.75, -3.0]]))[0] > 0  # beside the table, which is turned by 90 degrees
    through = float(free.geodesic(np.array([[3.0, -3.5]]), np.array([[5.0, -3.5]]))[0])
    assert through > 2 * np.hypot(1, 1.5)  # by the door, which is between z = -1 and -2, not through the wall
    assert through < 2 * np.hypot(1, 2.1)


def test_the_middle_of_a_window_is_open_and_its_sill_is_not(tmp_path: Path) -> None:
    scene = read_house(SceneFile(path=str(stored(tmp_path, house()))))
    boxes = scene.assets["wall_room_1_0_0_0_4"].shapes
    spans = {
        (round(b.pose[1] - b.half_extents[1], 3), round(b.pose[1] + b.half_extents[1], 3))
        for b in boxes
        if isinstance(b, Box)
    }
    assert spans == {(0.0, 2.5), (0.0, 1.0), (2.0, 2.5)}


def test_sizes_may_be_in_a_folder_of_assets(tmp_path: Path) -> None:
    path = stored(tmp_path, house(), database=None)
    with pytest.raises(SceneError) as refused:
        h3data.load_scene(path)
    assert refused.value.code == "H3-WORLD-021"
    assert {one.name for one in read_house(SceneFile(path=str(path), allow_missing=True)).instances}.isdisjoint(
        {"Mug_surface_1"}
    )
    folder = tmp_path / "assets"
    folder.mkdir()
    (folder / DATABASE).write_text(json.dumps(DATABASE_OF_OURS))
    assert len(read_house(SceneFile(path=str(path), assets=(str(folder),))).assets) == 2 + 5 + 3


def test_other_files_of_json_are_no_houses(tmp_path: Path) -> None:
    for number, text in enumerate(["", "[]", "{", '{"rooms": 1}', "[" * 99999]):
        path = tmp_path / f"{number}.json"
        path.write_text(text)
        reader = reader_of(str(path))
        assert reader is None or reader.read is not read_house


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"rooms": []}, "H3-WORLD-022"),
        ({"rooms": [{"id": "a"}]}, ""),
        ({"walls": [{"id": 3}]}, ""),
        ({"objects": [house()["objects"][1]] * 2}, ""),
        ({"objects": [house()["objects"][1] | {"position": point(1e300, 0, 0)}]}, ""),
        ({"rooms": [house()["rooms"][0] | {"floorPolygon": [point(1e9, 0, 0)] * 3}]}, ""),
    ],
)
def test_damaged_houses_are_refused(tmp_path: Path, change: dict[str, Any], code: str) -> None:
    with pytest.raises(FormatError) as refused:
        h3data.load_scene(stored(tmp_path, house() | change))
    assert refused.value.code.startswith("H3-WORLD-")
    assert code in ("", refused.value.code)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"metadata": {"schema": "9.0.0"}}, "its schema is '9.0.0'"),
        ({"doors": [house()["doors"][0] | {"wall0": "wall|none"}]}, "1 doors and windows without a wall"),
        ({"windows": [house()["windows"][0] | {"holePolygon": []}]}, "1 doors and windows without a wall"),
        (
            {
                "rooms": [
                    house()["rooms"][0]
                    | {"floorPolygon": [point(0, 0, 0), point(0, 0, 4), point(4, 0, 4), point(5, 0, 0)]}
                ]
            },
            "slanting sides become rectangles: room|1",
        ),
    ],
)
def test_what_is_not_read_as_meant_is_told_and_an_error_when_strict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict[str, Any], words: str
) -> None:
    path = str(stored(tmp_path, house() | change))
    assert read_house(SceneFile(path=path)).rooms
    assert words in capsys.readouterr().err
    with pytest.raises(SceneError, match="H3-WORLD-029"):
        read_house(SceneFile(path=path, strict=True))


def test_a_whole_house_is_read_without_a_word(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    read_house(SceneFile(path=str(stored(tmp_path, house())), strict=True))
    assert not capsys.readouterr().err
