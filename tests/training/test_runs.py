"""Runs: what they leave in their folder, that they resume exactly, and what they refuse."""

from __future__ import annotations

import json
import os
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from h3data.errors import FormatError, InputError
from h3data_pipelines.cli import main
from h3data_training import run as runs
from h3data_training.curve import EVENTS, curve_of
from h3data_training.episodes import by_home, make_bank
from h3data_training.networks import ActorCritic
from h3data_training.ppo import Learner, schedule
from h3data_training.run import CHECKPOINT, POLICY, train
from h3data_training.settings import RECIPES, recipe
from h3data_training.torch.episodes import EpisodeBank
from h3data_training.worlds import ActionRepeatEnv
from sim_kinematic.policies.learned import network_of
from sim_kinematic.policies.visual_policy import VisualPolicy
from tests.journeys import stays
from tests.training.runs import SMALL, small
from tests.training.torch.capturable import CapturableOnly

BLIND = ("humanoid_gps", "range_scan")


@pytest.fixture(scope="module")
def bank() -> EpisodeBank:
    return make_bank(SMALL, seed=0, workers=1)


@pytest.fixture(scope="module")
def whole(bank: EpisodeBank, tmp_path_factory: Any) -> Path:
    """A run of three updates."""
    folder = tmp_path_factory.mktemp("whole")
    said: list[str] = []
    result = train(folder, SMALL, bank=bank, name="small", say=said.append)
    assert result.done
    assert result.updates == 3
    assert any("update 1 " in line and "decisions/s" in line for line in said)
    return folder


def arrays(folder: Path) -> dict[str, np.ndarray]:
    network = network_of(f"weights:{folder / POLICY}")
    assert isinstance(network, VisualPolicy)
    return dict(network.arrays)


@pytest.mark.slow
def test_it_learns_in_homes_of_both_generations(bank: EpisodeBank, tmp_path: Path) -> None:
    settings = small(scenes="h3-homes/train#0,h3-homes-v2/train#0", updates=1)
    both = make_bank(settings, seed=0)
    assert both.place.tolist() == [0, 0, 1, 1]
    for name in ("robot_xz", "human_xz", "seeds"):  # a home has the episodes that it has alone
        np.testing.assert_array_equal(getattr(both, name)[:2], getattr(bank, name))
    named = {scene.name for scene in both.scenes}
    assert len(named) == 2
    assert both.floors[0].sdf.shape != both.floors[1].sdf.shape
    for k in (2, 3):
        ends = np.stack([both.robot_xz[k], both.human_xz[k]])
        assert both.floors[1].is_navigable(ends).all()
    result = train(tmp_path, settings, bank=both)
    assert all(np.isfinite(list(result.last.values())))
    worlds = ActionRepeatEnv(settings, both, device="cpu", compile=False)
    shown, _ = worlds.reset(seed=[0, 1, 2, 3])
    assert set(worlds.sim.place_of(worlds.play).tolist()) == {0, 1}
    assert all(tensor.isfinite().all() for tensor in shown.values())


def test_homes_are_in_their_order_whoever_makes_them() -> None:
    assert by_home(str, range(7), workers=3) == [str(k) for k in range(7)]
    assert by_home(str, range(7), workers=1) == [str(k) for k in range(7)]


def test_homes_with_stairs_are_refused() -> None:
    with pytest.raises(InputError, match=r"(?s)small2-storeys:3.*H3-TRAIN-076"):
        make_bank(small(scenes="small2-storeys:3"), seed=0)


def test_a_run_leaves_a_policy_and_its_curve(whole: Path) -> None:
    curve = curve_of(whole)
    assert [row["decisions"] for row in curve] == [12, 24, 36]
    assert all(np.isfinite(list(row.values())).all() for row in curve)
    network = network_of(f"weights:{whole / POLICY}")
    assert isinstance(network, VisualPolicy)
    card = network.card
    assert (card.task, card.robot, card.hold, card.picture_size) == ("social_nav", "quad_arm", 3, (16, 12))
    assert card.training["recipe"] == "small"
    assert card.training["steps"] == 36 * 3
    untrained = ActorCritic(SMALL).arrays()
    assert set(untrained) == set(network.arrays)


def test_tensorboard_reads_the_curve(whole: Path) -> None:
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(whole / EVENTS)).Reload()
    curve = curve_of(whole)
    assert [event.step for event in events.Scalars("reward")] == [row["decisions"] for row in curve]
    assert np.allclose([event.value for event in events.Scalars("reward")], [row["reward"] for row in curve])


@pytest.mark.slow  # quick: the same of populations and skills
def test_an_interrupted_run_comes_to_the_same_weights(
    whole: Path, bank: EpisodeBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def stop_in_the_second(*args: Any) -> Any:
        asked.append(args)
        if len(asked) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return schedule(*args)

    monkeypatch.setattr(runs, "schedule", stop_in_the_second)
    before = signal.getsignal(signal.SIGTERM)
    first = train(tmp_path, SMALL, bank=bank)
    assert not first.done
    assert first.updates == 2
    assert signal.getsignal(signal.SIGTERM) == before
    monkeypatch.setattr(runs, "schedule", schedule)
    assert train(tmp_path, SMALL, bank=bank, resume=True).done
    for name, array in arrays(whole).items():
        np.testing.assert_array_equal(arrays(tmp_path)[name], array, err_msg=name)
    with pytest.raises(InputError, match=r"(?s) 3 .*--updates.*H3-TRAIN-001"):
        train(tmp_path, SMALL, bank=bank, resume=True)


def test_the_learning_curve_has_the_mean_distance_to_the_person(bank: EpisodeBank) -> None:
    """The paper plots it beside the reward."""
    worlds = ActionRepeatEnv(
        small(observations=("humanoid_gps", "range_scan")), bank, device="cpu", compile=False, hold=1
    )
    worlds.reset(seed=0)
    worlds.repeat_action(torch.zeros(4, 2))
    apart = (worlds.play.robot.xz - worlds.play.human.xz).norm(dim=-1)
    total = dict(zip(worlds.counts, worlds.totals.tolist(), strict=True))
    assert worlds.figures(total)["distance_m"] == pytest.approx(float(apart.mean()), rel=1e-5)
    assert list(worlds.figures(total))[:2] == ["reward", "distance_m"]


@pytest.mark.slow  # quick: those that see depth
def test_a_run_that_sees_colours_resumes_exactly_and_plays(bank: EpisodeBank, tmp_path: Path) -> None:
    settings = small(observations=("arm_rgb", "humanoid_detector", "humanoid_gps"), light="baked")
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    for folder in (whole, parts):
        folder.mkdir()
    assert train(whole, settings, bank=bank).done
    assert train(parts, replace(settings, updates=1), bank=bank).done
    assert train(parts, settings, bank=bank, resume=True).updates == 3
    fresh = ActorCritic(settings).arrays()
    assert fresh["conv_0.weight"].shape == (4, 48, 3, 3)
    assert {n: a.shape for n, a in arrays(whole).items()} == {n: a.shape for n, a in fresh.items()}
    for name, array in arrays(whole).items():
        np.testing.assert_array_equal(arrays(parts)[name], array, err_msg=name)
    policy, first = f"weights:{whole / POLICY}", network_of(f"weights:{whole / POLICY}")
    options = "--scenes h3-homes/train#0 --episodes 1 --max-steps 30"
    assert main(["generate", "social_nav", *options.split(), "--policy", policy, "-o", str(tmp_path / "ds")]) == 0
    assert isinstance(first, VisualPolicy)
    assert first.card.picture_size == (16, 12)
    assert first.card.light == "baked"
    with pytest.raises(InputError, match="H3-TRAIN-021"):
        train(tmp_path, SMALL, bank=bank, init=first)


def test_other_settings_and_damaged_checkpoints_are_refused(whole: Path, bank: EpisodeBank, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)hidden=8, not 16.*H3-TRAIN-003"):
        train(whole, small(hidden=16, updates=9), bank=bank, resume=True)
    with pytest.raises(InputError, match=r"(?s)seed=0, not 1.*H3-TRAIN-003"):
        train(whole, small(updates=9), bank=bank, resume=True, seed=1)
    content = (whole / CHECKPOINT).read_bytes()
    for damaged in (content[: len(content) // 2], b"", b"what"):
        (tmp_path / CHECKPOINT).write_bytes(damaged)
        with pytest.raises(FormatError, match="H3-TRAIN-006"):
            train(tmp_path, SMALL, bank=bank, resume=True)


def test_a_decision_can_be_part_of_a_graph(bank: EpisodeBank) -> None:
    """It waits for nothing, and finds and leaves everything in the same places."""
    settings = small(observations=BLIND)
    worlds = ActionRepeatEnv(settings, bank, device="cpu", compile=False)
    learner, plan = Learner(settings, worlds, seed=0), schedule(settings, 0.5, 5)
    learner.update(plan)
    kept = [*learner.memory.tensors(), *learner.worlds.play.tensors(), *learner._kept.values()]
    places = [tensor.data_ptr() for tensor in kept]
    with CapturableOnly(), torch.no_grad():
        learner._decided(False)
    learner._row.zero_()
    learner.update(plan)
    kept = [*learner.memory.tensors(), *learner.worlds.play.tensors(), *learner._kept.values()]
    assert [tensor.data_ptr() for tensor in kept] == places
    shown, *_ = worlds.repeat_action(torch.zeros(4, 2))
    assert all(torch.equal(shown[name], worlds._shown[name]) for name in shown)


@pytest.mark.slow
def test_a_full_disk_loses_no_checkpoint(bank: EpisodeBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save = torch.save

    def full(kept: Any, path: Any) -> None:
        if len(kept["curve"]) == 2:
            raise RuntimeError("PytorchStreamWriter failed writing file: file write failed")
        save(kept, path)

    monkeypatch.setattr(torch, "save", full)
    said: list[str] = []
    assert train(tmp_path, SMALL, bank=bank, checkpoint_s=0.0, say=said.append).done
    assert sum("could not save" in line for line in said) == 1
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.slow
def test_minutes_end_a_run(bank: EpisodeBank, tmp_path: Path) -> None:
    settings = small(updates=0, minutes=0.2)  # 12 s, of which 10 are spare; where the set-up takes longer, one update
    result = train(tmp_path, settings, bank=bank)
    assert result.done
    assert result.updates >= 1
    assert curve_of(tmp_path)[-1]["rate"] < SMALL.rate


def test_it_trains_without_pictures_too(bank: EpisodeBank, tmp_path: Path) -> None:
    blind = small(observations=("humanoid_gps", "way", "range_scan"), updates=1)
    thread = threading.Thread(target=train, args=(tmp_path, blind), kwargs={"bank": bank})
    thread.start()  # signals are for the main thread alone
    thread.join()
    network = network_of(f"weights:{tmp_path / POLICY}")
    assert isinstance(network, VisualPolicy)
    assert network.card.picture_size is None


def test_a_decision_and_what_it_shows_are_followed_in_two_files(bank: EpisodeBank) -> None:
    worlds = ActionRepeatEnv(small(observations=BLIND), bank, device="cpu", compile=False)
    worlds.reset(seed=[0, 1, 2, 3])
    followed = worlds, worlds._numbers  # the decision, and the names of the observations that it ends with
    files = stays(
        lambda: worlds.repeat_action(torch.zeros(4, 2)), lambda _, value: any(value is thing for thing in followed)
    )
    assert [Path(file).name for file in files] == ["worlds.py", "task_worlds.py", "worlds.py"]  # there and back


def test_episodes_are_cut_short_after_following(bank: EpisodeBank) -> None:
    for limit in (0, 5):
        worlds = ActionRepeatEnv(small(follow_steps=limit, observations=BLIND), bank, device="cpu", compile=False)
        worlds.reset(seed=0)
        worlds.play.memory["followed"].copy_(torch.tensor([0, 4, 5, 900]))
        _, _, over, timed_out, idle = worlds.repeat_action(torch.zeros(4, 2))
        cut = [False, False, True, True] if limit else [False] * 4
        assert (over.tolist(), timed_out.tolist(), idle.tolist()) == (cut, cut, [False] * 4)
        assert worlds.play.steps.tolist() == [1 if c else 5 for c in cut]  # the next episode has begun


def test_a_second_stage_lets_the_critic_learn_first() -> None:
    first = recipe("fast")
    second = first.second_stage()
    assert second.horizon[0] == first.horizon[1]
    plans = [schedule(second, 0.0, update) for update in (0, 19, 20, 21, 60)]
    assert [plan.acts for plan in plans] == [False, False, True, True, True]
    assert plans[0].rate == plans[4].rate == second.rate  # the critic at once, the actor by and by
    assert plans[2].rate < plans[3].rate < second.rate
    assert all(schedule(first, 0.0, update).acts for update in (0, 1))


def test_a_longer_horizon_begins_later_in_proportion() -> None:
    first, second = recipe("fast").looking_ahead(1500), recipe("fast").second_stage().looking_ahead(1500)
    assert (first.horizon, second.horizon) == ((450.0, 1500.0), (1000.0, 1500.0))
    assert schedule(second, 1.0, 99).gamma == pytest.approx(1 - 3 / 1500)
    for steps in (10.0, 0.0, -5.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="H3-TRAIN-053"):
            first.looking_ahead(steps)


@pytest.mark.slow
def test_a_trained_policy_is_where_a_run_begins(whole: Path, bank: EpisodeBank, tmp_path: Path) -> None:
    policy = network_of(f"weights:{whole / POLICY}")
    assert isinstance(policy, VisualPolicy)
    for critic_updates, same in ((9, True), (1, False)):
        folder = tmp_path / str(critic_updates)
        folder.mkdir()
        train(folder, small(critic_updates=critic_updates, updates=2, warmup_updates=0), init=policy, bank=bank)
        after = arrays(folder)
        assert all(np.array_equal(after[n], array) for n, array in policy.arrays.items()) == same
    card = network_of(f"weights:{folder / POLICY}").card  # type: ignore[union-attr]
    assert card.training["parent"]["updates"] == 3
    assert card.training["parent"]["recipe"] == "small"
    with pytest.raises(InputError, match="H3-TRAIN-021"):
        train(tmp_path, small(observations=BLIND), init=policy, bank=bank)
    assert main(["train", "social_nav", "--warm-start", "plain_expert", "-o", str(tmp_path / "n")]) == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"network": "transformer"}, r"(?s)cnn_gru, resnet18_lstm.*H3-TRAIN-048"),
        ({"network": "resnet18_lstm", "channels": (8, 8, 8)}, "H3-TRAIN-050"),
        ({"follow_steps": -1}, "H3-TRAIN-052"),
        ({"observations": ("smell",)}, r"(?s)smell.*H3-TRAIN-046"),
        ({"picture_size": (30, 20)}, r"(?s)4.*H3-TRAIN-049"),
        ({"picture_size": (2048, 20)}, r"(?s)2048x20.*H3-TRAIN-049"),
        ({"network": "resnet18_lstm", "picture_size": (1028, 20)}, r"(?s)1024.*H3-TRAIN-050"),
        ({"worlds": 3}, r"(?s)minibatches=4.*H3-TRAIN-051"),
        ({"hold": 0}, r"(?s)hold.*1.*H3-TRAIN-039"),
        ({"minutes": 0.0}, "H3-TRAIN-038"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        recipe("tiny", **changes)


def test_unknown_recipes_are_refused() -> None:
    with pytest.raises(InputError, match=r"(?s)fast, paper, tiny.*H3-TRAIN-044"):
        recipe("huge")
    assert RECIPES["fast"].decisions_per_update == 4096 * 32


def test_the_command_plans_and_refuses(tmp_path: Path, whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "social_nav", "--recipe", "fast", "--dry-run", "--json", "-o", str(tmp_path / "n")]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["decisions_per_update"] == 131072
    options = ["--recipe", "paper", "--minutes", "5"]  # minutes that are given decide, not the recipe's updates
    assert main(["train", "social_nav", *options, "--dry-run", "--json", "-o", str(tmp_path / "n")]) == 0
    assert json.loads(capsys.readouterr().out)["settings"]["updates"] == 0
    options = ["--scenes", "h3-homes/train,h3-homes-v2/train", "--episodes-per-home", "14"]
    assert main(["train", "social_nav", *options, "--dry-run", "--json", "-o", str(tmp_path / "n")]) == 0
    chosen = json.loads(capsys.readouterr().out)["settings"]
    assert (chosen["scenes"], chosen["episodes_per_home"]) == ("h3-homes/train,h3-homes-v2/train", 14)
    assert main(["train", "social_nav", "--scenes", "small:1,castle", "-o", str(tmp_path / "unknown")]) == 2
    assert "Unknown scenes 'castle'" in capsys.readouterr().err
    assert main(["train", "social_nav", "--episodes-per-home", "0", "-o", str(tmp_path / "n")]) == 2
    assert "episodes_per_home of at least 1" in capsys.readouterr().err
    shown = "arm_rgb,humanoid_detector,humanoid_gps"
    options = ["--recipe", "fast", "--observations", shown, "--json", "-o", str(tmp_path / "n")]
    assert main(["train", "social_nav", *options, "--dry-run"]) == 0
    coloured = json.loads(capsys.readouterr().out)
    assert coloured["settings"]["light"] == "flat"
    lit = ["--light", "baked", "--size", "96x72", "--device", "cuda", *options]
    assert main(["train", "social_nav", *lit, "--dry-run"]) == 0
    lit_plan = json.loads(capsys.readouterr().out)
    assert (lit_plan["settings"]["light"], lit_plan["settings"]["picture_size"]) == ("baked", [96, 72])
    assert lit_plan["rollout_bytes"] - coloured["rollout_bytes"] == 131072 * (96 * 72 - 64 * 48) * 3 * 2
    for size, code in (("96x70", "TRAIN-049"), ("2048x64", "TRAIN-049"), ("96", "RENDER-085"), ("0x0", "RENDER-085")):
        assert main(["train", "social_nav", "--size", size, *options]) == 2
        assert f"H3-{code}" in capsys.readouterr().out
    assert main(["train", "social_nav", "--size", "96x72", "--json", "-o", str(tmp_path / "n")]) == 2
    assert "an observation that needs a picture" in capsys.readouterr().out
    assert main(["train", "social_nav", "--light", "baked", "--dry-run", "-o", str(tmp_path / "n")]) == 2
    assert "Light makes no difference to depth" in capsys.readouterr().err
    more = coloured["rollout_bytes"] - plan["rollout_bytes"]
    assert more == 131072 * 64 * 48 * (3 - 1) * 2  # half precision
    assert not (tmp_path / "n").exists()
    assert main(["train", "social_nav", "-o", str(whole)]) == 2
    assert "holds a training run" in capsys.readouterr().err
    assert main(["train", "social_nav", "--stop-after", "0", "-o", str(tmp_path / "n")]) == 2
    assert "more than 0 minutes" in capsys.readouterr().err
    if not torch.cuda.is_available():
        assert main(["train", "social_nav", "--device", "cuda", "-o", str(tmp_path / "n")]) == 2
        assert "no GPU" in capsys.readouterr().err
