"""Textures of a robot's meshes are kept from the file to the picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from h3data.bodies import load_robot
from h3data.mesh.loading import load_mesh
from h3data.mesh.mesh_operations import moved
from h3data.render import Renderer, RenderInstance, RenderScene, look_at, pinhole

PIXELS = np.zeros((8, 16, 3), np.uint8)
PIXELS[:4], PIXELS[4:], PIXELS[:, :2] = (220, 30, 30), (30, 160, 60), (240, 240, 240)
FACTOR = (128, 255, 255, 255)


def textured_file(path: Path) -> Path:
    """A square of 1 m in the plane z = 0 with a picture, in a node that is moved; beside it one in plain colour."""
    import trimesh
    from PIL import Image
    from trimesh.visual import ColorVisuals, TextureVisuals
    from trimesh.visual.material import PBRMaterial

    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = [[0, 1, 2], [0, 2, 3]]
    material = PBRMaterial(baseColorTexture=Image.fromarray(PIXELS), baseColorFactor=FACTOR)
    visual = TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    scene = trimesh.Scene()
    scene.add_geometry(
        trimesh.Trimesh(corners, faces, visual=visual, process=False),
        transform=trimesh.transformations.translation_matrix([0, 0, 0.5]),
    )
    blue = ColorVisuals(vertex_colors=np.tile(np.array([20, 40, 200, 255], np.uint8), (4, 1)))
    scene.add_geometry(trimesh.Trimesh(corners + np.array([2, 0, 0]), faces, visual=blue, process=False))
    scene.export(str(path))
    return path


def test_moving_a_mesh_keeps_its_texture(tmp_path: Path) -> None:
    mesh = load_mesh(textured_file(tmp_path / "a.glb"))
    there = moved(mesh, np.eye(4), (-1.0, 1.0, 1.0))
    assert there.textures == mesh.textures
    assert there.uv is mesh.uv
    assert np.array_equal(there.faces, mesh.faces[:, ::-1]), "mirrored: turned over"


@pytest.mark.parametrize(("color", "textured"), [("", True), ("<material><color rgba='1 0 0 1'/></material>", False)])
def test_robots_wear_their_textures(tmp_path: Path, color: str, textured: bool) -> None:
    """A colour in the URDF replaces what the file says, as before."""
    textured_file(tmp_path / "a.glb")
    visual = f'<visual><geometry><mesh filename="a.glb"/></geometry>{color}</visual>'
    (tmp_path / "r.urdf").write_text(f'<robot name="r"><link name="base">{visual}</link></robot>')
    (link,) = load_robot(tmp_path / "r.urdf", up="y").links
    assert link.mesh is not None
    assert bool(link.mesh.textures) == textured
    camera = pinhole(64, 64, hfov_deg=60, pose=look_at([0.5, 0.5, 1.8], [0.5, 0.5, 0]))
    scene = RenderScene([link.mesh], [RenderInstance(mesh=0, matrix=np.eye(4))])
    rgb = Renderer(scene).render(camera)["rgb"].astype(int)
    upper, lower = rgb[20, 34], rgb[44, 34]
    if textured:
        assert upper[0] > 1.5 * upper[1], "red above"
        assert lower[1] > 1.5 * lower[0], "green below"
    else:
        assert np.abs(upper - lower).max() < 4
