"""Scene files: load(save(scene)) is the same scene, viewers can open it, and bad files are refused in one clear line."""

from __future__ import annotations

import io
import json
import struct
import zlib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.errors import FormatError, InputError, SceneError
from h3data.mesh.png import png_bytes, png_pixels
from h3data.scene import (
    Asset,
    Box,
    Capsule,
    Cylinder,
    Hull,
    Instance,
    Mesh,
    Receptacle,
    Room,
    Scene,
    Texture,
    load_scene,
    save_scene,
    scene_digest,
)
from h3data.scene.scene_file import _linear_of_srgb, _srgb_of_linear, scene_bytes
from h3data_homes import HomeSpec, build_home
from tests.random_cases import examples


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(seed=5))


def same(a: Any, b: Any, path: str = "scene") -> None:
    """Asserts that two records are equal field by field: types, dtypes, shapes and bits."""
    assert type(a) is type(b), path
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, path
        assert a.shape == b.shape, path
        assert a.tobytes() == b.tobytes(), path
    elif hasattr(a, "__dataclass_fields__"):
        for name in a.__dataclass_fields__:
            same(getattr(a, name), getattr(b, name), f"{path}.{name}")
    elif isinstance(a, dict):
        assert list(a) == list(b), path
        for key in a:
            same(a[key], b[key], f"{path}[{key!r}]")
    elif isinstance(a, tuple | list):
        assert len(a) == len(b), path
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            same(x, y, f"{path}[{i}]")
    else:
        assert a == b, path


# --- round trip -------------------------------------------------------------------------------------------------------
def test_a_home_survives_exactly(home: Scene, tmp_path: Path):
    path = tmp_path / "home.glb"
    save_scene(home, path)
    loaded = load_scene(path)
    same(home, loaded)
    assert scene_digest(loaded) == scene_digest(home)
    assert [p.name for p in tmp_path.iterdir()] == ["home.glb"], "no .part is left"


def test_buffers_and_bytes_work_like_paths(home: Scene):
    buffer = io.BytesIO()
    save_scene(home, buffer)
    same(home, load_scene(buffer.getvalue()))
    same(home, load_scene(io.BytesIO(buffer.getvalue())))
    assert scene_bytes(load_scene(buffer.getvalue())) == buffer.getvalue(), "writing again gives the same bytes"


def floats(n: int, bound: float = 100.0) -> st.SearchStrategy[np.ndarray]:
    number = st.floats(-bound, bound, allow_nan=False, allow_subnormal=True)
    return st.lists(number, min_size=n, max_size=n).map(lambda v: np.array(v, np.float64))


names = st.text(st.characters(exclude_categories=("Cs",)), min_size=1, max_size=12)
positive = st.floats(1e-6, 1e3)
shapes = st.one_of(
    st.builds(Box, pose=floats(7), half_extents=floats(3)),
    st.builds(Cylinder, pose=floats(7), radius=positive, half_height=positive),
    st.builds(Capsule, start=floats(3), end=floats(3), radius=positive),
    st.builds(Hull, points=st.integers(0, 5).flatmap(lambda n: floats(3 * n).map(lambda v: v.reshape(-1, 3)))),
)


def random_texture(seed: int, *, gray: bool = False, opaque: bool = True) -> Texture:
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (*rng.integers(1, 6, 2), 4)).astype(np.uint8)
    if gray:
        pixels[..., 1:3] = pixels[..., :1]
    if opaque:
        pixels[..., 3] = 255
    return Texture(pixels=pixels, name=f"t{seed}")


TEXTURES = [random_texture(2 * g + o, gray=bool(g), opaque=bool(o)) for g in (0, 1) for o in (0, 1)]


@st.composite
def meshes(draw: st.DrawFn) -> Mesh:
    count = draw(st.integers(0, 6))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    triangles = draw(st.integers(0, 4)) if count else 0
    some = tuple(draw(st.lists(st.sampled_from(TEXTURES), max_size=3))) if count else ()
    chosen = rng.integers(-1, len(some), triangles).astype(np.int16)
    return Mesh(
        vertices=(rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-6, 6)).astype(np.float32),
        faces=rng.integers(0, max(count, 1), (triangles, 3)).astype(np.int32),
        colors=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        normals=draw(st.sampled_from([None, rng.normal(size=(count, 3)).astype(np.float32)])),
        uv=rng.normal(size=(count, 2)).astype(np.float32) if some or (count and draw(st.booleans())) else None,
        textures=some,
        face_textures=draw(st.sampled_from([None, chosen])) if some else None,
    )


receptacles = st.builds(Receptacle, name=names, center=floats(3), half_size=floats(2), clearance_m=positive)
assets = st.builds(
    Asset,
    name=names,
    mesh=meshes(),
    category=names,
    shapes=st.lists(shapes, max_size=3).map(tuple),
    receptacles=st.lists(receptacles, max_size=2).map(tuple),
)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    kinds = draw(st.dictionaries(names, assets, min_size=1, max_size=3))
    instance = st.builds(
        Instance,
        name=names,
        asset=st.sampled_from(sorted(kinds)),
        pose=floats(7),
        scale=floats(3),
        semantic_id=st.integers(-(2**31), 2**31),
        motion=st.sampled_from(["static", "kinematic"]),
        layer=st.sampled_from(["", "ceiling"]),
    )
    plain = st.recursive(
        st.none()
        | st.booleans()
        | st.integers()
        | st.floats(allow_nan=False, allow_infinity=False)
        | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3),
        max_leaves=5,
    )
    room = st.builds(
        Room,
        name=names,
        category=names,
        rectangles=st.integers(0, 3).flatmap(lambda n: floats(4 * n).map(lambda v: v.reshape(-1, 4))),
    )
    return Scene(
        name=draw(names),
        assets=kinds,
        instances=tuple(draw(st.lists(instance, max_size=4, unique_by=lambda i: i.name))),
        rooms=tuple(draw(st.lists(room, max_size=2))),
        source=draw(st.dictionaries(names, plain, max_size=3)),
    )


@settings(max_examples=examples(60), derandomize=True, deadline=None)
@given(scenes())
def test_any_scene_survives_exactly(scene: Scene):
    loaded = load_scene(scene_bytes(scene))
    same(scene, loaded)
    assert scene_digest(scene) == scene_digest(loaded)


def test_all_colours_survive_the_linear_form():
    linear = _linear_of_srgb()
    assert (np.diff(linear.astype(int)) >= 19).all()
    np.testing.assert_array_equal(_srgb_of_linear(linear), np.arange(256))
    assert (linear[0], linear[255]) == (0, 65535)
    assert linear[188] == pytest.approx(0.5 * 65535, rel=0.01), "sRGB 188 is half the light"


# --- others can read it -----------------------------------------------------------------------------------------------
def chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\x00"
    return json.loads(data[20 : 20 + size]), data[28 + size : 28 + size + binary_size]


def rebuilt(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\x00") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def test_it_is_sound_gltf(home: Scene):
    document, binary = chunks(scene_bytes(home))
    assert document["asset"]["version"] == "2.0"
    assert document["buffers"] == [{"byteLength": len(binary)}]
    for view in document["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= len(binary)
    assert len(document["nodes"]) == len(home.instances)
    assert len(document["meshes"]) == len(home.assets)
    size = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
    width = {5126: 4, 5123: 2, 5125: 4, 5122: 2}
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        stride = size[accessor["type"]] * width[accessor["componentType"]]
        assert stride % 4 == 0 or "target" not in view
        end = accessor.get("byteOffset", 0) + accessor["count"] * stride
        assert end <= view["byteLength"] if "byteOffset" in accessor else end == view["byteLength"]
    for node in document["nodes"]:
        assert np.linalg.norm(node["rotation"]) == pytest.approx(1, abs=1e-9)


def test_trimesh_opens_it(home: Scene, tmp_path: Path):
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "home.glb"
    save_scene(home, path)
    seen = trimesh.load_scene(path)
    corners, triangles = [], 0
    for name in seen.graph.nodes_geometry:  # one for each primitive of each node
        matrix, geometry = seen.graph[name]
        mesh = seen.geometry[geometry]
        corners.append(trimesh.transform_points(mesh.triangles.reshape(-1, 3), matrix))
        triangles += len(mesh.faces)
    assert triangles == sum(len(home.assets[i.asset].mesh.faces) for i in home.instances)
    corner = np.concatenate(corners)  # Scene.bounds encloses the boxes of turned meshes and is larger
    np.testing.assert_allclose([corner.min(0), corner.max(0)], home.bounds, atol=1e-5)


# --- textures ---------------------------------------------------------------------------------------------------------
def quad(**changes: Any) -> Mesh:
    """A unit square of two triangles with texture coordinates."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    mesh = Mesh(
        vertices=np.column_stack([corners, np.zeros(4, np.float32)]),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        colors=np.full((4, 3), 200, np.uint8),
        uv=corners,
    )
    return replace(mesh, **changes)


def scene_of(*meshes: Mesh) -> Scene:
    assets = {f"a{k}": Asset(name=f"a{k}", mesh=mesh) for k, mesh in enumerate(meshes)}
    here = np.array([0, 0, 0, 0, 0, 0, 1.0])
    return Scene(
        name="s", assets=assets, instances=tuple(Instance(name=name, asset=name, pose=here) for name in assets)
    )


def test_textures_are_stored_once_and_stay_shared():
    wood, cloth = random_texture(1), random_texture(2, gray=True)
    scene = scene_of(
        quad(textures=(wood,)),
        quad(textures=(cloth, wood), face_textures=np.array([1, 0], np.int16)),
        quad(textures=(cloth,), face_textures=np.array([-1, 0], np.int16)),
    )
    data = scene_bytes(scene)
    assert len(chunks(data)[0]["images"]) == 2
    loaded = load_scene(data)
    same(scene, loaded)
    a, b, c = (loaded.assets[f"a{k}"].mesh.textures for k in range(3))
    assert a[0] is b[1]
    assert b[0] is c[0]
    assert scene_bytes(loaded) == data


def test_viewers_see_a_material_for_each_texture():
    wood, cloth = random_texture(1), random_texture(2, opaque=False)
    mesh = quad(textures=(wood, cloth), face_textures=np.array([1, -1], np.int16))
    document, binary = chunks(scene_bytes(scene_of(mesh)))
    first, second = document["meshes"][0]["primitives"]
    assert "baseColorTexture" not in document["materials"][first["material"]]["pbrMetallicRoughness"]
    material = document["materials"][second["material"]]
    image = document["images"][
        document["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]["source"]
    ]
    assert (image["name"], material["alphaMode"]) == (cloth.name, "MASK")
    order = []
    for primitive in (first, second):
        accessor = document["accessors"][primitive["indices"]]
        view = document["bufferViews"][accessor["bufferView"]]
        start = view["byteOffset"] + accessor["byteOffset"]
        order.append(np.frombuffer(binary, "<u4", accessor["count"], start).tolist())
    assert order == [[0, 2, 3], [0, 1, 2]], "the triangle without a texture comes first"


def test_gray_and_opaque_images_take_fewer_channels():
    colour_types = []
    for texture in TEXTURES:
        data = png_bytes(texture.pixels)
        np.testing.assert_array_equal(png_pixels(data), texture.pixels)
        colour_types.append(data[25])
    assert sorted(colour_types) == [0, 2, 4, 6]  # gray, RGB, gray and opacity, RGBA


def test_files_without_textures_are_still_read():
    document, binary = chunks(scene_bytes(scene_of(quad(uv=None))))
    assert not {"images", "textures", "samplers"} & set(document)
    old = rebuilt(damage(document, ("extras", "h3data", "version"), [1, 0]), binary)
    same(scene_of(quad(uv=None)), load_scene(old))


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("images", 0, "bufferView"), 99),
        (("images",), []),
        (("images", 0), 5),
        (("extras", "h3data", "assets", 0, "mesh", "textures"), [7]),
        (("extras", "h3data", "assets", 0, "mesh", "face_textures"), 0),
    ],
)
def test_damaged_textures_give_one_format_error(keys: tuple[Any, ...], value: Any):
    mesh = quad(textures=(random_texture(3),), face_textures=np.array([0, -1], np.int16))
    document, binary = chunks(scene_bytes(scene_of(mesh)))
    with pytest.raises(FormatError, match="H3-SCENE-053"):
        load_scene(rebuilt(damage(document, keys, value), binary))


def test_an_image_that_claims_to_be_huge_is_refused_before_it_is_decoded():
    document, binary = chunks(scene_bytes(scene_of(quad(textures=(random_texture(3),)))))
    start = document["bufferViews"][document["images"][0]["bufferView"]]["byteOffset"]
    header = binary[start + 12 : start + 16] + struct.pack(">II", 60_000, 60_000) + binary[start + 24 : start + 29]
    huge = binary[: start + 12] + header + struct.pack(">I", zlib.crc32(header)) + binary[start + 33 :]
    with pytest.raises(FormatError, match=r"(?s)60000.*H3-SCENE-053"):
        load_scene(rebuilt(document, huge))


# --- digest -----------------------------------------------------------------------------------------------------------
def test_digest_sees_every_change_of_content_and_nothing_else(home: Scene):
    digest = scene_digest(home)
    assert scene_digest(replace(home, name="other", source={})) == digest
    assert scene_digest(replace(home, assets=dict(reversed(list(home.assets.items()))))) == digest
    first = home.instances[0]
    moved = replace(first, pose=first.pose + np.array([np.spacing(1.0), 0, 0, 0, 0, 0, 0]))
    key = first.asset
    asset = home.assets[key]
    colors = asset.mesh.colors.copy()
    colors[0, 0] ^= 1
    painted = replace(asset, mesh=replace(asset.mesh, colors=colors))
    changes = [
        replace(home, instances=(moved, *home.instances[1:])),
        replace(home, instances=home.instances[:-1]),
        replace(home, instances=home.instances[::-1]),
        replace(home, instances=(replace(first, layer="x"), *home.instances[1:])),
        replace(home, rooms=home.rooms[:-1]),
        replace(home, assets={**home.assets, key: painted}),
        replace(home, assets={**home.assets, key: replace(asset, mesh=replace(asset.mesh, normals=None))}),
        replace(home, assets={**home.assets, key: replace(asset, shapes=())}),
    ]
    assert len({digest, *(scene_digest(c) for c in changes)}) == len(changes) + 1


def test_digest_sees_textures_but_not_which_are_shared():
    wood = random_texture(1)
    mesh = quad(textures=(wood, random_texture(2)), face_textures=np.array([0, 1], np.int16))
    changes = [
        mesh,
        replace(mesh, textures=mesh.textures[::-1]),
        replace(mesh, uv=mesh.uv + np.float32(1)),
        replace(mesh, face_textures=np.array([0, 0], np.int16)),
        replace(mesh, face_textures=None),
        replace(mesh, textures=(replace(wood, pixels=wood.pixels ^ 1), mesh.textures[1])),
        quad(),
        quad(uv=None),
    ]
    assert len({scene_digest(scene_of(c)) for c in changes}) == len(changes)
    copy = Texture(pixels=wood.pixels.copy(), name=wood.name)
    assert scene_digest(scene_of(replace(mesh, textures=(copy, mesh.textures[1])))) == scene_digest(scene_of(mesh))


# --- hostile input ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "data", [b"", b"gl", b"not a glb at all, just some text", b'{"scene": 1}', b"\x89PNG\r\n\x1a\n"]
)
def test_other_files_are_named_as_such(data: bytes):
    with pytest.raises(FormatError, match=r"(?s)a scene as GLB.*H3-MESH-001"):
        load_scene(data)


def test_truncation_anywhere_is_noticed(home: Scene):
    data = scene_bytes(home)
    for cut in (4, 11, 19, 20, 1000, len(data) // 2, len(data) - 1):
        with pytest.raises(FormatError, match=r"H3-MESH-00(2|4)"):
            load_scene(data[:cut])


def test_a_foreign_glb_is_sent_to_open(tmp_path: Path):
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "box.glb"
    trimesh.creation.box().export(path)
    with pytest.raises(FormatError, match=r"(?s)box\.glb.*H3-SCENE-048"):
        load_scene(path)


@pytest.mark.parametrize("extras", [None, 3, [], {}, {"h3data": None}, {"h3data": {"format": "h3data.else"}}])
def test_foreign_extras_are_foreign(home: Scene, extras: Any):
    document, binary = chunks(scene_bytes(home))
    with pytest.raises(FormatError, match="H3-SCENE-048"):
        load_scene(rebuilt({**document, "extras": extras}, binary))


def damage(document: dict[str, Any], keys: tuple[Any, ...], value: Any) -> dict[str, Any]:
    copy = json.loads(json.dumps(document))
    at = copy
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    return copy


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("extras", "h3data", "version"), None),
        (("extras", "h3data", "assets"), 7),
        (("extras", "h3data", "assets", 0, "mesh", "POSITION"), 10**6),
        (("extras", "h3data", "assets", 0, "mesh", "POSITION"), "x"),
        (("extras", "h3data", "assets", 0, "shapes", 0, "type"), "torus"),
        (("extras", "h3data", "assets", 0, "shapes", 0, "pose"), [1, 2, 3]),
        (("extras", "h3data", "instances", 0, "asset"), "nobody"),
        (("extras", "h3data", "instances", 0, "motion"), "flying"),
        (("extras", "h3data", "instances", 0, "pose"), ["a"] * 7),
        (("extras", "h3data", "instances", 1), None),
        (("extras", "h3data", "rooms", 0, "rectangles"), [[0, 1]]),
        (("accessors", 0, "count"), 2**40),
        (("accessors", 0, "count"), -1),
        (("accessors", 0, "componentType"), 5120),
        (("bufferViews", 0, "byteOffset"), -8),
        (("bufferViews", 0, "byteOffset"), 2**33),
        (("accessors",), None),
    ],
)
def test_damaged_contents_give_one_format_error(home: Scene, keys: tuple[Any, ...], value: Any):
    document, binary = chunks(scene_bytes(home))
    with pytest.raises(FormatError, match="H3-SCENE-053"):
        load_scene(rebuilt(damage(document, keys, value), binary))


def test_indices_out_of_range_are_refused(home: Scene):
    document, binary = chunks(scene_bytes(home))
    accessor = document["accessors"][document["extras"]["h3data"]["assets"][0]["mesh"]["indices"]]
    offset = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    wrong = binary[:offset] + b"\xff\xff\xff\x7f" + binary[offset + 4 :]
    with pytest.raises(FormatError, match=r"(?s)faces index.*H3-SCENE-053"):
        load_scene(rebuilt(document, wrong))


def test_a_newer_format_is_refused_and_a_newer_minor_is_read(home: Scene):
    document, binary = chunks(scene_bytes(home))
    with pytest.raises(FormatError, match="H3-SCENE-052"):
        load_scene(rebuilt(damage(document, ("extras", "h3data", "version"), [2, 0]), binary))
    minor = damage(document, ("extras", "h3data", "version"), [1, 9])
    minor["extras"]["h3data"]["assets"][0]["wax"] = "polished"
    same(home, load_scene(rebuilt(minor, binary)))


@settings(max_examples=examples(80), derandomize=True, deadline=None)
@given(st.data())
def test_flipped_bytes_never_crash(data: st.DataObject):
    scene = scene_of(quad(textures=(random_texture(1),), face_textures=np.array([0, -1], np.int16)))
    shaped = replace(scene.assets["a0"], shapes=(Hull(points=np.eye(3)),))
    raw = bytearray(scene_bytes(replace(scene, assets={"a0": shaped})))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    with suppress(FormatError):  # most flips hit names or numbers and are harmless; nothing else may be raised
        load_scene(bytes(raw))


def test_missing_files_and_folders_are_input_errors(home: Scene, tmp_path: Path):
    with pytest.raises(InputError, match="H3-SCENE-055"):
        load_scene(tmp_path / "nothing.glb")
    with pytest.raises(InputError, match="H3-FILE-009"):
        save_scene(home, tmp_path / "no" / "folder.glb")


def test_a_failed_write_leaves_the_old_file(home: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "home.glb"
    path.write_bytes(b"precious")

    def full_disk(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[:100])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(InputError, match=r"(?s)No space left.*H3-SCENE-051"):
        save_scene(home, path)
    assert path.read_bytes() == b"precious"
    assert [p.name for p in tmp_path.iterdir()] == ["home.glb"]


@pytest.mark.parametrize("bad", ["pose", "vertices", "source"])
def test_what_cannot_be_stored_is_refused(home: Scene, bad: str):
    first = home.instances[0]
    asset = home.assets[first.asset]
    if bad == "pose":
        wrong = replace(home, instances=(replace(first, pose=np.full(7, np.nan)), *home.instances[1:]))
    elif bad == "vertices":
        vertices = asset.mesh.vertices.copy()
        vertices[0, 0] = np.inf
        wrong = replace(
            home, assets={**home.assets, first.asset: replace(asset, mesh=replace(asset.mesh, vertices=vertices))}
        )
    else:
        wrong = replace(home, source={"when": object()})
    with pytest.raises(SceneError, match=r"H3-SCENE-0(49|50)"):
        scene_bytes(wrong)
