"""Propositions by boxes and rectangles against PARTNR's rule, that a ray downwards from a thing meets the furniture's mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import h3data
from h3data.geometry import quat_from_heading, transform_points
from h3data.scene import Scene, instance_matrix
from h3data_language.evaluation.layout import Layout, owner_of
from h3data_language.evaluation.predicates import Rows, truth_of
from h3data_language.evaluation.records import Proposition

ROWS, THING = 200, "mug_0"


def triangles_of(scene: Scene, furniture: str) -> NDArray[np.float64]:
    """Triangles [N, 3, 3] of all parts of a piece of furniture in the world."""
    found = []
    for instance in scene.static_instances:
        if owner_of(scene, instance.name) == furniture:
            mesh = scene.assets[instance.asset].mesh
            found.append(transform_points(instance_matrix(instance), mesh.vertices)[mesh.faces])
    return np.concatenate(found)


def is_below(triangles: NDArray[np.float64], point: NDArray[np.float64]) -> bool:
    """Return whether a ray downwards from a point [3] meets a triangle, by barycentric coordinates on the floor plane."""
    a, b, c = triangles.transpose(1, 0, 2)
    ab, ac, to = (b - a)[:, [0, 2]], (c - a)[:, [0, 2]], (point - a)[:, [0, 2]]
    with np.errstate(divide="ignore", invalid="ignore"):
        area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
        u = (to[:, 0] * ac[:, 1] - to[:, 1] * ac[:, 0]) / area
        v = (ab[:, 0] * to[:, 1] - ab[:, 1] * to[:, 0]) / area
        y = a[:, 1] + u * (b - a)[:, 1] + v * (c - a)[:, 1]
        return bool(((area != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (y <= point[1])).any())


def test_things_are_on_furniture_only_where_rays_from_their_corners_meet_it() -> None:
    """Over a surface both rules agree; beside it, rays also meet arm rests, rims and lower parts, which are no surfaces."""
    scene, rng = h3data.load_scene("h3-homes/val#3"), np.random.default_rng(0)
    layout = Layout.of_scene(scene, [THING])
    open_to = {n: [s for s in f.surfaces if not s.inside] for n, f in layout.furniture.items()}
    names = [n for n, surfaces in open_to.items() if surfaces]
    triangles = {n: triangles_of(scene, n) for n in names}
    for reach, least in ((1.0, ROWS), (2.0, 0.75 * ROWS)):  # in half extents of the surface
        ours, theirs = np.zeros(ROWS, np.bool_), np.zeros(ROWS, np.bool_)
        for row, name in enumerate(rng.choice(names, ROWS).tolist()):
            surface = open_to[name][rng.integers(len(open_to[name]))]
            c, s = np.cos(surface.heading), np.sin(surface.heading)
            x, z = rng.uniform(-reach, reach, 2) * surface.half
            at = np.add(surface.center, (c * x + s * z, 0.05, c * z - s * x))
            pose = np.concatenate([at, quat_from_heading(rng.uniform(-np.pi, np.pi))])[None, None]
            rows = Rows(layout, pose, np.zeros((1, 1), np.bool_), bugs=True)
            asked = Proposition("is_on_top", {"object_handles": [THING], "receptacle_handles": [name]})
            ours[row] = truth_of(asked, rows)[0][0]
            theirs[row] = any(is_below(triangles[name], corner) for corner in rows.corners(THING)[0])
        assert (ours == theirs).sum() >= least
        assert not (ours & ~theirs).any()
        assert reach == 1 or 0 < ours.sum() < theirs.sum() < ROWS
