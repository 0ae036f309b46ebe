"""EXT_meshopt_compression: streams that meshoptimizer's own encoder made of the arrays below, and damage."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.errors import SceneError
from h3data.mesh.accessors import MESHOPT
from h3data_meshes import meshopt
from tests.mesh.gltf_builder import FLOAT, U16, Builder

K = np.arange(40)
ATTRIBUTES = np.stack([K * 25, K * K % 999, np.where(K % 7 == 0, 5000, K), K * 0], axis=1).astype("<u2")
GRID = np.arange(25).reshape(5, 5)
TRIANGLES = np.stack(
    [GRID[:-1, :-1], GRID[1:, :-1], GRID[:-1, 1:], GRID[:-1, 1:], GRID[1:, :-1], GRID[1:, 1:]], axis=-1
)
INDICES = np.arange(30) * 7 % 23 + np.arange(30) % 2 * 1000
STREAMS = {
    "ATTRIBUTES": "oB8AMjIyMjIyMjIyMjIyMjIyMjIyMjIyMjIyMjIyMjIyMv//AAAyMjIyMjIyMgUAAAIAACAAAh8AAgYKDhIWGh4iJiouMjY6PkJG"
    "Sk5SVlpeYmZqbnJ2ev//AACwgoaKjpKWmhSAAgCAwIIAAAUVOqvqr/L7//bxqr6q+ujj2tWr6gAAzMcVMAPADyUmJSYlADwA8CYl"
    "JiUDwAAAJiUAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAACIEwAA",
    "TRIANGLES": "4f4eAB4AHgAe3g4GHgUeBB7eDgQeBB4EHt4OBB4EHgQe8AoAdodWZ3iphmWJaJgBaQAA",
    "INDICES": "0QC9Hzg5IiM4IyI5IiM4OSIjOCMiOSIjOCMiOTgjIjkAAAAA",
    "OCTAHEDRAL 8": "oAE///8AKAMpSVEbCCA2ZDMBP///AEgsFjQwNlA6MAo7AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAACIl/AA==",
    "OCTAHEDRAL 12": "oAE//z8Agkuft+oqjJtauAEh9L0ABQMEBgE///8Adtidx/mP9lH7mlQCBEBEJkIBAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA"
    "AAAAiACJ+P8HAAA=",
    "QUATERNION": "oAE///8AiBEuhzChsIOSzicCA///R5MxAABKERFAAT///gCjYtyyZN/6gUrPAT///wAlBhgWLywhDwMGDAE///8AxnzWP8xDSO4k"
    "FtUCAvEr+MyoAABWTQEMNAAAAwYAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA/ecAANnu/h8=",
    "EXPONENTIAL": "oAE8AAAA//8CAURmb8zMAAAgAQIAAAABEQEAAAEL//8ACAYKCkAgIiYsAAABEQEAAAEPP/8AqqmqxJLk47mbAQ///wCysceFX1Fv"
    "V0k7AAERAQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA/v/5AAAA+QD0Afk=",
}
EXPECTED = {
    "ATTRIBUTES": ATTRIBUTES,
    "TRIANGLES": TRIANGLES.astype("<u2"),
    "INDICES": INDICES.astype("<u4"),
}
STRIDES = {"ATTRIBUTES": 8, "TRIANGLES": 2, "INDICES": 4}


def _decoded(name: str, count: int, stride: int, *, mode: str = "ATTRIBUTES", filter: str = "NONE") -> np.ndarray:
    stream = base64.b64decode(STREAMS[name])
    return meshopt.decode_view(stream, mode=mode, filter=filter, count=count, stride=stride)


@pytest.mark.parametrize("mode", EXPECTED)
def test_streams_of_the_reference_encoder(mode: str) -> None:
    expected = np.ascontiguousarray(EXPECTED[mode])
    found = _decoded(mode, expected.nbytes // STRIDES[mode], STRIDES[mode], mode=mode).view(expected.dtype)
    if mode == "TRIANGLES":  # the encoder may start a triangle at another corner
        found, expected = _from_least(found.reshape(-1, 3)), _from_least(expected.reshape(-1, 3))
    assert (found.reshape(expected.shape) == expected).all()


def _from_least(faces: np.ndarray) -> np.ndarray:
    """Triangles [F, 3], each from its least corner on."""
    return np.take_along_axis(faces, (faces.argmin(1)[:, None] + np.arange(3)) % 3, axis=1)


def test_filters() -> None:
    """The vectors that were encoded, within the bits they were given."""
    k = np.arange(12)
    a, b = 0.5 * k, 0.3 * k - 1.5
    unit = np.stack([np.cos(a) * np.cos(b), np.sin(b), np.sin(a) * np.cos(b)], axis=1)
    normals8 = _decoded("OCTAHEDRAL 8", 12, 4, filter="OCTAHEDRAL").view("i1").reshape(-1, 4)
    assert np.abs(normals8[:, :3] / 127 - unit).max() < 0.02
    normals16 = _decoded("OCTAHEDRAL 12", 12, 8, filter="OCTAHEDRAL").view("<i2").reshape(-1, 4)
    assert np.abs(normals16[:, :3] / 32767 - unit).max() < 1e-3
    quats = np.stack([np.sin(a), np.cos(a) * 0.5, 0.3 * k - 1, 0 * k + 0.7], axis=1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    found = _decoded("QUATERNION", 12, 8, filter="QUATERNION").view("<i2").reshape(-1, 4) / 32767
    assert np.abs((found * quats).sum(1)).min() > 1 - 1e-4
    numbers = np.stack([k * 1.5 - 4, 1e-3 * k * k, 1000 / (k + 1)], axis=1)
    found = _decoded("EXPONENTIAL", 12, 12, filter="EXPONENTIAL").view("<f4").reshape(-1, 3)
    assert np.abs(found - numbers).max() < 1e-2


def test_the_example_of_the_specification() -> None:
    """Appendix A, mode 0: sixteen differences in 4-bit sentinel encoding."""
    differences = [-1, -4, -3, 26, -91, 0, -6, 6, -4, -4, 5, -5, 1, -1, 0, 0]
    group = bytes([0x17, 0x5F, 0xF0, 0xBC, 0x77, 0xA9, 0x21, 0x00, 0x34, 0xB5])
    stream = bytes([0xA0, 2]) + group + bytes(3) + bytes(32)  # the three other bytes of the elements stay 0
    found = meshopt.decode_view(stream, mode="ATTRIBUTES", filter="NONE", count=16, stride=4).reshape(16, 4)
    assert (found[:, 0] == np.cumsum(differences) % 256).all()
    assert not found[:, 1:].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": "POINTS"}, "its mode is 'POINTS'"),
        ({"filter": "COLOR"}, "its filter is 'COLOR'"),
        ({"mode": "TRIANGLES", "stride": 4, "count": 3}, "starts with a0, expected e1"),
        ({"stride": 6}, "do not go with"),
        ({"count": 1 << 40}, "the limit is"),
        ({"count": 4000}, "ends early"),
        ({"count": 3}, "left over"),
    ],
)
def test_what_does_not_go_together_is_refused(change: dict, message: str) -> None:
    arguments = {"mode": "ATTRIBUTES", "filter": "NONE", "count": 40, "stride": 8, **change}
    with pytest.raises(ValueError, match=message):
        meshopt.decode_view(base64.b64decode(STREAMS["ATTRIBUTES"]), **arguments)


@settings(max_examples=200, deadline=None)
@given(
    mode=st.sampled_from(sorted(EXPECTED)), cut=st.integers(0, 200), place=st.integers(1, 300), byte=st.integers(0, 255)
)
def test_damage_is_refused_or_decodes(mode: str, cut: int, place: int, byte: int) -> None:
    stream = bytearray(base64.b64decode(STREAMS[mode]))
    stream[place % len(stream)] = byte
    count = EXPECTED[mode].size * EXPECTED[mode].itemsize // STRIDES[mode]
    try:
        out = meshopt.decode_view(
            bytes(stream[: len(stream) - cut]), mode=mode, filter="NONE", count=count, stride=STRIDES[mode]
        )
    except ValueError:
        return
    assert len(out) == count * STRIDES[mode]


def test_a_file_with_compressed_views(tmp_path: Path) -> None:
    """The indices lie compressed in the file; the buffer of their view has no bytes of its own, as gltfpack writes."""
    build, stream = Builder(), base64.b64decode(STREAMS["TRIANGLES"])
    places = np.stack([GRID % 5, GRID // 5, 0 * GRID], axis=-1).reshape(-1, 3).astype(np.float32)
    build.primitive["attributes"] = {"POSITION": build.chunk.array(places, "VEC3", FLOAT)}
    build.primitive["indices"] = build.chunk.array(TRIANGLES.reshape(-1).astype("<u2"), "SCALAR", U16)
    packed = build.chunk.views[build.chunk.view(stream)]
    about = {"buffer": 0, "byteOffset": packed["byteOffset"], "byteLength": len(stream), "byteStride": 2, "count": 96}
    view = build.chunk.views[build.chunk.accessors[build.primitive["indices"]]["bufferView"]]
    plain = dict(view)
    view.update(buffer=1, byteOffset=0, extensions={MESHOPT: {**about, "mode": "TRIANGLES"}})
    build.document["buffers"] = [{"byteLength": build.chunk.size}, {"byteLength": 192}]
    build.document["extensionsRequired"] = [MESHOPT]
    mesh = build.mesh(tmp_path)
    del view["extensions"]
    view.update(plain)
    assert (_from_least(build.mesh(tmp_path).faces) == _from_least(mesh.faces)).all()
    assert len(mesh.faces) == 32
    view.update(buffer=1, extensions={MESHOPT: {**about, "mode": "INDICES"}})
    with pytest.raises(SceneError, match=r"(?s)bufferViews\[.*\]\.extensions.*expected d1.*H3-MESH-021"):
        build.mesh(tmp_path)
