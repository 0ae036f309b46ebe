"""Smooth patches: what they join, and pictures with four samples that need them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.primitives import box_mesh, round_mesh
from h3data.render import Renderer, RenderInstance, RenderScene, look_at, pinhole

CAMERA = pinhole(96, 72, hfov_deg=50, pose=look_at(np.array([1.5, 1.2, 2.0]), np.zeros(3)))
ROUND = round_mesh(0.6, 0.0, (200, 120, 90), caps=True)
GRID = np.array([[x, 0, z] for x in range(4) for z in range(4)], np.float32)
SQUARES = np.array(
    [f for x in range(3) for z in range(3) for k in [4 * x + z] for f in ((k, k + 1, k + 5), (k, k + 5, k + 4))]
)


def patches(*meshes: Mesh) -> NDArray[np.int32]:
    return RenderScene(meshes, [RenderInstance(k, np.eye(4)) for k in range(len(meshes))]).patches


def floor(**attributes: object) -> Mesh:
    return Mesh(vertices=GRID, faces=SQUARES.astype(np.int32), **attributes)  # type: ignore[arg-type]


def test_what_is_continuous_is_one_patch() -> None:
    grey = np.full((16, 3), 120, np.uint8)
    shade = np.arange(48, dtype=np.uint8).reshape(16, 3)
    assert len(set(patches(floor(colors=grey)))) == 1
    assert len(set(patches(floor(colors=shade)))) == 1  # colours are continuous, though not equal
    assert len(set(patches(floor(colors=grey), floor(colors=grey)))) == 2  # of two meshes, which move apart


def test_seams_of_colour_normal_texture_and_folds_part_patches() -> None:
    sides = np.concatenate([SQUARES[:6], SQUARES[6:] + 16]).astype(np.int32)  # strip 1 | strips 2 and 3: seam at x = 1
    both = np.concatenate([GRID, GRID])
    up, aside = np.tile(np.array([0, 1, 0], np.float32), (32, 1)), np.tile(np.array([0.6, 0.8, 0], np.float32), (16, 1))

    def strips(**attributes: object) -> list[int]:
        found = patches(Mesh(vertices=both, faces=sides, **attributes))  # type: ignore[arg-type]
        return [len(set(found[:6])), len(set(found[6:])), len(set(found))]

    grey = np.full((32, 3), 120, np.uint8)
    assert strips(colors=grey) == [1, 1, 1]  # the same vertices twice are no seam
    other = grey.copy()
    other[16:] = 90
    assert strips(colors=other) == [1, 1, 2]
    assert strips(colors=grey, normals=np.concatenate([up[:16], aside])) == [1, 1, 2]
    texture = Texture(pixels=np.full((2, 2, 4), 255, np.uint8))
    uv = both[:, [0, 2]].copy()
    assert strips(colors=grey, uv=uv, textures=(texture,)) == [1, 1, 1]
    uv[16:] += 0.25
    assert strips(colors=grey, uv=uv, textures=(texture,)) == [1, 1, 2]

    bent = GRID.copy()
    bent[8:, 1] = [0.5] * 4 + [1.0] * 4  # strip 1 is level, 2 and 3 rise
    flat = Mesh(vertices=bent, faces=SQUARES.astype(np.int32), colors=grey[:16])
    assert len(set(patches(flat))) == 2  # without normals a fold is seen
    assert len(set(patches(Mesh(vertices=bent, faces=flat.faces, colors=grey[:16], normals=up[:16])))) == 1


@pytest.mark.parametrize("mesh", [ROUND, box_mesh((0.5, 0.35, 0.4))], ids=["sphere", "box"])
def test_pictures_are_those_of_four_samples_everywhere(mesh: Mesh) -> None:
    scene = RenderScene([mesh], [RenderInstance(0, np.eye(4))])
    picture = Renderer(scene).render(CAMERA, outputs=("rgb",), samples=4)["rgb"].astype(int)
    every = RenderScene([mesh], [RenderInstance(0, np.eye(4))])
    every.__dict__["patches"] = np.arange(len(mesh.faces), dtype=np.int32)  # each triangle is a patch: all edges count
    expected = Renderer(every).render(CAMERA, outputs=("rgb",), samples=4)["rgb"].astype(int)
    assert np.abs(picture - expected).max() <= 3
    one = Renderer(scene).render(CAMERA, outputs=("rgb",))["rgb"].astype(int)
    assert np.abs(one - expected).max() > 40  # silhouettes do need them


def test_a_surface_before_itself_keeps_its_edge() -> None:
    """One patch, bent back over itself: the near half ends before the far one."""
    s = np.linspace(0, np.pi, 30)
    ring = np.stack([0.5 * np.sin(s), 0.3 * np.cos(s)], 1)
    places = np.array([[x, y, z] for x, y in ring for z in (-0.5, 0.5)], np.float32)
    normals = np.array([[x / 0.25, y / 0.09, 0] for x, y in ring for _ in range(2)])
    k = np.arange(0, 58, 2)[:, None]
    faces = np.concatenate([k + np.array([0, 1, 3]), k + np.array([0, 3, 2])]).astype(np.int32)
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    colors = np.repeat(np.linspace(20, 240, 60).astype(np.uint8)[:, None], 3, 1)  # so that near and far differ
    mesh = Mesh(vertices=places, faces=faces, colors=colors, normals=normals)
    assert len(set(patches(mesh))) == 1
    pose = look_at(np.array([-0.6, 1.1, 0.2]), np.array([0.1, 0.0, 0.0]))
    camera = pinhole(96, 72, hfov_deg=60, pose=pose)
    scene = RenderScene([mesh], [RenderInstance(0, np.eye(4))])
    four = Renderer(scene).render(camera, outputs=("rgb",), samples=4)["rgb"].astype(int)
    scene.__dict__["patches"] = np.arange(len(faces), dtype=np.int32)
    expected = Renderer(scene).render(camera, outputs=("rgb",), samples=4)["rgb"].astype(int)
    assert np.abs(four - expected).max() <= 8
