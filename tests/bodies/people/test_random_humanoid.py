"""People by a number: between two built-in ones, the same for the same number, and as good as these."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import h3data
from h3data.bodies import Humanoid, load_humanoid
from h3data.bodies.people import humanoid_file
from h3data.bodies.people.foot_planting import LEG_JOINTS, sole_points
from h3data.bodies.people.humanoid_file import ADULTS
from h3data.bodies.people.humanoid_file import load_humanoid as load
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


def test_only_the_two_bodies_that_are_blended_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    names: list[str] = []
    read = humanoid_file.read_arrays
    monkeypatch.setattr(humanoid_file, "read_arrays", lambda path, form: names.append(path.stem) or read(path, form))
    load.__wrapped__("random:7")
    assert len(set(names) - {"common"}) == len(names) == 2


@settings(max_examples=10)
@given(SEEDS)
def test_a_random_person_is_between_the_built_in_ones(seed: int) -> None:
    heights = [load_humanoid(name).height_m for name in ADULTS]
    body = load.__wrapped__(f"random:{seed}")
    assert min(heights) <= body.height_m <= max(heights)
    assert np.abs(np.ptp(body.mesh.vertices[:, 1]) - body.height_m) < 0.12  # hair and soles
    rotation = np.linalg.inv(body.inverse_bind)[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (55, 1, 1)), atol=1e-6)
    assert planted_creep_mm(body) < 0.3


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
    """Skinned in the posture in which it was baked, a blend gives its own vertices back."""
    body = load_humanoid("random:11")
    vertices = body.skin(np.linalg.inv(body.inverse_bind)[None], lod=False)[0]
    np.testing.assert_allclose(vertices, body.mesh.vertices, atol=2e-4)


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
    with pytest.raises(InputError, match="random:SEED"):
        load_humanoid(name)
