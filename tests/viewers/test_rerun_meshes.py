"""Meshes in a Rerun file: thinned, faceted, textured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.thinning import thin_mesh
from h3data_viewers import write_rrd
from h3data_viewers.rerun.mesh_budget import baked_colors, view_mesh
from tests.viewers.rerun_file import File, Stage, Thing, example, sphere

pytest.importorskip("rerun")


@pytest.mark.parametrize("limit", [30, 200, 399])
def test_thin_meshes_stay_close_and_small(limit):
    mesh = sphere(400)
    thin = thin_mesh(mesh, limit)
    assert limit / 3 < len(thin.keep) <= limit
    assert len(np.unique(thin.keep)) == len(thin.keep)
    corners = mesh.vertices[thin.keep][thin.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert 0.5 * 4 * np.pi < area < 1.1 * 4 * np.pi, "still a closed ball"
    assert thin_mesh(mesh, 400).faces is mesh.faces


def test_meshes_without_normals_become_facets():
    mesh = sphere(normals=False)
    (facets,) = view_mesh(mesh)
    assert facets.faces is None
    assert np.array_equal(facets.vertices.reshape(-1, 3, 3), mesh.vertices[mesh.faces])
    assert np.array_equal(facets.colors.reshape(-1, 3, 3), mesh.colors[mesh.faces])


def test_too_large_scenes_are_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr("h3data_viewers.rerun.entities.MESH_BYTES", 40_000)
    monkeypatch.setattr("h3data_viewers.rerun.entities.SKIN_BYTES", 60_000)
    big = sphere(4000)
    stage = Stage(example())
    stage.drawables = [Thing(name="statue", mesh=big, matrix=np.eye(4)), stage.drawables[5]]
    stage.vertices = lambda index, steps: np.random.default_rng(0).random((len(steps), 400, 3)).astype(np.float32)
    file = File(write_rrd(example(), tmp_path / "e.rrd", replay=stage))
    assert 400 < len(file.at("/world/scene/statue", "Mesh3D:vertex_positions", 0)) <= 768  # 40 of 208 kB
    steps, _ = file.column("/world/alex/body", "Mesh3D:vertex_positions")
    assert np.diff(steps).min() == 5  # 60 rows x 400 vertices x 12 bytes = 288 kB


def two_textures(*, normals: bool) -> Mesh:
    """Two squares with a texture each, and one without."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    red, board = np.zeros((4, 4, 4), np.uint8), np.zeros((1024, 64, 4), np.uint8)
    red[...], board[...] = (255, 0, 0, 255), (0, 90, 0, 255)
    board[512:] = (0, 0, 90, 255)
    return Mesh(
        vertices=np.concatenate([square + np.array([0, 0, k]) for k in range(3)]).astype(np.float32),
        faces=np.concatenate([faces + 4 * k for k in range(3)]).astype(np.int32),
        colors=np.repeat(np.array([[255] * 3, [128] * 3, [7, 8, 9]], np.uint8), 4, axis=0),
        normals=np.tile(np.array([0, 0, 1], np.float32), (12, 1)) if normals else None,
        uv=np.tile(square[:, :2] * 0.98 + 0.01, (3, 1)),
        textures=(Texture(pixels=red), Texture(pixels=board)),
        face_textures=np.array([0, 0, 1, 1, -1, -1], np.int16),
    )


@pytest.mark.parametrize("normals", [True, False])
def test_every_triangle_keeps_its_texture(tmp_path, normals):
    mesh, stage = two_textures(normals=normals), Stage(example())
    stage.drawables = [Thing(name="squares", mesh=mesh, matrix=np.diag([2.0, 2, 2, 1]))]
    file = File(write_rrd(example(), tmp_path / "e.rrd", replay=stage))
    entities = ["/world/scene/squares", "/world/scene/squares/part_2", "/world/scene/squares/part_3"]
    shown = []
    for entity in entities:
        names = {n for _, batch in file.batches[entity] for n in batch.schema.names}
        points = np.array(file.at(entity, "Mesh3D:vertex_positions", 0))
        if "Mesh3D:triangle_indices" in names:
            points = points[np.array(file.at(entity, "Mesh3D:triangle_indices", 0))]
        depth = points.reshape(-1, 3, 3)[:, 0, 2]
        texel = None
        if "Mesh3D:albedo_texture_buffer" in names:
            form = file.at(entity, "Mesh3D:albedo_texture_format", 0)[0]
            pixels = np.array(file.at(entity, "Mesh3D:albedo_texture_buffer", 0)[0], np.uint8)
            texel = pixels.reshape(form["height"], form["width"], 3)
            uv = np.array(file.at(entity, "Mesh3D:vertex_texcoords", 0))
            assert np.allclose(np.sort(np.unique(uv)), [0.01, 0.99])
        shown.append((depth.tolist(), None if texel is None else (texel.shape, texel[0, 0].tolist())))
    assert shown == [
        ([2.0, 2.0], None),
        ([0.0, 0.0], ((4, 4, 3), [255, 0, 0])),
        ([1.0, 1.0], ((512, 32, 3), [0, 90, 0])),
    ]
    assert np.allclose(file.matrix(entities[0], 0), np.diag([2.0, 2, 2, 1]))


def test_textures_are_halved_until_they_fit(tmp_path, monkeypatch):
    monkeypatch.setattr("h3data_viewers.rerun.entities.TEXTURE_BYTES", 2 * (48 + 3 * 16 * 256))
    stage = Stage(example())
    mesh = two_textures(normals=True)
    stage.drawables = [Thing(name=n, mesh=mesh, matrix=np.eye(4)) for n in "ab"]
    file = File(write_rrd(example(), tmp_path / "e.rrd", replay=stage))
    (form,) = file.at("/world/scene/a/part_3", "Mesh3D:albedo_texture_format", 0)
    assert (form["width"], form["height"]) == (16, 256)


def test_baked_colours_are_texel_times_vertex_colour():
    colors = baked_colors(two_textures(normals=True))
    assert (colors[:4] == (255, 0, 0)).all()
    assert (colors[8:] == (7, 8, 9)).all(), "no texture"
    upper, lower = colors[4], colors[7]  # v = 0.01 and 0.99
    assert upper[1] > 30 > upper[2]
    assert lower[2] > 30 > lower[1]
    assert max(upper.max(), lower.max()) < 90, "darkened by the vertex colour"


def test_thinned_meshes_show_their_texture_as_vertex_colours():
    ball = sphere(400)
    uv = np.tile(np.array([0.5, 0.5], np.float32), (400, 1))
    texture = Texture(pixels=np.full((2, 2, 4), (10, 200, 30, 255), np.uint8))
    white = np.full_like(ball.colors, 255)
    (part,) = view_mesh(replace(ball, colors=white, uv=uv, textures=(texture,)), max_vertices=100)
    assert part.texture is None
    assert (part.colors == (10, 200, 30)).all()
