"""Polygons of any shape in OBJ, PLY and Collada files become triangles of the same area; options of MTL files."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from h3data.mesh.loading import load_mesh
from h3data.mesh.mesh import Mesh
from h3data_meshes.polygons import triangulated, with_holes

U: list[tuple[float, float]] = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
SHAPES: dict[str, tuple[list[tuple[float, float]], float]] = {
    "arrow": ([(0, 0), (2, 1), (0, 2), (0.5, 1)], 1.5),
    "arrow from its notch": ([(0.5, 1), (0, 0), (2, 1), (0, 2)], 1.5),
    "hexagon": ([(1, 0), (2, 0), (3, 1), (2, 2), (1, 2), (0, 1)], 4),
    "U": (U, 7),
    "U the other way round": (U[::-1], 7),
    "door in a wall": ([(0, 0), (1, 0), (1, 2), (2, 2), (2, 0), (6, 0), (6, 3), (0, 3)], 16),
    "corners on its sides": ([(0, 0), (1, 0), (2, 0), (2, 2), (1, 1), (0, 2), (0, 1)], 3),
    "touches itself": ([(0, 0), (4, 0), (4, 4), (2, 0), (0, 4)], 8),
    "walked there and back": ([(0, 0), (2, 0), (2, 2), (3, 3), (2, 2), (0, 2)], 4),
    "a corner twice": ([(0, 0), (2, 0), (2, 0), (2, 2), (1, 1), (0, 2)], 3),
}


def area(mesh: Mesh) -> float:
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).swapaxes(0, 1)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def tilted(shape: list[tuple[float, float]]) -> np.ndarray:
    return np.array([(x, 0.6 * y, 0.8 * y) for x, y in shape])


def obj(points: np.ndarray) -> bytes:
    rows = [f"v {x} {y} {z}" for x, y, z in points]
    return "\n".join([*rows, "f " + " ".join(str(k - len(points)) for k in range(len(points))), ""]).encode()


def ply(points: np.ndarray, form: str) -> bytes:
    header = (
        f"ply\nformat {form} 1.0\ncomment one polygon and a triangle\nelement vertex {len(points)}\nproperty float x\n"
        "property float y\nproperty float z\nelement face 2\nproperty uchar red\nproperty uchar green\n"
        "property uchar blue\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    faces = [list(range(len(points))), [0, 1, 1]]
    if form == "ascii":
        rows = [" ".join(map(str, p)) for p in points.tolist()]
        rows += [" ".join(map(str, (9, 8, 7, len(f), *f))) for f in faces]
        return header + "\n".join([*rows, ""]).encode()
    order = ">" if "big" in form else "<"
    body = points.astype(f"{order}f4").tobytes()
    return header + body + b"".join(struct.pack(f"{order}4B{len(f)}i", 9, 8, 7, len(f), *f) for f in faces)


def dae(points: np.ndarray) -> bytes:
    from tests.mesh.test_collada import SHOWN, document

    polygon = (
        f"<polylist>VERTEX<vcount>{len(points)}</vcount><p>{' '.join(map(str, range(len(points))))}</p></polylist>"
    )
    return document(f"<node>{SHOWN}</node>", points=points, primitive=polygon).encode()


@pytest.mark.parametrize("shape", SHAPES)
def test_the_area_is_the_polygons(tmp_path: Path, shape: str) -> None:
    points, expected = SHAPES[shape]
    files = {
        "a.obj": obj(tilted(points)),
        "b.ply": ply(tilted(points), "ascii"),
        "c.ply": ply(tilted(points), "binary_little_endian"),
        "d.ply": ply(tilted(points), "binary_big_endian"),
        "e.dae": dae(tilted(points)),
    }
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
        mesh = load_mesh(tmp_path / name)
        assert area(mesh) == pytest.approx(expected, rel=1e-5), name
        if name.endswith("ply"):
            assert (mesh.colors == (9, 8, 7)).all(), "the triangles keep their polygon's colour"


def test_random_stars_keep_area_winding_and_corners() -> None:
    rng = np.random.default_rng(0)
    polygons, areas = [], []
    for _ in range(200):
        size = int(rng.integers(3, 30))
        angle = (np.arange(size) + rng.uniform(0, 0.9, size)) * 2 * np.pi / size
        ring = rng.uniform(0.2, 1, size)[:, None] * np.stack([np.cos(angle), np.sin(angle), 0.3 * np.cos(angle)], 1)
        polygons.append(ring)
        areas.append(np.cross(ring, np.roll(ring, -1, 0)).sum(0) / 2)
    points = np.concatenate(polygons)
    triangles, owner = triangulated(points, np.array([len(p) for p in polygons]))
    a, b, c = points[triangles].swapaxes(0, 1)
    found = np.zeros((200, 3))
    np.add.at(found, owner, np.cross(b - a, c - a) / 2)
    np.testing.assert_allclose(found, areas, atol=1e-12)
    lengths = np.zeros(200)
    np.add.at(lengths, owner, np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
    np.testing.assert_allclose(lengths, np.linalg.norm(areas, axis=1), atol=1e-12)
    assert (np.bincount(owner) == [len(p) - 2 for p in polygons]).all()


@pytest.mark.parametrize("turned", [False, True])
def test_holes_side_by_side_at_one_height(turned: bool) -> None:
    wall = np.array([(0, 0, 0), (9, 0, 0), (9, 3, 0), (0, 3, 0)], float)
    holes = [np.array([(x, 1, 0), (x + 1, 1, 0), (x + 1, 2, 0), (x, 2, 0)], float) for x in (1, 3, 5, 7)]
    if turned:
        wall, holes = wall[::-1], [hole[::-1] if k % 2 else hole for k, hole in enumerate(holes)]
    points = np.concatenate([wall, *holes])
    walk = with_holes(wall, holes)
    triangles, _ = triangulated(points[walk], np.array([len(walk)]))
    a, b, c = points[walk[triangles]].swapaxes(0, 1)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(27 - 4)


@pytest.mark.parametrize("points", [[(0, 0)] * 5, [(0, 0), (1, 1), (2, 2), (3, 3)], [(0, 0), (2, 2), (2, 0), (0, 2)]])
def test_degenerate_and_crossed_polygons_survive(tmp_path: Path, points: list[tuple[float, float]]) -> None:
    (tmp_path / "a.obj").write_bytes(obj(tilted(points)))
    assert len(load_mesh(tmp_path / "a.obj").faces) == len(points) - 2


@pytest.mark.parametrize("corner", ["9", "-9", "x"])
def test_a_polygon_of_wrong_corners_is_one_error(tmp_path: Path, corner: str) -> None:
    from h3data.errors import SceneError

    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 {corner}\n")
    with pytest.raises(SceneError, match=r"(?s)a\.obj.*H3-MESH-021"):
        load_mesh(tmp_path / "a.obj")


OPTIONS = {
    "x.png": ((1, 1), (0, 0)),
    "-s 2 3 1 -clamp off x.png": ((2, 3), (0, 0)),
    "-o 0.5 -s 2 x.png": ((2, 1), (0.5, 0)),
    "-blendu on -blendv off -cc on -boost 2 -mm 0 1 -o 0.25 0.5 0 -s 1 1 1 -t 0 0 0 x.png": ((1, 1), (0.25, 0.5)),
    "-texres 512 -bm 1.5 -imfchan l -type sphere x.png": ((1, 1), (0, 0)),
    "-s 2 2 2 tex/my red wood.png": ((2, 2), (0, 0)),
    "-s 2 2 2 tex\\my red wood.png": ((2, 2), (0, 0)),
    '"x.png"': ((1, 1), (0, 0)),
    "-s 2 2 7": ((2, 2), (0, 0)),
}


@pytest.mark.parametrize("options", OPTIONS)
def test_images_with_options_are_found_and_repeated(tmp_path: Path, options: str) -> None:
    scale, offset = OPTIONS[options]
    (tmp_path / "tex").mkdir()
    for name in ("x.png", "tex/my red wood.png", "7"):
        Image.new("RGB", (2, 2), (10, 20, 30)).save(tmp_path / name, format="PNG")
    (tmp_path / "a.mtl").write_text(f"newmtl a\nKd 1 1 1\nmap_Kd {options}\n")
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3 4/4\n"
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + square)
    mesh = load_mesh(tmp_path / "a.obj")
    assert [tuple(t.pixels[0, 0, :3]) for t in mesh.textures] == [(10, 20, 30)]
    assert mesh.uv is not None
    expected = mesh.vertices[:, :2] * scale + offset
    np.testing.assert_allclose(mesh.uv, np.column_stack([expected[:, 0], 1 - expected[:, 1]]), atol=1e-6)
