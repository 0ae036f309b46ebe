"""What agents of training environments see and feel: own views, held things, sensors against each other, noise, the view for
people."""

from __future__ import annotations

import io
import sys
from functools import partial
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.errors import InputError
from h3data.progress import progress
from h3data.render import Light, look_at, pinhole
from h3data.replay import Replay, camera_track
from h3data.scene.articulation import opened
from h3data_homes import HomeSpec, build_home
from h3data_light.bake import LitScene
from sim_kinematic.envs import world_stepper
from sim_kinematic.envs.single import TaskEnv
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.rearrange_observations import HABITAT_SENSES, PAPER_SENSES, SENSES
from sim_kinematic.sensing import camera_sensor, watching
from sim_kinematic.sensing.agent_pictures import DETECTORS, picture_names
from sim_kinematic.sensing.sensor import depth_with_noise, with_noise
from sim_kinematic.sensing.table import SENSORS
from sim_kinematic.tasks import sources
from sim_kinematic.tasks.recorder import simulate
from tests.sim.steppers import PAIR, Batch, rearrange_env, social_nav_env

HOME = "small:1"
SIZES: dict[str, Any] = {"depth_size": (56, 43), "rgb_size": (40, 30)}
NAV_0, PICK_0, BACKWARD = 0, 4, 10


def assert_same(a: dict[str, Any], b: dict[str, Any]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


# --- pictures -----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_pictures_have_the_sizes_of_the_papers_cameras() -> None:
    names = ("arm_depth", "arm_rgb", *DETECTORS, "front_left_depth", "front_left_rgb")
    for env in (social_nav_env(HOME, observations=names), rearrange_env(HOME, observations=names)):
        seen, _ = env.reset(seed=4)
        assert {name: array.shape for name, array in seen.items()} == {
            "arm_depth": (171, 224, 1),
            "arm_rgb": (480, 640, 3),
            "humanoid_detector": (1,),
            "humanoid_mask": (171, 224, 1),
            "humanoid_box": (171, 224, 1),
            "front_left_depth": (212, 120, 1),
            "front_left_rgb": (212, 120, 3),
        }
        assert env.observation_space.contains(seen)
        assert {seen[name].dtype for name in names if name.endswith("_rgb")} == {np.dtype(np.uint8)}
        assert 0 < seen["arm_depth"].max() <= 1
        assert seen["arm_rgb"].std() > 5
    (robot, person) = env.stepper.play.episode.roster  # type: ignore[union-attr]
    assert set(names) < set(picture_names(robot.body))
    assert picture_names(person.body) == ("head_depth", "head_rgb")


def test_the_detectors_agree_and_see_the_person() -> None:
    batch = Batch(HOME, observations=tuple(DETECTORS))
    batch.begin(5, 0)
    (robot,), (person,), free = batch.state.robots, batch.state.people, batch.episodes[0].free
    rng, found = np.random.default_rng(2), []
    while (
        len(found) < 12
    ):  # somebody 1.5 to 2.5 m away in plain sight, straight ahead and then more and more to the side
        a, b = free.sample(rng, 2)
        gap = np.hypot(*(a - b))
        if not 1.5 < gap < 2.5 or free.geodesic(a, b) > gap + 1e-9:
            continue
        robot.xz[0], person.xz[0] = a, b
        robot.heading[0] = np.arctan2(-(b - a)[1], (b - a)[0]) + 0.12 * len(found)
        seen = {name: array[0] for name, array in batch.observe().items()}
        mask, box = seen["humanoid_mask"], seen["humanoid_box"]
        found.append(seen["humanoid_detector"][0])
        assert found[-1] == (mask.sum() > 1000)
        assert set(np.unique(mask)) <= {0.0, 1.0}
        if box.any():
            rows, columns = np.flatnonzero(mask.any((1, 2))), np.flatnonzero(mask.any((0, 2)))
            assert box.sum() == (rows[-1] - rows[0]) * (columns[-1] - columns[0])
    assert found[0] == 1
    assert found[-1] == 0


@pytest.fixture(scope="module")
def holding() -> TaskEnv:
    """The robot has taken the first object."""
    env = rearrange_env(HOME, partner="still", observations=("arm_depth", "is_holding"), render_mode="rgb_array")
    env.reset(seed=4)
    env.step(NAV_0)
    seen, _, _, _, info = env.step(PICK_0)
    assert info["outcome"] == "done"
    assert seen["is_holding"] == 1
    env.step(BACKWARD)
    env.step(BACKWARD)
    return env


def test_held_things_are_in_the_picture(holding: TaskEnv) -> None:
    play = holding.stepper.play
    assert play is not None
    drawn, target = holding.stepper._posed(np.array([0])), play.episode.targets[0]
    (number,) = [k for k, i in enumerate(drawn.scene.instances) if i.name == target.name]
    away = np.array([-0.5, 1.0, 0.5])

    def looked_at(point: np.ndarray) -> np.ndarray:
        camera = pinhole(80, 60, hfov_deg=30, pose=look_at(point + away, point), hidden_layers=("ceiling",))
        return drawn.picture([camera], ("instance",))["instance"][0]

    there = looked_at(play.team.objects.poses[0, :3])
    assert (there[20:40, 25:55] == number).sum() > 50
    assert set(drawn.instances(0)) & set(np.unique(there))  # the hand that holds it
    assert not (looked_at(target.start[:3])[20:40, 30:50] == number).any()
    picture = holding.render()
    assert picture is not None
    assert picture.shape == (480, 640, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 20


def test_a_moving_arm_moves_the_picture() -> None:
    env = rearrange_env(HOME, level="low", partner="still", observations=("arm_depth", "arm_joints"), **SIZES)
    before, _ = env.reset(seed=4)
    still = env.step(np.zeros(10))[0]
    np.testing.assert_array_equal(before["arm_depth"], still["arm_depth"])
    command = np.zeros(10, np.float32)
    command[3] = 1.0
    moved = env.step(command)[0]
    np.testing.assert_allclose(np.abs(moved["arm_joints"] - still["arm_joints"]).max(), 0.05, atol=1e-5)
    assert (np.abs(moved["arm_depth"] - still["arm_depth"]) > 1e-3).mean() > 0.1


@pytest.mark.parametrize("env", [social_nav_env, rearrange_env])
def test_each_of_two_has_its_own_pictures(env: Any) -> None:
    both = env(HOME, agents=PAIR, observations=("humanoid_gps", "arm_depth", "arm_joints", "head_rgb"), **SIZES)
    seen, _ = both.reset(seed=4)
    assert set(seen["robot"]) == {"humanoid_gps", "arm_depth", "arm_joints"}
    assert set(seen["human"]) == {"humanoid_gps", "head_rgb"}
    assert seen["human"]["head_rgb"].std() > 5
    assert all(both.observation_space(agent).contains(seen[agent]) for agent in both.agents)


def test_worlds_side_by_side_show_the_pictures_of_each() -> None:
    names = (*PAPER_SENSES, "arm_rgb")
    many = h3data.make("rearrange", scenes=HOME, num_envs=2, observations=names, render_mode="rgb_array", **SIZES)
    one = rearrange_env(HOME, observations=names, **SIZES)
    first, _ = many.reset(seed=3)
    second = many.step(np.array([8, 9]))[0]
    for w in range(2):
        assert_same(one.reset(seed=3 + w)[0], {name: array[w] for name, array in first.items()})
        assert_same(one.step(8 + w)[0], {name: array[w] for name, array in second.items()})
    assert [picture.shape for picture in many.render()] == [(480, 640, 3)] * 2


@pytest.mark.parametrize("scenes", [HOME, [HOME, HOME]], ids=str)
def test_worlds_side_by_side_are_watched_one_by_one(scenes: Any) -> None:
    many = h3data.make("social_nav", scenes=scenes, num_envs=2, render_mode="rgb_array")
    with pytest.raises(InputError, match="H3-ENV-016"):
        many.render()
    many.reset(seed=3)
    for w, picture in enumerate(many.render()):
        one = social_nav_env(scenes, render_mode="rgb_array")
        one.reset(seed=3 + w)
        np.testing.assert_array_equal(one.render(), picture)
    assert h3data.make("social_nav", scenes=scenes, num_envs=2).render() is None


# --- sensors against each other -----------------------------------------------------------------------------------------
def test_both_tasks_have_the_sensors_of_the_list() -> None:
    common = {
        "humanoid_gps",
        "egomotion",
        "arm_joints",
        "is_holding",
        "localization",
        "localization_in_start_frame",
        "humanoid_in_start_frame",
        "collision",
    }
    assert common <= set(SENSORS) & set(SENSES)
    assert set(PAPER_SENSES) - {"arm_depth"} <= set(SENSES) >= set(HABITAT_SENSES) - {"arm_depth"}


@pytest.mark.parametrize("task", ["social_nav", "rearrange"])
def test_the_start_frame_stays_where_it_was(task: str) -> None:
    names = ["localization", "localization_in_start_frame", "humanoid_in_start_frame", "humanoid_gps", "egomotion"]
    options: dict[str, Any] = {"level": "low", "partner": "still"} if task == "rearrange" else {}
    fixed = ["obj_start_in_start_frame", "obj_goal_in_start_frame", "obj_in_start_frame"] if options else []
    near = ["obj_start_gps_compass", "obj_goal_gps_compass", "obj_gps_compass"] if options else []
    env = h3data.make(task, scenes=HOME, observations=[*names, *fixed, *near], **options)
    began, _ = env.reset(seed=4)
    np.testing.assert_array_equal(began["localization_in_start_frame"], 0)
    np.testing.assert_array_equal(began["egomotion"], 0)
    for polar, place in zip(["humanoid_gps", *near], ["humanoid_in_start_frame", *fixed], strict=True):
        distance, right = began[polar].reshape(-1, 2).T
        x, _, z = began[place].reshape(-1, 3).T
        np.testing.assert_allclose([np.hypot(x, z), np.arctan2(z, x)], [distance, right], atol=1e-5)
    seen, moved = began, np.zeros(2)
    action = np.zeros(env.action_space.shape, np.float32)
    action[:2] = 0.5, 0.7
    for _ in range(10):
        before = seen
        seen = env.step(action)[0]
        forward, left, turn = seen["egomotion"] / 30
        heading = before["localization_in_start_frame"][3]
        c, s = np.cos(heading), np.sin(heading)
        moved += [c * forward - s * left, -s * forward - c * left]
        np.testing.assert_allclose(seen["localization_in_start_frame"][[0, 2]], moved, atol=1e-5)
        np.testing.assert_allclose(seen["localization_in_start_frame"][3], heading + turn, atol=1e-5)
    assert np.linalg.norm(moved) > 0.2
    gap = np.diff([began["localization"][[0, 2]], seen["localization"][[0, 2]]], axis=0)
    assert np.hypot(*gap[0]) == pytest.approx(float(np.linalg.norm(moved)), abs=1e-5)
    for name in fixed:
        np.testing.assert_allclose(seen[name], began[name], atol=1e-6)


@pytest.mark.parametrize("task", ["social_nav", "rearrange"])
def test_collisions_are_felt(task: str) -> None:
    options: dict[str, Any] = {"level": "low", "partner": "still"} if task == "rearrange" else {}
    env = h3data.make(task, scenes=HOME, observations=["collision"], **options)
    env.reset(seed=4)
    action = np.zeros(env.action_space.shape, np.float32)
    action[0] = 1.0
    felt = []
    for _ in range(90):
        seen, _, terminated, _, info = env.step(action)
        contact = info["robot_contact"] if task == "social_nav" else env.stepper.play.world.state.robots[0].contact[0]
        assert seen["collision"].tolist() == [contact, terminated]
        felt.append(contact)
        if terminated:
            break
    assert 0 < sum(felt) < len(felt)


# --- noise --------------------------------------------------------------------------------------------------------------
NOISE: dict[str, Any] = {
    "arm_depth": partial(depth_with_noise, missing=0.05),
    "humanoid_gps": partial(with_noise, sigma=(0.1, 0.02)),
    "arm_rgb": partial(with_noise, sigma=4.0),
}
NOISY = (*NOISE, "localization")


def test_noise_follows_from_seed_and_step() -> None:
    exact = social_nav_env(num_envs=2, scenes=HOME, observations=NOISY, **SIZES)
    noisy = social_nav_env(num_envs=2, scenes=HOME, observations=NOISY, noise=NOISE, **SIZES)
    one = social_nav_env(HOME, observations=NOISY, noise=NOISE, **SIZES)
    seen, blurred, single = exact.reset(seed=3)[0], noisy.reset(seed=3)[0], one.reset(seed=4)[0]
    for _ in range(3):
        assert noisy.observation_space.contains(blurred)
        assert_same({name: array[1] for name, array in blurred.items()}, single)
        np.testing.assert_array_equal(blurred["localization"], seen["localization"])
        apart = (blurred["humanoid_gps"] - seen["humanoid_gps"]) / (0.1, 0.02)
        assert 0 < np.abs(apart).max() < 5
        lost = (blurred["arm_depth"] == 0) & (seen["arm_depth"] > 0)
        assert 0.03 < lost.mean() < 0.07
        shades = blurred["arm_rgb"].astype(float) - seen["arm_rgb"]
        assert 3 < shades[(seen["arm_rgb"] > 20) & (seen["arm_rgb"] < 235)].std() < 5
        before = apart
        actions = np.full((2, 2), 0.3, np.float32)
        seen, blurred, single = exact.step(actions)[0], noisy.step(actions)[0], one.step(actions[1])[0]
        assert not np.array_equal(before, (blurred["humanoid_gps"] - seen["humanoid_gps"]) / (0.1, 0.02))


def test_noise_of_rearrangement_is_each_agents_own() -> None:
    names, noise = ("humanoid_gps", "arm_depth"), {"humanoid_gps": partial(with_noise, sigma=0.1)}
    env = rearrange_env(HOME, agents=PAIR, observations=names, noise=noise, **SIZES)
    plain = rearrange_env(HOME, agents=PAIR, observations=names, **SIZES)
    (seen, _), (exact, _) = env.reset(seed=4), plain.reset(seed=4)
    (robots, hers) = (seen[a]["humanoid_gps"] - exact[a]["humanoid_gps"] for a in ("robot", "human"))
    assert robots[0] != hers[0]
    np.testing.assert_array_equal(seen["robot"]["arm_depth"], exact["robot"]["arm_depth"])
    assert_same(env.reset(seed=4)[0]["robot"], seen["robot"])


@pytest.mark.parametrize("task", ["social_nav", "rearrange"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise": {"arm_depth": depth_with_noise}}, r"(?s)arm_depth.*H3-SIM-047"),
        ({"noise": {"humanoid_gps": lambda values, rng: values[:1]}}, r"(?s)\[2\].*H3-SIM-048"),
        ({"noise": {"humanoid_gps": lambda values, rng: values * np.nan}}, "H3-SIM-048"),
        ({"observations": ["head_rgb"]}, "(?s)arm_rgb.*H3-SIM-046"),
        ({"observations": ["arm_rgb"], "rgb_size": (0, 3)}, "H3-SIM-039"),
        ({"observations": [["arm_rgb"]]}, "H3-SIM-046"),
    ],
)
def test_what_cannot_be_shown_is_told(task: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        h3data.make(task, **{"scenes": HOME, "observations": ["humanoid_gps"], **options}).reset(seed=1)


# --- for people who watch -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("options", [{"agents": ("robot", "human")}, {"agents": ("human",)}, {}], ids=str)
def test_the_view_follows_the_agent_and_stays_on_its_side(options: dict[str, Any]) -> None:
    env = h3data.make("rearrange", scenes=HOME, render_mode="rgb_array", **options)
    with pytest.raises(InputError, match="H3-ENV-016"):
        env.render()
    env.reset(seed=4)
    first = env.render()
    np.testing.assert_array_equal(env.render(), first)
    assert first.shape == (480, 640, 3)
    assert h3data.make("rearrange", scenes=HOME, **options).render() is None


def test_the_view_shows_the_agent_wherever_it_is() -> None:
    env = social_nav_env(HOME, render_mode="rgb_array")
    env.reset(seed=4)
    free, robot = env.stepper.play.episodes[0].free, env.stepper.play.world.state.robots[0]
    for xz in free.sample(np.random.default_rng(0), 12):
        robot.xz[0] = xz
        env.render()
        drawn, side = env.stepper._posed(np.array([0])), env._watcher._side
        cameras = [watching._camera(drawn.middle(0)[0], k, (64, 48)) for k in range(watching.SIDES)]
        seen = drawn.picture(cameras, ("instance",))["instance"]
        pixels = np.isin(seen, drawn.instances(0)).sum((1, 2))
        assert pixels[side] > 0.4 * pixels.max() > 20


# --- in words -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"task": "social_nav"},
            "TaskEnv(social_nav, scene small:1, robot quad_arm beside human female_0, 1 world)",
        ),
        (
            {"task": "social_nav", "num_envs": 64, "scenes": "h3-homes/train"},
            "TaskVectorEnv(social_nav, 37 scenes of h3-homes/train, robot quad_arm beside human female_0, 64 worlds)",
        ),
        (
            {"task": "social_nav", "agents": ("robot", "human"), "scenes": ["small:1", "small:2"]},
            "TaskParallelEnv(social_nav, 2 scenes of small:1, small:2, robot quad_arm and human female_0, 1 world)",
        ),
        (
            {"task": "rearrange", "robot": "quad_arm", "human": "male_2"},
            "TaskEnv(rearrange, scene small:1, robot quad_arm beside human male_2 (plan_pop_4), 1 world)",
        ),
        (
            {"task": "rearrange", "agents": ("human",), "num_envs": 3, "scenes": "small"},
            "TaskVectorEnv(rearrange, 4 scenes of small, human female_0 beside robot quad_arm (complement), 3 worlds)",
        ),
        (
            {"task": "rearrange", "agents": ("robot", "human"), "scenes": [f"small:{k}" for k in range(5)]},
            "TaskParallelEnv(rearrange, 5 scenes of small:0, small:1, small:2, ..., robot quad_arm and human female_0, "
            "1 world)",
        ),
    ],
    ids=lambda value: value.partition("(")[0] if isinstance(value, str) else "",
)
def test_environments_say_what_they_are(options: dict[str, Any], words: str) -> None:
    env = h3data.make(**{"scenes": HOME, **options})
    assert repr(env) == str(env) == words


@pytest.mark.parametrize("task", ["social_nav", pytest.param("rearrange", marks=pytest.mark.slow)])
def test_a_bar_tells_how_far_a_first_reset_is(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [build_home(HomeSpec(preset="small", seed=seed)) for seed in (1, 2)]

    def told(*, terminal: bool) -> str:
        stderr = io.StringIO()
        monkeypatch.setattr(stderr, "isatty", lambda: terminal)
        monkeypatch.setattr(sys, "stderr", stderr)
        h3data.make(task, scenes=scenes, num_envs=4).reset(seed=3)
        return stderr.getvalue()

    def set_delay(seconds: float) -> None:
        for module in (sources, world_stepper):
            monkeypatch.setattr(
                module, "progress", lambda *items, **options: progress(*items, **{**options, "delay": seconds})
            )

    assert told(terminal=False) == ""
    set_delay(1e9)
    assert told(terminal=True) == ""
    set_delay(0.0)
    assert {"social_nav": "homes", "rearrange": "episodes"}[task] in told(terminal=True)


# --- light --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("light", ["baked", "flat"])
def test_colours_are_those_of_a_replay_in_the_same_light(light: Any) -> None:
    """`h3data generate` and `rerender` render replays."""
    spec = SocialNavSpec(max_steps=3)
    env = social_nav_env(HOME, observations=("arm_rgb",), rgb_size=(64, 48), spec=spec, light=light)
    env.reset(seed=3)
    recording = simulate(
        env.stepper.task,  # type: ignore[union-attr]
        env.stepper.play.episode,  # type: ignore[union-attr]
        {"robot": lambda view, base: Velocity(0.3, 0.4)},
    )
    replay = Replay(recording, light=light)
    frames = replay.frames([camera_track(replay, "robot_arm_rgb").resized(64, 48)], range(3))
    for _, (frame,) in frames:
        seen = env.step([0.3, 0.4])[0]
        # the poses of agents are rounded in recordings, so that an edge may fall on the pixel beside
        assert (np.abs(seen["arm_rgb"].astype(int) - frame["rgb"]).max(-1) > 1).mean() < 0.003


def test_environments_are_lit_by_default_and_say_which_lights_there_are() -> None:
    seen = {
        light: social_nav_env(HOME, observations=("arm_rgb", "arm_depth"), rgb_size=(64, 48), **light_option).reset(
            seed=3
        )[0]
        for light, light_option in {"default": {}, "baked": {"light": "baked"}, "flat": {"light": "flat"}}.items()
    }
    np.testing.assert_array_equal(seen["default"]["arm_rgb"], seen["baked"]["arm_rgb"])
    assert np.abs(seen["baked"]["arm_rgb"].astype(int) - seen["flat"]["arm_rgb"]).mean() > 5
    np.testing.assert_allclose(seen["baked"]["arm_depth"], seen["flat"]["arm_depth"], atol=1e-5)
    with pytest.raises(InputError, match=r"(?s)'sunny'.*baked, flat.*H3-RENDER-046"):
        social_nav_env(HOME, light="sunny")


def test_no_light_is_baked_for_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("h3data_light.bake.lit_scene", None)  # calling it fails
    for env in (social_nav_env(HOME, observations=("arm_depth",)), rearrange_env(HOME, observations=("arm_depth",))):
        assert env.reset(seed=4)[0]["arm_depth"].max() > 0


def test_doors_that_move_take_the_light_of_the_home_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light is baked with doors closed, as in replays; else every door that moves would cost seconds."""
    closed = build_home(HomeSpec(preset="small", seed=1, articulated=True))
    ajar = opened(closed)
    lit = []

    def bake(meshes: Any, instances: Any, static: Any, sources: Any, *, name: str) -> LitScene:
        lit.append([instances[k].matrix for k in static])
        return LitScene(list(meshes), list(instances), Light(), {}, None)

    monkeypatch.setattr("h3data_light.bake.lit_scene", bake)
    plain = camera_sensor.StateRenderer(closed, [], light="baked").scene
    turned = camera_sensor.StateRenderer(ajar, [], light="baked", lit_as=closed).scene
    np.testing.assert_array_equal(*lit)
    assert (np.abs(turned.instance_matrix - plain.instance_matrix) > 0.01).any((1, 2)).sum() > 3
