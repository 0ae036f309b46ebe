"""Clothes, hair and faces: every outfit fits everybody, moves nothing, and lets no skin through; children and older people."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bake.people.look.drafts import canonical, pack_faces
from h3data.bodies import Humanoid, humanoid_names, load_humanoid
from h3data.bodies.people.humanoid_file import ADULTS, FILE_FORMAT, read_arrays
from h3data.bodies.people.look.colors import PAINTS, SLOTS, Complexion
from h3data.bodies.people.look.dressing import Look, read_look
from h3data.bodies.people.look.patches import unpack_faces
from h3data.bodies.people.look.wardrobe import HAIRSTYLES, OUTFITS, builtin_wardrobe, split_outfit
from h3data.bodies.people.reach import reach
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.bodies.people.soles import LEG_JOINTS, sole_points
from h3data.builtin import builtin_path
from h3data.errors import InputError
from h3data.render import Renderer, RenderInstance, RenderScene, look_at, pinhole
from sim_kinematic.agents.roster import make_roster

ROOT = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
CHILDREN = tuple(f"child_{k}" for k in range(4))
CLOTH = tuple(k for k, name in enumerate(SLOTS) if name in ("top", "top trim", "bottom", "bottom trim"))
MOVES = (
    "joint_offsets",
    "bind_rotation",
    "bind_position",
    "capsule_start",
    "capsule_end",
    "capsule_radius",
    "feet",
    "ankle_height",
    "walk",
    "jog",
    "height_m",
)
MOVES_DIGEST = "b8169aed82264ae9"


@pytest.mark.slow
@pytest.mark.parametrize(
    "outfit", [pytest.param(n, marks=() if n in ("casual", "dress") else pytest.mark.slow) for n in OUTFITS]
)
def test_every_outfit_fits_everybody(outfit: str) -> None:
    for name in humanoid_names():
        body = load_humanoid(f"{name}:{outfit}")
        assert body.outfit == outfit
        for part in (body.full, body.lod):
            mesh = part.mesh
            assert mesh.normals is not None
            assert mesh.colors is not None
            assert len(mesh.vertices) == len(mesh.colors) == len(mesh.normals) == len(part.weights) == len(part.regions)
            assert np.isfinite(mesh.vertices).all()
            np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-4)
            np.testing.assert_allclose(part.weights.sum(axis=1), 1, atol=1e-6)
            assert part.joints.max() < 55
            assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))  # every vertex is drawn
            assert mesh.vertices[:, 1].min() > -0.004
            worn = {SLOTS[k] for k in np.unique(part.regions)}
            assert {"skin", "sclera", "iris", "brows", "top", "shoes", "soles"} <= worn
            assert ("bottom" in worn) is not OUTFITS[outfit].tights


def test_outfits_differ_in_cut_and_change_only_what_is_seen() -> None:
    plain = load_humanoid("male_3")
    shapes = set()
    for outfit in OUTFITS:
        body = load_humanoid(f"male_3:{outfit}")
        shapes.add((len(body.mesh.vertices), len(body.mesh.faces)))
        assert body.name == f"male_3:{outfit}"
        np.testing.assert_array_equal(body.inverse_bind, plain.inverse_bind)
        np.testing.assert_array_equal(body.joint_offsets, plain.joint_offsets)
        for one, other in zip(body.capsules, plain.capsules, strict=True):
            assert (one.radius, *one.start, *one.end) == (other.radius, *other.start, *other.end)
        for one, other in zip(body.clip_pose([2], [0.3]), plain.clip_pose([2], [0.3]), strict=True):
            np.testing.assert_array_equal(one, other)
    assert len(shapes) == len(OUTFITS) >= 7


def test_what_moves_the_twelve_is_what_shipped() -> None:
    """Recordings hold names, and depend on these arrays to the bit."""
    digest = hashlib.sha256()
    for name in ADULTS:
        data = read_arrays(builtin_path(f"bodies/{name}.npz"), FILE_FORMAT)
        for key in MOVES:
            digest.update(data[key].tobytes())
    assert digest.hexdigest()[:16] == MOVES_DIGEST


def test_cloth_lies_over_the_skin_at_rest() -> None:
    wardrobe = builtin_wardrobe()
    main = [SLOTS.index(name) for name in ("top", "bottom")]
    for piece in {piece for outfit in OUTFITS.values() for piece in outfit.pieces}:
        for detail in ("full", "lod"):
            patch = wardrobe.patch(piece, detail)
            np.testing.assert_allclose(patch.shares.sum(axis=1), 1, atol=1e-6)
            assert (patch.shares >= -1e-6).all()
            low = -0.001 if detail == "full" else -0.007  # the light skin itself lies up to 6 mm inside the full one
            if piece != "hoodie":  # a hood is rolled up, and partly inside itself
                assert (patch.lift[np.isin(patch.slots, main)] >= low).all(), (piece, detail)
            if (patch.slots != SLOTS.index("soles")).all():
                assert np.mean(patch.lift < low) < 0.08, (piece, detail)


def test_light_cloth_is_not_stained() -> None:
    """The few vertices of a light mesh are far apart, and must not pass for deep hollows: no darker than in the full one."""
    body = load_humanoid("female_1")
    darkest = []
    for part in (body.full, body.lod):
        x, y, z = part.mesh.vertices.T / body.height_m
        assert part.mesh.normals is not None
        back = (part.regions == SLOTS.index("top")) & (part.mesh.normals[:, 2] < -0.6) & (np.abs(x) < 0.08)
        back &= (y > 0.56) & (y < 0.72) & (z < 0)
        bright = part.mesh.colors[back].sum(axis=1)
        assert len(bright) > 10
        darkest.append(bright.min() / np.median(bright))
    assert darkest[1] > darkest[0] - 0.02


@pytest.mark.parametrize("name", ["child_0", "female_0", "male_1", "neutral_3"])
def test_no_scalp_comes_through_light_hair(name: str) -> None:
    """From behind and from the sides, the upper half of the head shows hair."""
    body = load_humanoid(name)
    mesh = body.lod_mesh
    renderer = Renderer(RenderScene([mesh], [RenderInstance(0, np.eye(4))]))
    top = float(mesh.vertices[:, 1].max())
    for side in (-0.6, 0.0, 0.6):
        middle = np.array([0.0, top - 0.075, 0.0])
        camera = pinhole(
            96, 96, hfov_deg=8, pose=look_at(middle + 2 * np.array([np.sin(side), 0.1, -np.cos(side)]), middle)
        )
        seen = renderer.render(camera, outputs=("triangle",))["triangle"][:48]
        shown = body.lod.regions[mesh.faces[seen[seen >= 0], 0]]
        assert len(shown) > 300
        assert np.mean(shown == SLOTS.index("skin")) < 0.01


def _poses(body: Humanoid) -> np.ndarray:
    """Walking, reaching down and up: joint frames [T, 55, 4, 4]."""
    quats, pelvis = body.walk_pose([1.3] * 4, [0.02, 0.25, 0.5, 0.75])
    size = body.height_m / 1.76
    reached = [reach(body, size * np.array(p)) for p in ((0.45, 0.30, 0.2), (0.45, 1.65, 0.2))]
    assert all(r.status == "reached" for r in reached)
    quats = np.concatenate([quats, *(r.quats[None] for r in reached)])
    pelvis = np.concatenate([pelvis, *(r.pelvis[None] for r in reached)])
    return body.joint_matrices(np.tile(ROOT, (len(quats), 1)), quats, pelvis)


@pytest.mark.parametrize("outfit", OUTFITS)
@pytest.mark.parametrize(
    "name", ["female_2", *(pytest.param(name, marks=pytest.mark.slow) for name in ("male_1", "child_0"))]
)
def test_no_skin_comes_through_cloth(name: str, outfit: str) -> None:
    """Skin beside cloth stands out of it by at most some millimetres, in walking and reaching."""
    from scipy.spatial import KDTree

    body = load_humanoid(f"{name}:{outfit}")
    joints = _poses(body)
    points, normals = body.skin(joints, lod=False), body.skin_normals(joints, lod=False)
    skin, cloth = body.full.regions == SLOTS.index("skin"), np.isin(body.full.regions, CLOTH)
    rest = body.mesh.vertices
    # the skin below cloth at rest: nearer than 3 cm to it, and on its inner side
    distance, nearest = KDTree(rest[cloth]).query(rest[skin])
    near = np.asarray(nearest)
    assert body.mesh.normals is not None
    inside = np.sum((rest[skin] - rest[cloth][near]) * body.mesh.normals[cloth][near], axis=1)
    under = (distance < 0.03) & (inside < -0.002)
    assert under.sum() > 50
    assert inside[distance < 0.012].max() < 0.012
    for k in range(len(joints)):
        own, over = points[k][skin][under], points[k][cloth][near[under]]
        out = np.sum((own - over) * normals[k][cloth][near[under]], axis=1)
        assert np.percentile(out, 99) < 0.004
        assert out.max() < 0.015


def test_children_are_small_with_large_heads_and_planted_feet() -> None:
    for name in CHILDREN:
        body, adult = load_humanoid(name), load_humanoid("neutral_0")
        assert 1.15 < body.height_m < 1.45
        head = [
            (b.height_m - b.joint_matrices(ROOT, *b.clip_pose([0], [0.0]))[0, JOINT_INDEX["head"], 1, 3]) / b.height_m
            for b in (body, adult)
        ]
        assert head[0] > 1.1 * head[1]
        assert body.stride_m(1.0) < 0.95 * adult.stride_m(1.0)
        distance = np.arange(40) / 30
        quats, pelvis = body.walk_pose(np.full(40, 1.0), distance / body.stride_m(1.0))
        base = np.zeros((40, 7))
        base[:, 0], base[:, 6] = distance, 1.0
        soles = sole_points(body, body.joint_matrices(base, quats, pelvis)[:, LEG_JOINTS])
        down = (soles[:-1, ..., 1] < 2e-3) & (soles[1:, ..., 1] < 2e-3)
        steps = np.where(down, np.linalg.norm(np.diff(soles[..., ::2], axis=0), axis=-1), np.inf).min(axis=(1, 2))
        assert steps[np.isfinite(steps)].max() < 3e-4


def test_older_people_stoop_and_have_lines() -> None:
    for name in ("older_0", "older_1"):
        body, upright = load_humanoid(name), load_humanoid("female_0")
        ahead = [
            b.joint_matrices(ROOT, *b.clip_pose([0], [0.0]))[0, [JOINT_INDEX["neck"], JOINT_INDEX["pelvis"]], 0, 3]
            for b in (body, upright)
        ]
        assert (ahead[0][0] - ahead[0][1]) > (ahead[1][0] - ahead[1][1]) + 0.03
        assert (
            read_look(str(read_arrays(builtin_path(f"bodies/{name}.npz"), FILE_FORMAT)["look"])).complexion.lines > 0.4
        )


def test_names_of_outfits() -> None:
    assert split_outfit("female_0:dress") == ("female_0", "dress")
    assert split_outfit("random:7") == ("random:7", "")
    assert split_outfit("random:7:knit") == ("random:7", "knit")
    assert split_outfit("dress") == ("dress", "")
    assert load_humanoid("random:7:knit").outfit == "knit"
    with pytest.raises(InputError, match=r"(?s)'dres'\. Did you mean 'dress'.*H3-BODY-079"):
        load_humanoid("female_0:dres")
    with pytest.raises(InputError, match=r"(?s)'nobody'.*H3-BODY-072"):
        load_humanoid("nobody:dress")
    roster = make_roster(["robot", "female_0:dress", "human:random:3:knit", "child_1"])
    assert [agent.model for agent in roster[1:]] == ["female_0:dress", "random:3:knit", "child_1"]


def test_random_people_wear_different_things() -> None:
    people = [load_humanoid(f"random:{seed}") for seed in range(24)]
    assert len({body.outfit for body in people}) >= 5
    assert len({len(body.mesh.vertices) for body in people}) > 12


@settings(derandomize=True, max_examples=40, deadline=None)
@given(st.lists(st.lists(st.integers(0, 65535), min_size=3, max_size=3, unique=True), min_size=1, max_size=60))
def test_packed_faces_round_trip(rows: list[list[int]]) -> None:
    faces = np.array(rows)
    ordered = canonical(faces)
    np.testing.assert_array_equal(unpack_faces(pack_faces(ordered)), ordered)
    assert sorted(map(tuple, ordered)) == sorted(tuple(np.roll(f, -int(np.argmin(f)))) for f in faces)


def test_looks_round_trip() -> None:
    look = Look(
        complexion=Complexion(skin=(1, 2, 3), hair=(4, 5, 6), lines=0.5),
        hair=HAIRSTYLES[0],
        beard=True,
        outfit="knit",
        palette=2,
        colors={"scarf": (7, 8, 9)},
    )
    assert read_look(look.to_json()) == look


def test_the_wardrobe_holds_every_piece_and_stays_small() -> None:
    wardrobe = builtin_wardrobe()
    pieces = {"skin", "brows", "beard", *HAIRSTYLES, *(p for o in OUTFITS.values() for p in o.pieces)}
    assert {key.split("/")[0] for key in wardrobe.data if "/" in key} == pieces
    assert wardrobe.data["skin/full/paint"].shape[1] == len(PAINTS)
    assert sum(p.stat().st_size for p in builtin_path("bodies").rglob("*.npz")) < 2_500_000
