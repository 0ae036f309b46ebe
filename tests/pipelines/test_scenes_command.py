"""``h3data scenes``: what it lists, draws, exports, and the faults that it finds in homes into which they were put."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from h3data.geometry import IDENTITY_POSE, quat_from_axis_angle
from h3data.render.sheets.scene_map import plan_picture
from h3data.scene import (
    Asset,
    Box,
    Capsule,
    Cylinder,
    FreeSpace,
    Hull,
    Instance,
    Mesh,
    Receptacle,
    Room,
    Scene,
    load_scene,
    scene_digest,
)
from h3data.scene.open import named_scenes
from h3data_habitat.exporters.scenes import export_habitat
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.assets.eye_level import eye_level_camera
from h3data_pipelines.assets.scene_plan import (
    ISLAND_COLOR,
    MAIN_COLOR,
    PROBLEM_COLOR,
    RECEPTACLE_COLOR,
    scene_map,
)
from h3data_pipelines.assets.scene_reports import validate_scene
from h3data_pipelines.cli import main
from h3data_pipelines.validation.overlaps import overlapping_instances
from h3data_pipelines.validation.scenes import Problem, find_problems, free_space_for_validation, hull_fills_hollows

SHUT = ["island", "unreachable_room", "out_of_reach"]
"""What a shut door does to the room with the table."""
BOX_FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ],
    np.int32,
)


def block(
    name: str,
    low: tuple[float, ...],
    high: tuple[float, ...],
    category: str = "wall",
    *,
    solid: bool = True,
    receptacles: tuple[Receptacle, ...] = (),
) -> Asset:
    a, b = np.array(low, float), np.array(high, float)
    vertices = np.array([[x, y, z] for x in (a[0], b[0]) for y in (a[1], b[1]) for z in (a[2], b[2])], np.float32)
    shape = Box(pose=np.concatenate([(a + b) / 2, [0, 0, 0, 1]]), half_extents=(b - a) / 2)
    mesh = Mesh(vertices=vertices, faces=BOX_FACES, colors=np.full((8, 3), 150, np.uint8))
    return Asset(name=name, mesh=mesh, category=category, shapes=(shape,) if solid else (), receptacles=receptacles)


def at(name: str, asset: str, x: float = 0, y: float = 0, z: float = 0, motion: Any = "static") -> Instance:
    pose = IDENTITY_POSE.copy()
    pose[:3] = x, y, z
    return Instance(name=name, asset=asset, pose=pose, motion=motion)


def two_rooms(door_m: float, *more: Instance, niche_m: float = 0.0) -> Scene:
    """Rooms of 4 x 4 m with a door of a given width between them, a table with a top of 0.7 m, and a 10 cm cube."""
    top = Receptacle(name="top", center=np.array([0, 0.7, 0.0]), half_size=np.array([0.3, 0.3]), clearance_m=1.0)
    lift = Receptacle(name="top", center=np.array([0, 0.7, 0.0]), half_size=np.array([1.9, 1.9]), clearance_m=1.0)
    assets = [
        block("floor", (-0.1, -0.1, -0.1), (8.2, 0, 4.1), "floor", solid=False),
        block("outer_w", (-0.1, 0, -0.1), (0, 2.6, 4.1)),
        block("outer_e", (8.1, 0, -0.1), (8.2, 2.6, 4.1)),
        block("outer_n", (0, 0, -0.1), (8.1, 2.6, 0)),
        block("outer_s", (0, 0, 4), (8.1, 2.6, 4.1)),
        block("inner_n", (4, 0, 0), (4.1, 2.6, 2 - door_m / 2)),
        block("inner_s", (4, 0, 2 + door_m / 2), (4.1, 2.6, 4)),
        block("table", (-0.4, 0, -0.4), (0.4, 0.7, 0.4), "table", receptacles=(top,)),
        block("platform", (-2, 0, -2), (2, 0.7, 2), "table", receptacles=(lift,)),
        block("cube", (-0.05, -0.05, -0.05), (0.05, 0.05, 0.05), "box"),
    ]
    walls = tuple(at(a.name, a.name) for a in assets[:7])
    instances = (*walls, at("table_0", "table", 1.3, 0, 1.3), *more)
    if niche_m:
        assets.append(block("cupboard", (0, 0, 0), (1, 2, 1)))
        instances += (at("cupboard_0", "cupboard", 6.1, 0, niche_m),)
    rooms = tuple(
        Room(name=n, category="living", rectangles=np.array([[x, 0.0, x + 4, 4]]))
        for n, x in (("west", 0), ("east", 4.1))
    )
    return Scene(name="two_rooms", assets={a.name: a for a in assets}, instances=instances, rooms=rooms)


def problems(scene: Scene) -> list[Problem]:
    loose = FreeSpace.from_scene(scene, radius_m=0.225, cache=False)
    return find_problems(scene, loose)


def kinds(scene: Scene) -> list[str]:
    return [p.kind for p in problems(scene)]


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=3))


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, Any]:
    """Exit code and JSON object of ``h3data scenes ... --json``."""
    capsys.readouterr()
    code = main(["scenes", *map(str, arguments), "--json"])
    return code, json.loads(capsys.readouterr().out)


# --- faults that are put in are found ---------------------------------------------------------------------------------
def test_a_sound_scene_has_no_problems() -> None:
    scene = two_rooms(0.9, at("cube_0", "cube", 1.3, 0.751, 1.3, "kinematic"))
    assert problems(scene) == []
    assert overlapping_instances(scene) == []


@pytest.mark.parametrize(
    ("door_m", "expected"),
    [(0.30, SHUT), (0.44, SHUT), (0.62, []), (0.9, [])],
)
def test_doors_clearly_shut_or_open(door_m: float, expected: list[str]) -> None:
    assert kinds(two_rooms(door_m)) == expected


@pytest.mark.parametrize("door_m", [0.47, 0.53, 0.58])
def test_a_door_of_nearly_an_agents_width(door_m: float) -> None:
    found = problems(two_rooms(door_m))
    (gap,) = [p for p in found if p.kind == "tight_gap"]
    assert gap.position is not None
    np.testing.assert_allclose(gap.position, [4.05, 0, 2.0], atol=0.12)
    width = float(gap.text.removeprefix("a passage ").split(" m")[0])
    assert width == pytest.approx(door_m, abs=0.012)
    # below 2 r it is shut for the agent as well
    assert [p.kind for p in found if p.kind != "tight_gap"] == (SHUT if door_m < 0.5 else [])


def test_a_niche_is_no_passage() -> None:
    """A cupboard 0.55 m from the wall: with a wall on one side a dead end, else one can walk round it."""
    assert kinds(two_rooms(0.9, niche_m=0.55)) == ["tight_gap"]
    scene = two_rooms(0.9, niche_m=0.55)
    stop = block("stop", (0, 0, 0), (0.1, 2, 0.6))
    closed = replace(
        scene, assets={**scene.assets, "stop": stop}, instances=(*scene.instances, at("stop_0", "stop", 6.1))
    )
    assert kinds(closed) == []


@pytest.mark.parametrize(
    ("y", "kind"),
    [
        (0.752, None),
        (0.765, None),
        (0.80, "floating"),
        (1.5, "floating"),
        (0.745, None),
        (0.72, "sunk"),
        (0.66, "sunk"),
    ],
)
def test_things_on_a_table(y: float, kind: str | None) -> None:
    found = problems(two_rooms(0.9, at("cube_0", "cube", 1.3, y, 1.3, "kinematic")))
    assert [(p.kind, p.subject) for p in found] == ([] if kind is None else [(kind, "cube_0")])


def test_things_on_the_floor_in_the_void_and_on_each_other() -> None:
    assert kinds(two_rooms(0.9, at("c", "cube", 3, 0.05, 3, "kinematic"))) == []
    assert kinds(two_rooms(0.9, at("c", "cube", 3, 0.02, 3, "kinematic"))) == ["sunk"]
    (lost,) = problems(two_rooms(0.9, at("c", "cube", 30, 1, 3, "kinematic")))
    assert (lost.kind, lost.text) == ("floating", "nothing is below it")
    stack = (at("a", "cube", 1.3, 0.75, 1.3, "kinematic"), at("b", "cube", 1.3, 0.851, 1.3, "kinematic"))
    assert kinds(two_rooms(0.9, *stack)) == []
    turned = np.concatenate(
        [[1.3, 0.7 + 0.05 * np.sqrt(2), 1.3], quat_from_axis_angle(np.array([0, 0, 1.0]), np.pi / 4)]
    )
    on_edge = replace(at("a", "cube", motion="kinematic"), pose=turned)
    assert kinds(two_rooms(0.9, on_edge)) == []


def test_the_middle_of_a_large_platform_is_out_of_reach() -> None:
    scene = two_rooms(0.9, at("platform_0", "platform", 6.1, 0, 2.0))
    assert kinds(scene) == ["unreachable_room", "out_of_reach"]
    shelf = problems(scene)[-1]
    assert shelf.subject == "platform_0|top"
    np.testing.assert_allclose(shelf.position, [6.1, 0.7, 2.0])


def test_overlaps_by_fcl() -> None:
    scene = two_rooms(
        0.9,
        at("table_1", "table", 2.05, 0, 1.3),
        at("cube_0", "cube", 3, 0.05, 3, "kinematic"),
        at("cube_1", "cube", 3.02, 0.12, 3, "kinematic"),
    )
    found = overlapping_instances(scene)
    assert [(o.first, o.second) for o in found] == [("table_0", "table_1"), ("cube_0", "cube_1")]
    assert found[0].depth_m == pytest.approx(0.05, abs=1e-6)
    assert found[1].depth_m == pytest.approx(0.03, abs=1e-6)
    assert 1.6 <= found[0].point[0] <= 1.75
    assert [o.first for o in overlapping_instances(scene, tolerance_m=0.04)] == ["table_0"]
    assert overlapping_instances(replace(scene, instances=())) == []


def test_overlaps_of_scaled_and_round_parts() -> None:
    ball = Asset(
        name="ball",
        mesh=block("m", (-1, -1, -1), (1, 1, 1)).mesh,
        shapes=(Capsule(start=np.zeros(3), end=np.zeros(3), radius=0.5),),
    )
    scene = two_rooms(0.9)
    near = replace(at("near", "ball", 6, 0.5, 2), scale=np.full(3, 0.5))
    for x, expected in ((6.74, True), (6.76, False)):
        moved = replace(scene, assets={**scene.assets, "ball": ball}, instances=(near, at("far", "ball", x, 0.5, 2)))
        assert bool(overlapping_instances(moved, tolerance_m=1e-4)) is expected


def test_hulls_that_fill_hollows_are_told_by_their_mesh(home: Scene) -> None:
    def as_one_hull(category: str) -> Asset:
        asset = next(a for a in home.assets.values() if a.category == category)
        return replace(asset, shapes=(Hull(points=asset.mesh.vertices.astype(np.float64)),))

    assert hull_fills_hollows(as_one_hull("chair"))
    assert hull_fills_hollows(as_one_hull("shelf"))
    assert not hull_fills_hollows(as_one_hull("box"))
    assert not hull_fills_hollows(next(a for a in home.assets.values() if a.category == "chair"))


# --- validate ---------------------------------------------------------------------------------------------------------
def test_homes_are_valid(home: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    code, data = run(capsys, "validate", "small:3", "medium:1")
    assert code == 0
    assert data["faults"] == 0
    assert [s["scene"] for s in data["scenes"]] == ["small:3", "medium:1"]
    assert data["scenes"][0]["free_m2"] == pytest.approx(FreeSpace.from_scene(home).polygon.area, rel=1e-3)


@pytest.mark.slow
def test_twenty_homes_are_valid(capsys: pytest.CaptureFixture[str]) -> None:
    code, data = run(capsys, "validate", "small", "medium", "--homes", "10")
    assert (code, data["faults"], len(data["scenes"])) == (0, 0, 20)


def test_a_bad_habitat_scene_is_reported_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = two_rooms(0.55, at("cube_0", "cube", 1.3, 1.0, 1.3, "kinematic"), at("table_1", "table", 2.0, 0, 1.3))
    config = export_habitat(scene, tmp_path / "bad")
    code, data = run(capsys, "validate", config, "-o", tmp_path / "bad.png")
    assert code == 1
    found = {p["kind"] for p in data["scenes"][0]["problems"]}
    assert found == {"floating", "overlap", "tight_gap"}
    image = cv2.imread(str(tmp_path / "bad.png"))[..., ::-1]
    assert (np.abs(image.astype(int) - PROBLEM_COLOR).sum(-1) < 30).sum() > 200
    assert main(["scenes", "validate", str(config)]) == 1
    out = capsys.readouterr().out
    assert "overlap by " in out
    assert "bad.scene_dataset_config.json: " in out or "two_rooms.scene_dataset_config.json: " in out


def test_missing_assets_are_a_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = export_habitat(two_rooms(0.9, at("cube_0", "cube", 1.3, 0.751, 1.3, "kinematic")), tmp_path / "x")
    cube = next((tmp_path / "x/objects").glob("box_*.object_config.json"))
    (tmp_path / "x/objects" / json.loads(cube.read_text())["render_asset"]).unlink()
    code, data = run(capsys, "validate", config)
    assert code == 1
    assert [p["kind"] for p in data["scenes"][0]["problems"]] == ["missing_asset"]
    assert data["scenes"][0]["free_m2"] > 10  # the rest is looked at all the same
    plan = ("show", config, "-o", tmp_path / "x.png")
    assert main(["scenes", *map(str, plan)]) == 2
    assert "--allow-missing" in capsys.readouterr().err
    assert run(capsys, *plan, "--allow-missing")[0] == 0
    assert main(["scenes", *map(str, plan), "--force", "--allow-missing", "--strict"]) == 2
    assert "Choose either" in capsys.readouterr().err


def test_what_stands_in_a_doorway_is_named() -> None:
    (island,) = [p for p in problems(two_rooms(0.9, at("chest", "table", 4.05, 0, 2))) if p.kind == "island"]
    assert island.text.endswith("; between them: chest")


@pytest.mark.parametrize("sunk_m", [0.02, 0.06])
def test_depth_of_an_overlap_is_how_far_it_must_be_lifted(sunk_m: float) -> None:
    scene = two_rooms(0.9)
    pose = np.array([0, 0.06, 0, 0, 0, 0, 1.0])
    can = replace(scene.assets["cube"], name="can", shapes=(Cylinder(pose=pose, radius=0.04, half_height=0.06),))
    standing = at("can_0", "can", 1.2, 0.7 - sunk_m, 1.3, "kinematic")
    scene = replace(scene, assets={**scene.assets, "can": can}, instances=(*scene.instances, standing))
    (overlap,) = overlapping_instances(scene)
    assert overlap.depth_m == pytest.approx(sunk_m, abs=1e-3)


def test_a_scene_without_floor_does_not_stop_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wall = Scene(name="wall", assets={"w": block("w", (0, 0, 0), (0.1, 3, 3))}, instances=(at("w", "w"),))
    config = export_habitat(wall, tmp_path / "x")
    code, data = run(capsys, "validate", config, "small:3", "-o", tmp_path / "pictures")
    assert code == 1
    assert [[p["kind"] for p in s["problems"]] for s in data["scenes"]] == [["no_floor"], []]
    assert [p.name for p in (tmp_path / "pictures").iterdir()] == ["small_3.png"]


def test_validation_of_the_real_test_room(real: Path) -> None:
    room = real / "habitat-sim/data/test_assets/scenes/simple_room.stage_config.json"
    report = validate_scene(named_scenes(str(room))[0])
    assert report["free_m2"] == pytest.approx(97, abs=3)
    # its block of 2 x 2 m is too large to reach the middle of
    assert "stage|receptacle_aabb_simpleroom_test" in [p["subject"] for p in report["problems"]]


# --- list, show, export -----------------------------------------------------------------------------------------------
def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    code, data = run(capsys, "list")
    assert code == 0
    assert {("small", 68.56), ("medium", 136.11)} <= {(p["preset"], p["area_m2"]) for p in data["presets"]}
    code, data = run(capsys, "list", "small", "--homes", "2")
    assert [s["scene"] for s in data["scenes"]] == ["small:0", "small:1"]
    assert all(abs(s["floor_m2"] - 68.56) < 0.1 and s["islands"] == 1 and s["movable"] > 5 for s in data["scenes"])
    assert main(["scenes", "list", "small:1"]) == 0
    assert "small:1" in capsys.readouterr().out


def test_show(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, data = run(capsys, "show", "small:3", "-o", tmp_path / "home.png", "--pixels-per-m", "40")
    assert code == 0
    plan = cv2.imread(str(tmp_path / "home.png"))
    assert plan.shape == (data["height"], data["width"], 3)
    code, data = run(capsys, "show", "small:3", "--view", "eye", "--room", "bathroom", "-o", tmp_path / "eye.png")
    assert code == 0
    assert np.std(cv2.imread(str(tmp_path / "eye.png"))) > 10


def test_export_glb_keeps_the_scene(home: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, data = run(capsys, "export", "small:3", "--to", "glb", "-o", tmp_path / "out")
    assert code == 0
    assert data["path"] == str(tmp_path / "out/home_small_3.glb")
    assert scene_digest(load_scene(data["path"])) == scene_digest(home)
    assert main(["scenes", "export", "small:3", "--to", "glb", "-o", str(tmp_path / "out")]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["scenes", "export", "small:3", "--to", "glb", "-o", str(tmp_path / "out"), "--force"]) == 0
    assert "wrote home_small_3 as glb: 1 file, " in capsys.readouterr().out


@pytest.mark.slow
def test_export_habitat_can_be_used_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, data = run(capsys, "export", "small:3", "small:1", "--to", "habitat", "-o", tmp_path / "out")
    assert code == 0
    assert data["files"] == sum(p.is_file() for p in (tmp_path / "out").rglob("*"))
    instance = tmp_path / "out/scenes/home_small_1.scene_instance.json"
    code, listed = run(capsys, "list", instance)
    assert code == 0
    ours = run(capsys, "list", "small:1")[1]["scenes"][0]["triangles"]
    assert ours - 40 < listed["scenes"][0]["triangles"] < ours  # without the top of the ceiling
    assert main(["scenes", "export", "small:3", "--to", "habitat", "-o", str(tmp_path / "out")]) == 2
    assert "not empty" in capsys.readouterr().err
    assert run(capsys, "export", "small:3", "--to", "habitat", "-o", tmp_path / "out", "--force")[0] == 0
    assert not instance.exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("show", "small", "-o", "x.png"), "add a seed"),
        (("show", "huge:3", "-o", "x.png"), "Unknown scenes"),
        (("show", "nowhere.glb", "-o", "x.png"), "no such scene"),
        (("show", "small:3", "-o", "x.gif"), "ends in .png"),
        (("show", "small:3", "-o", "x.png", "--room", "kitchen"), "--view eye"),
        (("show", "small:3", "-o", "x.png", "--view", "eye", "--room", "cellar"), "Its rooms: living"),
        (("show", "small:3", "-o", "x.png", "--pixels-per-m", "nan"), "--pixels-per-m"),
        (("list", "small", "--homes", "0"), "--homes"),
        (("export", "small:3", "small:3", "--to", "glb", "-o", "out"), "same name"),
        (("export", "small:3", "small:3", "--to", "habitat", "-o", "out"), "different names"),
        (("export", "--to", "glb", "-o", "out"), "at least one scene"),
        (("export", "small", "--to", "glb", "-o", "out"), "add a seed"),
        (("validate",), "at least one scene"),
        (("validate", "small:3", "--radius", "0"), "--radius"),
    ],
)
def test_refusals(
    arguments: tuple[str, ...],
    says: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["scenes", *arguments]) == 2
    assert says in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_folders_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("x")
    for arguments in (
        ("show", "small:3", "-o", tmp_path / "file/home.png"),
        ("export", "small:3", "--to", "glb", "-o", tmp_path / "file/out"),
        ("export", "small:3", "--to", "habitat", "-o", tmp_path / "file/out"),
        ("validate", "small:3", "-o", tmp_path / "file/home.png"),
    ):
        assert main(["scenes", *map(str, arguments)]) == 2, arguments
        assert "Cannot" in capsys.readouterr().err


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write to read-only folders")
def test_read_only_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tmp_path.chmod(0o555)
    try:
        for arguments in (("show", "small:3", "-o", "x.png"), ("export", "small:3", "--to", "habitat", "-o", "x")):
            target = str(tmp_path / arguments[-1])
            assert main(["scenes", *arguments[:-1], target]) == 2
            assert "Cannot" in capsys.readouterr().err
    finally:
        tmp_path.chmod(0o755)


@pytest.mark.parametrize("command", ["list", "show", "export", "validate"])
def test_help_has_examples(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["scenes", command, "--help"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    assert "Examples:" in out
    assert f"h3data scenes {command}" in out
    assert "--json" in out


# --- pictures ---------------------------------------------------------------------------------------------------------
def near(image: np.ndarray, color: tuple[int, int, int], within: int = 40) -> int:
    return int((np.abs(image.astype(int) - color).sum(-1) <= within).sum())


def test_the_plan_has_the_scale_that_it_says() -> None:
    """Corners of the room fall on the pixels that its metres say, at every height: walls do not lean."""
    scene = two_rooms(0.9)
    image, camera = plan_picture(scene, pixels_per_m=50)
    assert image.shape == (250, 454, 3)  # 8.1 x 4 m with half a metre around
    for y in (0.0, 2.6):
        pixels, _ = camera.project(np.array([[0.0, y, 0.0], [8.1, y, 4.0]]))
        assert np.linalg.norm(pixels[0] - [25, 25]) < 1.5
        np.testing.assert_allclose(pixels[1] - pixels[0], [405, 200], rtol=0.01)


def test_map_shows_islands_receptacles_and_problems() -> None:
    scene = two_rooms(0.3)
    free = FreeSpace.from_scene(scene, cache=False)
    clean = scene_map(scene, free)
    assert near(clean, ISLAND_COLOR) > 200  # the outline of the cut-off room
    assert near(clean, MAIN_COLOR) > 200
    assert near(clean, RECEPTACLE_COLOR) > 60
    found = find_problems(scene, free_space_for_validation(scene))
    marked = scene_map(scene, free, problems=found)
    assert near(marked, PROBLEM_COLOR) > near(clean, PROBLEM_COLOR) + 200
    assert marked.shape[0] > clean.shape[0]  # the list
    assert marked.shape[1] == clean.shape[1]
    assert (marked[clean.shape[0] :, -8:] == marked[-1, -1]).all()  # no line runs out of the picture


@pytest.mark.slow
def test_map_of_a_home_without_ceiling_layer(home: Scene, tmp_path: Path) -> None:
    """An exported home has its ceiling in the stage; from above one must look into the rooms all the same."""
    from h3data_habitat.scenes.scene_instance import load_habitat_scene

    again = load_habitat_scene(export_habitat(home, tmp_path / "x"))
    ours, _ = plan_picture(home, pixels_per_m=20)
    theirs, _ = plan_picture(again, pixels_per_m=20)
    rug = next(i for i in home.instances if home.assets[i.asset].category == "rug")
    color = np.median(home.assets[rug.asset].mesh.colors, axis=0)
    assert np.abs(ours.astype(int) - color).sum(-1).min() < 90
    assert abs(np.mean(ours) - np.mean(theirs)) < 25
    assert np.std(theirs) > 30


def test_eye_level_camera_stands_on_free_floor(home: Scene) -> None:
    free = FreeSpace.from_scene(home)
    for room in home.rooms:
        camera = eye_level_camera(home, free, room=room.name)
        x, y, z = camera.pose[:3, 3]
        assert y == pytest.approx(1.55)
        assert free.island(np.array([[x, z]]))[0] in (0, -1)
        assert free.clearance(np.array([x, z])) > -0.06
        x0, z0, x1, z1 = room.rectangles[0]
        assert x0 - 0.01 < x < x1 + 0.01
        assert z0 - 0.01 < z < z1 + 0.01


@pytest.mark.slow
def test_episodes_of_an_export_lead_to_its_scenes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the working directory of the export, as Habitat's own; and h3data finds them when the folder has moved."""
    from h3data.recording.task_episodes.rearrange_episode import instance_handles
    from h3data.recording.task_episodes.social_nav_episodes import read_social_nav
    from h3data.scene.sources import SceneFile
    from h3data_habitat.episodes.files import read_episodes
    from h3data_habitat.episodes.scenes import scene_of_episode

    monkeypatch.chdir(tmp_path)
    homes = [{"id": f"home_{k}", "seed": 20000 + k, "preset": "small"} for k in range(2)]
    scenes = ", ".join("{ " + ", ".join(f"{key} = {json.dumps(v)}" for key, v in home.items()) + " }" for home in homes)
    (tmp_path / "two.toml").write_text(f'format = 1\nname = "two"\nsplit = "val"\nabout = "two"\nscenes = [{scenes}]\n')
    code, data = run(capsys, "export", "two.toml", "--to", "habitat", "-o", "data/two", "--episodes", "2")
    assert code == 0
    (file,) = data["episodes"]
    for episode in read_episodes(file).episodes:
        assert (tmp_path / episode.scene_id).is_file()
        assert (tmp_path / episode.scene_dataset_config).is_file()
        (handle,) = instance_handles(episode)
        assert list(episode.targets) == [handle]
        assert episode.object_labels == {handle: "any_targets|0"}
        template = episode.rigid_objects[0].config
        assert (tmp_path / "data/two/objects" / template).is_file()
        assert episode.rigid_objects[0].pose[1] < -4
    Path("data/two").rename(tmp_path / "moved")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    nav = read_social_nav(episode)
    assert nav is not None
    other = msgspec.structs.replace(nav, scene_source={})  # as if the home could not be built again
    found = scene_of_episode(episode, other, tmp_path / "moved/episodes")
    assert isinstance(found, SceneFile)
    assert Path(found.path).parent == tmp_path / "moved"
