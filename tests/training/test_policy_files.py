"""Policy files: the same numbers as PyTorch, the same observations as on the device, and files that are no policies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

import h3data
from bake import packed_policy
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from h3data_pipelines.cli import main
from h3data_pipelines.jobs.evaluation_runs import EvaluationRequest
from h3data_training.episodes import make_bank, rules
from h3data_training.networks import ActorCritic, actor_numbers, picture
from h3data_training.settings import Settings
from h3data_training.worlds import ActionRepeatEnv
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.policies import visual_policy
from sim_kinematic.policies.learned import VisualNavigation, navigation_of, network_of, stamped
from sim_kinematic.policies.rearrange import learned_chooser
from sim_kinematic.policies.visual_policy import FILE_FORMAT, PolicyCard, VisualPolicy, save_policy
from sim_kinematic.tasks.episode import with_options
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.recorder import run
from sim_kinematic.tasks.social_nav import TRAINING, SocialNav
from sim_kinematic.tasks.sources import EpisodeSource
from tests.training.runs import SMALL, small

PICTURED = small(picture_size=(32, 24))


def untrained(settings: Settings = PICTURED, **card: Any) -> VisualPolicy:
    """Random weights that drive about."""
    torch.manual_seed(3)
    net = ActorCritic(settings)
    with torch.no_grad():
        net.act[-1].weight.mul_(60)  # type: ignore[operator]
    about = {"task": "social_nav", "robot": "quad_arm", "observations": settings.observations, "hold": 3, **card}
    return VisualPolicy(card=PolicyCard(**{"picture_size": (32, 24), **about}), arrays=net.arrays())


def colored(settings: Settings) -> Settings:
    return replace(settings, observations=("arm_rgb", "humanoid_detector", "humanoid_gps"))


def test_runs_with_the_papers_people_touch_their_bones() -> None:
    paper, natural = (rules(Settings(walk=walk)) for walk in ("paper", "natural"))
    assert (paper.person_contact, natural.person_contact) == ("bones", "body")
    assert natural == TRAINING
    assert paper == with_options(TRAINING, rules="paper")


@pytest.mark.parametrize("settings", [PICTURED, colored(PICTURED)], ids=["depth", "rgb"])
def test_it_gives_what_pytorch_gives(settings: Settings) -> None:
    torch.manual_seed(1)
    net = ActorCritic(settings)
    network = untrained(settings)
    network = replace(network, arrays=net.arrays())
    rng = np.random.default_rng(0)
    state, last, kept = torch.zeros(1, 8), torch.zeros(1, 2), network.start()
    for _ in range(20):
        shown = {
            "arm_depth": rng.uniform(0, 1, (24, 32, 1)).astype(np.float32),
            "arm_rgb": rng.integers(0, 256, (24, 32, 3)).astype(np.uint8),
            "humanoid_detector": rng.integers(0, 2, 1).astype(np.float32),
            "humanoid_gps": np.array([rng.uniform(0, 9), rng.uniform(-3, 3)]),
        }
        batch = {n: torch.as_tensor(v, dtype=torch.float32)[None] for n, v in shown.items()}
        with torch.no_grad():
            numbers = actor_numbers(batch, last, settings.observations)
            mean, state = net.step(picture(batch[settings.observations[0]]), numbers, state)
        out, kept = network(shown, last[0].numpy(), kept)
        np.testing.assert_allclose(out, mean[0].numpy(), atol=2e-6)
        np.testing.assert_allclose(kept, state[0].numpy(), atol=2e-6)
        last = mean.clamp(-1, 1)


def test_its_sums_do_not_depend_on_how_many_are_made_at_once() -> None:
    """BLAS adds in another order with other threads; the same picture must give the same action in every process."""
    rng = np.random.default_rng(0)
    x, columns, bias = (rng.normal(size=s).astype(np.float32) for s in ((7, 40), (40, 9), (9,)))
    x[x < 0] = 0
    together = visual_policy.affine(x, columns, bias)
    apart = np.concatenate([visual_policy.affine(x[k : k + 1], columns, bias) for k in range(len(x))])
    np.testing.assert_array_equal(together, apart)
    np.testing.assert_allclose(together, x.astype(float) @ columns + bias, rtol=1e-5, atol=1e-5)


def test_rolling_resets_where_episodes_begin() -> None:
    torch.manual_seed(2)
    net = ActorCritic(SMALL)
    steps, batch = 7, 3
    x = torch.randn(steps, batch, net.gru.input_size)
    first, begins = torch.randn(batch, 8), torch.rand(steps, batch) < 0.3
    rolled, state = net.roll(x, first, begins), first
    for t in range(steps):
        out, after = net.gru(x[t][None], (state * ~begins[t][:, None])[None])
        state = after[0]
        torch.testing.assert_close(rolled[t], out[0])


class Watched(VisualNavigation):
    """Keeps what it was shown in every step, and what it did."""

    def __init__(self, network: VisualPolicy) -> None:
        super().__init__(network)
        self.rows: list[tuple[dict[str, np.ndarray], tuple[float, float]]] = []

    def act(self, view: Any) -> Any:
        shown = self.look(view, BaseSpec())
        velocity = self(view, BaseSpec())
        self.rows.append((shown, (velocity.forward, velocity.turn)))
        return velocity


@pytest.mark.parametrize(
    ("seen", "light"),
    [("arm_depth", "flat"), *(pytest.param("arm_rgb", light, marks=pytest.mark.slow) for light in ("flat", "baked"))],
)
def test_device_and_simulator_show_the_same(seen: str, light: Any) -> None:
    settings = replace(PICTURED, worlds=1, minibatches=1, episodes_per_home=1)
    settings = settings if seen == "arm_depth" else replace(colored(settings), light=light)
    bank = make_bank(settings, seed=4, workers=1)
    spec = replace(rules(settings), max_steps=36)
    task = SocialNav()
    source = EpisodeSource(task, [bank.scenes[0]], spec=spec)
    episode = task.sample(bank.scenes[0], bank.floors[0], int(bank.seeds[0]), spec, source.roster)
    watched = Watched(untrained(settings, light=light))
    run(WorldRollout.of(task, episode, {"robot": watched}, measure=False))
    worlds = ActionRepeatEnv(settings, bank, device="cpu", compile=False, hold=1)
    shown, _ = worlds.reset(seed=0)
    pixels = 0.0
    for exact, action in watched.rows:
        np.testing.assert_allclose(shown["humanoid_gps"][0].numpy(), exact["humanoid_gps"], atol=2e-3)
        np.testing.assert_array_equal(shown["humanoid_detector"][0].numpy(), exact["humanoid_detector"])
        scale = 1 if seen == "arm_depth" else 255
        pixels += (np.abs(shown[seen][0].numpy() / scale - exact[seen] / scale) > 0.01).mean()
        shown = worlds.repeat_action(torch.tensor([action]))[0]
    actions = {action for _, action in watched.rows}
    assert len(watched.rows) == 36
    assert 3 < len(actions) <= 12  # held for three steps each
    assert pixels / 36 < 0.01


# --- playing ------------------------------------------------------------------------------------------------------------
@pytest.fixture
def file(tmp_path: Path) -> Path:
    save_policy(untrained(), tmp_path / "policy.npz")
    return tmp_path / "policy.npz"


def test_it_plays_wherever_a_policy_has_a_name(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = "--scenes h3-homes/train#0 --episodes 1 --max-steps 30 --mcap"
    generate = ["generate", "social_nav", *options.split()]
    assert main([*generate, "--policy", f"weights:{file}", "-o", str(tmp_path / "ds")]) == 0
    (episode,) = (tmp_path / "ds").rglob("*.mcap")
    assert main(["replay", str(episode), "--verify"]) == 0
    assert main([*generate, "--robot", "lift_arm", "--policy", f"weights:{file}", "-o", str(tmp_path / "x")]) != 0
    captured = capsys.readouterr()
    assert "drive the robot quad_arm, the episode has lift_arm" in captured.err + captured.out


class Eyes:
    """Keeps the light and the size in which a policy asks for pictures, and shows noise."""

    def __init__(self) -> None:
        self.lights: list[str] = []
        self.sizes: list[Any] = []

    def __call__(self, names: Any, size: Any, light: str = "flat") -> dict[str, np.ndarray]:
        self.lights.append(light)
        self.sizes.append(size)
        rgb = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
        return {"arm_rgb": rgb, "humanoid_detector": np.zeros(1, np.float32)}


def asked_light(name: str) -> str:
    """The light in which the policy of a name looks."""
    eyes = Eyes()
    network = network_of(name)
    assert isinstance(network, VisualPolicy)
    view = SimpleNamespace(
        pictures=eyes, step=0, robot_xz=np.zeros(2), robot_heading=0.0, human_xz=np.ones(2), met=False
    )
    VisualNavigation(network)(view, BaseSpec())  # type: ignore[arg-type]
    (light,) = eyes.lights
    assert eyes.sizes == [network.card.picture_size]
    return light


def test_a_policy_is_shown_the_light_it_has_learned_in(tmp_path: Path) -> None:
    flat, old, baked, depth = (str(tmp_path / f"{name}.npz") for name in ("flat", "old", "baked", "depth"))
    seeing = untrained(colored(PICTURED))
    save_policy(seeing, flat)
    save_policy(seeing.in_light("baked"), baked)
    save_policy(untrained(), depth)
    with np.load(flat) as data:
        card = msgspec.json.decode(str(data["card"]))
        assert card.pop("light") == "flat"
        np.savez(old, **{**data, "card": np.array(msgspec.json.encode(card).decode())})  # type: ignore[arg-type]
    assert [asked_light(f"weights:{file}") for file in (flat, old, baked)] == ["flat", "flat", "baked"]
    # asked for otherwise, which the recorded name says
    digest = seeing.digest[:12]
    assert asked_light(f"weights:{flat}@baked") == asked_light(f"weights:{flat}@{digest}@baked") == "baked"
    assert stamped(f"weights:{flat}@baked") == f"weights:{flat}@{digest}@baked"
    assert stamped(f"weights:{flat}@flat") == stamped(f"weights:{flat}") == f"weights:{flat}@{digest}"
    assert stamped(stamped(f"weights:{flat}@baked")) == f"weights:{flat}@{digest}@baked"
    # the light decides what it does, where it sees colours; digests of before it was on cards stay
    assert network_of(f"weights:{old}").digest == seeing.digest != network_of(f"weights:{baked}").digest
    assert replace(untrained(), card=replace_light(untrained().card)).digest == untrained().digest
    with pytest.raises(InputError, match="H3-POLICY-032"):
        network_of(f"weights:{depth}@baked")


def replace_light(card: PolicyCard) -> PolicyCard:
    return msgspec.structs.replace(card, light="baked")


def test_an_evaluation_shows_policies_the_light_that_is_asked_for(tmp_path: Path) -> None:
    save_policy(untrained(colored(PICTURED)), tmp_path / "rgb.npz")
    save_policy(untrained(), tmp_path / "depth.npz")
    names = [f"weights:{tmp_path / name}.npz" for name in ("rgb", "depth")]

    def played(light: Any) -> tuple[str, ...]:
        policies = (*names, "end_to_end", "stand_still")
        request = EvaluationRequest(task="social_nav", policies=policies, scenes=("small:1",), episodes=1, light=light)
        return request.jobs()[0].policies

    own = (*map(stamped, names), "end_to_end", "stand_still")
    assert played(None) == played("flat") == own
    assert played("baked") == (f"{own[0]}@baked", *own[1:])


def test_a_flat_policy_sees_flat_light_in_an_episode_whose_environment_is_baked() -> None:
    settings = replace(colored(PICTURED), worlds=1, minibatches=1, episodes_per_home=1)
    spec, task = replace(rules(settings), max_steps=2), SocialNav()
    env = h3data.make("social_nav", "small:1", observations=("arm_rgb",), rgb_size=(32, 24), spec=spec)
    baked = env.reset(seed=3)[0]["arm_rgb"].astype(int)
    for light in ("flat", "baked"):
        episode = env.stepper.play.episodes[0]  # type: ignore[attr-defined]
        watched = Watched(untrained(settings).in_light(light))  # type: ignore[arg-type]
        run(WorldRollout.of(task, episode, {"robot": watched}, measure=False))
        shown = watched.rows[0][0]["arm_rgb"].astype(int)
        assert (np.abs(shown - baked).mean() < 0.1) == (light == "baked")
        assert np.abs(shown - baked).mean() > 3 or light == "baked"


def test_every_episode_starts_without_memory(file: Path) -> None:
    network = network_of(f"weights:{file}")
    assert network_of(f"weights:{file}@{network.digest[:12]}") is not None
    a, b = navigation_of(network, "social_nav"), navigation_of(network, "social_nav")
    assert a is not b


def test_other_tasks_and_robots_are_refused(file: Path) -> None:
    with pytest.raises(FormatError, match=r"(?s)rearrange.*'social_nav'.*H3-POLICY-016"):
        learned_chooser(f"weights:{file}", "rearrange", 2, robot=True)
    with pytest.raises(FormatError, match=r"(?s)social_nav.*'rearrange'.*H3-POLICY-016"):
        navigation_of(untrained(task="rearrange"), "social_nav")
    with pytest.raises(FormatError, match=r"(?s)quad_arm.*mobile_arm.*H3-POLICY-020"):
        navigation_of(untrained(), "social_nav", robot="mobile_arm")


def test_a_policy_that_is_named_wrongly_is_told_its_name(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "policy.npz").write_bytes(file.read_bytes())
    for task, policy, expected in (
        ("rearrange", "end_to_end", "these are for 'social_nav'. Policy: end_to_end"),
        ("social_nav", "plan_pop_3_robot", "these are for 'rearrange'. Policy: plan_pop_3_robot"),
        ("wander", f"weights:{run / 'policy.npz'}", "In wander a policy cannot be a file of weights"),
        ("social_nav", str(run / "policy.npz"), f"Hint: weights:{run / 'policy.npz'}"),
        ("social_nav", f"weights:{run}", f"the folder of a training run. Hint: weights:{run / 'policy.npz'}"),
    ):
        assert main(["generate", task, "--scenes", "small:1", "--policy", policy, "-o", str(tmp_path / "ds")]) == 2
        assert expected in capsys.readouterr().err


def saved(tmp_path: Path, *, drop: str = "", text: str | None = None, **arrays: Any) -> Path:
    network = untrained()
    card = msgspec.json.encode(network.card).decode() if text is None else text
    rows = {"format": np.array(FILE_FORMAT), "card": np.array(card), **network.arrays, **arrays}
    np.savez(tmp_path / "p.npz", **{n: a for n, a in rows.items() if n != drop})
    return tmp_path / "p.npz"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"drop": "card"}, r"(?s)'card'.*H3-POLICY-034"),
        ({"drop": "gru.bias_hh"}, r"(?s)the array gru\.bias_hh is missing.*H3-POLICY-007"),
        ({"text": "{"}, "H3-POLICY-035"),
        ({"text": '{"task": "social_nav"}'}, r"(?s)missing required field.*H3-POLICY-035"),
        (
            {"act_1.bias": np.array([np.nan, 0], np.float32)},
            "(?s)act_1.bias holds numbers that are not finite.*H3-POLICY-007",
        ),
        (
            {"act_1.bias": np.zeros(3, np.float32)},
            r"(?s)act_1\.bias has the shape \[3\], expected \[2\].*H3-POLICY-007",
        ),
        ({"act_1.bias": np.zeros(2)}, r"(?s)act_1\.bias is float64, expected float32.*H3-POLICY-007"),
        ({"more": np.zeros(2, np.float32)}, r"(?s)unknown array more.*H3-POLICY-007"),
        (
            {"act_1.bias.planes": np.zeros((3, 2), np.uint8)},
            r"(?s)planes.*bytes are uint8 \[4, \.\.\.\], got uint8 \[3, 2\].*H3-POLICY-030",
        ),
        ({"act_1.bias.planes": np.zeros((4, 2), np.float32)}, r"(?s)planes.*bytes are uint8.*H3-POLICY-030"),
        ({"act_1.bias.planes": np.array(0, np.uint8)}, r"(?s)got uint8 \[\].*H3-POLICY-030"),
        (
            {"act_1.bias.planes": np.full((4, 2), 255, np.uint8)},
            "(?s)act_1.bias holds numbers that are not finite.*H3-POLICY-007",
        ),
    ],
)
def test_damaged_policies_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        network_of(f"weights:{saved(tmp_path, **change)}")


def test_a_packed_policy_is_the_same_one(file: Path, tmp_path: Path) -> None:
    packed, rounded = tmp_path / "packed.npz", tmp_path / "rounded.npz"
    packed_policy.main(file, packed, rounding=False)
    packed_policy.main(file, rounded, rounding=True)
    before, after, near = (network_of(f"weights:{path}") for path in (file, packed, rounded))
    assert before.digest == after.digest != near.digest
    for name, array in before.arrays.items():
        assert after.arrays[name].tobytes() == array.tobytes()
        np.testing.assert_allclose(near.arrays[name], array, rtol=2**-11)
        assert not (near.arrays[name].view(np.uint32) & 0x1FFF).any()
    with np.load(packed) as members:
        assert all(members[f"{name}.planes"].shape == (4, *array.shape) for name, array in before.arrays.items())


@pytest.mark.parametrize(
    ("policy", "digest"),
    [
        ("end_to_end", "20cd086e69681236"),
        ("end_to_end_paper", "e974033d50794e67"),
        ("learn_single", "5bcd3dd49c934167"),
        ("plan_pop_3_robot", "9733b80c5ab7fb64"),
        ("plan_pop_3_pixels", "f924fe400a08"),
        ("learn_pop", "182830523dfc7896"),
    ],
)
def test_the_policies_of_the_package_are_those_that_were_measured(policy: str, digest: str) -> None:
    """Docs show their scores."""
    assert network_of(f"weights:{builtin_path(f'policies/{policy}.npz')}").digest.startswith(digest)


def test_other_sizes_and_truncated_files_are_refused(file: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)picture\.weight has the shape \[8, 16\], expected.*H3-POLICY-007"):
        untrained(picture_size=(64, 48))
    with pytest.raises(InputError, match=r"(?s)multiples of 4.*H3-POLICY-007"):
        untrained(picture_size=(30, 24))
    with pytest.raises(InputError, match=r"(?s)unknown observations smell.*H3-POLICY-007"):
        untrained(observations=("smell",))
    with pytest.raises(InputError, match=r"(?s)held for 0 steps.*H3-POLICY-007"):
        untrained(hold=0)
    network = untrained()
    shown = {"arm_depth": np.zeros((12, 16, 1)), "humanoid_detector": np.zeros(1), "humanoid_gps": np.zeros(2)}
    with pytest.raises(InputError, match=r"(?s)arm_depth \[24, 32, 1\].*H3-POLICY-033"):
        network(shown, np.zeros(2, np.float32), network.start())
    file.write_bytes(file.read_bytes()[:-700])
    with pytest.raises(FormatError, match="H3-POLICY-030"):
        network_of(f"weights:{file}")
