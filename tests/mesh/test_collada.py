"""Collada files: unit x up_axis x scene graph x vertices, against a reader built on pycollada; packages of others."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from h3data.errors import SceneError
from h3data.mesh.loading import load_mesh

UP = {
    "X_UP": np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "Y_UP": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "Z_UP": np.eye(3),
}
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], float)
FACES = "0 2 1 0 1 3 0 3 2 1 2 3"


def document(
    scene: str,
    *,
    unit: str = '<unit meter="1"/>',
    axis: str = "Z_UP",
    points: np.ndarray = POINTS,
    primitive: str = "",
    libraries: str = "",
    sources: str = "",
) -> str:
    values = " ".join(f"{v:g}" for v in points.ravel())
    vertex = '<input semantic="VERTEX" source="#v" offset="0"/>'
    primitive = primitive.replace("VERTEX", vertex) or f'<triangles count="4">{vertex}<p>{FACES}</p></triangles>'
    return (
        '<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
        f"<asset>{unit}<up_axis>{axis}</up_axis></asset>{libraries}"
        f'<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="{points.size}">{values}'
        f'</float_array><technique_common><accessor source="#a" count="{len(points)}" stride="3">'
        '<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor>'
        f'</technique_common></source>{sources}<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
        f"{primitive}</mesh></geometry></library_geometries>"
        f'<library_visual_scenes><visual_scene id="other"><node><translate>9 9 9</translate>{SHOWN}</node>'
        f'</visual_scene><visual_scene id="s">{scene}</visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


SHOWN = '<instance_geometry url="#g"/>'
UNITS = ('<unit meter="1"/>', '<unit meter="0.01"/>', '<unit name="inch" meter="0.0254"/>', '<unit meter="0.001"/>', "")
NESTINGS = {
    "flat": "{0}",
    "moved": "<translate>1 2 3</translate><rotate>0 0 1 30</rotate>{0}",
    "matrix": "<matrix>0 -2 0 1 1 0 0 2 0 0 0.5 3 0 0 0 1</matrix>{0}",
    "deep": "<rotate>1 0 0 90</rotate><node><scale>2 1 3</scale><translate>0 1 0</translate>"
    "<node><rotate>0 0.6 0.8 45</rotate>{0}</node></node>",
}
MIRRORS = {"plain": "{0}", "mirrored": "<scale>-1 1 1</scale>{0}"}
HOLDERS = ("direct", "library")
VARIANTS = list(itertools.product(UNITS, UP, NESTINGS, MIRRORS, HOLDERS))


def variant(unit: str, axis: str, nesting: str, mirror: str, holder: str) -> str:
    library = '<library_nodes><node id="n"><translate>0 0 1</translate>' + SHOWN + "</node></library_nodes>"
    inner = SHOWN if holder == "direct" else '<instance_node url="#n"/>'
    inner = f"<node>{MIRRORS[mirror].format(inner)}</node>"
    scene = f"<node>{NESTINGS[nesting].format(inner)}</node>"
    return document(scene, unit=unit, axis=axis, libraries=library if holder == "library" else "")


def pycollada_bounds(path: Path) -> np.ndarray | None:
    """Bounds [2, 3] of a file from pycollada's scene graph, None if pycollada finds nothing in it."""
    collada = pytest.importorskip("collada", reason="needs pycollada")
    file = collada.Collada(str(path), ignore=[collada.common.DaeError])
    linear = UP[file.assetInfo.upaxis] * (file.assetInfo.unitmeter or 1.0)
    points = []

    def walk(node: object, matrix: np.ndarray) -> None:
        for primitive in getattr(getattr(node, "geometry", None), "primitives", ()):
            if isinstance(primitive, collada.polylist.Polylist):
                primitive = primitive.triangleset()
            if isinstance(primitive, collada.triangleset.TriangleSet) and len(primitive.vertex_index):
                points.append(primitive.vertex[primitive.vertex_index.ravel()] @ matrix[:3, :3].T + matrix[:3, 3])
        for child in getattr(node, "children", ()):
            walk(child, matrix @ np.asarray(getattr(node, "matrix", np.eye(4)), np.float64))

    for node in file.scene.nodes:
        walk(node, np.eye(4))
    if not points:
        return None
    placed = np.concatenate(points) @ linear.T
    return np.stack([placed.min(0), placed.max(0)])


def volume(path: Path) -> float:
    """Signed volume, positive if the triangles look outwards."""
    mesh = load_mesh(path)
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.slow) for part in range(1, 7))])
def test_240_variants_have_the_bounds_of_an_independent_reader(tmp_path: Path, part: int) -> None:
    assert len(VARIANTS) == 240
    some = VARIANTS[part::7]  # 7 divides no number of choices, so each part has all of them
    assert {v[1] for v in some} == set(UP)
    for number, chosen in enumerate(some):
        path = tmp_path / f"{number}.dae"
        path.write_text(variant(*chosen))
        expected = pycollada_bounds(path)
        assert expected is not None
        size = np.abs(expected).max()
        np.testing.assert_allclose(load_mesh(path).bounds, expected, atol=2e-6 * size, err_msg=str(chosen))
        assert volume(path) > 0, f"{chosen}: inside out"


@pytest.mark.parametrize(
    ("scene", "low", "high"),
    [
        (f"<node><lookat>1 0 0  5 0 0  0 0 1</lookat>{SHOWN}</node>", (-2, -1, 0), (1, 0, 2)),
        (f"<node><skew>45 1 0 0 0 1 0</skew>{SHOWN}</node>", (0, 0, 0), (1, 2, 3)),
        (f"<node><skew>45 0 1 0 1 0 0</skew>{SHOWN}</node>", (0, 0, 0), (2, 2, 3)),
        (f'<node><translate>0 0 5</translate></node><node id="g">{SHOWN}</node>', (0, 0, 0), (1, 2, 3)),
        (
            f"<node><translate>1 0 0</translate><rotate>0 0 1 90</rotate><scale>2 1 1</scale>{SHOWN}</node>",
            (-1, 0, 0),
            (1, 2, 3),
        ),
    ],
)
def test_transforms_in_their_order(tmp_path: Path, scene: str, low: tuple[float, ...], high: tuple[float, ...]) -> None:
    path = tmp_path / "a.dae"
    path.write_text(document(scene))
    np.testing.assert_allclose(load_mesh(path).bounds, [low, high], atol=1e-6)


def test_what_the_scene_does_not_show_is_not_there(tmp_path: Path) -> None:
    path = tmp_path / "a.dae"
    path.write_text(document("<node/>"))
    with pytest.raises(SceneError, match="H3-MESH-024"):
        load_mesh(path)


def test_nodes_inside_themselves_and_without_end_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.dae"
    loop = '<library_nodes><node id="n"><instance_node url="#n"/></node></library_nodes>'
    path.write_text(document('<node><instance_node url="#n"/></node>', libraries=loop))
    with pytest.raises(SceneError, match=r"(?s)inside itself.*H3-MESH-021"):
        load_mesh(path)
    path = tmp_path / "b.dae"
    path.write_text(document(f"<node>{SHOWN}</node>").replace("?>", "?><!DOCTYPE a [<!ENTITY b 'c'>]>", 1))
    with pytest.raises(SceneError, match=r"(?s)DOCTYPE.*H3-MESH-021"):
        load_mesh(path)


@pytest.mark.parametrize("fault", ["9", "-1", "x"])
def test_wrong_indices_are_one_error(tmp_path: Path, fault: str) -> None:
    path = tmp_path / "a.dae"
    path.write_text(document(f"<node>{SHOWN}</node>").replace(FACES, f"0 1 {fault}"))
    with pytest.raises(SceneError, match=r"(?s)geometry 'g', <triangles>.*H3-MESH-021"):
        load_mesh(path)


@pytest.mark.parametrize(
    ("primitive", "count"),
    [
        ("<tristrips>VERTEX<p>0 1 2 3</p></tristrips>", 2),
        ("<trifans>VERTEX<p>0 1 2 3</p></trifans>", 2),
        ("<polygons>VERTEX<p>0 1 2</p><p>0 1 3</p></polygons>", 2),
        ("<lines>VERTEX<p>0 1</p></lines><triangles>VERTEX<p>0 1 2</p></triangles>", 1),
    ],
)
def test_primitives(tmp_path: Path, primitive: str, count: int) -> None:
    path = tmp_path / "a.dae"
    path.write_text(document(f"<node>{SHOWN}</node>", primitive=primitive))
    assert len(load_mesh(path).faces) == count


def test_a_wall_with_holes_keeps_them_open(tmp_path: Path) -> None:
    wall = [(0, 0, 0), (6, 0, 0), (6, 0, 3), (0, 0, 3)]
    door, window = [(1, 0, 0.5), (2, 0, 0.5), (2, 0, 2), (1, 0, 2)], [(4, 0, 1), (4, 0, 2), (5, 0, 2), (5, 0, 1)]
    path = tmp_path / "a.dae"
    holed = "<polygons>VERTEX<ph><p>0 1 2 3</p><h>4 5 6 7</h><h>8 9 10 11</h></ph></polygons>"
    path.write_text(document(f"<node>{SHOWN}</node>", points=np.array([*wall, *door, *window], float), primitive=holed))
    mesh = load_mesh(path)
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).swapaxes(0, 1)
    areas = np.cross(b - a, c - a)[:, 1] / -2
    assert areas.sum() == pytest.approx(18 - 1.5 - 1)
    assert (areas >= 0).all()


def test_colours_textures_and_bound_materials(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2), (10, 20, 30)).save(tmp_path / "my wood.png")
    libraries = (
        '<library_images><image id="i"><init_from>my%20wood.png</init_from></image></library_images><library_effects>'
        '<effect id="e"><profile_COMMON><newparam sid="u"><surface type="2D"><init_from>i</init_from></surface></newparam>'
        '<newparam sid="w"><sampler2D><source>u</source></sampler2D></newparam><technique><phong><diffuse>'
        '<texture texture="w" texcoord="UV"/></diffuse></phong></technique></profile_COMMON></effect>'
        '<effect id="f"><profile_COMMON><technique><lambert><diffuse><color>1 0.5 0 1</color></diffuse></lambert>'
        "</technique></profile_COMMON></effect></library_effects><library_materials>"
        '<material id="m"><instance_effect url="#e"/></material><material id="k"><instance_effect url="#f"/></material>'
        "</library_materials>"
    )
    sources = (
        '<source id="t"><float_array>0 0 1 0 0 1</float_array><technique_common><accessor count="3" stride="2">'
        '<param name="S"/><param name="T"/></accessor></technique_common></source>'
    )
    coordinates = '<input semantic="TEXCOORD" source="#t" offset="1"/>'
    primitive = f'<triangles material="y">VERTEX{coordinates}<p>0 0 1 1 2 2</p></triangles>'
    found = {}
    for target in ("m", "k"):
        bound = (
            f'<bind_material><technique_common><instance_material symbol="y" target="#{target}"/></technique_common>'
        )
        scene = f'<node><instance_geometry url="#g">{bound}</bind_material></instance_geometry></node>'
        path = tmp_path / f"{target}.dae"
        path.write_text(document(scene, libraries=libraries, sources=sources, primitive=primitive))
        found[target] = load_mesh(path)
    assert (found["m"].textures[0].pixels[0, 0, :3] == (10, 20, 30)).all()
    np.testing.assert_allclose(found["m"].uv, [[0, 1], [1, 1], [0, 0]])
    assert not found["k"].textures
    assert (found["k"].colors == (255, 128, 0)).all()


@pytest.mark.slow
def test_collada_files_of_robot_packages() -> None:
    """Every .dae below ``H3DATA_COLLADA_FILES``, a folder with packages unpacked there (docs/robots.md says which)."""
    folder = os.environ.get("H3DATA_COLLADA_FILES")
    if not folder:
        pytest.skip("set H3DATA_COLLADA_FILES to a folder with .dae files")
    wrong, count = [], 0
    for path in sorted(p for p in Path(folder).rglob("*") if p.suffix.lower() == ".dae"):
        expected = pycollada_bounds(path)
        if expected is None:  # pycollada does not read what this file has
            assert len(load_mesh(path).faces)
            continue
        count += 1
        if not np.allclose(load_mesh(path).bounds, expected, atol=1e-5 * max(1.0, np.abs(expected).max())):
            wrong.append(path)
    print(f"{count} files, {len(wrong)} with other bounds than pycollada's scene graph")
    assert count, f"no .dae files below {folder}"
    assert not wrong
