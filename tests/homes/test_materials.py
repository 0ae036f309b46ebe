"""Materials of homes: the same bytes everywhere, repeating, not dark; and where surfaces lie on them."""

from __future__ import annotations

import copy
import hashlib
import io
import pickle
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import InputError
from h3data.mesh.mesh import Mesh
from h3data.scene import Scene
from h3data.srgb import bytes_to_linear, linear_to_srgb
from h3data_homes import HomeSpec, build_home
from h3data_homes.materials import _STEPS, MATERIALS, Finish, texture
from h3data_homes.solids import MeshBuilder, shade, subdivided, turn_x, turn_y, vary

WOOD = Finish((186, 140, 92), "wood")
materials = pytest.mark.parametrize("name", MATERIALS)


@cache
def home(preset: Any, seed: int = 1) -> Scene:
    return build_home(HomeSpec(preset=preset, seed=seed))


# --- the images -------------------------------------------------------------------------------------------------------
def test_images_have_the_same_bytes_on_every_machine():
    digest = hashlib.sha256(b"".join(texture(name).pixels.tobytes() for name in MATERIALS)).hexdigest()
    assert digest == "87f994bf6300a47f2c19663c4ff610b8a5d7c8e0045d7eb58ad9a7ba3b688636"
    bytes_ = 255 * linear_to_srgb(np.arange(_STEPS + 1) / _STEPS)
    assert np.abs(bytes_ % 1 - 0.5).min() > 1e-4, "a texel would be rounded up on one machine and down on another"


@materials
def test_images_are_grey_opaque_and_keep_the_colours_light(name: str):
    pixels = texture(name).pixels
    assert pixels.shape[:2] == (128, 128)
    assert (pixels[..., :3] == pixels[..., :1]).all()
    assert (pixels[..., 3] == 255).all()
    light = bytes_to_linear(pixels[..., 0])
    assert light.mean() == pytest.approx(1 - MATERIALS[name].darkening, abs=0.004)
    assert light.mean() > 0.85
    assert light.std() > 0.005, "nothing to be seen"


@materials
def test_images_repeat_without_a_seam(name: str):
    """The step from the last row to the first is no larger than those within the image, where one is as large."""
    grey = texture(name).pixels[..., 0].astype(float)
    for axis in (0, 1):
        steps = np.abs(grey - np.roll(grey, 1, axis)).mean(1 - axis)
        assert steps[0] <= steps[1:].max() + 1, "a seam"


def test_all_images_together_are_small():
    cv2 = pytest.importorskip("cv2")
    sizes = [len(cv2.imencode(".png", texture(name).pixels[..., 0])[1]) for name in MATERIALS]
    assert sum(sizes) < 110_000


# --- colours that know their material ---------------------------------------------------------------------------------
def test_a_finish_is_a_colour_and_keeps_its_material():
    rng = np.random.default_rng(0)
    assert WOOD == (186, 140, 92)
    assert np.array(WOOD, np.uint8).tolist() == [186, 140, 92]
    for made in (shade(WOOD, 0.5), vary(rng, WOOD), copy.deepcopy(WOOD), pickle.loads(pickle.dumps(WOOD))):
        assert isinstance(made, Finish)
        assert made.material == "wood"
    assert not isinstance(shade((1, 2, 3), 2.0), Finish)
    assert shade(WOOD, 0.5) == shade((186, 140, 92), 0.5)
    with pytest.raises(InputError, match=r"(?s)'marble'.*wood.*H3-SCENE-026"):
        Finish((1, 2, 3), "marble")


# --- where surfaces lie on their material -----------------------------------------------------------------------------
def on_material(mesh: Mesh, material: str) -> tuple[np.ndarray, np.ndarray]:
    """Corners [F, 3, 3] of the textured triangles and their places on the material [F, 3, 2], both in metres."""
    assert mesh.uv is not None
    assert mesh.face_textures is not None
    faces = mesh.faces[mesh.face_textures >= 0]
    return mesh.vertices[faces].astype(float), mesh.uv[faces] * np.array(MATERIALS[material].size_m)


@given(
    size=st.tuples(*[st.floats(0.02, 3)] * 3),
    bevel=st.sampled_from([0.0, 0.004]),
    angle=st.floats(-3, 3),
)
def test_a_box_shows_its_material_undistorted_with_the_grain_along_its_longest_side(
    size: tuple[float, float, float], bevel: float, angle: float
):
    builder, turn = MeshBuilder(), turn_y(angle) @ turn_x(angle / 2)
    builder.box((1, 2, 3), size, WOOD, bevel=bevel, turn=turn)
    mesh = builder.mesh()
    corners, place = on_material(mesh, "wood")
    assert len(corners) == 12, "bevels show no material"
    for a, b in ((0, 1), (1, 2), (2, 0)):
        np.testing.assert_allclose(
            np.linalg.norm(place[:, a] - place[:, b], axis=1),
            np.linalg.norm(corners[:, a] - corners[:, b], axis=1),
            atol=2e-5,
        )
    longest = turn[:, int(np.argmax(size))]
    edge, step = corners[:, 1] - corners[:, 0], place[:, 1] - place[:, 0]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    sides = np.abs(across @ longest) < 0.5
    assert sides.sum() == 8
    np.testing.assert_allclose(np.abs(step[sides, 0]), np.abs(edge[sides] @ longest), atol=2e-5)


def test_parts_are_cut_from_different_places_of_their_material():
    builder = MeshBuilder()
    for _ in range(3):
        builder.box((0, 0, 0), (1, 0.02, 0.1), WOOD)
    uv = builder.mesh().uv
    assert uv is not None
    first = uv.reshape(3, 24, 2)[:, 0] % 1
    assert min(np.abs(first[a] - first[b]).max() for a, b in ((0, 1), (0, 2), (1, 2))) > 0.05


def test_a_turned_solid_has_its_material_a_whole_number_of_times_round_it():
    builder, cloth = MeshBuilder(), Finish((200, 200, 200), "weave")
    builder.lathe([(0.2, 0), (0.1, 0.3)], cloth, segments=16)
    mesh = builder.mesh()
    uv = mesh.uv
    assert uv is not None
    rings = uv.reshape(2, 17, 2)
    np.testing.assert_allclose(mesh.vertices.reshape(2, 17, 3)[:, 0], mesh.vertices.reshape(2, 17, 3)[:, -1], atol=1e-6)
    times = rings[:, -1, 0] - rings[:, 0, 0]
    assert times == pytest.approx(round(2 * np.pi * 0.2 / 0.24), abs=1e-5)
    plain = MeshBuilder()
    plain.lathe([(0.2, 0), (0.1, 0.3)], (200, 200, 200), segments=16)
    assert len(plain.mesh().vertices) == 2 * 16, "no seam without a material"


def test_quads_without_places_fit_together_and_stand_upright():
    builder, brick = MeshBuilder(), Finish((172, 104, 82), "brick")
    wall = [[(x, 0, 0), (x + 1, 0, 0), (x + 1, 2, 0), (x, 2, 0)] for x in (0.0, 1.0)]
    builder.quads(wall, brick)
    mesh = builder.mesh()
    assert mesh.uv is not None
    expected = mesh.vertices[:, :2] * (1, -1) / np.array(MATERIALS["brick"].size_m)  # rows of an image go down
    np.testing.assert_allclose(mesh.uv, expected, atol=1e-6)


def test_plain_colours_give_plain_meshes_and_mixed_ones_only_what_is_needed():
    plain, mixed = MeshBuilder(), MeshBuilder()
    plain.box((0, 0, 0), (1, 1, 1), (9, 9, 9))
    assert plain.mesh().uv is None
    assert plain.mesh().textures == ()
    mixed.box((0, 0, 0), (1, 1, 1), (9, 9, 9))
    mixed.cushion((0, 1, 0), (1, 1, 1), Finish((9, 9, 9), "weave"))
    mesh = mixed.mesh()
    assert [t.name for t in mesh.textures] == ["weave"]
    assert mesh.face_textures is not None
    assert mesh.face_textures.tolist() == [-1] * 12 + [0] * 108


def test_cut_triangles_lie_where_they_lay():
    builder = MeshBuilder()
    builder.box((0, 0, 0), (1, 0.5, 0.2), WOOD)
    builder.box((0, 1, 0), (1, 0.5, 0.2), (9, 9, 9), bevel=0.01)
    mesh = builder.mesh()
    fine = subdivided(mesh, 3)
    assert fine.textures == mesh.textures
    assert fine.uv is not None
    assert fine.face_textures is not None
    assert mesh.uv is not None
    assert mesh.face_textures is not None
    for k in range(len(mesh.faces)):
        part = slice(9 * k, 9 * k + 9)
        assert (fine.face_textures[part] == mesh.face_textures[k]).all()
        np.testing.assert_allclose(
            fine.uv[fine.faces[part]].mean((0, 1)), mesh.uv[mesh.faces[k]].mean(0), atol=1e-5, err_msg=str(k)
        )


# --- homes ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("preset", ["small", "medium"])
def test_surfaces_of_homes_are_textured_without_distortion(preset: Any):
    """Flat parts lie on their materials in true size: triangle by triangle, area on the image times its size is area.

    Round ones (cushions, pillows, cones of lampshades) are stretched a little.
    """
    scene = home(preset)
    used = set()
    for asset in scene.assets.values():
        mesh = asset.mesh
        for k, image in enumerate(mesh.textures):
            used.add(image.name)
            assert image is texture(image.name), "meshes share images"
            assert mesh.uv is not None
            assert mesh.face_textures is not None
            faces = mesh.faces[mesh.face_textures == k]
            p, q = mesh.vertices[faces].astype(float), mesh.uv[faces] * np.array(MATERIALS[image.name].size_m)
            area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
            (a, b), (c, d) = (q[:, 1] - q[:, 0]).T, (q[:, 2] - q[:, 0]).T
            shown = np.abs(a * d - b * c)
            assert shown.sum() == pytest.approx(area.sum(), rel=0.4), (asset.name, image.name)
            if asset.category in ("wall", "floor", "ceiling", "dining_table", "wardrobe", "shelf", "desk"):
                np.testing.assert_allclose(shown, area, rtol=0.01, atol=1e-5, err_msg=asset.name)
    assert {"boards", "wood", "tiles", "weave", "quilt", "rug", "plaster", "stone", "concrete"} <= used


def test_textures_add_little_to_the_file_of_a_home():
    from h3data.scene.scene_file import save_scene

    scene, buffer = home("small"), io.BytesIO()
    save_scene(scene, buffer)
    uv = sum(a.mesh.uv.nbytes for a in scene.assets.values() if a.mesh.uv is not None)
    images = {id(t): t for a in scene.assets.values() for t in a.mesh.textures}
    assert uv < 140_000
    assert len(images) <= len(MATERIALS)
    assert len(buffer.getvalue()) < 1_700_000
