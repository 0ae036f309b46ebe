"""Training of skills: what a run leaves, that it resumes exactly, and that its file plays."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from h3data.errors import InputError
from h3data_pipelines.cli import main
from h3data_pipelines.skill_judging import judge
from h3data_training import run as runs
from h3data_training.curve import curve_of
from h3data_training.networks import ActorCritic, actor_numbers
from h3data_training.ppo import Learner, schedule
from h3data_training.run import POLICY, train
from h3data_training.skills.cpu_cameras import CpuSkillCameras
from h3data_training.skills.episodes import make_skill_bank
from h3data_training.skills.settings import OF_THE_ARM, SkillSettings, skill_recipe
from h3data_training.skills.worlds import ActionRepeatSkills
from h3data_training.torch.skills import driving
from h3data_training.torch.skills.bank import COLUMNS, SkillBank
from h3data_training.torch.skills.worlds import SkillTensors
from sim_kinematic.motion.spec import SkillSpec
from sim_kinematic.policies.learned import network_of
from sim_kinematic.policies.skills.names import recorded_skills, skills_of
from sim_kinematic.policies.skills.player import NetworkSkill
from sim_kinematic.policies.visual_policy import PolicyCard, VisualPolicy, save_policy
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import verify
from sim_kinematic.tasks.skills.skill_starts import SKILL_NAMES, draw_starts
from sim_kinematic.tasks.sources import EpisodeSource
from tests.training.torch.capturable import CapturableOnly

SMALL = replace(
    skill_recipe("tiny", "pick"),
    scenes="small:1",
    episodes_per_home=1,
    starts=4,
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
def bank() -> SkillBank:
    return make_skill_bank(SMALL, seed=0, workers=1)


@pytest.fixture(scope="module")
def whole(bank: SkillBank, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three updates."""
    folder = tmp_path_factory.mktemp("whole")
    said: list[str] = []
    assert train(folder, SMALL, bank=bank, name="small", say=said.append).done
    assert any("no episode has ended" in line and "decisions/s" in line for line in said)
    return folder


def arrays(folder: Path) -> dict[str, np.ndarray]:
    network = network_of(f"weights:{folder / POLICY}")
    assert isinstance(network, VisualPolicy)
    return dict(network.arrays)


def test_a_run_leaves_a_policy_of_a_skill_and_its_curve(whole: Path) -> None:
    assert [row["decisions"] for row in curve_of(whole)] == [12, 24, 36]
    assert {"reward", "succeeded", "failed", "holding"} <= set(curve_of(whole)[0])
    network = network_of(f"weights:{whole / POLICY}")
    assert isinstance(network, VisualPolicy)
    card = network.card
    assert (card.task, card.actions, card.observations, card.picture_size) == ("skill_pick", 10, OF_THE_ARM, None)
    assert "walk" not in card.training["settings"]
    assert set(skills_of(recorded_skills(str(whole / POLICY)), robot="quad_arm")) == {"pick"}


def test_an_interrupted_run_comes_to_the_same_weights(
    whole: Path, bank: SkillBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = threading.Event()

    class Stopping:
        def __enter__(self) -> threading.Event:
            return stop

        def __exit__(self, *error: object) -> None: ...

    monkeypatch.setattr(runs, "stop_asked", Stopping)
    first = train(tmp_path, SMALL, bank=bank, say=lambda line: stop.set() if "update 1 " in line else None)
    assert not first.done
    monkeypatch.undo()
    assert train(tmp_path, SMALL, bank=bank, resume=True).done
    for name, array in arrays(whole).items():
        np.testing.assert_array_equal(arrays(tmp_path)[name], array, err_msg=name)


def test_it_gives_what_pytorch_gives() -> None:
    torch.manual_seed(1)
    net = ActorCritic(SMALL)
    network = VisualPolicy(
        card=PolicyCard(
            task=SMALL.task, robot="quad_arm", observations=SMALL.observations, picture_size=None, hold=3, actions=10
        ),
        arrays=net.arrays(),
    )
    rng = np.random.default_rng(0)
    sizes = {
        "target_gps_compass": 2,
        "way": 2,
        "range_scan": 12,
        "egomotion": 3,
        "target_sensor": 3,
        "resting_sensor": 3,
        "arm_joints": 7,
        "is_holding": 1,
    }
    state, last, kept = torch.zeros(1, 8), torch.zeros(1, 10), network.start()
    for _ in range(10):
        shown = {name: rng.normal(size=sizes[name]).astype(np.float32) for name in SMALL.observations}
        batch = {name: torch.as_tensor(values)[None] for name, values in shown.items()}
        with torch.no_grad():
            mean, state = net.step(None, actor_numbers(batch, last, SMALL.observations), state)
        out, kept = network(shown, last[0].numpy(), kept)
        np.testing.assert_allclose(out, mean[0].numpy(), atol=2e-6)
        np.testing.assert_allclose(kept, state[0].numpy(), atol=2e-6)
        last = mean.clamp(-1, 1)


def test_episodes_are_cut_short_and_count_once(bank: SkillBank) -> None:
    worlds = ActionRepeatSkills(replace(SMALL, limit=6), bank, device="cpu")
    worlds.reset(seed=[0, 1, 2, 3])
    still = torch.zeros(4, 10)
    # six steps, then a decision that begins the next episode
    over = [worlds.repeat_action(still)[2:5] for _ in range(3)]
    begun, timed_out, idle = over[2]
    assert begun.all()
    assert timed_out.all()
    assert idle.all()
    assert not any(flags[0].any() for flags in over[:2])
    assert worlds.totals[ActionRepeatSkills.counts.index("ended")] == 4


def test_before_an_episode_has_ended_there_is_no_length_of_one(bank: SkillBank) -> None:
    worlds = ActionRepeatSkills(SMALL, bank, device="cpu")
    total = dict.fromkeys((*ActionRepeatSkills.counts, "reward"), 0.0) | {"steps": 3072.0}
    assert runs.figures_of(worlds.figures(total)) == "no episode has ended"
    assert runs.figures_of(worlds.figures(total | {"ended": 12.0})) == "succeeded 0%  failed 0%  256 steps"


def test_settings_that_cannot_be_are_refused() -> None:
    for change, message in (
        ({"observations": ("humanoid_gps",)}, "(?s)humanoid_gps.*H3-TRAIN-046"),
        ({"network": "resnet18_lstm"}, "H3-TRAIN-055"),
        ({"path_m": (2.0, 1.0)}, "H3-TRAIN-057"),
        ({"skill": "fetch"}, "H3-SIM-022"),
    ):
        with pytest.raises(InputError, match=message):
            SkillSettings(**change)  # type: ignore[arg-type]
    for size in ((30, 24), (32, 2)):
        with pytest.raises(InputError, match=r"(?s)4.*H3-TRAIN-049"):
            replace(SMALL, picture_size=size)
    with pytest.raises(InputError, match=r"(?s)arm_rgb.*H3-TRAIN-046"):
        replace(SMALL, observations=("arm_rgb", "way"))


def test_the_command_line_plans_and_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "skill", "nav", "--dry-run", "--json", "-o", str(tmp_path / "run")]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["settings"]["skill"] == "nav"
    assert not (tmp_path / "run").exists()
    for words, message in (
        (["skill"], "Expected the name of a skill: h3data train skill nav, pick or place."),
        (["skill", "nav", "--recipe", "paper"], "Unknown recipe 'paper' of skills"),
        (["skill", "nav", "--recipe", "fast", "--observations", "arm_rgb"], "arm_rgb"),
        (["skill", "nav", "--rules", "paper"], "no options of skill: --rules"),
        (["social_nav", "nav"], "after the task skill only"),
    ):
        assert main(["train", *words, "-o", str(tmp_path / "run")]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    "observations", [OF_THE_ARM, pytest.param(("target_sensor", "arm_joints"), marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    "skill", ["pick", *(pytest.param(skill, marks=pytest.mark.slow) for skill in ("nav", "place"))]
)
def test_the_teacher_does_what_it_teaches(bank: SkillBank, skill: str, observations: tuple[str, ...]) -> None:
    """Those who are told the way to the stand, and those who are not."""
    own = replace(bank, holds=np.full(len(bank), skill == "place"))
    settings = replace(SMALL, skill=skill, near_share=0.0, observations=observations)  # type: ignore[arg-type]
    worlds = ActionRepeatSkills(settings, own, device="cpu")
    worlds.reset(seed=[0, 1, 2, 3])
    for _ in range(80):
        action = worlds.taught()
        assert action.shape == (4, worlds.sim.action_width)
        worlds.repeat_action(action)
    total = dict(zip(ActionRepeatSkills.counts, worlds.totals.tolist(), strict=True))
    assert total["succeeded"] >= 3
    assert total["failed"] == 0


@pytest.mark.parametrize("teacher", [False, True])
def test_a_decision_can_be_part_of_a_graph(bank: SkillBank, teacher: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driving, "_on_cpu", lambda robot: False)
    learner = Learner(SMALL, ActionRepeatSkills(SMALL, bank, device="cpu", compile=False), seed=0)
    learner.update(schedule(SMALL, 0.0, 10))
    assert set(learner._decide) == {False, True}
    with CapturableOnly(), torch.no_grad():
        learner._decided(teacher)


def test_a_teachers_weight_comes_down_to_nothing() -> None:
    weights = [schedule(SMALL, share, 10).teacher for share in (0.0, 0.3, 0.6, 1.0)]
    assert weights == pytest.approx([3.0, 1.5, 0.0, 0.0])


def test_starts_are_kept_in_a_file_and_read_again(
    bank: SkillBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "starts.npz"
    make_skill_bank(SMALL, seed=0, workers=1, file=file)
    kept = file.read_bytes()
    other = make_skill_bank(SMALL, seed=1, workers=1, file=file)
    assert not np.array_equal(other.xz, bank.xz)
    for damaged in (b"", kept[:500], b"no file"):
        file.write_bytes(damaged)
        make_skill_bank(SMALL, seed=0, workers=1, file=file)
        with np.load(file) as arrays:
            np.testing.assert_array_equal(arrays["xz"], bank.xz)
    monkeypatch.setattr("h3data_training.skills.episodes.draw_starts", None)
    again = make_skill_bank(SMALL, seed=0, workers=1, file=file)
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(again, name), getattr(bank, name), err_msg=name)
        assert getattr(again, name).dtype == getattr(bank, name).dtype
    assert [scene.name for scene in again.scenes] == [scene.name for scene in bank.scenes]
    np.testing.assert_array_equal(again.floors[0].sdf, bank.floors[0].sdf)


def test_starts_nearby_are_repeated(bank: SkillBank) -> None:
    near = np.hypot(*(bank.xz - bank.stand).T) < 2.0
    more = bank.with_near(0.9, within_m=2.0)
    share = (np.hypot(*(more.xz - more.stand).T) < 2.0).mean()
    assert near.mean() < share if 0 < near.mean() < 0.9 else len(more) == len(bank)
    assert len(bank.with_near(0.0)) == len(bank)


def test_starts_at_the_stand_have_the_arm_on_its_way(bank: SkillBank) -> None:
    settings = replace(SMALL, near_share=0.0, reaching_share=0.5)
    sim = ActionRepeatSkills(settings, bank, device="cpu").sim
    count = len(sim.bank)
    assert count == 2 * len(bank)
    now = sim.step(sim.before_the_first(torch.arange(count) - 1), torch.zeros(count, sim.action_width))
    new = torch.arange(count) >= len(bank)
    assert torch.equal(now.joints[~new], sim.arm.rest.expand(len(bank), -1).float())
    assert (now.way[new] < 0.3).all()
    # the farther the arm is extended, the nearer is the hand
    assert sim.bank.unfolded is not None
    extended, apart = torch.as_tensor(sim.bank.unfolded)[new], now.apart[new]
    assert np.corrcoef(extended, apart)[0, 1] < -0.7
    reaching = replace(sim.bank, unfolded=np.ones(count))
    sim = SkillTensors("pick", reaching, device="cpu", dtype=torch.float32)
    there = sim.step(sim.before_the_first(torch.arange(count) - 1), torch.zeros(count, sim.action_width))
    assert (there.apart[new] < 0.15).all()
    assert bank.with_reaching(0.0, 0.0, np.random.default_rng(0)) is bank


def test_the_teacher_acts_in_some_worlds_that_are_not_counted(bank: SkillBank) -> None:
    settings = replace(SMALL, skill="place", demonstrations=0.5, std=0.1)  # type: ignore[arg-type]
    own = replace(bank, holds=np.ones(len(bank), np.bool_))
    worlds = ActionRepeatSkills(settings, own, device="cpu")
    learner = Learner(settings, worlds, seed=0)
    assert worlds.shown is not None
    assert worlds.shown.tolist() == [True, True, False, False]
    learner.update(schedule(settings, 0.0, 10))
    steps = worlds.counts.index("steps")
    assert worlds.counted.tolist() == [False, False, True, True]
    assert float(worlds.totals[steps]) <= 2 * settings.rollout * settings.hold
    assert not learner._kept["valid"][:, :2].any()
    assert learner._kept["valid"][1:, 2:].all()
    # the next decision is told what the teacher has done, but for a little noise
    taught = learner._kept["taught"][-1].clamp(-1, 1)
    off = (learner.memory.last - taught).abs().amax(1)
    assert (off[:2] < 0.5).all()
    assert (off[2:] > 0.5).all()
    # without the teacher, the policy acts everywhere
    learner.update(schedule(settings, 0.9, 10))
    assert worlds.counted.all()
    assert learner._kept["valid"].all()


def test_a_hand_that_nobody_teaches_lets_go_now_and_then() -> None:
    place = skill_recipe("tiny", "place")
    assert place.first_action[-1] == 1.6
    assert replace(place, teacher=0.0).first_action[-1] == 1.0
    assert replace(skill_recipe("tiny", "pick"), teacher=0.0).first_action[-1] == 2.0
    with pytest.raises(InputError, match=r"(?s)demonstrations.*H3-TRAIN-056"):
        replace(place, demonstrations=1.0)


# --- pictures -----------------------------------------------------------------------------------------------------------
PICTURED = replace(
    skill_recipe("fast", "pick"),
    scenes="small:1",
    episodes_per_home=1,
    starts=4,
    worlds=4,
    rollout=3,
    minibatches=2,
    epochs=2,
    picture_size=(16, 12),
    channels=(4, 4, 4),
    features=8,
    hidden=8,
    act_width=8,
    critic_width=8,
    updates=3,
)


def test_fast_is_told_no_map() -> None:
    for skill in SKILL_NAMES:
        settings = skill_recipe("fast", skill)
        assert settings.observations[0] == "arm_depth"
        assert not {"way", "range_scan", "egomotion"} & set(settings.observations)
        assert {"way", "range_scan"} <= set(settings.critic)


@pytest.fixture(scope="module")
def pictured(bank: SkillBank, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three updates that learns from pictures."""
    folder = tmp_path_factory.mktemp("pictured")
    assert train(folder, PICTURED, bank=bank, name="small").done
    return folder


def test_one_that_learns_from_pictures_goes_on_exactly(
    pictured: Path, bank: SkillBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = threading.Event()

    class Stopping:
        def __enter__(self) -> threading.Event:
            return stop

        def __exit__(self, *error: object) -> None: ...

    monkeypatch.setattr(runs, "stop_asked", Stopping)
    assert not train(tmp_path, PICTURED, bank=bank, say=lambda line: stop.set() if "update 1 " in line else None).done
    monkeypatch.undo()
    assert train(tmp_path, PICTURED, bank=bank, resume=True).done
    mine, theirs = arrays(tmp_path), arrays(pictured)
    assert "conv_0.weight" in mine
    for name, array in theirs.items():
        np.testing.assert_array_equal(mine[name], array, err_msg=name)


def test_worlds_show_pictures_of_the_state_after_the_last_step(bank: SkillBank) -> None:
    worlds = ActionRepeatSkills(PICTURED, bank, device="cpu")
    shown, _ = worlds.reset(seed=[0, 1, 2, 3])
    assert shown["arm_depth"].shape == (4, 12, 16, 1)
    assert 0 <= shown["arm_depth"].min() < shown["arm_depth"].max() <= 1
    after = worlds.repeat_action(torch.ones(4, 10))[0]
    assert not torch.equal(after["arm_depth"], shown["arm_depth"])
    assert worlds._cameras is not None
    want = worlds._cameras.observe(worlds.play)["depth"].clip(0, 10) / 10
    assert torch.equal(after["arm_depth"][..., 0], want)
    assert torch.equal(after["arm_joints"], worlds.play.joints)


@pytest.fixture(scope="module")
def episode() -> RearrangeEpisode:
    found = EpisodeSource(Rearrange(), "small:1").sample(0, 0)
    assert isinstance(found, RearrangeEpisode)
    return found


def test_the_file_of_one_that_sees_is_shown_what_it_saw_in_training(pictured: Path, episode: RearrangeEpisode) -> None:
    skills = recorded_skills(str(pictured / POLICY))
    start = draw_starts(episode, "pick", 1, np.random.default_rng(0), path_m=(0.0, 5.0))[0]
    seen: list[np.ndarray] = []
    learned = skills_of(skills, robot="quad_arm")["pick"]

    class Watched(VisualPolicy):
        def __call__(self, shown, last, state):
            seen.append(shown["arm_depth"])
            return super().__call__(shown, last, state)

    own = NetworkSkill(Watched(card=learned.network.card, arrays=learned.network.arrays), rules=SkillSpec(arm_steps=4))
    assert judge(episode, start, {"pick": own}).steps <= 4
    sim = SkillTensors("pick", SkillBank.of([(episode, episode.free, [start])]), device="cpu", dtype=torch.float64)
    begun = sim.step(sim.before_the_first(torch.tensor([-1])), torch.zeros(1, 10, dtype=torch.float64))
    want = CpuSkillCameras(sim, size=(16, 12)).observe(begun)["depth"][0, ..., None].numpy() / 10
    assert len(seen) == 2
    np.testing.assert_allclose(seen[0], want.clip(0, 1), atol=1e-5)


def test_one_that_sees_plays_in_rearrangement_and_is_verified(tmp_path: Path, episode: RearrangeEpisode) -> None:
    """What is in its pictures steers it."""
    settings = replace(PICTURED, skill="nav", observations=("arm_depth", "target_gps_compass"), std=0.5)
    torch.manual_seed(0)
    net = ActorCritic(settings)
    with torch.no_grad():
        net.act[-1].weight.mul_(40.0)  # type: ignore[union-attr, operator]
    card = PolicyCard(
        task="skill_nav", robot="quad_arm", observations=settings.observations, picture_size=(16, 12), hold=3
    )
    save_policy(VisualPolicy(card=card, arrays=net.arrays()), tmp_path / "nav.npz")
    short = replace(episode, spec=replace(episode.spec, skills=str(tmp_path), max_steps=24))
    recording = simulate(Rearrange(), short, {"robot": "greedy_nearest", "human": "both"})
    assert len({tuple(action) for action in recording.columns["agent_0.action"].round(4).tolist()}) > 4
    assert verify(recording).difference is None


def test_a_second_stage_of_a_skill_plays_as_long_as_in_play_without_a_teacher() -> None:
    for skill, steps in (("nav", SkillSpec().nav_steps), ("pick", SkillSpec().arm_steps)):
        second = skill_recipe("fast", skill).second_stage()
        assert (second.limit, second.teacher, second.critic_updates > 0) == (steps, 0.0, True)
