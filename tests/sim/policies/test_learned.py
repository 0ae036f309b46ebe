"""Policies from files of weights: the same numbers as PyTorch, the same observations as the training environment, and
files that are no weights."""

from __future__ import annotations

import contextlib
import os
import pickle
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

import h3data
from h3data.errors import FormatError, InputError
from h3data.scene import FreeSpace
from h3data_pipelines.cli import main
from sim_kinematic.agents.skills import Action, choices
from sim_kinematic.motion.spec import BaseSpec, SocialNavSpec
from sim_kinematic.policies.assignment import resolve_policy
from sim_kinematic.policies.learned import LearnedNavigation, navigation_input, network_of, stamped
from sim_kinematic.policies.network import FILE_FORMAT, Network, from_torch, load_network, save_network
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.rearrange import Chooser, chooser_input, learned_chooser
from sim_kinematic.policies.views import RearrangeView, SocialNavView
from sim_kinematic.sensing.table import FOLLOWER
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.resume import verify
from tests.sim.steppers import social_nav_env
from tests.simulated import rearrange_episode, simulate_rearrange, simulate_social_nav, social_nav_episode

NAMES = ("humanoid_gps", "egomotion")
CHOOSER_INPUTS = ("holds", "at_goal", "last_done")


def small_network(*, seed: int = 0, outputs: int = 2, task: str = "social_nav") -> Network:
    rng = np.random.default_rng(seed)
    weights = [rng.normal(size=shape).astype(np.float32) for shape in ((8, 5), (outputs, 8))]
    biases = tuple(np.zeros(len(w), np.float32) for w in weights)
    return Network(task=task, observations=NAMES, weights=tuple(weights), biases=biases)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    save_network(small_network(), tmp_path / "net.npz")
    return tmp_path / "net.npz"


# --- the network --------------------------------------------------------------------------------------------------------
@given(
    widths=st.lists(st.integers(1, 9), min_size=2, max_size=5),
    kind=st.sampled_from([nn.Tanh, nn.ReLU]),
    bias=st.booleans(),
    seed=st.integers(0, 100),
)
@settings(max_examples=30, deadline=None)
def test_it_gives_what_pytorch_gives(widths: list[int], kind: type, bias: bool, seed: int) -> None:
    torch.manual_seed(seed)
    layers: list[nn.Module] = []
    for a, b in pairwise(widths):
        layers += [nn.Linear(a, b, bias=bias), kind()]
    module = nn.Sequential(*layers[:-1])
    x = torch.randn(7, widths[0])
    mean, scale = torch.randn(widths[0]), torch.rand(widths[0]) + 0.5
    network = from_torch(module, task="t", observations=["o"], mean=mean.numpy(), scale=scale.numpy())
    wanted = module((x - mean) / scale).detach().numpy()
    np.testing.assert_allclose(network(x.numpy()), wanted, rtol=1e-4, atol=1e-5)
    assert (network.inputs, network.outputs) == (widths[0], widths[-1])


def test_a_file_gives_back_what_was_saved(tmp_path: Path) -> None:
    network = small_network()
    save_network(network, tmp_path / "n.npz")
    again = load_network(tmp_path / "n.npz")
    x = np.random.default_rng(1).normal(size=(4, 5))
    np.testing.assert_array_equal(again(x), network(x))
    assert again.digest == network.digest != small_network(seed=1).digest
    assert str(again) == "Network(social_nav, humanoid_gps, egomotion: 5 - 8 - 2, tanh)"
    with zipfile.ZipFile(tmp_path / "n.npz") as packed:
        assert {n for n in packed.namelist() if "weight" in n} == {"weight_0.npy", "weight_1.npy"}


def test_layers_that_make_no_network_are_refused() -> None:
    one = small_network()
    with pytest.raises(InputError, match=r"(?s)layer 1.*for 8 inputs.*H3-POLICY-025"):
        Network(task="t", observations=("a",), weights=(one.weights[0], one.weights[0]), biases=one.biases)
    with pytest.raises(InputError, match=r"(?s)finite.*H3-POLICY-025"):
        Network(task="t", observations=("a",), weights=one.weights, biases=(one.biases[0] * np.nan, one.biases[1]))
    with pytest.raises(InputError, match=r"(?s)at least one.*H3-POLICY-025"):
        Network(task="t", observations=("a",), weights=(), biases=())
    with pytest.raises(InputError, match=r"(?s)scale positive.*H3-POLICY-025"):
        Network(task="t", observations=("a",), weights=one.weights, biases=one.biases, scale=np.zeros(1, np.float32))
    with pytest.raises(InputError, match=r"(?s)5.*H3-POLICY-026"):
        one(np.zeros(4))
    with pytest.raises(InputError, match="H3-POLICY-023"):
        from_torch([nn.Linear(2, 2), nn.Linear(2, 2), nn.Tanh()], task="t", observations=["a"])


# --- files that are none ------------------------------------------------------------------------------------------------
class Bomb:
    def __reduce__(self) -> tuple:
        return os.mkdir, ("/tmp/this-must-not-be-made",)


def other_arrays(**change: object) -> dict:
    net = small_network()
    arrays = {
        "format": FILE_FORMAT,
        "task": "social_nav",
        "activation": "tanh",
        "observations": list(NAMES),
        "mean": net.mean,
        "scale": net.scale,
        "weight_0": net.weights[0],
        "bias_0": net.biases[0],
        "weight_1": net.weights[1],
        "bias_1": net.biases[1],
        **change,
    }
    return {name: value for name, value in arrays.items() if value is not None}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "h3data.network/9"}, r"(?s)h3data\.network/9.*H3-POLICY-024"),
        ({"format": None}, r"(?s)another npz.*H3-POLICY-024"),
        ({"format": 3}, r"(?s)an array int64.*H3-POLICY-024"),
        ({"task": None}, r"(?s)'task'.*H3-POLICY-027"),
        ({"bias_1": None}, "(?s)bias_1.*H3-POLICY-027"),
        ({"activation": "sign"}, r"(?s)tanh, relu.*H3-POLICY-025"),
        ({"weight_1": np.zeros((2, 9), np.float32)}, r"(?s)layer 1.*H3-POLICY-025"),
        ({"weight_0": np.zeros(5, np.float32)}, r"(?s)layer 0.*H3-POLICY-025"),
        ({"weight_0": np.zeros((8, 5))}, r"(?s)float32.*H3-POLICY-025"),
        ({"weight_1": np.full((2, 8), np.inf, np.float32)}, r"(?s)finite.*H3-POLICY-025"),
        ({"mean": np.zeros(3, np.float32)}, r"(?s)expected \[1\] or \[5\].*H3-POLICY-025"),
        ({"observations": []}, r"(?s)observations.*H3-POLICY-025"),
        ({"weight_0": np.array([Bomb()], object)}, r"(?s)allow_pickle.*H3-POLICY-030"),
    ],
)
def test_arrays_that_are_no_network(tmp_path: Path, change: dict, message: str) -> None:
    np.savez(tmp_path / "x.npz", **other_arrays(**change))
    with pytest.raises(FormatError, match=message) as told:
        load_network(tmp_path / "x.npz")
    assert str(tmp_path) in str(told.value)
    assert not Path("/tmp/this-must-not-be-made").exists()


def _repacked(source: Path, target: Path, changed: dict[str, tuple[str, bytes]]) -> None:
    """A copy of a zip file with other members, check sums and all."""
    with zipfile.ZipFile(source) as packed, zipfile.ZipFile(target, "w") as copy:
        for name in packed.namelist():
            copy.writestr(*changed.get(name, (name, packed.read(name))))


def test_files_that_are_no_weights(tmp_path: Path, weights: Path) -> None:
    torch.save({"a": torch.zeros(2)}, tmp_path / "torch.pt")
    (tmp_path / "pickle.pkl").write_bytes(pickle.dumps(Bomb()))
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "text.npz").write_text("weights")
    (tmp_path / "short.npz").write_bytes(weights.read_bytes()[:-100])
    np.save(tmp_path / "array.npy", np.zeros(3))
    _repacked(weights, tmp_path / "no_array.npz", {"mean.npy": ("mean", b"0.0")})
    with zipfile.ZipFile(weights) as packed:
        header = packed.read("scale.npy").replace(b"}", b"(", 1)
    _repacked(weights, tmp_path / "header.npz", {"scale.npy": ("scale.npy", header)})
    for file in tmp_path.iterdir():
        if file != weights:
            with pytest.raises(FormatError, match="H3-POLICY-030"):
                load_network(file)
    for missing in (tmp_path / "no.npz", tmp_path):
        with pytest.raises(InputError, match="H3-POLICY-029"):
            load_network(missing)
    assert not Path("/tmp/this-must-not-be-made").exists()


@given(at=st.floats(0, 1), value=st.integers(0, 255))
@settings(max_examples=60, deadline=None)
def test_a_flipped_byte_is_noticed_or_harmless(tmp_path_factory: pytest.TempPathFactory, at: float, value: int) -> None:
    folder = tmp_path_factory.mktemp("flipped")
    save_network(small_network(), folder / "a.npz")
    data = bytearray((folder / "a.npz").read_bytes())
    data[int(at * (len(data) - 1))] = value
    (folder / "b.npz").write_bytes(data)
    with contextlib.suppress(InputError):
        assert np.isfinite(load_network(folder / "b.npz")(np.ones(5))).all()


def test_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: Path) -> None:
    monkeypatch.setattr("sim_kinematic.policies.network.MAX_BYTES", 64)
    with pytest.raises(FormatError, match=r"(?s)0.*H3-POLICY-028"):
        load_network(weights)


# --- social navigation --------------------------------------------------------------------------------------------------
def test_it_is_shown_what_the_training_environment_shows() -> None:
    names = FOLLOWER
    spec = SocialNavSpec(max_steps=25, spawn_distance_m=3.0)
    env = social_nav_env("small:1", spec=spec, observations=names)
    seen = [env.reset(seed=3)[0]]
    network = small_network()
    policy = LearnedNavigation(network)

    def watched(view: SocialNavView, base: BaseSpec) -> Velocity:
        shown.append(navigation_input(view, base, names))
        return policy(view, base)

    for _ in range(24):
        x = np.concatenate([seen[-1][name] for name in NAMES])
        seen.append(env.step(np.clip(network(x), -1, 1))[0])
    shown: list[np.ndarray] = []
    simulate_social_nav(env.stepper.play.episodes[0], policy=watched)
    np.testing.assert_array_equal(shown, [np.concatenate([o[n] for n in names]) for o in seen[: len(shown)]])
    assert len(shown) > 5


def test_by_name_it_drives_and_comes_out_again(weights: Path) -> None:
    home = h3data.build_home(h3data.HomeSpec(preset="small", seed=1))
    world = social_nav_episode(home, seed=2, spec=SocialNavSpec(max_steps=40, spawn_distance_m=3.0))
    named = simulate_social_nav(world, policy=f"weights:{weights}")
    given_ = simulate_social_nav(world, policy=LearnedNavigation(small_network()))
    np.testing.assert_array_equal(named.columns["state_hash"], given_.columns["state_hash"])
    assert np.ptp(named.columns["agent_0.action"], axis=0).max() > 0
    assert verify(named).equal


def test_the_weights_that_come_with_the_package_find_and_follow() -> None:
    home = h3data.build_home(h3data.HomeSpec(preset="small", seed=7))
    world = social_nav_episode(home, seed=2, spec=SocialNavSpec(max_steps=300, spawn_distance_m=3.0))
    recording = simulate_social_nav(world, policy="learned_follower")
    assert recording.episode.info["policy"] == "learned_follower"
    assert any(event.kind == "found" for event in recording.events)
    assert verify(recording).equal


def test_the_trained_robot_that_comes_with_the_package_finds_by_sight() -> None:
    home = h3data.build_home(h3data.HomeSpec(preset="small", seed=7))
    world = social_nav_episode(home, seed=2, spec=SocialNavSpec(max_steps=300, spawn_distance_m=3.0))
    recording = simulate_social_nav(world, policy="end_to_end")
    assert recording.episode.info["policy"] == "end_to_end"
    assert any(event.kind == "found" for event in recording.events)
    assert verify(recording).equal


def test_a_name_can_mean_these_very_weights(weights: Path) -> None:
    name = stamped(f"weights:{weights}")
    assert name == f"weights:{weights}@{small_network().digest[:12]}"
    assert stamped(name) == name
    assert network_of(name).digest == small_network().digest
    assert stamped("random") == "random"
    save_network(small_network(seed=5), weights)
    os.utime(weights, (1, 1))
    with pytest.raises(InputError, match="H3-POLICY-014"):
        network_of(name)
    assert network_of(f"weights:{weights}").digest == small_network(seed=5).digest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "chess"}, r"(?s)social_nav.*H3-POLICY-016"),
        ({"observations": ["arm_depth"]}, r"(?s)arm_depth.*humanoid_gps.*H3-POLICY-017"),
        ({"weight_1": np.zeros((3, 8), np.float32), "bias_1": np.zeros(3, np.float32)}, r"(?s)2.*H3-POLICY-018"),
    ],
)
def test_networks_for_something_else_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    np.savez(tmp_path / "x.npz", **other_arrays(**change))
    with pytest.raises(FormatError, match=message):
        resolve_policy(find_task("social_nav"), "robot", f"weights:{tmp_path / 'x.npz'}", SocialNavSpec())


def test_inputs_of_another_length_are_told(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", **other_arrays(observations=["humanoid_gps"]))
    home = h3data.build_home(h3data.HomeSpec(preset="small", seed=1))
    world = social_nav_episode(home, seed=2, spec=SocialNavSpec(max_steps=4, spawn_distance_m=3.0))
    with pytest.raises(InputError, match=r"(?s)5.*\[2\].*H3-POLICY-026"):
        simulate_social_nav(world, policy=f"weights:{tmp_path / 'x.npz'}")


def test_the_command_takes_weights(tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["generate", "social_nav", "--episodes", "1", "--max-steps", "20", "--policy"]
    assert main([*args, f"weights:{weights}", "-o", str(tmp_path / "ds")]) == 0
    recording = h3data.open(tmp_path / "ds")
    assert f"@{small_network().digest[:12]}" in str(recording.recording(0).episode.info["policy"])
    assert main([*args, "weights:nothing.npz", "-o", str(tmp_path / "no")]) == 2
    assert "found none" in capsys.readouterr().err
    assert main([*args, "weights:", "-o", str(tmp_path / "no")]) == 2


# --- rearrangement ------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def task_world() -> RearrangeEpisode:
    home = h3data.build_home(h3data.HomeSpec(preset="small", seed=1))
    return rearrange_episode(home, seed=3, free=FreeSpace.from_scene(home))


def copied_chooser(world: RearrangeEpisode) -> Network:
    """One layer that follows what the greedy robot does by `last_done`: next comes what came next then."""
    known = choices(len(world.targets))
    rows: list[tuple[np.ndarray, int]] = []

    class Watched(Chooser):
        def act(self, view: RearrangeView) -> Action:
            action = super().act(view)
            if action in known:
                rows.append((chooser_input(view, CHOOSER_INPUTS), known.index(action)))
            return action

        def interrupts(self, view: RearrangeView) -> str:
            return ""

    simulate_rearrange(world, policy=Watched(lambda view, left: min(left, default=None)), partner="still", solo_steps=1)
    x, y = np.stack([row for row, _ in rows]), np.array([k for _, k in rows])
    weight = np.linalg.lstsq(np.append(x, np.ones((len(x), 1)), axis=1), np.eye(len(known))[y], rcond=None)[0]
    return Network(
        task="rearrange",
        observations=CHOOSER_INPUTS,
        weights=(weight[:-1].T.astype(np.float32).copy(),),
        biases=(weight[-1].astype(np.float32),),
    )


@pytest.mark.slow  # quick: training/test_populations.py
def test_a_chooser_from_a_file_does_the_task(tmp_path: Path, task_world: RearrangeEpisode) -> None:
    save_network(copied_chooser(task_world), tmp_path / "chooser.npz")
    policy = f"weights:{tmp_path / 'chooser.npz'}"
    recording = simulate_rearrange(task_world, policy=policy, partner="still", solo_steps=1)
    assert recording.episode.info["ended"] == "success"
    assert str(recording.episode.info["policy"]).startswith(f"{policy}@")
    done = [s.name for s in recording.skills if s.agent == 0 and s.outcome == "done"]
    assert done[:4] == ["nav_to_object", "pick", "nav_to_goal", "place"]


@pytest.mark.slow
def test_choosers_that_do_not_fit_are_refused(tmp_path: Path, task_world: RearrangeEpisode, weights: Path) -> None:
    good = copied_chooser(task_world)
    save_network(good, tmp_path / "robot.npz")
    for policy, partner, message in (
        (f"weights:{weights}", "both", "for the task rearrange"),
        ("still", f"weights:{tmp_path / 'robot.npz'}", "9 outputs"),
        ("weights:none.npz", "both", "found none"),
    ):
        with pytest.raises(InputError, match=message):
            simulate_rearrange(task_world, policy=policy, partner=partner, solo_steps=1)
    with pytest.raises(FormatError, match="H3-POLICY-018"):
        learned_chooser(f"weights:{tmp_path / 'robot.npz'}", "rearrange", 4, robot=True)


@pytest.mark.slow
def test_the_commands_take_choosers(
    tmp_path: Path, task_world: RearrangeEpisode, capsys: pytest.CaptureFixture[str]
) -> None:
    save_network(copied_chooser(task_world), tmp_path / "c.npz")
    common = ["rearrange", "--scenes", "small:1", "--episodes", "1", "--max-steps", "700"]
    policy = f"weights:{tmp_path / 'c.npz'}"
    args = ["evaluate", *common, "--policies", f"still,{policy}", "--partners", "still", "-o", str(tmp_path / "out")]
    assert main(args) == 0
    assert "weights:" in capsys.readouterr().out
    args = ["generate", *common, "--policy", policy, "--partner", "still", "-o", str(tmp_path / "ds")]
    assert main(args) == 0
    assert "@" in str(h3data.open(tmp_path / "ds").recording(0).episode.info["job"]["policy"])
    assert main(["evaluate", *common, "--policies", "weights:no.npz", "-o", str(tmp_path / "no")]) == 2
