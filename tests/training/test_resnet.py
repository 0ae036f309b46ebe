"""The paper's network: it is trained by the same learner, written to policy files, and plays as it was trained."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from benchmarks import training
from h3data.errors import FormatError, InputError
from h3data_pipelines.cli import main
from h3data_training.episodes import make_bank
from h3data_training.networks import actor_numbers, network
from h3data_training.run import POLICY, train
from h3data_training.settings import recipe
from sim_kinematic.policies.learned import network_of
from sim_kinematic.policies.networks import resnet_lstm
from sim_kinematic.policies.networks.resnet_lstm import ResNet18, ResNetLSTM, ResNetPolicy
from sim_kinematic.policies.visual_policy import FILE_FORMAT
from tests.training.runs import small
from tests.training.torch.capturable import CapturableOnly

SETTINGS = small(network="resnet18_lstm", picture_size=(30, 22), channels=(16, 1, 1), features=8, hidden=6, updates=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: Any) -> Path:
    """A run of two updates."""
    folder = tmp_path_factory.mktemp("resnet")
    assert train(folder, SETTINGS, bank=make_bank(SETTINGS, seed=0, workers=1)).updates == 2
    return folder


@pytest.mark.slow
def test_it_learns_and_its_file_gives_what_was_trained(folder: Path) -> None:
    policy = network_of(f"weights:{folder / POLICY}")
    assert isinstance(policy, ResNetPolicy)
    assert policy.card.network == "resnet18_lstm"
    torch.manual_seed(0)
    net = network(SETTINGS)
    fresh = net.arrays()
    moved = [name for name, array in policy.arrays.items() if not np.array_equal(array, fresh[name])]
    assert set(moved) >= {"visual.first.weight", "lstm.weight_ih_l0", "lstm.weight_hh_l1", "act.weight"}
    net.take(policy.arrays)
    rng = np.random.default_rng(0)
    state, last, kept = torch.zeros(1, net.state_length), torch.zeros(1, 2), policy.start()
    shown: dict[str, np.ndarray] = {}
    for _ in range(5):
        shown = {
            "arm_depth": rng.uniform(0, 1, (22, 30, 1)).astype(np.float32),
            "humanoid_detector": np.ones(1, np.float32),
            "humanoid_gps": np.array([rng.uniform(0, 9), rng.uniform(-3, 3)]),
        }
        batch = {n: torch.as_tensor(v, dtype=torch.float32)[None] for n, v in shown.items()}
        with torch.no_grad():
            numbers = actor_numbers(batch, last, SETTINGS.observations)
            mean, state = net.step(net.pixels(batch["arm_depth"]), numbers, state)
        out, kept = policy(shown, last[0].numpy(), kept)
        np.testing.assert_allclose(out, mean[0].numpy(), atol=1e-5)
        np.testing.assert_allclose(kept, state[0].numpy(), atol=1e-5)
        last = mean.clamp(-1, 1)
    with pytest.raises(InputError, match=r"(?s)arm_depth \[22, 30, 1\].*H3-POLICY-033"):
        policy({**shown, "arm_depth": np.zeros((12, 16, 1))}, np.zeros(2, np.float32), kept)


def test_it_plays_wherever_a_policy_has_a_name(folder: Path, tmp_path: Path) -> None:
    options = "--scenes h3-homes/train#0 --episodes 1 --max-steps 20 --mcap"
    policy = f"weights:{folder / POLICY}"
    assert main(["generate", "social_nav", *options.split(), "--policy", policy, "-o", str(tmp_path / "ds")]) == 0
    (episode,) = (tmp_path / "ds").rglob("*.mcap")
    assert main(["replay", str(episode), "--verify"]) == 0


@pytest.mark.slow
def test_it_goes_on_from_a_file_of_the_same_network_only(folder: Path, tmp_path: Path) -> None:
    policy = network_of(f"weights:{folder / POLICY}")
    assert isinstance(policy, ResNetPolicy)
    bank = make_bank(SETTINGS, seed=0, workers=1)
    frozen = replace(SETTINGS, critic_updates=5, updates=1)
    train(tmp_path, frozen, init=policy, bank=bank)
    after = network_of(f"weights:{tmp_path / POLICY}")
    assert isinstance(after, ResNetPolicy)
    for name, array in policy.arrays.items():
        np.testing.assert_array_equal(after.arrays[name], array, err_msg=name)  # only the critic has learned
    parent = after.card.training["parent"]
    assert (parent["digest"], parent["updates"], parent["steps"]) == (policy.digest[:12], 2, 72)
    with pytest.raises(InputError, match="H3-TRAIN-021"):
        train(tmp_path, small(picture_size=(32, 24)), init=policy, bank=bank)
    with pytest.raises(InputError, match="H3-TRAIN-021"):
        train(tmp_path, replace(SETTINGS, picture_size=(16, 12)), init=policy, bank=bank)
    with pytest.raises(InputError, match="H3-TRAIN-022"):
        train(tmp_path, replace(SETTINGS, hidden=7), init=policy, bank=bank)


def test_rolling_resets_where_episodes_begin() -> None:
    torch.manual_seed(2)
    net = network(SETTINGS)
    steps, batch = 7, 3
    x = torch.randn(steps, batch, 8 + 9)
    first, begins = torch.randn(batch, net.state_length), torch.rand(steps, batch) < 0.3
    rolled, state = net.roll(x, first, begins), first
    for t in range(steps):
        out, state = net.remember(x[t][None], state * ~begins[t][:, None])
        torch.testing.assert_close(rolled[t], out[0])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:TF32 acceleration on top of oneDNN")
def test_norms_of_sixteen_bits_are_as_near(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where convolutions have 16 bits, as on a GPU, norms of 16 are no farther from the exact features and gradients than norms
    of 32, which round again in the next convolution."""
    torch.manual_seed(0)
    visual, pixels = ResNet18((30, 22), given=1, planes=32, features=64), torch.rand(8, 1, 22, 30)
    target = torch.randn(8, 64)

    def learned(*, short: bool) -> tuple[torch.Tensor, torch.Tensor]:
        visual.zero_grad()
        with torch.backends.mkldnn.flags(enabled=False):  # its gradients of 16 bits read memory that nobody wrote
            with torch.autocast("cpu", torch.bfloat16, enabled=short):
                found = visual(pixels).float()
            (found - target).square().mean().backward()
        return found.detach(), torch.cat([p.grad.flatten() for p in visual.parameters() if p.grad is not None])

    exact, short = learned(short=False), learned(short=True)
    monkeypatch.setattr(resnet_lstm._Norm, "forward", lambda norm, x: torch.nn.GroupNorm.forward(norm, x.float()))
    for wanted, found, long in zip(exact, short, learned(short=True), strict=True):
        assert not torch.equal(found, long)
        assert (found - wanted).norm() < 1.5 * (long - wanted).norm() < 0.4 * wanted.norm()


def test_a_decision_waits_for_nothing() -> None:
    net = network(SETTINGS)
    pixels, numbers, state = torch.rand(3, 1, 22, 30).half(), torch.rand(3, 9), torch.zeros(3, net.state_length)
    with CapturableOnly(), torch.no_grad():
        net.step(pixels, numbers, state)


@pytest.mark.slow
def test_its_benchmark_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """As on a GPU, in two small worlds: each case gives its lines, nothing after the time is over."""
    monkeypatch.setattr(training, "ROLLOUT", 2)
    lines: dict[str, float] = {}
    times = iter([False, False, False, True])

    def emit(name: str, value: float, unit: str) -> None:
        lines[name] = value

    cases = [training.Case(2), training.Case(2, hold=3), training.Case(2, hold=3, learned=4), training.Case(2)]
    training.measure(emit, SETTINGS, cases, device="cpu", passes=1, over=lambda: next(times))
    place = "training.cpu.paper_network_w2"
    names = [f"{place}.{name}" for name in ("acting_decisions_per_s", "acting_steps_per_s", "environment_steps_per_s")]
    held = [name.replace("w2", "w2_hold3") for name in names]
    learning = [f"{place}_hold3.learning_{of}_per_s" for of in ("decisions", "steps")]
    assert list(lines) == [*names, *held, *learning]
    assert min(lines.values()) > 0
    assert lines[held[1]] == pytest.approx(3 * lines[held[0]])
    assert "no time for training.cpu.paper_network_w2\n" in capsys.readouterr().out


def test_it_has_the_published_size() -> None:
    net = ResNetLSTM(9, size=(224, 171))
    assert sum(p.numel() for p in net.parameters()) == pytest.approx(8_517_000, rel=0.01)
    settings = recipe("paper")
    assert settings.updates * settings.decisions_per_update == pytest.approx(200e6, rel=0.001)


@pytest.mark.parametrize(
    ("card", "arrays", "message"),
    [
        ({"network": "transformer"}, {}, r"(?s)unknown network 'transformer'.*H3-POLICY-007"),
        ({"network": "cnn_gru", "picture_size": (32, 24)}, {}, r"(?s)conv_0\.weight is missing.*H3-POLICY-007"),
        ({"picture_size": (4, 4)}, {}, r"(?s)expected sides of 8 to 1024.*H3-POLICY-007"),
        ({"observations": ("humanoid_gps",)}, {}, r"(?s)unknown array visual\.first\.weight.*H3-POLICY-007"),
        (
            {},
            {"act.weight": np.full((2, 6), np.nan, np.float32)},
            r"(?s)act\.weight holds numbers that are not finite.*H3-POLICY-007",
        ),
        ({}, {"lstm.weight_hh_l0": np.zeros((0,), np.float32)}, r"(?s)lstm\.weight_hh_l0 has the shape.*H3-POLICY-007"),
        (
            {},
            {"visual.first.weight": np.zeros((5, 1, 7, 7), np.float32)},
            r"(?s)visual\.first\.weight has the shape.*H3-POLICY-007",
        ),
    ],
)
def test_damaged_policies_are_refused(
    folder: Path, tmp_path: Path, card: dict[str, Any], arrays: dict[str, Any], message: str
) -> None:
    policy = network_of(f"weights:{folder / POLICY}")
    assert isinstance(policy, ResNetPolicy)
    about = msgspec.json.decode(msgspec.json.encode(policy.card)) | card
    rows = {"format": np.array(FILE_FORMAT), "card": np.array(msgspec.json.encode(about).decode())}
    np.savez(tmp_path / "p.npz", **rows, **{**policy.arrays, **arrays})
    with pytest.raises(FormatError, match=message):
        network_of(f"weights:{tmp_path / 'p.npz'}")
