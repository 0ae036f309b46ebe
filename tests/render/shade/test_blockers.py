"""Soft shadows of capsules: the formulas, that culling changes no pixel, and what must not happen."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.kernels import kernel
from h3data.mesh.mesh import Mesh
from h3data.mesh.primitives import box_mesh
from h3data.render import Camera, Renderer, RenderInstance, RenderScene, look_at, orthographic, pinhole
from h3data.render.shade import blockers as module
from h3data.render.shade import shading
from h3data.render.shade.blockers import Blockers, Tiled, block_pixels, blocker_rows
from h3data.render.shade.blockers_simd import DARKEST, FADE_M, KEPT_M, LEFT, RAY_ROWS, SCRATCH_ROWS, SPREAD

UP = np.array([0.0, 1, 0])
F = np.float32


def capsules_at_random(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    start = rng.uniform([-2, 0.1, -2], [2, 1.5, 2], (count, 3))
    return np.column_stack([start, start + rng.normal(0, 0.2, (count, 3)), rng.uniform(0.02, 0.2, count)])


def rows_at_random(rng: np.random.Generator, count: int = 24, groups: int = 4) -> NDArray[np.float32]:
    group = rng.integers(0, groups, count)
    light = rng.normal([0, 1.5, 0], 1, (groups, 3))
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    share, reach = rng.uniform(0, 0.8, groups), rng.uniform(0.2, 3, count)
    return blocker_rows(capsules_at_random(rng, count), group, light[group], share[group], reach)


def floor_scene() -> RenderScene:
    floor = Mesh(
        vertices=F([[-4, 0, -4], [-4, 0, 4], [4, 0, 4], [4, 0, -4]]),
        faces=np.int32([[0, 1, 2], [0, 2, 3]]),
        colors=np.full((4, 3), 200, np.uint8),
    )
    box = np.eye(4)
    box[:3, 3] = 0.6, 0.25, 0.4
    return RenderScene([floor, box_mesh((0.25, 0.25, 0.25))], [RenderInstance(0, np.eye(4)), RenderInstance(1, box)])


def no_tints(scene: RenderScene, *, group: int = -1) -> NDArray[np.float32]:
    return np.tile(F([1, 1, 1, group]), (len(scene.instances), 1))


CAMERA = pinhole(150, 110, hfov_deg=70, pose=look_at(np.array([1.8, 1.7, 2.6]), np.array([0.0, 0.2, 0.0])))


def reference(rows: NDArray, points: NDArray, normals: NDArray, owners: NDArray) -> NDArray[np.float32]:
    """Light left at points [N, 3] with normals [N, 3], in float32, one operation after another."""

    def dot(a: Any, b: Any) -> Any:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    def clamp(x: Any, low: float, high: float) -> Any:
        return np.minimum(np.maximum(x, F(low)), F(high))

    p, n, one = points.T, normals.T, F(1)
    left = np.ones(len(points), F)
    for group in dict.fromkeys(rows[:, module.GROUP].tolist()):
        directed, ambient = np.ones(len(points), F), np.ones(len(points), F)
        own = owners == group
        for row in rows[rows[:, module.GROUP] == group]:
            start, along, light = row[0:3], row[3:6], row[6:9]
            per_length2, to_light, per_across2, radius, radius2, width, reach, per_range4 = row[9:17]
            away_from = [p[a] - start[a] for a in range(3)]
            beside, ahead = dot(away_from, along), dot(away_from, light)
            s = clamp(beside * per_length2, 0, 1)
            to = [along[a] * s - away_from[a] for a in range(3)]
            d2 = np.maximum(dot(to, to), radius2)
            window = np.maximum(one - d2 * d2 * per_range4, F(0))
            per_d, length = one / np.sqrt(d2), row[module.LENGTH]
            covered = sum(np.minimum((length * part + radius) * per_d, one) for part in (s, one - s)) * F(0.5)
            facing = np.maximum(dot(n, to), F(0)) * per_d
            hidden = np.minimum(facing * (radius * per_d) * covered * window * window, one)
            s = clamp((beside - ahead * to_light) * per_across2, 0, 1)
            to = [along[a] * s - away_from[a] for a in range(3)]
            away = s * to_light - ahead
            off = np.sqrt(np.maximum(dot(to, to) - away * away, F(0)))
            disc = np.maximum(away * F(SPREAD), F(0.01))
            per_radius, per_disc = row[module.PER_RADIUS], one / disc
            step = clamp((disc + radius - off) * (np.maximum(per_disc, per_radius) * F(0.5)), 0, 1)
            overlap = step * step * (F(3) - step * F(2))
            most = np.minimum(radius * per_disc * np.minimum(width * per_disc, one), one)
            onset = clamp(away * (per_radius * F(2)), 0, 1)
            fade = clamp((reach + F(KEPT_M + FADE_M) - away) * F(1 / FADE_M), 0, 1)
            directed *= np.where(own, one, one - most * overlap * onset * fade)
            ambient *= np.where(own, one, one - hidden)
        share, light = row[module.SHARE], row[6:9]
        f = share * np.maximum(dot(n, light), F(0))
        f = f / np.maximum(f + (one - share) * F(0.25), F(1e-6))
        lost = f * (one - directed) + (one - f) * (one - ambient)
        left *= one - lost * F(1 - DARKEST)
    return left


@kernel()
def _run(cast, rays, near, owners, strip, scratch):
    block_pixels(
        cast,
        0,
        rays,
        np.uintp(near.ctypes.data),
        np.uintp(owners.ctypes.data),
        np.float32(-1),
        np.uintp(strip.ctypes.data),
        np.uintp(strip.shape[1] * 4),
        scratch,
    )


def test_eight_pixels_at_a_time_equal_the_reference_bit_by_bit() -> None:
    rng = np.random.default_rng(0)
    rows = rows_at_random(rng)
    lists = np.array([0, len(rows)], np.int32), (4 * np.arange(len(rows)) + 3).astype(np.int32)
    cast = Tiled(rows, np.zeros((0, 4), F), *lists, np.zeros((0, 0), F))
    darkest = 1.0
    for _ in range(200):
        rays = rng.normal(0, 1, (RAY_ROWS, 8)).astype(F)
        near, owners = rng.uniform(0.3, 3, 8).astype(F), rng.integers(-1, 4, 8).astype(F)
        normals = rng.normal(0, 1, (3, 8))
        normals /= np.linalg.norm(normals, axis=0)
        strip = np.zeros((6, 8), np.int32)
        strip[:3] = rng.integers(0, 8192, (3, 8))
        strip.view(F)[3:] = normals
        levels, scratch = strip[:3].copy(), np.full((SCRATCH_ROWS, 8), np.nan, F)
        _run(cast, rays, near, owners, strip, scratch)
        want = reference(rows, (rays[:3] + rays[3:] * (F(1) / near)).T, normals.T.astype(F), owners)
        np.testing.assert_array_equal(scratch[LEFT], want)
        np.testing.assert_array_equal(strip[:3], (levels.astype(F) * want).astype(np.int32))
        darkest = min(darkest, float(want.min()))
    assert darkest < 0.5


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("kind", ["perspective", "near", "orthographic"])
def test_culling_changes_no_pixel(kind: str, samples: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    scene = floor_scene()
    camera: Camera = {
        "perspective": CAMERA,
        "near": pinhole(150, 110, hfov_deg=110, pose=look_at(np.array([0.1, 0.4, 0.2]), np.array([0.9, 0.1, -0.7]))),
        "orthographic": orthographic(150, 110, width_m=5.0, pose=look_at(UP * 3 + [0, 0, 0.01], UP * 0)),
    }[kind]
    blockers = Blockers(rows_at_random(rng), no_tints(scene))
    renderer = Renderer(scene)
    plain = renderer.render(camera, outputs=("rgb",), samples=samples)["rgb"]
    renderer.set_blockers(blockers)
    culled = renderer.render(camera, outputs=("rgb",), samples=samples)["rgb"]
    assert (culled < plain).any(-1).mean() > 0.1
    assert (culled <= plain).all()
    tiled = shading.tiled

    def everything(blockers: Blockers | None, *arguments: Any, **options: Any) -> Tiled:
        found = tiled(blockers, *arguments, **options)
        tiles, count = len(found.first) - 1, len(found.rows)
        listed = np.tile(4 * np.arange(count) + 3, tiles).astype(np.int32)
        assert 0 < found.first[-1] < 0.5 * tiles * count
        return found._replace(first=(np.arange(tiles + 1) * count).astype(np.int32), listed=listed)

    monkeypatch.setattr(shading, "tiled", everything)
    np.testing.assert_array_equal(renderer.render(camera, outputs=("rgb",), samples=samples)["rgb"], culled)


def test_a_picture_without_capsules_in_it_is_the_same_picture() -> None:
    scene = floor_scene()
    renderer = Renderer(scene)
    plain = renderer.render(CAMERA, outputs=("depth", "instance", "rgb"))
    far = blocker_rows(np.array([[50.0, 1, 50, 50, 2, 50, 0.2]]), np.zeros(1, int), UP[None], np.ones(1), np.ones(1))
    renderer.set_blockers(Blockers(far, no_tints(scene)))
    for name, image in renderer.render(CAMERA, outputs=("depth", "instance", "rgb")).items():
        np.testing.assert_array_equal(image, plain[name])
    renderer.set_blockers(Blockers(rows_at_random(np.random.default_rng(1)), no_tints(scene)))
    shadowed = renderer.render(CAMERA, outputs=("depth", "instance", "rgb"))
    assert (shadowed["rgb"] != plain["rgb"]).any()
    for name in ("depth", "instance"):
        np.testing.assert_array_equal(shadowed[name], plain[name])
    renderer.set_blockers(None)
    np.testing.assert_array_equal(renderer.render(CAMERA, outputs=("rgb",))["rgb"], plain["rgb"])


def _floor_darkening(capsule: list[float], light: NDArray, share: float, points: NDArray, reach: float = 9) -> NDArray:
    rows = blocker_rows(np.array([capsule]), np.zeros(1, int), light[None], np.array([share]), np.array([reach]))
    normals = np.tile(UP, (len(points), 1)).astype(F)
    return 1 - reference(rows, points.astype(F), normals, np.full(len(points), -1, F))


def test_a_sphere_on_the_floor_takes_its_form_factor() -> None:
    x = np.linspace(0.12, 0.3, 9)
    points = np.column_stack([x, 0 * x, 0 * x])
    taken = _floor_darkening([0, 0.1, 0, 0, 0.1, 0, 0.1], UP, 0.0, points)
    exact = 0.1**3 / (x**2 + 0.1**2) ** 1.5  # cosine 0.1 / d, times (r / d)^2
    window = (1 - ((x**2 + 0.01) / 0.52**2) ** 2) ** 2
    np.testing.assert_allclose(taken, (1 - DARKEST) * exact * window, rtol=1e-4)


def test_a_long_cylinder_on_the_floor_takes_its_form_factor() -> None:
    x = np.linspace(0.06, 0.2, 9)
    taken = _floor_darkening([0, 0.05, -3, 0, 0.05, 3, 0.05], UP, 0.0, np.column_stack([x, 0 * x, 0 * x]))
    distance2 = x**2 + 0.05**2
    window = (1 - (distance2 / 0.32**2) ** 2) ** 2
    np.testing.assert_allclose(taken, (1 - DARKEST) * 0.05**2 / distance2 * window, rtol=1e-4)  # (r / d) (cosine r / d)


def test_a_shadow_falls_away_from_the_light_and_softens_with_height() -> None:
    light = np.array([0.6, 0.8, 0])
    x = np.linspace(-3, 3, 601)
    line = np.column_stack([x, 0 * x, 0 * x])
    edges = []
    for height in (0.3, 1.2):
        shadow = _floor_darkening([0, height, -0.3, 0, height, 0.3, 0.1], light, 0.6, line)
        middle = (x * shadow).sum() / shadow.sum()
        assert abs(middle - (-0.75 * height)) < 0.12
        edges.append(((shadow > 0.1 * shadow.max()).sum(), shadow.max()))
    assert edges[1][0] > 1.3 * edges[0][0]
    assert edges[1][1] < edges[0][1]


def test_walls_stop_a_shadow() -> None:
    light = np.array([0.8, 0.6, 0])
    far = np.array([[-1.6, 0.0, 0.0]])
    body = [0.0, 1.2, 0.0, 0.0, 1.2, 0.01, 0.15]
    assert _floor_darkening(body, light, 0.6, far)[0] > 0.03
    assert _floor_darkening(body, light, 0.6, far, reach=1.0)[0] == 0


def test_a_group_does_not_darken_itself_and_tints_multiply() -> None:
    scene = floor_scene()
    rows = blocker_rows(
        np.array([[0.6, 0.25, 0.4, 0.6, 0.3, 0.4, 0.3]]), np.array([5]), UP[None], np.ones(1), np.ones(1)
    )
    renderer = Renderer(scene)
    plain = renderer.render(CAMERA, outputs=("instance", "rgb"))
    box = plain["instance"] == 1
    tints = no_tints(scene)
    tints[1, 3] = 5
    renderer.set_blockers(Blockers(rows, tints))
    own = renderer.render(CAMERA, outputs=("rgb",))["rgb"]
    np.testing.assert_array_equal(own[box], plain["rgb"][box])
    assert (own[~box] < plain["rgb"][~box]).any()
    tints[1] = 0.5, 0.5, 0.5, 5
    renderer.set_blockers(Blockers(rows, tints))
    assert renderer.render(CAMERA, outputs=("rgb",))["rgb"][box].mean() < 0.85 * own[box].mean()


def test_bad_capsules_are_left_out_and_bad_arrays_named() -> None:
    bad = np.array([[np.nan] * 7, [0, 1, 0, 0, 1, 0, -0.1], [0, np.inf, 0, 0, 1, 0, 0.1], [0, 1, 0, 0, 1, 0, 0.1]])
    rows = blocker_rows(bad, np.arange(4), np.tile(UP, (4, 1)), np.full(4, 0.5), np.ones(4))
    assert len(rows) == 1
    assert np.isfinite(rows).all()
    scene = floor_scene()
    renderer = Renderer(scene)
    with pytest.raises(InputError, match=r"(?s)\[2, 4\].*H3-RENDER-065"):
        renderer.set_blockers(Blockers(rows, no_tints(scene)[:1]))
    rows[0, 0] = np.nan
    with pytest.raises(InputError, match="H3-RENDER-066"):
        renderer.set_blockers(Blockers(rows, no_tints(scene)))
