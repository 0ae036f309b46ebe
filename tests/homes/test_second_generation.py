"""Homes of the second generation: styles, kinds of rooms, clutter, and what must stay as it is in the first."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from h3data.errors import InputError, SceneError
from h3data.recording.assets.scenes import categories_of
from h3data.scene import Scene, scene_digest
from h3data.scene.kinds import CATEGORIES, KINDS
from h3data.scene.open import named_scenes, open_scene
from h3data.scene.scene_sets import builtin_sets, find_scene_set
from h3data_homes import HomeSpec, build_home
from h3data_homes.check import faults
from h3data_homes.layout import Layout, plan_layout
from h3data_homes.spec import seed_look

SPEC = HomeSpec(seed=1, generation=2)


@cache
def home(spec: HomeSpec) -> Scene:
    return build_home(spec)


def layout_of(spec: HomeSpec) -> Layout:
    """The first plan that succeeds, as in `build_home`."""
    for attempt in range(12):
        with suppress(SceneError):
            return plan_layout(spec, attempt)
    raise AssertionError(spec)


def movable(scene: Scene) -> int:
    return sum(i.motion == "kinematic" for i in scene.instances)


# --- the spec ---------------------------------------------------------------------------------------------------------
def test_the_same_spec_gives_the_same_bytes_and_is_found_again_in_the_source():
    scene = home(SPEC)
    assert scene_digest(build_home(SPEC)) == scene_digest(scene)
    fields = {name: value for name, value in scene.source.items() if name != "kind"}
    assert fields["style"] == SPEC.look
    assert scene_digest(build_home(HomeSpec(**fields))) == scene_digest(scene)


def test_the_first_generation_knows_nothing_of_the_second():
    assert HomeSpec(seed=1).changes == {}
    assert HomeSpec(seed=1).look is None
    assert set(home(HomeSpec(seed=1)).source) == {"kind", "preset", "seed"}
    assert categories_of(home(HomeSpec(seed=1))) == list(CATEGORIES)


def test_wrong_generations_and_styles_are_refused():
    for wrong in ({"generation": 3}, {"generation": 0}, {"generation": 1.5}):
        with pytest.raises(InputError, match=r"(?s)generation.*H3-SCENE-028"):
            HomeSpec(**wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"(?s)nordic.*H3-SCENE-029"):
        HomeSpec(generation=2, style="baroque")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="H3-SCENE-029"):
        HomeSpec(style="nordic")


def test_seeds_choose_all_styles():
    assert len({seed_look(seed) for seed in range(100)}) == 8


def test_a_style_changes_looks_and_not_places():
    other = "rustic" if SPEC.look != "rustic" else "nordic"
    a, b = home(SPEC), home(replace(SPEC, style=other))
    assert scene_digest(a) != scene_digest(b)
    fixed = [[(i.name, i.pose.tobytes()) for i in s.static_instances] for s in (a, b)]
    assert [n for n, _ in fixed[0]] == [n for n, _ in fixed[1]]
    assert fixed[0] == fixed[1]


@pytest.mark.slow
def test_clutter_changes_only_the_small_things():
    bare, full = home(replace(SPEC, clutter=0.0)), home(replace(SPEC, clutter=2.0))
    assert movable(bare) == 0
    assert movable(full) > 1.3 * movable(home(SPEC)) > 20
    assert [i.pose.tobytes() for i in bare.static_instances] == [i.pose.tobytes() for i in full.static_instances]


# --- the home ---------------------------------------------------------------------------------------------------------
def test_everything_is_of_a_kind_with_its_id():
    scene = home(SPEC)
    for instance in scene.instances:
        category = scene.assets[instance.asset].category
        assert instance.semantic_id == KINDS[category].semantic_id
        assert (instance.motion == "kinematic") == (KINDS[category].role == "thing"), instance.name
    assert {scene.assets[i.asset].category for i in scene.instances} <= set(categories_of(scene))


@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_things_do_not_float_overlap_or_block(seed: int):
    from h3data_pipelines.assets.scene_reports import validate_scene

    (named,) = named_scenes(f"small2:{seed}")
    assert not validate_scene(named)["problems"]
    assert not faults(open_scene(named.source))


def test_new_kinds_of_rooms_and_an_open_plan():
    layout = layout_of(HomeSpec(seed=0, preset="medium", area_m2=210, bedrooms=4, bathrooms=2, generation=2))
    kinds = {room.category for room in layout.rooms}
    assert {"child", "office", "laundry", "garage"} <= kinds
    beams = [o for o in layout.openings if o.kind == "wide" and len(o.rooms) == 2 and o.span[1] - o.span[0] > 2.6]
    assert beams


def test_rooms_of_large_homes_are_not_equal():
    areas = np.array([room.area for room in layout_of(HomeSpec(seed=0, preset="large", generation=2)).rooms])
    assert areas.max() > 5 * np.median(areas)
    assert np.median(areas) < 30


# --- the set ----------------------------------------------------------------------------------------------------------
def test_the_set_has_as_many_homes_as_the_first():
    assert builtin_sets()["h3-homes-v2"] == ("train", "val", "test")
    for split in ("train", "val", "test"):
        first, second = find_scene_set(f"h3-homes/{split}"), find_scene_set(f"h3-homes-v2/{split}")
        assert first is not None
        assert second is not None
        assert len(first.scenes) == len(second.scenes)
        assert all(isinstance(e.source, HomeSpec) and e.source.generation == 2 for e in second.scenes)
        assert first.social_nav == second.social_nav


@pytest.mark.slow
@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_episodes_of_both_tasks_can_be_sampled_in_every_home(split: str):
    from h3data_pipelines.assets.scene_reports import validate_scene
    from h3data_pipelines.assets.set_episodes import set_episode
    from sim_kinematic.tasks.rearrange.task import Rearrange
    from sim_kinematic.tasks.sources import EpisodeSource

    scenes = find_scene_set(f"h3-homes-v2/{split}")
    assert scenes is not None
    for named, entry in zip(named_scenes(f"h3-homes-v2/{split}"), scenes.scenes, strict=True):
        assert not validate_scene(named)["problems"], named.name
        set_episode(scenes, entry, 0)
        EpisodeSource(Rearrange(), [open_scene(entry.source)]).sample(0, 0)  # as jobs do, which try again
