"""People by a number: shapes of their own, the same for the same number, and as good as the built-in ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import h3data
from h3data.bodies import Humanoid, load_humanoid
from h3data.bodies.people.humanoid_file import _builtin_arrays, humanoid_names
from h3data.bodies.people.humanoid_file import load_humanoid as load
from h3data.bodies.people.random_humanoid import ADULT_HEIGHT_M, DIRECTIONS, _shape_space, _weights
from h3data.bodies.people.soles import LEG_JOINTS, sole_points
from h3data.errors import InputError
from h3data_pipelines.cli import main

SEEDS = st.integers(0, 2**31 - 1)


def test_the_same_number_is_the_same_person_and_another_is_another() -> None:
    load.cache_clear()
    first = load_humanoid("random:7")
    load.cache_clear()
    again = load_humanoid("random:7")
    np.testing.assert_array_equal(first.mesh.vertices, again.mesh.vertices)
    np.testing.assert_array_equal(first.mesh.colors, again.mesh.colors)
    other = load_humanoid("random:8")
    assert other.height_m != first.height_m
    assert not np.array_equal(other.mesh.colors, first.mesh.colors)


@settings(max_examples=10)
@given(SEEDS)
def test_a_random_person_is_an_adult_that_walks(seed: int) -> None:
    body = load.__wrapped__(f"random:{seed}")
    assert ADULT_HEIGHT_M[0] <= body.height_m <= ADULT_HEIGHT_M[1]
    assert np.abs(np.ptp(body.mesh.vertices[:, 1]) - body.height_m) < 0.12  # hair and soles
    rotation = np.linalg.inv(body.inverse_bind)[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (55, 1, 1)), atol=1e-6)
    assert planted_creep_mm(body) < 0.3
    assert min(capsule.radius for capsule in body.capsules) > 0.02


def test_shapes_are_no_blends_of_two_bodies() -> None:
    for seed in range(8):
        rng = np.random.Generator(np.random.Philox(seed))
        ages = [float(json.loads(str(_builtin_arrays(name)["phenotype"]))["age"]) for name in humanoid_names()]
        weights = _weights(rng, ages, [load_humanoid(name).height_m for name in humanoid_names()])
        assert sum(weights) == pytest.approx(1, abs=1e-4)  # rounded directions
        assert sum(abs(w) > 0.02 for w in weights) > 5


def test_directions_are_orthogonal_and_a_step_is_a_standard_deviation() -> None:
    space = _shape_space()
    assert space.bodies == humanoid_names()
    rows = np.array(space.directions)
    assert rows.shape == (DIRECTIONS, len(space.bodies))
    np.testing.assert_allclose(rows.sum(axis=1), 0, atol=1e-4)
    np.testing.assert_allclose(len(space.bodies) * rows @ rows.T, np.eye(DIRECTIONS), atol=1e-4)


def planted_creep_mm(body: Humanoid, speed: float = 1.3) -> float:
    """How far the lowest point of a sole moves along the floor in 1/30 s of walking, at most."""
    distance = np.arange(60) * speed / 30
    quats, pelvis = body.walk_pose(np.full(60, speed), distance / body.stride_m(speed))
    base = np.zeros((60, 7))
    base[:, 0], base[:, 6] = distance, 1.0
    soles = sole_points(body, body.joint_matrices(base, quats, pelvis)[:, LEG_JOINTS])
    down = (soles[:-1, ..., 1] < 2e-3) & (soles[1:, ..., 1] < 2e-3)
    steps = np.linalg.norm(np.diff(soles[..., ::2], axis=0), axis=-1)
    best = np.where(down, steps, np.inf).min(axis=(1, 2))
    return 1000 * float(best[np.isfinite(best)].max())


def test_the_skin_follows_the_skeleton() -> None:
    """Skinned in the posture in which it was baked, a random person gives its own vertices back."""
    body = load_humanoid("random:11")
    vertices = body.skin(np.linalg.inv(body.inverse_bind)[None], lod=False)[0]
    np.testing.assert_allclose(vertices, body.mesh.vertices, atol=2e-4)


@pytest.mark.slow
def test_episodes_make_people_of_their_own_and_verify(tmp_path: Path) -> None:
    out = tmp_path / "ds"
    words = ["--human", "random", "--scenes", "small:1", "--max-steps", "20"]
    assert main(["generate", "social_nav", "--episodes", "2", *words, "-o", str(out)]) == 0
    dataset = h3data.Dataset(out)
    models = {dataset[k].agents[1].model for k in range(2)}
    assert len(models) == 2
    assert all(model.startswith("humanoid/random:") for model in models)
    assert main(["replay", f"{out}#0", "--verify"]) == 0
    image = h3data.render_frame(dataset[0], camera="third_person", step=10)["rgb"]
    assert image.std() > 10


@pytest.mark.slow
def test_each_person_of_an_episode_is_another(tmp_path: Path) -> None:
    out = tmp_path / "ds"
    words = [
        "generate",
        "wander",
        "--agents",
        "human,human",
        "--human",
        "random",
        "--episodes",
        "1",
        "--max-steps",
        "30",
    ]
    assert main([*words, "-o", str(out)]) == 0
    first, second = h3data.Dataset(out)[0].agents
    assert first.model != second.model


@pytest.mark.parametrize("name", ["random:", "random:x", "random:-1", "random", "random:1.5"])
def test_names_that_mean_nobody_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=r"(?s)random:SEED.*H3-BODY-072"):
        load_humanoid(name)
