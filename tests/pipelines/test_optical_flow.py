"""Optical flow against projected points; boxes and masks."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.render import Renderer, RenderInstance, RenderScene, equirectangular, look_at, orthographic, pinhole
from h3data_pipelines.pictures.boxes import visible_boxes, visible_masks
from h3data_pipelines.pictures.flow import flow_to_rgb, optical_flow
from tests.render.test_renderer import at, bumpy, views

NEEDED = ("depth", "instance", "triangle")


def drawn() -> RenderScene:
    meshes = [bumpy(8), bumpy(8, smooth=False)]
    instances = [
        RenderInstance(0, at(0, 0, 0), id=7),
        RenderInstance(0, at(-1, 1, 0, 0.3), id=3),
        RenderInstance(1, at(1, 1, 0, 0.4)),
    ]
    return RenderScene(meshes, instances, deformable=[1])


FROM_ABOVE = orthographic(60, 50, width_m=4, pose=look_at([0, 4, 0], [0, 0, 0]))
ASLANT = pinhole(50, 40, hfov_deg=70, pose=look_at([1, 4, 1], [0, 0, 0]))


@pytest.mark.parametrize(("camera", "camera_after"), [tuple(views(2)), (FROM_ABOVE, ASLANT), (ASLANT, FROM_ABOVE)])
def test_flow_leads_to_where_each_vertex_goes(camera, camera_after):
    scene = drawn()
    renderer = Renderer(scene)
    before = renderer.poses()
    picture = renderer.render(camera, outputs=NEEDED)
    moved = at(-0.8, 1.3, 0.2, 0.3) @ np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
    soft = scene.meshes[1].vertices * np.float32([1.1, 2, 0.9]) + np.float32([0.1, 0, 0])
    renderer.set_transforms([1], moved)
    renderer.set_vertices(1, soft)
    flow = optical_flow(scene, picture, camera, before, camera_after, renderer.poses())
    after_matrix = [np.eye(4), moved, scene.instances[2].matrix]
    start, directions = camera.rays()
    checked = 0
    for k, (instance, matrix) in enumerate(zip(scene.instances, after_matrix, strict=True)):
        mesh, new = scene.meshes[instance.mesh], soft if k == 2 else scene.meshes[instance.mesh].vertices
        ids = [7, 3, 2][k]
        for v, u in np.argwhere(picture["instance"] == ids)[::29]:
            corners = mesh.faces[picture["triangle"][v, u]]
            point = camera.pose[:3, :3] @ (start[v, u] + directions[v, u] * picture["depth"][v, u]) + camera.pose[:3, 3]
            old = mesh.vertices[corners] @ instance.matrix[:3, :3].T + instance.matrix[:3, 3]
            weights = np.linalg.lstsq(np.vstack([old.T, np.ones(3)]), np.append(point, 1), rcond=None)[0]
            target = weights @ (new[corners] @ matrix[:3, :3].T + matrix[:3, 3])
            expected, depth = camera_after.project(target)
            if depth[0] > 0.05:
                np.testing.assert_allclose(flow[v, u] + [u + 0.5, v + 0.5], expected[0], atol=0.05)
                checked += 1
    assert checked > 30


def test_what_stands_still_has_no_flow_and_the_sky_turns():
    renderer, camera = Renderer(drawn()), views(1)[0]
    picture = renderer.render(camera, outputs=NEEDED)
    poses = renderer.poses()
    still = optical_flow(renderer.scene, picture, camera, poses, camera, poses)
    assert np.abs(still).max() < 1e-3
    turned = np.array([[np.cos(0.1), 0, -np.sin(0.1), 0], [0, 1, 0, 0], [np.sin(0.1), 0, np.cos(0.1), 0], [0, 0, 0, 1]])
    empty = {name: picture[name] * 0 - (name != "depth") for name in NEEDED}
    sky = optical_flow(renderer.scene, empty, camera, poses, camera.at(camera.pose @ turned), poses)
    middle = sky[camera.height // 2, camera.width // 2]
    assert abs(middle[0]) == pytest.approx(np.tan(0.1) * camera.fx, rel=0.02)
    around = equirectangular(64)
    nothing = {
        "depth": np.zeros((32, 64), np.float32),
        "instance": np.full((32, 64), -1),
        "triangle": np.full((32, 64), -1),
    }
    wrapped = optical_flow(renderer.scene, nothing, around, poses, around.at(turned), poses)
    np.testing.assert_allclose(np.abs(wrapped[16, :, 0]), 0.1 * around.fx, rtol=0.01)
    with pytest.raises(InputError, match="H3-RENDER-012"):
        optical_flow(renderer.scene, {"depth": 0, "instance": 0}, camera, poses, camera, poses)  # type: ignore[dict-item]


def test_flow_colours_show_direction_and_length():
    flow = np.zeros((1, 4, 2), np.float32)
    flow[0, 1], flow[0, 2], flow[0, 3] = (5, 0), (0, 5), (np.nan, 0)
    rgb = flow_to_rgb(flow, longest_px=5)
    np.testing.assert_array_equal(rgb[0, 0], [255, 255, 255])
    np.testing.assert_array_equal(rgb[0, 1], [255, 0, 0])
    assert rgb[0, 2, 1] == 255
    assert rgb[0, 2, 2] < 10
    assert rgb[0, 3].max() < 30


def test_boxes_and_masks_hold_exactly_the_visible_pixels():
    rng = np.random.default_rng(0)
    ids = np.full((20, 30), -1, np.int32)
    for k in range(5):
        y, x = rng.integers(0, 15), rng.integers(0, 22)
        ids[y : y + 5, x : x + 8] = k * 3
    found = visible_boxes(ids)
    np.testing.assert_array_equal(found.ids, np.unique(ids[ids >= 0]))
    masks = visible_masks(ids, found.ids)
    for mask, (x0, y0, x1, y1), pixels in zip(masks, found.boxes, found.pixels, strict=True):
        assert mask.sum() == pixels == mask[y0:y1, x0:x1].sum()
        assert mask[y0:y1, x0].any()
        assert mask[y0:y1, x1 - 1].any()
        assert mask[y0, x0:x1].any()
        assert mask[y1 - 1, x0:x1].any()
    groups = np.full(13, -1)
    groups[[0, 3]] = 1
    grouped = visible_boxes(ids, groups=groups)
    np.testing.assert_array_equal(grouped.ids, [1])
    assert grouped.pixels[0] == np.isin(ids, [0, 3]).sum()
    assert len(visible_boxes(np.full((3, 3), -1)).ids) == 0
    with pytest.raises(InputError, match=r"(?s)0.*1.*H3-RENDER-002"):
        visible_boxes(ids, groups=[0, 1])
    with pytest.raises(InputError, match="H3-RENDER-001"):
        visible_boxes(np.zeros((3, 3)))
