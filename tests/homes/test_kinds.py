"""Kinds of things: every one has a class, a mass, a grasp and a sound model; tables and ids agree."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.scene.kinds import CATEGORIES, KINDS, Kind
from h3data.scene.records import Box, Cylinder, Shape
from h3data_homes.kinds.kind import extent, furniture_of, grasp_point, thing_of
from h3data_homes.kinds.shapes import model_of
from h3data_homes.lived_in.habits import CHANCE, ON_FLOOR, ON_FURNITURE
from h3data_homes.lived_in.looks import LOOKS, thing_style
from h3data_homes.lived_in.rooms import EXTRAS, ON_WALL
from h3data_homes.spec import Look

MADE = [k for k in KINDS.values() if k.model]
made = pytest.mark.parametrize("kind", MADE, ids=lambda k: k.name)
LOOK: Look = "nordic"


def test_there_are_at_least_150_kinds_with_ids_of_their_own():
    assert len(KINDS) >= 150
    assert len({k.semantic_id for k in KINDS.values()}) == len(KINDS)
    assert {name: KINDS[name].semantic_id for name in CATEGORIES} == dict(CATEGORIES)
    assert all(name == kind.name for name, kind in KINDS.items())


def test_ids_of_recorded_images_stay():
    known = {
        "rocking_chair": 100,
        "flower_box": 152,
        "wall_clock": 180,
        "plate": 200,
        "toothbrush_cup": 300,
        "book_row": 400,
    }
    assert {name: KINDS[name].semantic_id for name in known} == known


def test_tables_name_kinds_that_exist():
    habits = [*ON_FURNITURE.values(), *ON_FLOOR.values()]
    things = {name for group in habits for habit in group for name in habit.kinds}
    assert {KINDS[name].role for name in things} == {"thing"}
    assert {KINDS[name].role for names in EXTRAS.values() for name in names} == {"furniture"}
    assert {KINDS[name].role for names in ON_WALL.values() for name, _ in names} == {"wall"}
    assert set(ON_FURNITURE) - {"sink"} <= set(KINDS)
    assert set(CHANCE) <= set(ON_FURNITURE)


def test_every_thing_is_left_about_somewhere():
    habits = [*ON_FURNITURE.values(), *ON_FLOOR.values()]
    used = {name for group in habits for habit in group for name in habit.kinds}
    unused = {k.name for k in MADE if k.role == "thing"} - used
    assert not unused


@made
def test_models_are_modest_and_stand_on_the_ground(kind: Kind):
    low, high = extent(kind)
    assert np.isfinite([low, high]).all()
    assert 0.002 < (high - low).max() < 2.3
    if kind.role == "furniture":
        assert abs(low[1]) < 0.015
    if kind.role == "wall":
        assert low[2] > -0.03  # nothing reaches into the wall
    mesh = thing_of(kind, np.random.default_rng(0), thing_style(LOOK), kind.name).mesh
    assert 10 < len(mesh.faces) <= (900 if kind.role == "thing" else 2200)
    assert mesh.faces.max() < len(mesh.vertices)
    assert mesh.normals is not None
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-3)


@made
def test_mass_and_grasp(kind: Kind):
    assert 0 < kind.mass_kg < 300
    low, high = extent(kind)
    point = grasp_point(kind)
    assert (point >= low - 0.03).all()
    assert (point <= high + 0.03).all()
    if kind.role == "thing" and kind.grasp == "none":
        assert kind.mass_kg > 1.5
    if kind.role == "furniture" and kind.mass_kg > 30:
        assert kind.grasp == "none"


def _box(shape: Shape) -> np.ndarray:
    if isinstance(shape, Box):
        half = shape.half_extents
    else:
        assert isinstance(shape, Cylinder)
        half = np.array([shape.radius, shape.half_height, shape.radius])
    return np.stack([shape.pose[:3] - half, shape.pose[:3] + half])


@pytest.mark.parametrize("kind", [k for k in MADE if model_of(k).surfaces], ids=lambda k: k.name)
def test_surfaces_are_free_above_and_held_from_below(kind: Kind):
    for seed in range(3):
        piece = furniture_of(kind, np.random.default_rng(seed), thing_style(LOOK))
        vertices = piece.asset("x").mesh.vertices
        for surface in piece.receptacles:
            x, y, z = surface.center
            a, b = surface.half_size
            assert surface.clearance_m > 0.1
            low, high = np.array([x - a, y + 0.003, z - b]), np.array([x + a, y + 0.1, z + b])
            for box in map(_box, piece.shapes):
                assert not ((box[0] < high - 1e-6) & (low < box[1] - 1e-6)).all(), surface.name
            near = np.abs(vertices[:, 1] - y) < 0.035
            assert near.any(), surface.name


@pytest.mark.parametrize("look", LOOKS)
def test_styles_differ_and_use_known_colours(look: Look):
    style = thing_style(look)
    others = [thing_style(other) for other in LOOKS if other != look]
    assert all((style.wood, style.fabric, style.accent) != (o.wood, o.fabric, o.accent) for o in others)


def test_a_kind_is_repeatable():
    for kind in MADE[::17]:
        first, again = (thing_of(kind, np.random.default_rng(5), thing_style(LOOK), "x").mesh for _ in range(2))
        np.testing.assert_array_equal(first.vertices, again.vertices)
        np.testing.assert_array_equal(first.colors, again.colors)
