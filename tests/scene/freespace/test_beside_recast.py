"""FreeSpace from real Habitat meshes against navmeshes of the real habitat-sim (Recast): islands, distances, geodesics.

Recast erodes by whole cells of 5 cm and simplifies contours, so it closes passages that are up to a few centimetres wider
than the agent, and its borders lie a little inside ours. Hence two comparisons: with the same radius no path of ours may be
longer, and with 2 cm more (half of Recast's rounding) the lengths must be the same within a few per cent both ways.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from h3data.mesh.mesh import Mesh
from h3data.scene import FreeSpace
from h3data.scene.records import Asset, Instance, Scene
from h3data_habitat.navmesh.file import read_navmesh

IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
CHAIR_ORIGIN = np.array([0.0740, 0.2070, -0.0059])
"""Of the mesh of chair.glb in its centre-of-mass frame, which the reference gives (reference/README.md)."""


def read_mesh(path: Path, *, z_up: bool = False) -> Mesh:
    import trimesh

    mesh = trimesh.load(path).to_geometry()
    v = np.asarray(mesh.vertices, np.float32)
    if z_up:
        v = np.stack([v[:, 0], v[:, 2], -v[:, 1]], -1)
    return Mesh(vertices=v, faces=np.asarray(mesh.faces, np.int32), colors=np.zeros(v.shape, np.uint8))


def mesh_scene(*items: tuple[Mesh, np.ndarray]) -> Scene:
    assets = {f"a{k}": Asset(name=f"a{k}", mesh=mesh) for k, (mesh, _) in enumerate(items)}
    return Scene(
        name="real",
        assets=assets,
        instances=tuple(Instance(name=f"i{k}", asset=f"a{k}", pose=pose) for k, (_, pose) in enumerate(items)),
    )


@pytest.fixture(scope="module", params=["simple_room_default", "simple_room_6chairs"])
def room(request: pytest.FixtureRequest, real: Path) -> tuple[Scene, dict[str, Any]]:
    reference = json.loads((real / "habitat-sim/reference/navmesh" / request.param / "reference.json").read_text())
    data = real / "habitat-sim/data/test_assets"
    chair = read_mesh(data / "objects/chair.glb")
    items = [(read_mesh(data / "scenes/simple_room.glb", z_up=True), IDENTITY)]
    for thing in reference.get("static_objects", []):
        assert thing["rotation_wxyz"] == [1, 0, 0, 0]
        items.append((chair, np.concatenate([np.array(thing["translation"]) + CHAIR_ORIGIN, IDENTITY[3:]])))
    return mesh_scene(*items), reference | {"name": request.param}


def free_space(scene: Scene, settings: dict[str, Any], extra_m: float, *, floor_y: float | None = None) -> FreeSpace:
    return FreeSpace.from_scene(
        scene,
        radius_m=settings["agent_radius"] + extra_m,
        height_m=settings["agent_height"],
        max_climb_m=settings["agent_max_climb"],
        floor_y=floor_y,
        cache=False,
    )


def floor(points: list[list[float]]) -> np.ndarray:
    return np.array(points)[:, [0, 2]]


def test_simple_room_geodesics(room):
    scene, reference = room
    pairs = [p for p in reference["geodesic"] if p["island"] == [0, 0] and p["euclid"] > 0.5]
    assert len(pairs) > 150
    a, b = floor([p["start"] for p in pairs]), floor([p["end"] for p in pairs])
    theirs = np.array([p["geodesic"] for p in pairs])
    same = free_space(scene, reference["settings"], 0.0).geodesic(a, b) / theirs
    assert np.median(np.abs(same - 1)) < 0.001
    assert same.max() < 1.005
    wider = free_space(scene, reference["settings"], 0.02).geodesic(a, b) / theirs
    assert np.median(wider) == pytest.approx(1, abs=0.002)
    assert np.percentile(wider, 5) > 0.95
    assert np.percentile(wider, 95) < 1.01


def test_simple_room_floor_and_islands(room):
    scene, reference = room
    space = free_space(scene, reference["settings"], 0.0)
    assert space.floor_y == pytest.approx(0.1458, abs=1e-3)  # Recast says 0.339: its voxels are 20 cm high
    assert reference["island_areas"][0] == pytest.approx(space.island_areas[0], rel=0.04)
    # snapped navigable points of the reference that lie on the floor are navigable for us
    lowest = reference["geodesic"][0]["start"][1]
    on_floor = [
        p["snapped"] for p in reference["snap_point"] if p["navigable"] and abs(p["snapped"][1] - lowest) < 0.05
    ]
    if on_floor:
        gap = np.linalg.norm(space.snap(floor(on_floor)) - floor(on_floor), axis=1)
        assert gap.max() < 0.01


def test_simple_room_distance_to_obstacles(room):
    scene, reference = room
    space = free_space(scene, reference["settings"], 0.0)
    queries = reference["closest_obstacle"]
    points = floor([q["point"] for q in queries])
    theirs = np.array([q["distance"] for q in queries])  # to the eroded border
    open_floor = (space.island(points) == 0) & (theirs < 4.9)
    assert open_floor.sum() > 100
    more = space.clearance(points[open_floor]) - theirs[open_floor]
    assert more.min() > -0.04  # contours simplified by up to 1.3 cells
    assert more.max() < 0.10  # eroded by up to one cell more, plus half of our voxels at the border of the floor


def test_every_island_of_the_real_navmesh_lies_on_one_of_our_floors(room, real):
    """Floor by floor (the tops of two blocks are floors of their own): as many islands, a cell of erosion larger."""
    scene, reference = room
    folder = real / "habitat-sim/reference/navmesh" / reference["name"]
    navmesh = read_navmesh(folder / f"{reference['name']}.navmesh")
    theirs = [
        shapely.union_all(shapely.polygons(navmesh.triangles(island=k)[..., [0, 2]]))
        for k in range(len(navmesh.island_areas))
    ]
    heights = [float(navmesh.triangles(island=k)[..., 1].mean()) for k in range(len(theirs))]
    settings, found = reference["settings"], 0
    for height in np.unique(np.round(heights, 2)):
        space = free_space(scene, settings, 0.0, floor_y=float(height))
        assert space.floor_y == pytest.approx(height, abs=0.2)  # Recast's voxels are 20 cm high
        same_floor = [outline for outline, y in zip(theirs, heights, strict=True) if abs(y - height) < 0.1]
        assert len(space.polygon.geoms) == len(same_floor)
        for ours, outline in zip(space.polygon.geoms, same_floor, strict=True):  # both largest first
            assert ours.buffer(0.066).covers(outline)  # its contours are simplified by up to 1.3 cells of 5 cm
            assert outline.buffer(0.115, join_style="mitre").covers(ours)  # and it erodes by up to a cell more
            found += 1
    assert found == reference["num_islands"]


def test_reachable_or_not_and_snapped_points_agree_with_the_real_navmesh(room):
    scene, reference = room
    space = free_space(scene, reference["settings"], 0.0)
    level = reference["geodesic"][0]["start"][1]
    on_floor = [p for p in reference["geodesic"] if abs(p["start"][1] - level) + abs(p["end"][1] - level) < 0.1]
    a, b = floor([p["start"] for p in on_floor]), floor([p["end"] for p in on_floor])
    np.testing.assert_array_equal(np.isfinite(space.geodesic(a, b, max_snap_m=0.05)), [p["found"] for p in on_floor])
    assert sum(p["found"] for p in on_floor) > 150
    assert sum(not p["found"] for p in on_floor) > 5
    snaps = [s for s in reference["snap_point"] if abs(s["snapped"][1] - level) < 0.1]
    points, theirs = floor([s["point"] for s in snaps]), floor([s["snapped"] for s in snaps])
    ours = space.snap(points)
    way = np.linalg.norm(theirs - points, axis=1) - np.linalg.norm(ours - points, axis=1)
    assert way.min() > -0.02  # their border lies inside of ours
    assert np.percentile(way, 95) < 0.12
    inside = np.linalg.norm(theirs - points, axis=1) < 1e-3
    assert inside.sum() > 100
    np.testing.assert_allclose(ours[inside], points[inside], atol=1e-9)


def test_flat_with_doors_against_the_social_navigation_runs(real):
    """1,500 distances between robot and human, by the real PathFinder, in a flat of five rooms."""
    folder = real / "habitat-lab/reference"
    layout = json.loads((folder / "navmesh/flat.json").read_text())
    scene = mesh_scene((read_mesh(folder / "navmesh/flat.glb"), IDENTITY))
    starts, ends, lengths = [], [], []
    for path in sorted((folder / "socialnav").glob("*_T*.npz")):
        with np.load(path) as run:
            starts.append(run["in_robot_base_pos"][::7, [0, 2]])
            ends.append(run["in_human_base_pos"][::7, [0, 2]])
            lengths.append(run["geodesic"][::7])
    a, b, theirs = np.concatenate(starts), np.concatenate(ends), np.concatenate(lengths)
    assert len(theirs) > 1000
    far = np.isfinite(theirs) & (theirs > 0.5)
    same = free_space(scene, layout["settings"], 0.0)
    assert len(same.polygon.geoms) == layout["num_islands"]
    assert same.floor_y == pytest.approx(0.0, abs=1e-6)
    assert layout["navigable_area"] == pytest.approx(same.polygon.area, rel=0.03)
    ratio = same.geodesic(a, b)[far] / theirs[far]
    assert np.median(ratio) == pytest.approx(1, abs=0.001)
    assert ratio.max() < 1.01  # never a detour; shorter where Recast has closed a door cut by a wall (0.536 m left)
    wider = free_space(scene, layout["settings"], 0.025)
    ratio = wider.geodesic(a, b)[far] / theirs[far]
    assert np.percentile(ratio, 5) > 0.99
    assert np.percentile(ratio, 95) < 1.01
    fast = wider.geodesic_lattice(a, b)[far] / theirs[far]
    assert np.percentile(fast, 95) < 1.03
