"""Joining and painting meshes; what a mesh refuses."""

import numpy as np
import pytest

from h3data.errors import SceneError
from h3data.mesh.mesh_operations import joined, painted
from h3data.scene import Mesh, Texture


def _triangle(*textures: Texture, face_textures=None, **more) -> Mesh:
    return Mesh(
        vertices=np.eye(3, dtype=np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
        colors=np.full((3, 3), 200, np.uint8),
        uv=np.eye(3, 2, dtype=np.float32) if textures else None,
        textures=textures,
        face_textures=face_textures,
        **more,
    )


def _texture(level: int) -> Texture:
    return Texture(pixels=np.full((2, 2, 4), level, np.uint8))


def test_joined_meshes_keep_every_triangles_texture():
    a, b = _texture(10), _texture(20)
    second = _triangle(b, a, face_textures=np.array([1], np.int16))  # texture a, by index
    mesh = joined([_triangle(), _triangle(a), second, _triangle(b)])
    assert mesh.face_textures is not None
    assert mesh.uv is not None
    assert [mesh.textures[k] if k >= 0 else None for k in mesh.face_textures] == [None, a, a, b]
    assert len(mesh.textures) == 2
    np.testing.assert_array_equal(mesh.uv[3:6], np.eye(3, 2))


def test_joined_meshes_without_textures_have_none():
    mesh = joined([_triangle(), _triangle()])
    assert mesh.uv is None
    assert mesh.textures == ()
    assert mesh.face_textures is None


def test_painted_drops_textures():
    mesh = painted(_triangle(_texture(10)), (1, 2, 3))
    assert mesh.textures == ()
    assert (mesh.colors == (1, 2, 3)).all()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"uv": np.zeros((2, 2), np.float32)}, r"(?s)uv must be.*H3-MESH-028"),
        ({"textures": (_texture(1),)}, r"(?s)textures need uv.*H3-MESH-028"),
        ({"face_textures": np.zeros(1, np.int16)}, r"(?s)index textures up to 0.*H3-MESH-028"),
        ({"face_textures": np.zeros(2, np.int16)}, r"(?s)face_textures must be.*H3-MESH-028"),
    ],
)
def test_a_mesh_refuses_texture_data_that_does_not_fit(more, message):
    with pytest.raises(SceneError, match=message):
        Mesh(
            vertices=np.eye(3, dtype=np.float32),
            faces=np.array([[0, 1, 2]], np.int32),
            colors=np.zeros((3, 3), np.uint8),
            **more,
        )


def test_a_texture_refuses_other_shapes():
    with pytest.raises(SceneError, match="H3-MESH-027"):
        Texture(pixels=np.zeros((2, 2, 3), np.uint8))
