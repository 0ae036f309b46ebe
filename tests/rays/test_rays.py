"""Rays: against the rasteriser and against all triangles; fisheye, equirectangular, lidar, line of sight, shadows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from h3data.render import Light, Renderer, RenderInstance, RenderScene, equirectangular, fisheye, look_at, pinhole
from h3data_rays import RayCaster, lidar
from tests.render.raster.test_raster import cast, mesh_of, random_view, soup
from tests.render.test_renderer import at, bumpy, scene, views

pytest.importorskip("embreex", reason="the extra 'rays' is not installed")


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_the_rasteriser_sees_what_rays_see(projection):
    rng = np.random.default_rng(11)
    alike = total = 0
    for _ in range(20):
        drawn = RenderScene([mesh_of(soup(rng))], [RenderInstance(0, np.eye(4), semantic_id=5)])
        camera = random_view(rng, projection)
        outputs = ("depth", "instance", "semantic", "triangle")
        a, b = (Renderer(drawn, backend=name).render(camera, outputs=outputs) for name in ("cpu", "rays"))
        alike += (np.abs(a["depth"] - b["depth"]) < 1e-4 * np.maximum(1, b["depth"])).sum()
        total += a["depth"].size
    assert alike / total > 0.995  # silhouettes


def test_normals_and_movers_by_rays_are_those_of_the_rasteriser():
    camera, drawn = views(1)[0], scene()
    renderers = [Renderer(drawn, backend=name) for name in ("cpu", "rays")]
    for step in range(3):
        pictures = []
        for renderer in renderers:
            renderer.set_transforms([2], at(0.3 * step, 1, 0.2, 0.3))
            renderer.set_visible([3], step != 1)
            pictures.append(renderer.render(camera, outputs=("instance", "triangle", "normal", "rgb")))
        a, b = pictures
        same = a["triangle"] == b["triangle"]
        assert same.mean() > 0.99
        np.testing.assert_allclose(a["normal"][same], b["normal"][same], atol=2e-3)
        np.testing.assert_array_equal(a["rgb"], b["rgb"])
        assert (3 in a["instance"]) == (step != 1)


@pytest.mark.parametrize("make", [lambda: fisheye(48, 40, hfov_deg=230), lambda: equirectangular(64)])
def test_wide_cameras_equal_the_ray_caster(make):
    rng = np.random.default_rng(4)
    right = total = 0
    for _ in range(8):
        triangles = soup(rng)
        camera = make().at(look_at(rng.normal(size=3) * 0.3, rng.normal(size=3)))
        picture = Renderer(RenderScene([mesh_of(triangles)], [RenderInstance(0, np.eye(4))])).render(
            camera, outputs=("depth", "triangle")
        )
        depth, ids, clear = cast(triangles, replace(camera, near=1e-6))
        known = clear & (ids != -2)
        right += (picture["triangle"][known] == ids[known]).sum()
        total += known.sum()
        both = known & (picture["triangle"] == ids)
        np.testing.assert_allclose(picture["depth"][both], depth[both], rtol=2e-4, atol=1e-4)
    assert right / total > 0.999


def test_colours_of_a_wide_camera_are_those_of_a_narrow_one():
    drawn, pose = scene(), look_at([0.2, 2.2, 2.6], [0, 0, 0])
    light = Light(occlusion=0)
    wide = Renderer(drawn, light=light).render(fisheye(300, 300, hfov_deg=170, pose=pose), outputs=("rgb",), samples=4)[
        "rgb"
    ]
    narrow_camera = pinhole(61, 61, hfov_deg=40, pose=pose)
    narrow = Renderer(drawn, light=light).render(narrow_camera, outputs=("rgb",), samples=4)["rgb"]
    _, directions = narrow_camera.rays()
    pixels = fisheye(300, 300, hfov_deg=170).to_pixels(directions.reshape(-1, 3)).astype(int).reshape(61, 61, 2)
    difference = np.abs(wide[pixels[..., 1], pixels[..., 0]].astype(int) - narrow).max(-1)
    assert np.median(difference) < 8


def box_room() -> RenderScene:
    """Walls of a room of 4 x 3 x 6 m around the origin, as 12 triangles."""
    corners = np.array([[x, y, z] for x in (-2, 2) for y in (0, 3) for z in (-3, 3)], np.float64)
    quads = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
    triangles = np.concatenate([[corners[q[:3]], corners[[q[0], q[2], q[3]]]] for q in quads])
    return RenderScene(
        [mesh_of(triangles), bumpy(4)], [RenderInstance(0, np.eye(4)), RenderInstance(1, at(0, 9, 0, 0.2))]
    )


def test_a_lidar_measures_a_room():
    pose = np.eye(4)
    pose[1, 3] = 1.0
    scan = lidar(RayCaster(box_room()), pose, elevations_deg=[0, 30], columns=360, max_m=2.9)
    assert scan.distance.shape == (2, 360)
    assert scan.distance[0, 0] == pytest.approx(2, abs=1e-5), "ahead, +x"
    assert scan.distance[0, 90] == 0, "3 m to the left: out of reach"
    turn = np.radians(20)
    assert scan.distance[0, 20] == pytest.approx(2 / np.cos(turn), abs=1e-4)
    assert scan.points[0, 20, 2] < 0, "column 20 looks to the left, -z"
    assert scan.distance[1, 0] == pytest.approx(2 / np.cos(np.radians(30)), abs=1e-4)
    assert scan.points[1, 0, 1] > 1


def test_line_of_sight_ends_at_walls_and_ignores_what_is_left_out():
    drawn = RenderScene([mesh_of(np.float64([[[0, -9, -9], [0, 9, -9], [0, 0, 9]]]))], [RenderInstance(0, np.eye(4))])
    caster = RayCaster(drawn)
    a, b = [[-1, 0, 0]], [[1, 0, 0], [-0.5, 1, 0], [0, 0, 0]]
    np.testing.assert_array_equal(caster.line_of_sight(a, b), [False, True, True])
    assert RayCaster(drawn, shown=[False]).line_of_sight(a, b).all()
    hits = caster.cast([[-1.0, 0, 0]], [[np.nan, 0, 1], [1, 0, 0]])
    np.testing.assert_array_equal(hits.instance, [-1, 0])
    assert hits.distance[1] == pytest.approx(1)


def test_shadows_fall_where_the_sun_is_hidden():
    floor = mesh_of(np.float64([[[-9, 0, -9], [9, 0, -9], [0, 0, 14]]]))
    shade = mesh_of(np.float64([[[-1, 2, -1], [1, 2, -1], [1, 2, 1]], [[-1, 2, -1], [1, 2, 1], [-1, 2, 1]]]))
    drawn = RenderScene([floor, shade], [RenderInstance(0, np.eye(4)), RenderInstance(1, np.eye(4), layer="ceiling")])
    camera = pinhole(60, 60, hfov_deg=60, pose=look_at([0, 1.9, 0], [0, 0, 0]), hidden_layers=())
    above = Light(sun_direction=(0.0, 1.0, 0.0), occlusion=0, headlight=(0, 0, 0))
    plain, hard, soft = (
        Renderer(drawn, light=replace(above, shadow_rays=n, sun_size_deg=size))
        .render(camera, outputs=("rgb",))["rgb"]
        .astype(int)[30, :, 0]
        for n, size in ((0, 1.0), (4, 0.1), (32, 20.0))
    )
    x = (np.arange(60) + 0.5 - 30) / camera.fx * 1.9
    inside, outside = np.abs(x) < 0.95, np.abs(x) > 1.05
    assert (hard[inside] < plain[inside] - 20).all()
    np.testing.assert_allclose(hard[outside], plain[outside], atol=1)
    levels = np.unique(soft[(np.abs(x) > 0.7) & (np.abs(x) < 1.05)])
    assert len(levels) > 4, "a wide sun has soft edges"
    without = Renderer(drawn, light=replace(above, shadow_rays=4)).render(
        replace(camera, hidden_layers=("ceiling",)), outputs=("rgb",), samples=4
    )["rgb"][30, :, 0]
    np.testing.assert_allclose(without, plain, atol=1, err_msg="what is hidden casts no shadow")
