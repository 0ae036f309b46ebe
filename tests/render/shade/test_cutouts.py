"""Cut-outs: what is clear in a texture is a hole in every output, by every back end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from h3data.mesh.mesh import Mesh, Texture
from h3data.render import Camera, Light, Renderer, RenderInstance, RenderScene, look_at, pinhole
from h3data.render.shade.cutouts import cut_out_faces, pack_opacity
from h3data_rays import RayCaster
from h3data_rays.rays import solid_points
from tests.random_cases import examples
from tests.render.raster.test_raster import random_view, soup

OUTPUTS = ("depth", "instance", "triangle", "rgb")
HERE = np.eye(4)


def spotted(seed: int, height: int = 9, width: int = 13) -> Texture:
    """Texels of any colour; a third are clear, a third solid, a third between."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (height, width, 4)).astype(np.uint8)
    pixels[..., 3] = np.clip(rng.integers(-128, 383, (height, width)), 0, 255)
    return Texture(pixels=pixels)


def half_clear(opacity: int = 255) -> Texture:
    """The left half is clear."""
    pixels = np.full((8, 8, 4), 200, np.uint8)
    pixels[..., 3] = opacity
    pixels[:, :4, 3] = 0
    return Texture(pixels=pixels)


def quad(texture: Texture | None, z: float = 0.0, size: float = 1.0) -> Mesh:
    """A square that faces +z, its texture upright."""
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size + [0, 0, z]
    return Mesh(
        vertices=points.astype(np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        colors=np.full((4, 3), 255, np.uint8),
        uv=np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32),
        textures=() if texture is None else (texture,),
    )


def scene_of(*meshes: Mesh, deformable: tuple[int, ...] = ()) -> RenderScene:
    return RenderScene(meshes, [RenderInstance(k, HERE) for k in range(len(meshes))], deformable=deformable)


FRONT = pinhole(80, 60, hfov_deg=50, pose=look_at([0, 0, 3], [0, 0, 0]))


# --- the reference ----------------------------------------------------------------------------------------------------
def opacity_at(texture: Texture, uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bilinear opacity 0..255 of a repeated texture at coordinates [..., 2]."""
    alpha = texture.pixels[..., 3].astype(float)
    height, width = alpha.shape
    x, y = uv[..., 0] * width - 0.5, uv[..., 1] * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    total = np.zeros(x.shape)
    for dy in (0, 1):
        for dx in (0, 1):
            weight = np.abs(1 - dx - (x - x0)) * np.abs(1 - dy - (y - y0))
            total += weight * alpha[(y0 + dy) % height, (x0 + dx) % width]
    return total


def cast(mesh: Mesh, camera: Camera) -> tuple[NDArray, NDArray, NDArray]:
    """Nearest depth, its triangle and "this is clear" of every pixel [N], by testing every triangle in float64."""
    corners = (mesh.vertices[mesh.faces].astype(float) - camera.pose[:3, 3]) @ camera.pose[:3, :3]
    start, ray = (r.reshape(-1, 3) for r in camera.rays())
    a, to_b, to_c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    with np.errstate(all="ignore"):  # Moeller & Trumbore 1997
        p = np.cross(ray[:, None], to_c)
        scale = 1 / np.einsum("tk,ntk->nt", to_b, p)
        from_a = start[:, None] - a
        b1 = np.einsum("ntk,ntk->nt", from_a, p) * scale
        q = np.cross(from_a, to_b)
        b2 = np.einsum("nk,ntk->nt", ray, q) * scale
        depth = np.einsum("tk,ntk->nt", to_c, q) * scale
        lowest = np.minimum(np.minimum(b1, b2), 1 - b1 - b2)
        assert mesh.uv is not None
        assert mesh.face_textures is not None
        uv = mesh.uv[mesh.faces].astype(float)
        at = uv[:, 0] + b1[..., None] * (uv[:, 1] - uv[:, 0]) + b2[..., None] * (uv[:, 2] - uv[:, 0])
        opacity = np.where(mesh.face_textures >= 0, opacity_at(mesh.textures[0], np.nan_to_num(at)), 255.0)
    ahead = np.isfinite(depth) & (depth > max(camera.near, 1e-4)) & (depth < camera.far)
    near = np.where(ahead & (lowest >= 0) & (opacity >= 127.5), depth, np.inf)
    nearest = near.min(1)
    unsure = ahead & (lowest > -0.02) & ((np.abs(lowest) < 0.02) | (np.abs(opacity - 127.5) < 4))
    unsure |= (lowest > -0.02) & (np.abs(depth - camera.near) < 1e-3)
    unsure |= (lowest > -0.02) & (np.abs(depth - camera.far) < 1e-2)
    unsure &= depth < nearest[:, None] + 1e-3
    twice = (near < nearest[:, None] + 1e-3).sum(1) > 1
    return np.where(np.isfinite(nearest), nearest, 0), near.argmin(1), ~unsure.any(1) & ~twice


def random_mesh(rng: np.random.Generator) -> Mesh:
    """Nasty triangles, two in three with holes."""
    corners = soup(rng)
    count = len(corners)
    return Mesh(
        vertices=corners.reshape(-1, 3).astype(np.float32),
        faces=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        colors=np.full((3 * count, 3), 255, np.uint8),
        uv=rng.uniform(-3, 3, (3 * count, 2)).astype(np.float32),
        textures=(spotted(int(rng.integers(100))),),
        face_textures=rng.choice([-1, 0, 0], count).astype(np.int16),
    )


@pytest.mark.parametrize("backend", ["cpu", pytest.param("rays", marks=pytest.mark.slow)])
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_random_soups_equal_the_reference(projection, backend):
    if backend == "rays":
        pytest.importorskip("embreex", reason="the extra 'rays' is not installed")
    rng = np.random.default_rng(5)
    checked = total = through = odd = 0
    for _ in range(examples(12)):
        mesh, camera = random_mesh(rng), random_view(rng, projection)
        got = Renderer(scene_of(mesh), backend=backend).render(camera, outputs=("depth", "triangle"))
        depth, triangle, clear = cast(mesh, camera)
        error = np.abs(got["depth"].ravel() - depth)[clear] > 1e-4 * np.maximum(1, depth[clear])
        wrong = (got["triangle"].ravel() != np.where(depth > 0, triangle, -1))[clear]
        if backend == "cpu":
            assert not error.any()
            assert not wrong.any()
        # of two cut-outs in one plane rays see one only
        odd += (error | wrong).sum()
        whole = Renderer(scene_of(replace(mesh, textures=(), face_textures=None))).render(camera, outputs=("depth",))
        through += (np.abs(whole["depth"].ravel() - depth)[clear] > 1e-2).sum()
        checked, total = checked + clear.sum(), total + clear.size
    assert checked > 0.6 * total
    assert through > 0.05 * total
    assert odd < 0.01 * checked


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.floats(0.02, 1.5))
def test_whole_triangles_have_no_hole_anywhere(seed, reach):
    rng = np.random.default_rng(seed)
    pixels = np.full((16, 12, 4), 255, np.uint8)
    pixels[rng.integers(16), rng.integers(12), 3] = 0
    uv = rng.uniform(-2, 2, (30, 1, 2)) + rng.uniform(-reach, reach, (30, 3, 2))
    cut = cut_out_faces(uv, pixels)
    weights = rng.dirichlet(np.ones(3), 400)
    weights[:3] = np.eye(3)
    points = (weights @ uv).reshape(-1, 2)
    solid = solid_points(*pack_opacity([Texture(pixels=pixels)]), np.zeros(len(points), np.int32), points).reshape(
        30, -1
    )
    assert solid[~cut].all()
    np.testing.assert_array_equal(solid.ravel(), opacity_at(Texture(pixels=pixels), points) >= 127.5)


# --- what it means -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("samples", [1, 4])
def test_holes_show_what_is_behind(samples):
    behind = quad(None, z=-2, size=4)
    renderer = Renderer(scene_of(quad(half_clear()), behind))
    got = renderer.render(FRONT, outputs=OUTPUTS, samples=samples)
    alone = Renderer(scene_of(behind)).render(FRONT, outputs=OUTPUTS, samples=samples)
    left, right = (30, 28), (30, 52)
    assert [got["instance"][left], got["instance"][right]] == [1, 0]
    assert got["depth"][left] == alone["depth"][left]
    assert got["depth"][right] == pytest.approx(3, abs=1e-5)
    assert (got["instance"] == 0).sum() == pytest.approx(0.5 * (2 / 3 * FRONT.fx) ** 2, rel=0.05)
    np.testing.assert_array_equal(got["rgb"][:, :10], alone["rgb"][:, :10])


@pytest.mark.parametrize(("texture", "whole"), [(half_clear(127), True), (half_clear(128), False)])
def test_a_tinted_pane_is_drawn_whole(texture, whole):
    got = Renderer(scene_of(quad(texture), quad(None, z=-2, size=4))).render(FRONT, outputs=OUTPUTS)
    assert got["instance"][30, 28] == (0 if whole else 1)


def test_holes_move_and_bend_with_their_mesh():
    scene = scene_of(quad(half_clear()), quad(None, z=-2, size=4), deformable=(0,))
    renderer = Renderer(scene, worlds=2)
    renderer.set_vertices(0, scene.meshes[0].vertices * [-1, 1, 1], world=1)
    first, second = (renderer.render(FRONT, outputs=OUTPUTS, world=w) for w in (0, 1))
    np.testing.assert_array_equal(first["instance"], second["instance"][:, ::-1])
    assert (first["instance"][30, 28], second["instance"][30, 28]) == (1, 0)
    renderer.set_transforms([0], [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])
    np.testing.assert_array_equal(renderer.render(FRONT, outputs=OUTPUTS)["instance"], second["instance"])


def test_pictures_repeat_with_any_number_of_threads():
    rng = np.random.default_rng(8)
    scene = scene_of(random_mesh(rng))
    cameras = [replace(FRONT, pose=look_at(eye, [0, 0, 0])) for eye in rng.normal(size=(6, 3)) * 4]
    one, two = (Renderer(scene, threads=n).render_batch(cameras, outputs=OUTPUTS) for n in (1, 2))
    for name in OUTPUTS:
        np.testing.assert_array_equal(one[name], two[name])


def test_shadows_and_sight_pass_through_holes():
    pytest.importorskip("embreex", reason="the extra 'rays' is not installed")
    scene = scene_of(quad(half_clear(), z=1), quad(None, z=0, size=4))
    caster = RayCaster(scene)
    free = caster.line_of_sight([[-0.5, 0, 2], [0.5, 0, 2]], [[-0.5, 0, 0.5], [0.5, 0, 0.5]])
    np.testing.assert_array_equal(free, [True, False])
    light = Light(sun_direction=(0.0, 0.0, 1.0), occlusion=0, headlight=(0, 0, 0), shadow_rays=4, sun_size_deg=0.1)
    floor = pinhole(80, 60, hfov_deg=70, pose=look_at([0, 0, 0.9], [0, 0, 0]))
    lit = Renderer(scene, light=light).render(floor, outputs=("rgb",))["rgb"].astype(int)
    assert lit[30, 10, 0] > lit[30, 70, 0] + 20
