"""Scene sets: the shipped splits, the TOML format with its refusals, the names by which the command line finds scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bake.home_sets import set_text, updated_card
from h3data.builtin import builtin_root
from h3data.errors import FormatError, InputError
from h3data.scene import save_scene, scene_digest
from h3data.scene.open import named_scenes, open_scene
from h3data.scene.scene_sets import SceneSet, builtin_sets, find_scene_set, read_scene_set
from h3data.scene.sources import SceneFile
from h3data_habitat.exporters.scenes import export_habitat
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.assets.scene_reports import validate_scene
from h3data_training.episodes import listed_scenes

SPLITS = {"train": (37, 1000, 3.0), "val": (12, 100, 5.0), "test": (10, 15, 5.0)}
"""Homes, episodes in each (paper, appendix on scenes), least distance of the starts (appendix, social navigation)."""


def shipped(split: str) -> SceneSet:
    found = find_scene_set(f"h3-homes/{split}")
    assert found is not None
    return found


# --- what ships -------------------------------------------------------------------------------------------------------
def test_the_splits_have_the_sizes_of_the_paper() -> None:
    assert builtin_sets()["h3-homes"] == tuple(SPLITS)
    for split, (homes, episodes, apart) in SPLITS.items():
        scenes = shipped(split)
        assert (len(scenes.scenes), scenes.social_nav.episodes_per_scene) == (homes, episodes)
        assert scenes.episodes == homes * episodes
        assert scenes.social_nav.spawn_distance_m == apart
        assert scenes.label == f"h3-homes/{split}"


def test_no_home_is_in_two_splits() -> None:
    entries = [entry for split in SPLITS for entry in shipped(split).scenes]
    assert len(entries) == 59
    assert len({e.id for e in entries}) == 59
    assert all(isinstance(e.source, HomeSpec) for e in entries)
    seeds = [{e.source.seed for e in shipped(split).scenes if isinstance(e.source, HomeSpec)} for split in SPLITS]
    assert sum(map(len, seeds)) == len(set.union(*seeds)) == 59


def test_sizes_are_spread_in_every_split() -> None:
    for split in SPLITS:
        areas = sorted(e.source.program.area_m2 for e in shipped(split).scenes if isinstance(e.source, HomeSpec))
        assert areas[0] < 80
        assert areas[-1] > 800
        assert areas[len(areas) // 2] == pytest.approx(190, abs=40)


def test_the_files_are_as_the_script_writes_them() -> None:
    for split in SPLITS:
        file = builtin_root() / "h3-homes" / f"{split}.toml"
        assert set_text(shipped(split)) == file.read_text()


def test_the_card_names_every_home() -> None:
    card = (builtin_root() / "h3-homes" / "README.md").read_text()
    for split in SPLITS:
        for entry in shipped(split).scenes:
            assert f"| {entry.id} |" in card
    assert updated_card(card, {"splits": "A", "homes": "B"}).count("\nA\n<!-- end -->") == 1


@pytest.mark.slow
@pytest.mark.parametrize("split", SPLITS)
def test_all_homes_are_sound(split: str) -> None:
    reports = [validate_scene(named) for named in named_scenes(f"h3-homes/{split}")]
    assert [(r["scene"], r["problems"]) for r in reports if r["problems"]] == []


# --- episodes by number -----------------------------------------------------------------------------------------------
def test_episodes_go_round_the_scenes() -> None:
    scenes = shipped("test")
    places = [scenes.place(i) for i in range(scenes.episodes)]
    assert len({(entry.id, index) for entry, index in places}) == 150
    assert {index for _, index in places} == set(range(15))
    assert len({entry.id for entry, _ in places[:10]}) == 10


def test_seeds_of_episodes_are_fixed_and_differ() -> None:
    """Changing them would change every episode of every set: the first one is written down here."""
    assert shipped("test").episode_seed("test_00", 0) == 7187913866969587865
    seeds = {
        scenes.episode_seed(entry.id, index, seed=seed)
        for scenes in map(shipped, SPLITS)
        for entry in scenes.scenes
        for index in range(20)
        for seed in (0, 1)
    }
    assert len(seeds) == 59 * 20 * 2
    assert all(0 <= s < 2**63 for s in seeds)


# --- the TOML format --------------------------------------------------------------------------------------------------
GOOD = """
format = 1
name = "mine"
scenes = [
  { id = "a", seed = 3 },
  { id = "b", seed = 4, preset = "medium", area_m2 = 150, clutter = 2 },
]
"""


def written(folder: Path, text: str) -> Path:
    file = folder / "mine.toml"
    file.write_text(text)
    return file


def test_a_set_of_ones_own(tmp_path: Path) -> None:
    scenes = read_scene_set(written(tmp_path, GOOD))
    assert scenes.label == "mine"
    assert [e.source for e in scenes.scenes] == [
        HomeSpec(seed=3),
        HomeSpec(seed=4, preset="medium", area_m2=150.0, clutter=2.0),
    ]
    assert scenes.social_nav.spawn_distance_m == 5.0
    assert scenes.entry("1").id == scenes.entry("b").id == "b"
    assert scenes.sha256 != read_scene_set(written(tmp_path, GOOD + "# more")).sha256


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            ("seed = 3", "seed = 3, colour = 'red'"),
            r"(?s)scenes\[0\]: unknown key 'colour'\. Expected: id, seed, preset.*H3-SCENE-058",
        ),
        (("seed = 3", "seed = '3'"), r"(?s)scenes\[0\]: Expected 'int', got 'str' - at 'seed'.*H3-SCENE-058"),
        (('id = "a", seed', "seed"), r"(?s)scenes\[0\]: missing field 'id'.*H3-SCENE-058"),
        (('id = "a"', 'id = "b"'), r"(?s)the id 'b' occurs 2 times.*H3-SCENE-058"),
        (('id = "a"', 'id = "../a"'), r"(?s)scenes\[0\]: id: expected letters.*H3-SCENE-058"),
        (("seed = 3", "seed = -3"), r"(?s)scenes\[0\]: The seed of a home must be a whole number >= 0.*H3-SCENE-058"),
        (("area_m2 = 150", "area_m2 = 9"), r"(?s)scenes\[1\]: area_m2 of a home must be.*H3-SCENE-058"),
        (("seed = 3", "file = 'no.glb'"), r"(?s)scenes\[0\]: file: no such file: 'no\.glb'.*H3-SCENE-058"),
        (
            ("seed = 3", "file = '../mine.toml'"),
            r"(?s)scenes\[0\]: file: the path must not leave the folder.*H3-SCENE-058",
        ),
        (("seed = 3", "file = 'x/../../mine.toml'"), r"(?s)must not leave the folder.*H3-SCENE-058"),
        (("seed = 3", "file = 3"), r"(?s)scenes\[0\]: Expected 'str', got 'int' - at 'file'.*H3-SCENE-058"),
        (
            ("seed = 3", "file = 'mine.toml', seed = 3"),
            r"(?s)scenes\[0\]: unknown key 'seed'\. Expected: id, file.*H3-SCENE-058",
        ),
        (("format = 1", "format = 2"), r"(?s)format: expected 1, got 2.*H3-SCENE-058"),
        (("format = 1\n", ""), r"(?s)missing field 'format'.*H3-SCENE-063"),
        (
            ("format = 1", "format = 1\nweather = 'fine'"),
            r"(?s)unknown key 'weather'\. Expected: format, name, scenes.*H3-SCENE-063",
        ),
        (('"mine"', '"a/b"'), r"(?s)expected words without '/'.*H3-SCENE-058"),
        (("scenes = [", "scenes = 3 #"), "H3-SCENE-063"),
        (("name =", "name"), "(?s)mine.toml.*H3-SCENE-063"),
        (("]", "]\n[social_nav]\nepisodes = 3"), r"(?s)unknown key 'episodes' - at 'social_nav'.*H3-SCENE-063"),
        (
            ("]", "]\n[social_nav]\nepisodes_per_scene = 0"),
            r"(?s)social_nav\.episodes_per_scene: expected at least 1.*H3-SCENE-058",
        ),
        (
            ("]", "]\n[social_nav]\nspawn_distance_m = nan"),
            r"(?s)social_nav\.spawn_distance_m: expected a distance.*H3-SCENE-058",
        ),
    ],
)
def test_faults_are_named_with_file_and_key(tmp_path: Path, change: tuple[str, str], words: str) -> None:
    assert change[0] in GOOD
    with pytest.raises(FormatError, match=words) as fault:
        read_scene_set(written(tmp_path, GOOD.replace(*change)))
    assert "mine.toml" in str(fault.value)
    assert "\n" not in str(fault.value)
    assert "$" not in str(fault.value)


def test_all_faults_of_a_file_are_said_at_once(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"(?s)format.*scenes\[0\].*scenes\[1\].*H3-SCENE-058"):
        read_scene_set(written(tmp_path, GOOD.replace("format = 1", "format = 7").replace("seed =", "sed =")))
    with pytest.raises(FormatError, match=r"(?s)at least one.*H3-SCENE-058"):
        read_scene_set(written(tmp_path, 'format = 1\nname = "x"\nscenes = []'))


@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_any_bytes_are_a_set_or_a_format_error(tmp_path_factory: Any, data: bytes) -> None:
    file = tmp_path_factory.mktemp("set") / "x.toml"
    file.write_bytes(data)
    with pytest.raises(FormatError):
        read_scene_set(file)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)No such file.*H3-SCENE-062"):
        find_scene_set(str(tmp_path / "none.toml"))


# --- scenes by name ---------------------------------------------------------------------------------------------------
def test_names() -> None:
    assert [s.name for s in named_scenes("small", homes=2)] == ["small:0", "small:1"]
    assert named_scenes("medium:7")[0].source == HomeSpec(preset="medium", seed=7)
    test = named_scenes("h3-homes/test")
    assert [s.name for s in test[:2]] == ["h3-homes/test#0", "h3-homes/test#1"]
    assert named_scenes("h3-homes/test#3") == named_scenes("h3-homes/test#test_03") == (test[3],)
    for bad, words in (
        ("castle", "H3-HABITAT-108"),
        ("h3-homes", r"(?s)h3-homes/train or h3-homes/val or h3-homes/test.*H3-SCENE-057"),
        ("h3-homes/dev", "H3-SCENE-057"),
        ("h3-homes/test#10", r"(?s)10: 0.*9.*test_00.*H3-SCENE-056"),
        ("h3-homes/test#", r"(?s)''.*H3-SCENE-056"),
        ("small:", "H3-HABITAT-108"),
        ("small:-1", r"(?s)small:3.*H3-SCENE-068"),
    ):
        with pytest.raises(InputError, match=words):
            named_scenes(bad)


def test_several_names() -> None:
    both = listed_scenes("h3-homes/train, h3-homes-v2/train")
    assert both == (*named_scenes("h3-homes/train"), *named_scenes("h3-homes-v2/train"))
    assert listed_scenes("medium:7") == named_scenes("medium:7")
    for bad, words in (
        ("small:1,castle", r"(?s)'castle'.*H3-HABITAT-108"),
        ("small:1,", r"(?s)''.*H3-HABITAT-108"),
        ("h3-homes/test,small:1,h3-homes/test#test_03", r"(?s)h3-homes/test\#3.*H3-HABITAT-109"),
    ):
        with pytest.raises(InputError, match=words):
            listed_scenes(bad)


def test_a_path_may_have_a_comma(tmp_path: Path) -> None:
    path = tmp_path / "one, two.glb"
    save_scene(build_home(HomeSpec(seed=2)), path)
    assert [named.name for named in listed_scenes(str(path))] == [str(path)]


def test_scenes_in_files(tmp_path: Path) -> None:
    """Our GLB, a Habitat scene instance and a Habitat dataset, by path and in a set."""
    home = build_home(HomeSpec(seed=2))
    save_scene(home, tmp_path / "home.glb")
    config = export_habitat(home, tmp_path / "habitat")
    text = f"""
        format = 1
        name = "files"
        scenes = [
          {{ id = "ours", file = "home.glb" }},
          {{ id = "theirs", file = "habitat/scenes/{home.name}.scene_instance.json" }},
          {{ id = "dataset", file = "habitat/{config.name}", scene = "{home.name}" }},
          {{ id = "whole", file = "{(tmp_path / "home.glb").as_posix()}" }},
        ]"""
    ours, theirs, dataset, whole = named_scenes(str(written(tmp_path, text)))
    assert ours.source == whole.source == SceneFile(path=str(tmp_path / "home.glb"))
    assert scene_digest(open_scene(ours.source)) == scene_digest(home)
    assert len(open_scene(theirs.source).instances) == len(open_scene(dataset.source).instances) > 20
    assert named_scenes(str(tmp_path / "home.glb"))[0].source == ours.source
    assert open_scene(ours.source) is open_scene(ours.source)


def test_homes_that_open_are_those_of_the_second_generation() -> None:
    for split in ("train", "val", "test"):
        second, opening = find_scene_set(f"h3-homes-v2/{split}"), find_scene_set(f"h3-homes-open/{split}")
        assert second is not None
        assert opening is not None
        assert opening.social_nav.episodes_per_scene == 20
        assert [(e.id, e.source) for e in opening.scenes] == [
            (e.id, replace(e.source, articulated=True))
            for e in second.scenes  # type: ignore[type-var]
        ]


def test_large_homes_begin_where_the_middle_of_the_others_ends() -> None:
    assert builtin_sets()["h3-homes-large"] == ("train", "val", "test")
    for split in ("train", "val", "test"):
        first, large = find_scene_set(f"h3-homes/{split}"), find_scene_set(f"h3-homes-large/{split}")
        assert first is not None
        assert large is not None
        assert len(first.scenes) == len(large.scenes)
        assert first.social_nav == large.social_nav
        homes = [entry.source for entry in large.scenes]
        assert all(isinstance(home, HomeSpec) and home.generation == 1 for home in homes)
        areas = [home.area_m2 for home in homes if isinstance(home, HomeSpec)]
        assert areas == sorted(areas)
        assert min(areas) >= 136
        assert max(areas) == 846.0
    seeds = {
        name: {e.source.seed for split in splits for e in find_scene_set(f"{name}/{split}").scenes}  # type: ignore[union-attr]
        for name, splits in builtin_sets().items()
        if name != "h3-homes-open"
    }
    assert len(set().union(*seeds.values())) == sum(map(len, seeds.values())) == 59 * len(seeds)
