"""FCL against analytic formulas and against FreeSpace; the traps of python-fcl; robot-human contact."""

from __future__ import annotations

import gc
import itertools
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sim_kinematic.contact
from h3data.errors import InputError, SceneError
from h3data.geometry import normalized, quat_from_axis_angle, quat_from_heading, quat_to_matrix, transform_points
from h3data.mesh.mesh import Mesh
from h3data.scene import FreeSpace
from h3data.scene.records import Asset, Box, Capsule, Cylinder, Hull, Instance, Room, Scene, Shape
from h3data.scene.shape_bounds import bounding_capsule, bounding_sphere, shape_bounds
from sim_kinematic.contact import (
    AgentContacts,
    FclScene,
    MovingShapes,
    capsule_transforms,
    collide,
    contacts,
    distance,
    shapes_from_capsules,
)
from sim_kinematic.contact.agent_contact import segment_square
from sim_kinematic.contact.shapes import fcl_geometry

IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
NO_MESH = Mesh(
    vertices=np.zeros((0, 3), np.float32), faces=np.zeros((0, 3), np.int32), colors=np.zeros((0, 3), np.uint8)
)
UNIT_BOX = Box(pose=IDENTITY, half_extents=np.full(3, 0.5))


def scene_of(*placed: tuple[Shape, np.ndarray, tuple[float, float, float]], motion="static", rooms=()) -> Scene:
    return Scene(
        name="shapes",
        assets={f"a{k}": Asset(name=f"a{k}", mesh=NO_MESH, shapes=(s,)) for k, (s, _, _) in enumerate(placed)},
        instances=tuple(
            Instance(name=f"i{k}", asset=f"a{k}", pose=np.asarray(p, float), scale=np.array(f, float), motion=motion)
            for k, (_, p, f) in enumerate(placed)
        ),
        rooms=rooms,
    )


def sphere(radius: float) -> Capsule:
    return Capsule(start=np.zeros(3), end=np.zeros(3), radius=radius)


def at(position, rotation=None) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    matrix[:3, :3] = np.eye(3) if rotation is None else rotation
    return matrix


def segment_distance(p, q, r, s) -> float:
    """Distance of two segments, by dense search refined: slow, plain, right to 1e-7."""
    low, high = np.zeros(2), np.ones(2)
    for _ in range(14):
        t, u = (np.linspace(low[k], high[k], 9) for k in range(2))
        d = np.linalg.norm((p + t[:, None] * (q - p))[:, None] - (r + u[:, None] * (s - r))[None], axis=-1)
        i, j = np.unravel_index(np.argmin(d), d.shape)
        middle, width = np.array([t[i], u[j]]), (high - low) / 4
        low, high = np.maximum(middle - width, 0), np.minimum(middle + width, 1)
    return float(d.min())


def box_distance(point, half) -> float:
    """Signed distance of a point to a box about the origin."""
    q = np.abs(point) - half
    return float(np.linalg.norm(np.maximum(q, 0)) + min(q.max(), 0.0))


vectors = st.tuples(*[st.floats(-1.5, 1.5)] * 3).map(np.array)
angles = st.floats(-3.0, 3.0)


@given(vectors, vectors, angles)
def test_sphere_against_box(centre, axis, angle):
    rotation = quat_to_matrix(quat_from_axis_angle(axis + np.array([0, 0, 2.0]), angle))
    half = np.array([0.5, 0.3, 0.8])
    ball, block = MovingShapes([sphere(0.25)]), MovingShapes([Box(pose=IDENTITY, half_extents=half)])
    ball.set_transforms([at(centre)])
    block.set_transforms([at(np.zeros(3), rotation)])
    expected = box_distance(rotation.T @ centre, half) - 0.25
    if abs(expected) > 1e-5:
        assert collide(ball, block) == (expected < 0)
    if expected > -0.2:  # the centre is outside the box: one nearest face
        assert distance(ball, block) == pytest.approx(expected, abs=2e-3 if expected < 0 else 1e-5)


@given(vectors, vectors, vectors, angles)
def test_capsule_depth_parts_the_two(a, b, axis, angle):
    """The depth of a capsule in a box is an upper bound that works: moved by it along the normal, they are apart."""
    rotation = quat_to_matrix(quat_from_axis_angle(axis + np.array([0, 0, 2.0]), angle))
    block = MovingShapes([Box(pose=IDENTITY, half_extents=np.array([0.5, 0.3, 0.8]))])
    block.set_transforms([at(np.zeros(3), rotation)])
    bone = MovingShapes(shapes_from_capsules(a[None], b[None], 0.1))
    bone.set_transforms(capsule_transforms(a[None], b[None]))
    found = contacts(block, bone)
    assert bool(found) == collide(block, bone)
    if found:
        way = found[0].normal * (found[0].depth_m + 2e-3)
        bone.set_transforms(capsule_transforms(a[None] + way, b[None] + way))
        assert not collide(block, bone)


@given(vectors, vectors, vectors, vectors)
def test_capsule_against_capsule(a, b, c, d):
    start, end = np.stack([a, c]), np.stack([b, d])
    shapes = shapes_from_capsules(start, end, [0.1, 0.2])
    one, two = MovingShapes(shapes[:1]), MovingShapes(shapes[1:])
    frames = capsule_transforms(start, end)
    one.set_transforms(frames[:1])
    two.set_transforms(frames[1:])
    expected = segment_distance(a, b, c, d) - 0.3
    if abs(expected) > 1e-4:
        assert collide(one, two) == (expected < 0)
    if expected > 0:
        assert distance(one, two) == pytest.approx(expected, abs=1e-4)


def test_capsules_are_where_their_ends_are():
    rng = np.random.default_rng(0)
    start, end = rng.normal(size=(2, 50, 3))
    start[0] = end[0]  # a ball
    end[1] = start[1] + [0, -2, 0]
    frames = capsule_transforms(start, end)
    np.testing.assert_allclose(
        frames[:, :3, :3] @ np.swapaxes(frames[:, :3, :3], 1, 2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(frames[:, :3, :3]), 1)
    for k, shape in enumerate(shapes_from_capsules(start, end, 0.1)):
        np.testing.assert_allclose(
            transform_points(frames[k], np.stack([shape.start, shape.end])), [start[k], end[k]], atol=1e-12
        )


@pytest.mark.parametrize("shape", [(3,), (0, 3), (24, 3), (5, 24, 3)])
def test_frames_of_capsules_have_the_bits_of_numpys_formulas(shape: tuple[int, ...]):
    rng = np.random.default_rng(len(shape))
    for length in (0.0, 1e-9, 0.3, 2.0):
        start, way = rng.normal(size=(2, *shape))
        # along an axis, for which the choice of the second axis matters
        way[..., : rng.integers(3)] = 0.0
        end = start + length * way
        y = normalized(end - start)
        y = np.where(y.any(-1, keepdims=True), y, np.array([0.0, 1.0, 0.0]))
        helper = np.where(np.abs(y[..., :1]) < 0.7, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
        z = normalized(np.cross(helper, y))
        middle = (start + end) / 2
        expected = np.concatenate([np.stack([np.cross(y, z), y, z, middle], -1), np.zeros((*shape[:-1], 1, 4))], -2)
        expected[..., 3, 3] = 1.0
        assert capsule_transforms(start, end).tobytes() == expected.tobytes()
        assert capsule_transforms(start.astype(np.float32), end).shape == expected.shape


def test_contact_normal_points_from_a_to_b_whichever_side_fcl_puts_first():
    block = FclScene(scene_of((UNIT_BOX, IDENTITY, (1, 1, 1))))
    ball = MovingShapes([sphere(0.1), sphere(0.3)])
    ball.set_transforms([at([5, 0, 0]), at([0.7, 0.05, 0.02])])
    (one,) = contacts(block, ball)
    (two,) = contacts(ball, block)
    np.testing.assert_allclose(one.normal, [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(two.normal, [-1, 0, 0], atol=1e-6)
    assert (one.index_a, one.index_b, two.index_a, two.index_b) == (0, 1, 1, 0)
    assert one.depth_m == pytest.approx(0.1, abs=1e-5)
    assert 0.4 - 1e-6 <= one.point[0] <= 0.5 + 1e-6
    ball.set_transforms([at([5, 0, 0]), at([0.7 + one.depth_m + 1e-4, 0.05, 0.02])])
    assert not collide(block, ball)


def test_contacts_name_the_right_shapes():
    placed = [(UNIT_BOX, np.array([2.0 * k, 0, 0, 0, 0, 0, 1]), (1, 1, 1)) for k in range(6)]
    world = FclScene(scene_of(*placed))
    assert world.names == tuple(f"i{k}" for k in range(6))
    moving = MovingShapes([sphere(0.2)] * 4)
    moving.set_transforms([at([9, 9, 9]), at([4.0, 0.6, 0]), at([10.0, 0.65, 0]), at([5.0, 0, 0])])
    found = contacts(moving, world)
    assert [(c.index_a, world.names[c.index_b]) for c in found] == [(1, "i2"), (2, "i5")]  # deepest first
    assert distance(moving, world) == pytest.approx(-0.1, abs=1e-6)  # the deepest, not the first


@pytest.mark.parametrize("kind", ["cylinder", "capsule"])
def test_round_things_stand_along_y(kind):
    tall: Shape = Cylinder(pose=IDENTITY, radius=0.2, half_height=1.0)
    if kind == "capsule":
        tall = Capsule(start=np.array([0, -0.8, 0]), end=np.array([0, 0.8, 0]), radius=0.2)
    still, probe = FclScene(scene_of((tall, IDENTITY, (1, 1, 1)))), MovingShapes([sphere(0.05)])
    for position, hit in (([0, 0.98, 0], True), ([0, 1.06, 0], False), ([0.98, 0, 0], False), ([0, 0, 0.98], False)):
        probe.set_transforms([at(position)])
        assert collide(still, probe) is hit, position
    lying = np.concatenate([[0, 0, 0], quat_from_axis_angle([0, 0, 1], np.pi / 2)])  # y goes to -x
    still = FclScene(scene_of((tall, lying, (1, 1, 1))))
    probe.set_transforms([at([0.98, 0, 0])])
    assert collide(still, probe)


def test_a_moved_object_is_seen_where_it_is_now():
    world, probe = FclScene(scene_of((UNIT_BOX, IDENTITY, (1, 1, 1)))), MovingShapes([sphere(0.2)])
    for x, hit in ((5.0, False), (0.5, True), (-40.0, False), (-0.6, True)):
        probe.set_transforms([at([x, 0, 0])])
        assert collide(world, probe) is hit
    # the trap that set_transforms avoids: without manager.update the old place counts
    probe.set_transforms([at([5.0, 0, 0])])
    probe.objects[0].setTranslation(np.array([0.5, 0, 0]))
    assert not collide(world, probe)
    probe.manager.update()
    assert collide(world, probe)


SOLIDS: dict[str, Shape] = {
    "box": Box(pose=IDENTITY, half_extents=np.full(3, 2.0)),
    "cylinder": Cylinder(pose=IDENTITY, radius=2.0, half_height=2.0),
    "capsule": Capsule(start=np.array([0, -1.0, 0]), end=np.array([0, 1.0, 0]), radius=2.0),
    "ball": sphere(2.0),
    "hull": Hull(points=np.array(list(itertools.product((-2, 2), repeat=3)), float)),
}
SCALES = [(1, 1, 1), (1, 2, 1.5), (-1, 1, 1)]


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("kind", SOLIDS)
def test_something_wholly_inside_is_a_contact(kind, scale):
    """A triangle mesh is hollow to FCL, and its distance to what is inside is positive; ours are solid."""
    world, probe = FclScene(scene_of((SOLIDS[kind], IDENTITY, scale))), MovingShapes([sphere(0.1)])
    for x in (0.0, 0.5, 1.2):
        probe.set_transforms([at([x, 0.3, 0.1])])
        assert collide(world, probe)
        assert contacts(world, probe)
        assert distance(world, probe) < -0.1


@pytest.mark.parametrize("kind", SOLIDS)
def test_normals_point_out_of_every_kind_of_solid(kind):
    """Against triangle meshes FCL's normals are of any sign."""
    world, probe = FclScene(scene_of((SOLIDS[kind], IDENTITY, (1, 1, 1)))), MovingShapes([sphere(0.3)])
    for side in np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]]):
        probe.set_transforms([at(2.2 * side)])
        found = contacts(world, probe)[0]
        np.testing.assert_allclose(found.normal, side, atol=0.02)
        assert found.depth_m == pytest.approx(0.1, abs=2e-3)
        assert distance(world, probe) == pytest.approx(-0.1, abs=2e-3)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("kind", SOLIDS)
def test_no_shape_becomes_a_triangle_mesh(kind, scale):
    import fcl

    geometry, _ = fcl_geometry(SOLIDS[kind], scale)
    assert not isinstance(geometry, fcl.BVHModel)
    assert isinstance(geometry, fcl.Box | fcl.Cylinder | fcl.Capsule | fcl.Sphere | fcl.Convex)


def test_nothing_uses_what_python_fcl_answers_wrongly():
    """Continuous collision misses contacts of meshes, and nearest points come in either order."""
    sources = {p: p.read_text() for p in Path(sim_kinematic.contact.__file__).parent.glob("*.py")}
    assert len(sources) > 3
    for path, text in sources.items():
        for call in ("BVHModel", "continuousCollide", "nearest_points"):
            assert call not in text, path


def test_shapes_live_as_long_as_their_world():
    placed = [(UNIT_BOX, np.array([2.0 * k, 0, 0, 0, 0, 0, 1]), (1, 1, 1)) for k in range(6)]
    world = FclScene(scene_of(*placed))
    gc.collect()
    for _ in range(20):  # new geometries would get the addresses of old ones
        FclScene(scene_of(*placed[:3]))
    probe = MovingShapes([sphere(0.2)])
    probe.set_transforms([at([6.0, 0.6, 0])])
    assert [world.names[c.index_b] for c in contacts(probe, world)] == ["i3"]


def test_worlds_cannot_be_sent_to_other_processes_by_mistake():
    with pytest.raises(TypeError, match="__reduce__"):
        pickle.dumps(MovingShapes([UNIT_BOX]))


@given(st.integers(0, 10**6))
def test_hulls_are_solid_and_exact(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(12, 3)) * 0.5
    from scipy.spatial import ConvexHull

    planes = ConvexHull(points).equations
    world, probe = FclScene(scene_of((Hull(points=points), IDENTITY, (1, 1, 1)))), MovingShapes([sphere(0.001)])
    for p in rng.uniform(-1, 1, (10, 3)):
        outside = float((planes[:, :3] @ p + planes[:, 3]).max())
        if abs(outside) > 0.01:
            probe.set_transforms([at(p)])
            assert collide(world, probe) == (outside < 0)


@given(st.integers(0, 10**6))
def test_scaled_and_mirrored_shapes_hold_the_same_points(seed):
    """A point is in the scaled shape where it is, unscaled, in the shape: for every kind, uneven and negative scales."""
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.uniform(-0.3, 0.3, 3), quat_from_axis_angle(rng.normal(size=3), rng.uniform(-3, 3))])
    scale = rng.choice([-1, 1], 3) * (rng.uniform(0.5, 2, 3) if rng.random() < 0.5 else np.full(3, rng.uniform(0.5, 2)))
    half, radius = np.array([0.4, 0.6, 0.3]), 0.35
    shape: Shape = Box(pose=pose, half_extents=half)
    if seed % 2:
        shape = Cylinder(pose=pose, radius=radius, half_height=0.6)
    placed = np.concatenate([rng.uniform(-0.3, 0.3, 3), quat_from_heading(rng.uniform(-3, 3))])
    world, probe = FclScene(scene_of((shape, placed, tuple(scale)))), MovingShapes([sphere(0.001)])
    rotation = quat_to_matrix(pose[3:])
    for p in rng.uniform(-1.5, 1.5, (12, 3)):
        in_asset = (quat_to_matrix(placed[3:]).T @ (p - placed[:3])) / scale
        q = rotation.T @ (in_asset - pose[:3])
        if isinstance(shape, Box):
            out = float((np.abs(q) - half).max())
        else:
            out = max(float(np.hypot(q[0], q[2])) - radius, abs(q[1]) - 0.6)
        if abs(out) > 0.015:  # an uneven cylinder is a 32-sided prism
            probe.set_transforms([at(p)])
            assert collide(world, probe) == (out < 0)


def test_flat_hulls_and_odd_input_are_refused():
    with pytest.raises(SceneError, match="H3-SIM-031"):
        FclScene(scene_of((Hull(points=np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 1.0]])), IDENTITY, (1, 1, 1))))
    with pytest.raises(InputError, match="H3-SIM-030"):
        FclScene(scene_of((UNIT_BOX, IDENTITY, (1, 0, 1))))
    moving = MovingShapes([sphere(0.1)])
    with pytest.raises(InputError, match=r"(?s)4x4.*1.*H3-SIM-026"):
        moving.set_transforms(np.zeros((2, 4, 4)))
    with pytest.raises(InputError, match="H3-SIM-027"):
        moving.set_transforms(np.full((1, 4, 4), np.nan))


def test_empty_worlds_touch_nothing():
    empty, probe = FclScene(scene_of((UNIT_BOX, IDENTITY, (1, 1, 1)), motion="kinematic")), MovingShapes([sphere(0.1)])
    assert len(empty) == 0
    assert not collide(empty, probe)
    assert contacts(probe, empty) == []
    assert distance(empty, probe) == np.inf


def test_two_cylinders_agree_with_the_free_space():
    """Spot's two cylinders against furniture: FCL and the distance grid differ only within 6 mm of touching."""
    rng = np.random.default_rng(0)
    placed = []
    for _ in range(12):
        half = np.array([rng.uniform(0.2, 0.6), 0.5, rng.uniform(0.2, 0.6)])
        pose = np.concatenate(
            [[rng.uniform(1, 7), 0.5, rng.uniform(1, 7)], quat_from_heading(rng.choice([0.0, 0.4, 1.1]))]
        )
        placed.append((Box(pose=IDENTITY, half_extents=half), pose, (1, 1, 1)))
    room = Room(name="r", category="room", rectangles=np.array([[-2.0, -2.0, 10.0, 10.0]]))
    scene = scene_of(*placed, rooms=(room,))
    space, world = FreeSpace.from_scene(scene, cache=False), FclScene(scene)
    robot = MovingShapes([Cylinder(pose=IDENTITY, radius=0.25, half_height=0.35)] * 2)
    offsets = np.array([0.0, 0.225])
    disagree, hits = [], 0
    for _ in range(1500):
        x, z, heading = *rng.uniform(0, 8, 2), rng.uniform(-np.pi, np.pi)
        centres = np.array([x, z]) + offsets[:, None] * np.array([np.cos(heading), -np.sin(heading)])
        robot.set_transforms([at([c[0], 0.6, c[1]]) for c in centres])
        hit = collide(robot, world)
        grid = float(space.clearance(centres).min())
        hits += hit
        if hit != (grid < 0):
            disagree.append(distance(robot, world))
    assert 300 < hits < 1200
    assert len(disagree) < 15
    assert (np.abs(disagree) < 0.006).all()


# --- robot and person ---------------------------------------------------------------------------------------------------
BONES = np.array([[[0, 0.9, 0], [0, 1.5, 0]], [[0, 1.4, 0.2], [0.1, 0.9, 0.5]], [[0, 0.1, 0.1], [0, 0.9, 0.1]]])
BODY = (
    Box(pose=IDENTITY, half_extents=np.array([0.45, 0.1, 0.12])),
    Cylinder(pose=IDENTITY, radius=0.05, half_height=0.3),
)


def test_agent_contact_equals_the_ungated_check():
    rng = np.random.default_rng(0)
    start, end, radius = BONES[:, 0], BONES[:, 1], np.array([0.15, 0.05, 0.08])
    pair = AgentContacts(BODY, shapes_from_capsules(start, end, radius))
    robot, human = MovingShapes(BODY), MovingShapes(shapes_from_capsules(start, end, radius))
    hits = 0
    for _ in range(300):
        base = at(
            [*rng.uniform(-1, 1, 1), 0.5, *rng.uniform(-1, 1, 1)],
            quat_to_matrix(quat_from_heading(rng.uniform(-3, 3))),
        )
        frames = np.stack([base, base @ at([0.4, 0.3, 0])])
        turn = at(rng.uniform(-0.3, 0.3, 3), quat_to_matrix(quat_from_heading(rng.uniform(-3, 3))))
        a, b = transform_points(turn, start), transform_points(turn, end)
        pair.update(0, frames)
        pair.update(1, capsule_transforms(a, b))
        robot.set_transforms(frames)
        human.set_transforms(capsule_transforms(a, b))
        expected = collide(robot, human)
        assert pair.collides() is expected
        assert pair.touching() == [(0, 1)] * expected
        assert bool(pair.contacts()) is expected
        assert pair.distance() == pytest.approx(distance(robot, human), abs=1e-9)
        hits += expected
    assert 20 < hits < 200


def test_agents_far_apart_never_reach_fcl():
    pair = AgentContacts(BODY, shapes_from_capsules(BONES[:, 0], BONES[:, 1], 0.1))
    pair.update(0, np.stack([at([5, 0.5, 0]), at([5.4, 0.8, 0])]))
    pair.update(1, capsule_transforms(BONES[:, 0], BONES[:, 1]))
    assert not pair.collides()
    assert all(body._stale for body in pair._bodies)  # nothing was posed in FCL
    assert pair.distance() > 4
    pair.update(0, np.stack([at([0, 1.0, 0]), at([0.4, 1.3, 0])]))
    assert pair.collides()
    assert {c.index_b for c in pair.contacts()} >= {0}


@given(st.integers(0, 10**6), st.sampled_from(["skew", "parallel", "point", "points", "crossing"]))
def test_distance_of_segments_is_what_a_search_finds(seed, kind):
    rng = np.random.default_rng(seed)
    p, q, r, s = rng.uniform(-1, 1, (4, 3))
    if kind == "parallel":
        s = r + (q - p) * rng.uniform(-2, 2)
    if kind in ("point", "points"):
        q = p
    if kind == "points":
        s = r
    if kind == "crossing":
        s = 2 * (p + rng.uniform(0, 1) * (q - p)) - r
    assert np.sqrt(segment_square(p, q, r, s)) == pytest.approx(segment_distance(p, q, r, s), abs=2e-5)
    assert segment_square(p, q, r, s) == pytest.approx(segment_square(s, r, q, p), abs=1e-12)


@given(st.integers(0, 10**6))
def test_bounding_capsules_hold_their_shapes(seed):
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.normal(size=3), quat_from_axis_angle(rng.normal(size=3), rng.uniform(-3, 3))])
    for shape in (
        Box(pose=pose, half_extents=rng.uniform(0.1, 1, 3)),
        Cylinder(pose=pose, radius=0.4, half_height=0.7),
        Capsule(start=rng.normal(size=3), end=rng.normal(size=3), radius=0.3),
        Hull(points=rng.normal(size=(9, 3))),
    ):
        start, end, radius = bounding_capsule(shape)
        body, ball = MovingShapes([shape]), MovingShapes([sphere(0.05)])
        for point in start + rng.normal(size=(20, 3)):
            ball.set_transforms([at(point)])
            away = np.sqrt(segment_square(start, end, point, point))
            assert away < radius + 0.051 or not collide(body, ball)


@given(st.integers(0, 10**6))
def test_bounding_spheres_hold_their_shapes(seed):
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.normal(size=3), quat_from_axis_angle(rng.normal(size=3), rng.uniform(-3, 3))])
    a, b, r = rng.normal(size=3), rng.normal(size=3), 0.3
    points = rng.normal(size=(9, 3))
    for shape in (
        Box(pose=pose, half_extents=rng.uniform(0.1, 1, 3)),
        Cylinder(pose=pose, radius=0.4, half_height=0.7),
        Capsule(start=a, end=b, radius=r),
        Hull(points=points),
    ):
        centre, radius = bounding_sphere(shape)
        body, ball = MovingShapes([shape]), MovingShapes([sphere(0.01)])
        for direction in rng.normal(size=(4, 3)):
            ball.set_transforms([at(centre + direction / np.linalg.norm(direction) * (radius + 0.02))])
            assert not collide(body, ball)


@given(st.integers(0, 10**6))
def test_bounds_are_where_a_wall_first_touches(seed):
    """A box pushed against each side of the bounds touches the shape at once, and 2 mm before not yet."""
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.normal(size=3), quat_from_axis_angle(rng.normal(size=3), rng.uniform(-3, 3))])
    frame = at(rng.normal(size=3), quat_to_matrix(quat_from_axis_angle(rng.normal(size=3), rng.uniform(-3, 3))))
    for shape in (
        Box(pose=pose, half_extents=rng.uniform(0.1, 1, 3)),
        Cylinder(pose=pose, radius=0.4, half_height=0.7),
        Capsule(start=rng.normal(size=3), end=rng.normal(size=3), radius=0.3),
        Hull(points=rng.normal(size=(9, 3))),
    ):
        body, wall = MovingShapes([shape]), MovingShapes([Box(pose=IDENTITY, half_extents=np.full(3, 9.0))])
        body.set_transforms([frame])
        low, high = shape_bounds(shape, frame)
        for axis, sign in itertools.product(range(3), (-1, 1)):
            for gap, touches in ((0.002, False), (-0.002, True)):
                center = (low + high) / 2
                center[axis] = (high if sign > 0 else low)[axis] + sign * (9.0 + gap)
                wall.set_transforms([at(center)])
                assert collide(body, wall) is touches
