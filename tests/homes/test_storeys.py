"""Homes with two storeys: both furnished, beside each other in the plan, joined by one flight of stairs."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from h3data.errors import InputError
from h3data.recording.assets.scenes import categories_of
from h3data.scene import FreeSpace, instance_bounds, scene_digest
from h3data.scene.articulation import joints_of
from h3data.scene.kinds import KINDS
from h3data.scene.open import named_scenes, open_scene
from h3data_homes import HomeSpec, build_home
from h3data_homes.storeys.plan import GOING_M, RISE_M, RISERS, STOREY_M
from h3data_pipelines.validation.scenes import find_problems, free_space_for_validation
from tests import storeys


def test_a_home_with_storeys_has_a_name_and_is_the_same_each_time() -> None:
    (named,) = named_scenes("small2-storeys:3")
    assert named.source == storeys.SPEC
    assert scene_digest(open_scene(named.source)) == scene_digest(storeys.home())
    assert storeys.home().source["storeys"] == 2
    assert "storeys" not in repr(HomeSpec(seed=3, generation=2))


@pytest.mark.parametrize("wrong", [{"storeys": 2}, {"storeys": 3, "generation": 2}, {"storeys": 0}, {"storeys": 1.5}])
def test_other_numbers_of_storeys_are_refused(wrong) -> None:
    with pytest.raises(InputError, match=r"(?s)storeys.*H3-SCENE-0(28|30)"):
        HomeSpec(**wrong)
    with pytest.raises(InputError, match="H3-SCENE-030"):
        HomeSpec(preset="large", generation=2, storeys=2)


def test_no_two_rooms_share_any_floor() -> None:
    boxes = [shapely.box(*r) for room in storeys.home().rooms for r in room.rectangles]
    assert np.isclose(shapely.union_all(boxes).area, sum(b.area for b in boxes))
    levels = {room.floor_y for room in storeys.home().rooms}
    assert levels == {0.0, STOREY_M}


def test_stairs_are_as_people_build_them() -> None:
    room, ramp = storeys.stairs(), storeys.stairs().ramp
    assert ramp is not None
    assert (RISE_M, GOING_M, ramp.steps) == (0.17, 0.28, RISERS)
    assert np.isclose(abs(ramp.end - ramp.start), RISERS * GOING_M)
    x0, z0, x1, z1 = storeys.flight()
    width = storeys.floor().signed_distance([[(x0 + x1) / 2, (z0 + z1) / 2]])[0] * 2
    assert 0.9 <= width <= 1.15  # between the handrails
    assert (storeys.floor().treads_at([[x0, room.rectangles[0, 1]]]) >= 0).all()


def test_what_is_upstairs_is_upstairs() -> None:
    scene = storeys.home()
    upper = [i for i in scene.instances if i.name.startswith("upper_")]
    assert len(upper) > 50
    rooms = shapely.union_all([shapely.box(*r) for room in scene.rooms if room.floor_y for r in room.rectangles])
    for instance in upper:
        low, high = instance_bounds(scene, instance)
        assert low[1] > STOREY_M - 0.05, instance.name
        assert rooms.buffer(0.3).intersects(shapely.box(low[0], low[2], high[0], high[2])), instance.name


def test_every_thing_of_it_has_a_class() -> None:
    scene = storeys.home()
    assert {"stairs", "railing"} <= {a.category for a in scene.assets.values()}
    for instance in scene.instances:
        assert instance.semantic_id == KINDS[scene.assets[instance.asset].category].semantic_id, instance.name
    names = categories_of(scene)
    assert [KINDS[n].semantic_id for n in names] == sorted(KINDS[n].semantic_id for n in names)
    assert "stairs" not in categories_of(build_home(HomeSpec(seed=1, generation=2)))


@pytest.mark.slow
def test_furniture_opens_on_both_storeys() -> None:
    scene = build_home(HomeSpec(preset="medium", seed=1, generation=2, storeys=2, articulated=True))
    names = [thing.name for thing in scene.articulations]
    assert any(n.startswith("upper_") for n in names)
    assert any(not n.startswith("upper_") for n in names)
    joints = joints_of(scene)
    motions = joints.motions(np.array([[part.joint.opened for _, part in joints.parts]]))[0]
    handles = [(t, p) for t, p in joints.parts if p.handle is not None]
    assert np.isfinite(motions).all()
    assert {t.pose[1] >= STOREY_M for t, _ in handles} == {True, False}


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "seed"), [*(("small", k) for k in range(8)), *(("medium", k) for k in range(3))])
def test_every_home_is_sound_and_one_can_walk_everywhere(preset, seed) -> None:
    scene = build_home(HomeSpec(preset=preset, seed=seed, generation=2, storeys=2))
    assert not find_problems(scene, free_space_for_validation(scene))
    free = FreeSpace.from_scene(scene)
    assert free.island_areas[0] > 0.98 * free.polygon.area
