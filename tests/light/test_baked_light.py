"""Baked light: where it falls, what it leaves alone, its cache, and scenes that it cannot light."""

from __future__ import annotations

import json
import logging
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from h3data.files import evict
from h3data.geometry import IDENTITY_POSE
from h3data.mesh.mesh import Mesh
from h3data.mesh.primitives import box_mesh
from h3data.render import Renderer, RenderInstance, RenderScene, look_at, pinhole
from h3data.render.light.sources import Lamp, LightSources, sources_of
from h3data.scene import Asset, Instance, LightSource, Scene
from h3data.scene.records import instance_matrix
from h3data_habitat.scenes.config_keys import KeyNotes
from h3data_habitat.scenes.lights import read_lights
from h3data_homes import HomeSpec, build_home
from h3data_light.bake import LitScene, lit_scene
from h3data_light.outdoors import EYE_M, outdoors, with_view


@pytest.fixture(autouse=True)
def _no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("H3DATA_CACHE", "off")


def _quad(*corners: tuple[float, float, float]) -> Mesh:
    return Mesh(
        vertices=np.array(corners, np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        colors=np.full((4, 3), 180, np.uint8),
    )


def _two_rooms() -> tuple[list[Mesh], list[RenderInstance]]:
    """A closed box, 6 x 2.5 x 3 m, cut in two by a wall at x = 3."""
    boxes = {
        "floor": ((-0.1, -0.1, -0.1), (6.1, 0.0, 3.1)),
        "ceiling": ((-0.1, 2.5, -0.1), (6.1, 2.6, 3.1)),
        "left": ((-0.1, 0.0, 0.0), (0.0, 2.5, 3.0)),
        "right": ((6.0, 0.0, 0.0), (6.1, 2.5, 3.0)),
        "back": ((-0.1, 0.0, -0.1), (6.1, 2.5, 0.0)),
        "front": ((-0.1, 0.0, 3.0), (6.1, 2.5, 3.1)),
        "between": ((2.94, 0.0, 0.0), (3.06, 2.5, 3.0)),
    }
    meshes, instances = [], []
    for name, (low, high) in boxes.items():
        size, center = np.subtract(high, low), np.add(low, high) / 2
        matrix = np.eye(4)
        matrix[:3, 3] = center
        instances.append(RenderInstance(mesh=len(meshes), matrix=matrix, name=name))
        meshes.append(box_mesh(size / 2))
    return meshes, instances


def _lit(sources: LightSources) -> LitScene:
    meshes, instances = _two_rooms()
    return lit_scene(meshes, instances, range(len(instances)), sources)


def _brightness(lit: LitScene, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """How bright the floor looks at points [N, 2] (x, z), 0 to 255, shape [N]."""
    renderer = Renderer(RenderScene(lit.meshes, lit.instances), light=replace(lit.light, occlusion=0.0))
    out = []
    for x, z in points:
        above = look_at(np.array([x, 1.0, z]), np.array([x, 0.0, z]), up=(0.0, 0.0, -1.0))
        picture = renderer.render(pinhole(8, 8, hfov_deg=3, pose=above), outputs=("rgb",))["rgb"]
        out.append(picture.mean())
    return np.array(out)


LAMP = LightSources(lamps=(Lamp(np.array([1.5, 2.2, 1.5]), np.full(3, 4.0)),))


def test_a_lamp_lights_its_room_and_not_the_one_behind_the_wall() -> None:
    lit = _lit(LAMP)
    assert lit.baked
    under, beside, behind, wall_base = _brightness(lit, np.array([[1.5, 1.5], [0.3, 0.3], [4.5, 1.5], [3.2, 1.5]]))
    assert under > beside > 1.5 * behind
    assert wall_base < 1.2 * behind  # no light leaks under the wall


def test_moving_things_keep_the_flat_light_unless_the_field_tints_them() -> None:
    meshes, instances = _two_rooms()
    thing = RenderInstance(
        mesh=len(meshes), matrix=np.eye(4) + np.pad([[4.5], [1.0], [1.5]], ((0, 1), (3, 0))), name="cup"
    )
    meshes, instances = [*meshes, box_mesh((0.2, 0.2, 0.2))], [*instances, thing]
    lit = lit_scene(meshes, instances, range(7), LAMP)
    camera = pinhole(64, 64, hfov_deg=20, pose=look_at(np.array([4.5, 1.2, 2.9]), np.array([4.5, 1.0, 1.5])))
    plain = Renderer(RenderScene(meshes, instances)).render(camera, outputs=("rgb",))["rgb"][32, 32]
    baked = Renderer(RenderScene(lit.meshes, lit.instances), light=lit.light).render(camera, outputs=("rgb",))
    assert np.abs(plain.astype(int) - baked["rgb"][32, 32]).max() <= 3
    assert lit.field is not None
    renderer, members = Renderer(RenderScene(lit.meshes, lit.instances), light=lit.light), np.array([-1] * 7 + [0])
    capsule = np.array([[4.5, 1.0, 1.4, 4.5, 1.0, 1.6, 0.2]])
    renderer.set_blockers(lit.field.blockers(capsule, np.zeros(1, int), members=members))
    dark = renderer.render(camera, outputs=("rgb",))["rgb"][32, 32]
    assert dark.mean() < 0.8 * plain.mean()  # behind the wall, where no lamp is


def test_surfaces_ids_and_depth_stay() -> None:
    meshes, instances = _two_rooms()
    lit = lit_scene(meshes, instances, range(7), LAMP)
    camera = pinhole(160, 120, hfov_deg=80, pose=look_at(np.array([0.5, 1.6, 0.5]), np.array([2.5, 0.8, 2.5])))
    outputs = ("depth", "instance", "normal")
    before = Renderer(RenderScene(meshes, instances)).render(camera, outputs=outputs)
    after = Renderer(RenderScene(lit.meshes, lit.instances)).render(camera, outputs=outputs)
    np.testing.assert_allclose(after["depth"], before["depth"], atol=1e-4)
    assert (after["instance"] == before["instance"]).mean() > 0.999
    assert (np.abs(after["normal"] - before["normal"]).max(-1) < 1e-4).mean() > 0.999


def test_without_light_a_scene_is_flat_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    meshes, instances = _two_rooms()
    with caplog.at_level(logging.WARNING):
        lit = lit_scene(meshes, instances, range(7), LightSources(), name="the cellar")
    assert not lit.baked
    assert lit.field is None
    assert lit.mirrors == {}
    assert lit.meshes == meshes
    (message,) = [r.message for r in caplog.records]
    assert "No light reaches the cellar" in message
    assert "flat" in message


def test_one_open_mesh_is_lit_from_outdoors() -> None:
    stage = _quad((0, 0, 0), (0, 0, 4), (4, 0, 4), (4, 0, 0))
    for faces in (stage.faces, stage.faces[:, ::-1].copy()):
        mesh = replace(stage, faces=faces)
        lit = lit_scene([mesh], [RenderInstance(mesh=0, matrix=np.eye(4))], [0], LightSources())
        assert lit.baked
        camera = pinhole(32, 32, hfov_deg=40, pose=look_at(np.array([2.0, 3.0, 2.1]), np.array([2.0, 0.0, 2.0])))
        picture = Renderer(RenderScene(lit.meshes, lit.instances), light=lit.light).render(camera, outputs=("rgb",))
        assert picture["rgb"][8:24, 8:24].min() > 60
        assert lit.field is not None
        renderer = Renderer(RenderScene(lit.meshes, lit.instances), light=lit.light)
        ball = np.array([[2.0, 0.2, 2.0, 2.0, 0.2, 2.0, 0.2]])
        renderer.set_blockers(lit.field.blockers(ball, np.zeros(1, int), members=np.full(1, -1)))
        shadowed = renderer.render(camera, outputs=("rgb",))["rgb"]
        assert shadowed[16, 16].mean() < 0.8 * picture["rgb"][16, 16].mean()


@pytest.mark.parametrize(
    ("light", "fault"),
    [
        ({"intensity": float("nan")}, "not finite"),
        ({"intensity": -2.0}, "negative power"),
        ({"color": np.array([1.0, -1.0, 1.0])}, "negative power"),
        ({"frame": "camera"}, "moves with the camera"),
    ],
)
def test_a_light_that_cannot_be_used_is_named_and_left_out(
    light: dict, fault: str, caplog: pytest.LogCaptureFixture
) -> None:
    bad = replace(
        LightSource(name="bulb 7", kind="point", vector=np.zeros(3), color=np.ones(3), intensity=1.0), **light
    )
    good = LightSource(name="good", kind="point", vector=np.array([1.0, 2.0, 1.0]), color=np.ones(3), intensity=3.0)
    box = Asset(name="box", mesh=box_mesh((1, 1, 1)))
    scene = Scene(
        name="s",
        assets={"box": box},
        instances=(Instance(name="b", asset="box", pose=IDENTITY_POSE),),
        lights=(bad, good),
    )
    with caplog.at_level(logging.WARNING):
        sources = sources_of(scene, file="home.scene_instance.json")
    assert len(sources.lamps) == 1
    (message,) = [r.message for r in caplog.records]
    assert "'bulb 7'" in message
    assert fault in message
    assert "home.scene_instance.json" in message


def test_lights_of_habitats_files_light_a_scene(real: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = real / (
        "habitat-sim/data/test_assets/dataset_tests/dataset_0/lights/dataset_test_lights.lighting_config.json"
    )
    lights = read_lights(json.loads(path.read_text()), KeyNotes(), where=path)
    meshes, instances = _two_rooms()
    with caplog.at_level(logging.WARNING):
        sources = sources_of(Scene(name="s", assets={}, instances=(), lights=lights), file=str(path))
    assert (len(sources.lamps), len(sources.suns)) == (6, 1)
    assert len(caplog.records) == 5  # Habitat takes light away by negative lamps
    inside = replace(sources, lamps=sources.lamps[2:3])  # at (0.35, 0.5, 3.5) there; here within the left room
    moved = replace(inside, lamps=(replace(inside.lamps[0], position=np.array([0.35, 0.5, 1.0])),))
    lit = lit_scene(meshes, instances, range(len(instances)), moved)
    near, behind = _brightness(lit, np.array([[0.6, 1.0], [4.5, 1.0]]))
    assert near > 1.5 * behind


def test_a_home_is_lit_through_its_windows_within_the_limits() -> None:
    home = build_home(HomeSpec(preset="small", seed=7))
    sources = sources_of(home)
    assert len(sources.windows) == 6
    assert sources.glass
    assert sources.glowing


def test_the_light_is_cached_and_a_broken_file_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path))
    first = _lit(LAMP)
    (file,) = (tmp_path / "light").iterdir()
    written = file.read_bytes()
    monkeypatch.setattr("h3data_light.bake.bake", lambda *_: pytest.fail("computed again"))
    again = _lit(LAMP)
    for one, other in zip(first.meshes, again.meshes, strict=True):
        np.testing.assert_array_equal(one.colors, other.colors)
        np.testing.assert_array_equal(one.faces, other.faces)
    assert first.field is not None
    assert again.field is not None
    for name, value in vars(first.field).items():
        np.testing.assert_array_equal(getattr(again.field, name), value)
    monkeypatch.undo()
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path))
    file.write_bytes(written[:1000])
    with caplog.at_level(logging.WARNING):
        _lit(LAMP)
    assert "broken" in caplog.text
    assert file.read_bytes() == written


def test_the_cache_keeps_what_was_used_last_and_drops_what_killed_processes_left(tmp_path: Path) -> None:
    for age, name in enumerate(("newest.npz", "older.npz", "oldest.npz", "killed.npz.1-ab.part")):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    (tmp_path / "others.npz.2-cd.part").write_bytes(b"")
    evict(tmp_path, 250, keep=tmp_path / "oldest.npz")
    assert {p.name for p in tmp_path.iterdir()} == {"oldest.npz", "newest.npz", "others.npz.2-cd.part"}


def test_panes_show_the_outdoors_with_the_horizon_at_eye_height() -> None:
    home = build_home(HomeSpec(preset="small", seed=7))
    name = min(sources_of(home).glass)
    window = next(i for i in home.static_instances if i.name == name)
    before = home.assets[window.asset].mesh
    after = with_view(before, instance_matrix(window), floor_y=0.0, shown=0.6)
    assert len(after.faces) == len(before.faces)
    assert after.textures == (outdoors(),)
    assert after.face_textures is not None
    assert after.uv is not None
    panes = after.vertices[after.faces[after.face_textures == 0]]
    uv = after.uv[after.faces[after.face_textures == 0]]
    assert np.ptp(panes[..., 1]) > 0.5
    place = instance_matrix(window)[1, 3] + panes[..., 1]
    np.testing.assert_allclose((0.5 - uv[..., 1]) * 4.5, place - EYE_M, atol=1e-4)
    pixels = outdoors().pixels.astype(int)
    assert (pixels[10, :, 2] > pixels[10, :, 1]).all()  # the sky is blue
    assert (pixels[-60, :, 1] > pixels[-60, :, 2]).all()  # the lawn is green
    assert np.abs(pixels[:, 0] - pixels[:, -1]).max() < 40  # it repeats without a seam
