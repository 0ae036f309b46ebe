"""The example that learns social navigation: it learns, the same again, and after having been killed as if it had not."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.paths import EXAMPLES

torch = pytest.importorskip("torch")

from h3data.errors import InputError  # noqa: E402
from h3data_training.torch.episodes import EpisodeBank  # noqa: E402
from sim_kinematic.policies.assignment import resolve_policy  # noqa: E402
from sim_kinematic.policies.network import load_network  # noqa: E402
from sim_kinematic.tasks.registry import find_task  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
EXAMPLE = EXAMPLES / "train_social_nav.py"
WORLDS, ROLLOUT = 64, 32


@pytest.fixture(scope="module")
def bank() -> EpisodeBank:
    return EpisodeBank.draw("small:1", 64, seed=0)


@pytest.fixture
def example() -> dict[str, Any]:
    """The names in the example, with small rollouts."""
    names = runpy.run_path(str(EXAMPLE))
    names["train"].__globals__["ROLLOUT"] = ROLLOUT
    return names


def run(
    example: dict[str, Any], out: Path, bank: EpisodeBank, *, rounds: int, **options: Any
) -> list[dict[str, float]]:
    options = {"checkpoint_s": 1e9, "minibatch": 256, **options}
    return example["train"](out, episodes=bank, worlds=WORLDS, steps=rounds * WORLDS * ROLLOUT, **options)


@pytest.mark.slow
def test_it_learns_and_its_weights_play(example: dict[str, Any], bank: EpisodeBank, tmp_path: Path) -> None:
    curve = run(example, tmp_path / "net.npz", bank, rounds=16)
    reward = np.array([row["reward"] for row in curve])
    assert len(curve) == 16
    written = np.genfromtxt(tmp_path / "net.csv", delimiter=",", names=True)
    assert written.dtype.names == ("step", "reward", "followed", "collided")
    np.testing.assert_array_equal(written["reward"], reward)
    assert reward[-6:].mean() > reward[:2].mean() + 0.3
    network = load_network(tmp_path / "net.npz")
    assert network.observations == example["OBSERVATIONS"]
    assert network.inputs == len(network.mean) == len(network.scale) == 21
    resolve_policy(find_task("social_nav"), "robot", f"weights:{tmp_path / 'net.npz'}", None)


@pytest.mark.slow
def test_who_was_killed_goes_on_to_the_same_weights(
    example: dict[str, Any], bank: EpisodeBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run(example, tmp_path / "whole.npz", bank, rounds=4, seed=3)
    learn, calls = example["learn"], 0

    def killed(*args: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise KeyboardInterrupt
        learn(*args)

    monkeypatch.setitem(example["train"].__globals__, "learn", killed)
    with pytest.raises(KeyboardInterrupt):
        run(example, tmp_path / "cut.npz", bank, rounds=4, seed=3, checkpoint_s=0.0)
    assert not (tmp_path / "cut.npz").exists()
    assert run(example, tmp_path / "cut.npz", bank, rounds=4, seed=3, resume=True) == whole
    assert calls == 5
    assert load_network(tmp_path / "cut.npz").digest == load_network(tmp_path / "whole.npz").digest
    with pytest.raises(InputError, match="'seed': 3"):
        run(example, tmp_path / "cut.npz", bank, rounds=4, seed=4, resume=True)
    run(example, tmp_path / "other.npz", bank, rounds=1, seed=4)
    assert load_network(tmp_path / "other.npz").digest != load_network(tmp_path / "whole.npz").digest


@pytest.mark.slow
def test_advantages_end_with_their_episodes(example: dict[str, Any]) -> None:
    steps, worlds = 12, 5
    generator = torch.Generator().manual_seed(0)
    ended = torch.rand(steps, worlds, generator=generator) < 0.3
    seen = {
        "x": torch.randn(steps, worlds, 1, generator=generator),
        "reward": torch.randn(steps, worlds, generator=generator),
        "ended": ended,
        "terminated": ended & (torch.rand(steps, worlds, generator=generator) < 0.5),
    }
    last = torch.randn(worlds, 1, generator=generator)

    class Values:
        def value(self, x: Any) -> Any:
            return x[..., 0]

    example["add_advantages"](seen, Values(), last, 0.97)
    gamma, decay = 0.97, example["LAMBDA"]
    value = torch.cat([seen["x"], last[None]])[..., 0]
    for w in range(worlds):
        for t in range(steps):
            wanted, weight = 0.0, 1.0
            for k in range(t, steps):  # sum of (gamma lambda)^n delta up to the end of the episode
                after = 0.0 if seen["terminated"][k, w] else gamma * value[k + 1, w]
                wanted += weight * ((1 - gamma) * seen["reward"][k, w] + after - value[k, w])
                weight *= gamma * decay
                if ended[k, w]:
                    break
            assert float(seen["gain"][t, w]) == pytest.approx(float(wanted), abs=1e-5)
    torch.testing.assert_close(seen["return"], seen["gain"] + value[:-1])


def test_observations_are_normalised_by_all_that_was_seen(example: dict[str, Any]) -> None:
    learner = example["Learner"](3)
    learner.seen.fill_(0)
    parts = [torch.randn(n, 3, generator=torch.Generator().manual_seed(n)) * 4 + 9 for n in (500, 20, 3000)]
    for part in parts:
        learner.look(part)
    every = torch.cat(parts)
    torch.testing.assert_close(learner.mean, every.mean(0), rtol=0, atol=1e-4)
    torch.testing.assert_close(learner.var, every.var(0), rtol=0.01, atol=0)
