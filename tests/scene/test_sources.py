"""Scenes of packages: generators and readers that are installed, and packages that are not."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import h3data
from h3data.errors import FormatError, InputError, SceneError
from h3data.scene import save_scene, scene_digest
from h3data.scene.open import named_scenes, open_scene
from h3data.scene.scene_sets import read_scene_set
from h3data.scene.sources import SCENES, SceneFile, object_mesh
from h3data_habitat.episodes.scenes import recorded_spec
from h3data_homes import HomeSpec, build_home

LIFTED = """
from dataclasses import dataclass
from typing import ClassVar
import msgspec
from h3data.scene import load_scene
from h3data_homes import HomeSpec, build_home
from h3data.scene.sources import SceneGenerator, SceneReader

@dataclass(frozen=True)
class Spec:
    kind: ClassVar[str] = "lifted"
    floor: int = 0

class Table(msgspec.Struct, forbid_unknown_fields=True):
    id: str
    floor: int = 0

GENERATOR = SceneGenerator(names=("lift",), named=lambda name, seed: Spec(floor=seed), Spec=Spec, Table=Table,
                           build=lambda spec: build_home(HomeSpec(seed=spec.floor)))
READER = SceneReader(endings=(".lift", ".lifts"), read=lambda file: load_scene(file.path.removesuffix("s") + file.scene),
                     collection=".lifts", scenes_in=lambda path: path.read_text().split(), open_collection=str)
"""


@pytest.fixture
def lifted(install_package) -> None:
    install_package("lifted", "h3data.scenes", {"lifted": "lifted:GENERATOR", "lifts": "lifted:READER"}, LIFTED)


def test_a_generator_is_found_by_name_in_sets_and_in_what_a_scene_says(lifted: None, tmp_path: Path) -> None:
    (named,) = named_scenes("lift:7")
    assert named.name == "lift:7"
    assert [n.name for n in named_scenes("lift", homes=2)] == ["lift:0", "lift:1"]
    assert recorded_spec({"kind": "lifted", "floor": 7}) == named.source
    file = tmp_path / "mine.toml"
    file.write_text('format = 1\nname = "mine"\nscenes = [{ id = "a", kind = "lifted", floor = 7 }]\n')
    assert read_scene_set(file).scenes[0].source == named.source
    file.write_text('format = 1\nname = "mine"\nscenes = [{ id = "a", kind = "lifted", seed = 7 }]\n')
    with pytest.raises(FormatError, match=r"(?s)scenes\[0\].*unknown key 'seed'.*Expected: id, floor.*H3-SCENE-058"):
        read_scene_set(file)
    file.write_text('format = 1\nname = "mine"\nscenes = [{ id = "a", kind = "habitat" }]\n')
    with pytest.raises(
        FormatError, match=r"(?s)expected a generator of scenes such as home, got 'habitat'.*H3-SCENE-058"
    ):
        read_scene_set(file)
    file.write_text('format = 1\nname = "mine"\nscenes = [{ id = "a", kind = "unknown_module:THING" }]\n')
    with pytest.raises(FormatError, match=r"(?s)using it would run the Python module unknown_module.*H3-SCENE-058"):
        read_scene_set(file)


def test_a_reader_opens_its_files_and_those_that_hold_several(lifted: None, tmp_path: Path) -> None:
    home = build_home(HomeSpec(seed=1))
    save_scene(home, tmp_path / "a.glb")
    (tmp_path / "a.glb").rename(tmp_path / "a.lift")
    (tmp_path / "a.lifts").write_text("one two")
    assert scene_digest(h3data.open(tmp_path / "a.lift")) == scene_digest(home)
    assert h3data.open(tmp_path / "a.lifts") == str(tmp_path / "a.lifts")
    assert [n.name[-6:] for n in named_scenes(str(tmp_path / "a.lifts"))] == ["ts#one", "ts#two"]
    (named,) = named_scenes(f"{tmp_path / 'a.lifts'}#one")
    assert named.source == SceneFile(path=str(tmp_path / "a.lifts"), scene="one")


def test_our_own_file_needs_no_reader_and_the_missing_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = build_home(HomeSpec(seed=1))
    save_scene(home, tmp_path / "home.glb")
    (tmp_path / "a.stage_config.json").write_text("{}")
    monkeypatch.setattr("h3data.plugins._is_there", lambda reference: False)
    monkeypatch.setattr("h3data.scene.sources.SCENES", type(SCENES)(SCENES.group, {}, what=SCENES.what))
    monkeypatch.setattr("sys.path", [*sys.path, str(tmp_path)])  # what is installed is looked up again
    assert scene_digest(h3data.open(tmp_path / "home.glb")) == scene_digest(home)
    assert named_scenes(str(tmp_path / "home.glb"))[0].source == SceneFile(path=str(tmp_path / "home.glb"))
    with pytest.raises(FormatError, match=r"(?s)lacks.*\(habitat\).*H3-SCENE-067"):
        open_scene(SceneFile(path=str(tmp_path / "a.stage_config.json")))
    with pytest.raises(SceneError, match=r"(?s)'chair'.*lacks.*\(habitat\).*H3-SCENE-066"):
        object_mesh("chair", tmp_path / "chair.object_config.json", ())
    with pytest.raises(InputError, match=r"(?s)'small:1'.*lacks.*\(home\).*H3-HABITAT-108"):
        named_scenes("small:1")
    with pytest.raises(InputError, match=r"(?s)kind of scenes 'home'.*H3-FILE-010"):
        open_scene(HomeSpec(seed=93))
