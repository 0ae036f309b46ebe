"""Training of a robot among people: that it learns and resumes exactly, and that its weights play in all commands."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("shapely")
pytest.importorskip("fcl")

import h3data  # noqa: E402
from h3data.errors import FormatError, InputError  # noqa: E402
from h3data_crowds.crowd_nav import CrowdNav  # noqa: E402
from h3data_pipelines.cli import main  # noqa: E402
from h3data_training import run as runs  # noqa: E402
from h3data_training.crowds.settings import OBSERVED, CrowdSettings, crowd_recipe  # noqa: E402
from h3data_training.crowds.worlds import ActionRepeatCrowd, make_crowd_bank  # noqa: E402
from h3data_training.curve import curve_of  # noqa: E402
from h3data_training.networks import ActorCritic, actor_numbers  # noqa: E402
from h3data_training.ppo import Learner  # noqa: E402
from h3data_training.run import POLICY, train  # noqa: E402
from h3data_training.torch.crowd.bank import CrowdBank  # noqa: E402
from sim_kinematic.policies.assignment import resolve_policy  # noqa: E402
from sim_kinematic.policies.learned import network_of  # noqa: E402
from sim_kinematic.policies.network import from_torch, save_network  # noqa: E402
from sim_kinematic.policies.visual_policy import PolicyCard, VisualPolicy, save_policy  # noqa: E402
from sim_kinematic.sensing.encodings import OF_COMMANDS  # noqa: E402
from sim_kinematic.tasks.resume import verify  # noqa: E402
from tests.training.torch.capturable import CapturableOnly  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
HOME = "small:1"
SMALL = replace(
    crowd_recipe("tiny", "crowd_nav"),
    scenes=HOME,
    people=2,
    episodes_per_home=2,
    worlds=4,
    rollout=3,
    minibatches=2,
    epochs=2,
    hidden=8,
    act_width=8,
    critic_width=8,
    updates=3,
)


@pytest.fixture(scope="module")
def bank() -> CrowdBank:
    return make_crowd_bank(SMALL, seed=0, workers=1)


@pytest.fixture(scope="module")
def whole(bank: CrowdBank, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three updates."""
    folder = tmp_path_factory.mktemp("whole")
    assert train(folder, SMALL, bank=bank, name="small").done
    return folder


def network(folder: Path) -> VisualPolicy:
    found = network_of(f"weights:{folder / POLICY}")
    assert isinstance(found, VisualPolicy)
    return found


def untrained(settings: CrowdSettings = SMALL, **card: Any) -> VisualPolicy:
    """Random weights that drive about."""
    torch.manual_seed(3)
    net = ActorCritic(settings)
    with torch.no_grad():
        net.act[-1].weight.mul_(60)  # type: ignore[operator]
    about = {"task": "crowd_nav", "robot": "quad_arm", "observations": settings.observations, "hold": 3, **card}
    return VisualPolicy(card=PolicyCard(picture_size=None, **about), arrays=net.arrays())


# --- training -----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_it_learns_to_drive_to_the_goal(tmp_path: Path) -> None:
    alone = crowd_recipe(
        "tiny", "crowd_nav", scenes=HOME, people=0, worlds=128, minutes=10.0, updates=40, episodes_per_home=8
    )
    assert train(tmp_path, alone, name="alone").done
    curve = curve_of(tmp_path)
    assert curve[0]["reward"] < 0.01
    assert curve[-1]["reward"] > 0.05
    assert sum(row["succeeded"] * row["ended"] for row in curve[-5:]) >= 5


def test_a_run_leaves_a_policy_and_its_curve(whole: Path) -> None:
    curve = curve_of(whole)
    assert [row["decisions"] for row in curve] == [12, 24, 36]
    assert {"reward", "succeeded", "failed", "contact"} <= set(curve[0])
    assert all(np.isfinite(list(row.values())).all() for row in curve)
    card = network(whole).card
    assert (card.task, card.robot, card.hold, card.observations) == ("crowd_nav", "quad_arm", 3, OBSERVED)
    assert card.training["settings"]["people"] == 2
    assert "walk" not in card.training["settings"]


def test_an_interrupted_run_comes_to_the_same_weights(
    whole: Path, bank: CrowdBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = threading.Event()

    class Stopping:
        def __enter__(self) -> threading.Event:
            return stop

        def __exit__(self, *error: object) -> None: ...

    monkeypatch.setattr(runs, "stop_asked", Stopping)
    assert not train(tmp_path, SMALL, bank=bank, say=lambda line: stop.set() if "update 1 " in line else None).done
    monkeypatch.undo()
    assert train(tmp_path, SMALL, bank=bank, resume=True).done
    for name, array in network(whole).arrays.items():
        np.testing.assert_array_equal(network(tmp_path).arrays[name], array, err_msg=name)


def test_a_decision_can_be_part_of_a_graph(bank: CrowdBank) -> None:
    learner = Learner(SMALL, ActionRepeatCrowd(SMALL, bank, device="cpu"), seed=0)
    with torch.no_grad(), CapturableOnly():
        learner._decided(False)


def test_episodes_are_those_of_each_home_alone(bank: CrowdBank) -> None:
    both = CrowdBank.merged([bank, bank])
    assert both.place.tolist() == [0, 0, 1, 1]
    assert len(both.legs) == 2 * len(bank.legs) == both.leg_counts.sum()
    np.testing.assert_array_equal(both.starts[2:], bank.starts)
    np.testing.assert_array_equal(both.extra["goal"][:2], bank.extra["goal"])
    alone = make_crowd_bank(replace(SMALL, people=0), seed=0, workers=1)
    assert alone.starts.shape == (2, 1, 3)


def test_an_episode_that_lasts_too_long_is_cut_short(bank: CrowdBank) -> None:
    worlds = ActionRepeatCrowd(replace(SMALL, limit=6), bank, device="cpu")
    worlds.reset(seed=range(4))
    cut = torch.zeros(4, dtype=torch.bool)
    for _ in range(3):
        *_, timed_out, _ = worlds.repeat_action(torch.zeros(4, 2))
        cut |= timed_out
    assert cut.all()
    assert worlds.figures(dict(zip(worlds.counts, worlds.totals.tolist(), strict=True)))["succeeded"] == 0.0


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (["--people", "13"], "H3-TRAIN-085"),
        (["--people", "-1"], "H3-TRAIN-085"),
        (["--recipe", "paper"], "H3-TRAIN-083"),
        (["--observations", "arm_depth"], "H3-TRAIN-046"),
        (["--size", "32x24"], "H3-TRAIN-082"),
        (["--minibatches", "3"], "H3-TRAIN-051"),
    ],
)
def test_options_that_do_not_fit_are_refused(
    options: list[str], code: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "crowd_nav", "--dry-run", "-o", str(tmp_path / "run"), *options]) != 0
    assert code in capsys.readouterr().err


# --- weights ------------------------------------------------------------------------------------------------------------
def test_it_gives_what_pytorch_gives() -> None:
    torch.manual_seed(1)
    net = ActorCritic(SMALL)
    policy = replace(untrained(), arrays=net.arrays())
    rng = np.random.default_rng(0)
    state, last, kept = torch.zeros(1, 8), torch.zeros(1, 2), policy.start()
    for _ in range(20):
        shown = {name: rng.uniform(0, 2, OF_COMMANDS[name].given).astype(np.float32) for name in OBSERVED}
        with torch.no_grad():
            batch = {name: torch.as_tensor(values)[None] for name, values in shown.items()}
            numbers = actor_numbers(batch, last, OBSERVED)
            mean, state = net.step(None, numbers, state)
        out, kept = policy(shown, last[0].numpy(), kept)
        np.testing.assert_allclose(out, mean[0].numpy(), atol=2e-6)
        last = mean.clamp(-1, 1)


@pytest.mark.parametrize("people", [0, 2, 6])
def test_weights_play_beside_any_number_of_people(people: int, tmp_path: Path) -> None:
    file = tmp_path / "net.npz"
    save_policy(untrained(), file)
    roster = ["robot", *["human"] * people]
    recording = h3data.simulate(
        "crowd_nav", HOME, roster=roster, agents={"robot": f"weights:{file}"}, seed=2, max_steps=60
    )
    assert np.ptp(recording.columns["agent_0.base_pose"][:, :3], axis=0).max() > 0.05
    assert f"weights:{file}@{untrained().digest[:12]}" in str(recording.episode.info)
    assert verify(recording).difference is None


def test_networks_of_layers_play_too(tmp_path: Path) -> None:
    file, observed = tmp_path / "net.npz", ("goal_way", "people", "lidar")
    layers = torch.nn.Sequential(torch.nn.Linear(2 + 20 + 360, 8), torch.nn.Tanh(), torch.nn.Linear(8, 2))
    save_network(from_torch(layers, task="crowd_nav", observations=observed), file)
    recording = h3data.simulate("crowd_nav", HOME, agents={"robot": f"weights:{file}"}, seed=2, max_steps=20)
    assert verify(recording).difference is None


def test_weights_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    for card, code in (({"task": "social_nav"}, "H3-POLICY-016"), ({"robot": "wheeled_arm"}, "H3-POLICY-020")):
        file = tmp_path / f"{code}.npz"
        save_policy(untrained(SMALL, **card), file)
        with pytest.raises(FormatError, match=code):
            h3data.simulate("crowd_nav", HOME, agents={"robot": f"weights:{file}"}, max_steps=2)
    for kind, name in (("robot", "end_to_end"), ("human", f"weights:{file}")):
        with pytest.raises(InputError, match="H3-POLICY-00"):
            resolve_policy(CrowdNav(), kind, name)


def test_the_nearest_people_are_shown_in_their_order() -> None:
    env = h3data.make("crowd_nav", HOME, num_envs=3, roster=["robot", *["human"] * 6], observations=["people", "lidar"])
    shown, _ = env.reset(seed=1)
    for _ in range(15):
        shown, *_ = env.step(np.zeros((3, 2), np.float32))
    env.close()
    people = shown["people"].reshape(3, 4, 5)
    near, there = people[..., 2], people[..., 2] > 0
    assert (np.diff(near, axis=1) <= 0).all()
    np.testing.assert_allclose(np.hypot(*people[..., :2].T).T[there], 1.0, atol=1e-6)
    assert not people[~there].any()
    assert 0.01 < np.hypot(*people[..., 3:].T).max() < 2.5
