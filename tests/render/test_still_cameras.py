"""A camera that stands still draws only what has changed; its pictures are those of a new renderer, to the last bit."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.mesh.primitives import box_mesh
from h3data.render import Camera, Renderer, RenderInstance, RenderScene, look_at, orthographic, pinhole
from h3data.render.raster.cpu import CpuEngine
from h3data.render.shade.blockers import Blockers, blocker_rows
from h3data.render.shade.marks import SEEN, marked_runs
from h3data.replay import Replay, camera_track
from h3data.replay.stage import Stage
from h3data_homes import HomeSpec, build_home
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.registry import find_task
from tests.simulated import simulate_social_nav, social_nav_episode

OUTPUTS = ("rgb", "depth", "instance", "triangle")
EYE = np.array([0.4, 4.0, 3.0])
CAMERAS = {
    "perspective": pinhole(151, 113, hfov_deg=70, pose=look_at(EYE, np.zeros(3))),
    "near plane": pinhole(96, 80, hfov_deg=80, pose=look_at(EYE, np.zeros(3)), near=3.2),
    "far plane": pinhole(96, 80, hfov_deg=80, pose=look_at(EYE, np.zeros(3)), far=5.0),
    "low": pinhole(150, 110, hfov_deg=110, pose=look_at(np.array([0.1, 0.4, 2.2]), np.array([0.2, 0.1, -0.7]))),
    "orthographic": orthographic(150, 110, width_m=6.0, pose=look_at(EYE, np.zeros(3))),
}


def room() -> RenderScene:
    """A floor, a wall and a ball, on and before which two boxes and a deformable one are."""
    floor, wall, small = box_mesh((6, 0.2, 6)), box_mesh((6, 1.5, 0.2)), box_mesh((0.4, 0.5, 0.3))
    body = box_mesh((0.3, 1.2, 0.3))
    places = [(0, -0.1, 0), (0, 0.7, -2), (1, 0.25, 0), (-1, 0.25, 0), (0, 0, 0), (0.6, 0.25, -1)]
    meshes = [floor, wall, small, small, body, small]
    return RenderScene(
        meshes, [RenderInstance(k, placed(np.array(place))) for k, place in enumerate(places)], deformable=[4]
    )


def placed(at: Array, turn: float = 0.0) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(turn), np.sin(turn), -np.sin(turn), np.cos(turn)
    pose[:3, 3] = at
    return pose


def pose_room(renderer: Renderer, scene: RenderScene, step: int, lit: bool) -> None:
    """The state of `room` at one of many steps: boxes slide, stand, hide and vanish; one is far off for a while."""
    angle = step * 0.21
    at = np.array([1.6 * np.cos(angle), 0.25, 1.2 * np.sin(angle)])
    other = np.array([-1.2 + 0.04 * (step // 3), 0.25, 0.5])
    if step % 17 == 11:
        at = at * np.nan
    if step % 19 == 13:
        other = np.array([0.0, -30.0, -60.0])  # the furthest of all, which changes the order of the draws
    renderer.set_transforms([2, 3], np.stack([placed(at, angle), placed(other)]))
    renderer.set_visible([5], step % 7 != 3)
    body = scene.meshes[4].vertices + np.array([0.8 * np.sin(0.1 * (step // 2)), 0.6, -0.4 * np.cos(angle)], np.float32)
    renderer.set_vertices(4, body)
    if lit:
        ends = np.array(
            [[*at, at[0], at[1] + 0.4, at[2], 0.2], [*other, *other, 0.2], [0.6, 0.2, -1, 0.6, 0.6, -1, 0.15]]
        )
        light = np.array([0.6, 0.8, 0.0])
        groups = np.arange(3)
        rows = blocker_rows(ends, groups, np.tile(light, (3, 1)), np.full(3, 0.7), np.full(3, 2.0))
        tints = np.ones((6, 4), np.float32)
        tints[:, 3] = [-1, -1, 0, 1, -1, 2]
        tints[2, :3] = 1 - 0.02 * (step // 4 % 3)
        renderer.set_blockers(None if step % 23 == 20 else Blockers(rows, tints))


def drawn_share(renderer: Renderer) -> float:
    """Share of the tiles that the last picture drew, of the camera that stands still."""
    engine = renderer._engine
    assert isinstance(engine, CpuEngine)
    drawings = engine._free.get()
    engine._free.put(drawings)
    last = max(drawings.still.values(), key=lambda drawing: drawing.last_used)
    return float(last.target.tile_drawn.mean())


def assert_same(again: dict[str, NDArray[Any]], anew: dict[str, NDArray[Any]], what: object) -> None:
    for name in OUTPUTS:
        assert np.array_equal(again[name], anew[name]), (what, name, np.argwhere(again[name] != anew[name])[:5])


@pytest.mark.parametrize("kind", list(CAMERAS))
@pytest.mark.parametrize(("samples", "lit"), [(1, True), (4, True), (4, False)])
def test_only_what_has_changed_is_drawn_and_nothing_looks_different(
    kind: str, samples: Literal[1, 4], lit: bool
) -> None:
    scene, camera = room(), CAMERAS[kind]
    renderer, shares = Renderer(scene), []
    for step in range(30):
        pose_room(renderer, scene, step, lit)
        again = renderer.render(camera, outputs=OUTPUTS, samples=samples)
        fresh = Renderer(scene)
        pose_room(fresh, scene, step, lit)
        assert_same(again, fresh.render(camera, outputs=OUTPUTS, samples=samples), step)
        shares += [drawn_share(renderer)] if step else []
    if kind != "low":  # there, a cluster is at the eye, which may cover everything
        assert np.median(shares) < 0.5


def test_nothing_is_drawn_where_nothing_changes_and_all_after_another_image_of_the_drawing() -> None:
    scene, camera = room(), CAMERAS["perspective"]
    renderer = Renderer(scene)
    first, *_ = [renderer.render(camera, outputs=OUTPUTS, samples=1) for _ in range(3)]
    assert drawn_share(renderer) == 0
    renderer.set_transforms([2], placed(np.array([0.0, 0.3, 1.0])))
    renderer.render(camera, outputs=("depth",))  # now the drawing is ahead of the picture
    second = renderer.render(camera, outputs=OUTPUTS, samples=1)
    fresh = Renderer(scene)
    fresh.set_transforms([2], placed(np.array([0.0, 0.3, 1.0])))
    assert_same(second, fresh.render(camera, outputs=OUTPUTS, samples=1), "after depth alone")
    assert not np.array_equal(first["rgb"], second["rgb"])
    second["rgb"][:] = 0  # who gets a picture may draw on it
    again = renderer.render(camera, outputs=OUTPUTS, samples=1)
    assert_same(again, fresh.render(camera, outputs=OUTPUTS, samples=1), "after drawing on the picture")


def test_cameras_that_move_take_no_memory_for_themselves() -> None:
    scene = room()
    renderer = Renderer(scene)
    standing = CAMERAS["perspective"]
    for step in range(80):
        moved = pinhole(151, 113, hfov_deg=70, pose=look_at(EYE + np.array([0.01 * step, 0, 0]), np.zeros(3)))
        again = renderer.render(moved, outputs=OUTPUTS)
        assert_same(again, Renderer(scene).render(moved, outputs=OUTPUTS), step)
        renderer.render(standing, outputs=OUTPUTS)
    engine = renderer._engine
    assert isinstance(engine, CpuEngine)
    drawings = engine._free.get()
    assert len(drawings.still) == 1
    assert len(drawings.moving) == 1


def same_as_new_stages(replay: Replay, camera: Camera, steps: range, samples: Literal[1, 4]) -> list[float]:
    """Asserts that one renderer draws every step as a new one; returns the shares of the tiles that were drawn."""
    stage = Stage(replay)
    renderer, shares = stage.renderer(), []
    for step in steps:
        (again,) = stage.render(renderer, step, [camera], outputs=OUTPUTS, samples=samples)
        (anew,) = stage.render(stage.renderer(), step, [camera], outputs=OUTPUTS, samples=samples)
        assert_same(again, anew, step)
        shares += [drawn_share(renderer)] if step != steps[0] else []
    return shares


@pytest.mark.slow
def test_a_map_of_a_recording_is_drawn_where_people_and_robots_are() -> None:
    replay = Replay(simulate_social_nav(social_nav_episode(build_home(HomeSpec(preset="small", seed=2)), seed=2)))
    camera = camera_track(replay, "top_down").resized(240, 200).at(0)
    assert np.median(same_as_new_stages(replay, camera, range(0, 60, 6), 4)) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("light", ["baked", "flat"])
@pytest.mark.parametrize("seed", [3, 8, 21])
@pytest.mark.parametrize("task", ["rearrange", "social_nav"])
def test_homes_with_doors_things_and_people(task: str, seed: int, light: Literal["baked", "flat"]) -> None:
    rules = find_task(task)
    home = build_home(HomeSpec(preset="small", seed=seed, generation=2))
    replay = Replay(simulate(rules, rules.episode(home, seed=seed)), light=light)
    steps = range(0, min(len(replay), 400), 5)
    for name in ("top_down", "top_down_orthographic", "third_person", "human_head", "orbit"):
        camera = camera_track(replay, name).resized(400, 300).at(len(replay) // 3)
        for samples in (1, 4):
            same_as_new_stages(replay, camera, steps, samples)


def test_the_part_of_a_row_that_is_looked_at_holds_the_runs_of_all_marks():
    rng = np.random.default_rng(5)
    for width, factor in ((37, 1), (64, 2), (200, 2)):
        for _ in range(40):
            words = np.repeat(rng.integers(0, 4, 40), rng.integers(1, 30, 40))
            words = np.resize(words, width * factor).astype(np.int32)
            marks = np.zeros(width + 8, np.uint8)
            marked = rng.integers(0, width, rng.integers(0, 4))
            marks[marked] = SEEN
            first, last = marked_runs.py_func(marks, words, factor, width)
            if not len(marked):
                assert first == last
                continue
            assert first % 8 == 0
            assert last % 8 == 0 or last == width
            run = np.cumsum(np.diff(words[::factor], prepend=words[0]) != 0)
            for x in {*marked, *np.minimum(marked + 1, width - 1)}:
                (inside,) = np.nonzero(run == run[x])
                assert first <= inside[0]
                assert inside[-1] < last
