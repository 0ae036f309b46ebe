"""Vector environments beside Gymnasium's own: the autoreset modes, and attributes of the worlds."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import h3data
from h3data.errors import InputError
from sim_kinematic.motion.spec import SocialNavSpec

HOME = "small:3"
W = 3
SHORT = SocialNavSpec(max_steps=5, spawn_distance_m=2.0)


def make(**options: Any) -> Any:
    return h3data.make("social_nav", HOME, spec=SHORT, **options)


def assert_alike(ours: Any, theirs: Any, where: str = "") -> None:
    """Equal, entries of infos only in the worlds of Gymnasium's masks."""
    if isinstance(theirs, tuple):
        ours, theirs = dict(enumerate(ours)), dict(enumerate(theirs))
    if isinstance(theirs, dict):
        for name, value in theirs.items():
            mask = theirs.get(f"_{name}")
            own = ours[name]
            if mask is not None and not isinstance(value, dict):
                assert (ours[f"_{name}"] | ~mask).all(), (where, name)
                value, own = value[mask], own[mask]
            assert_alike(own, value, f"{where}/{name}")
    elif isinstance(theirs, np.ndarray) and theirs.dtype == object:
        for one, other in zip(ours, theirs, strict=True):
            assert_alike(one, other, where)
    else:
        np.testing.assert_array_equal(ours, theirs, err_msg=where)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_every_autoreset_mode_is_gymnasiums(mode: AutoresetMode) -> None:
    ours = make(num_envs=W, autoreset_mode=mode.name)
    theirs = SyncVectorEnv([make] * W, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    a, b = ours.reset(seed=7), theirs.reset(seed=7)
    assert_alike(a, b)
    ours.action_space.seed(1)
    ended = np.zeros(W, np.bool_)
    for step in range(14):
        if mode is AutoresetMode.DISABLED and ended.any():
            assert_alike(
                *(each.reset(options={"reset_mask": ended.copy()}) for each in (ours, theirs)), f"reset at {step}"
            )
        actions = ours.action_space.sample()
        a, b = ours.step(actions), theirs.step(actions)
        assert_alike(dict(enumerate(a[:4])), dict(enumerate(b[:4])), f"step {step}")
        assert_alike(a[4], b[4], f"info {step}")
        assert ("final_obs" in a[4]) == ("final_obs" in b[4])
        if mode is AutoresetMode.SAME_STEP and "final_obs" in b[4]:
            for one, other in zip(a[4]["final_obs"], b[4]["final_obs"], strict=True):
                assert (one is None) == (other is None)
        ended = a[2] | a[3]


def test_disabled_worlds_must_be_reset_and_only_they_are() -> None:
    env = make(num_envs=2, autoreset_mode="DISABLED")
    with pytest.raises(InputError, match="H3-ENV-052"):
        env.reset(seed=1, options={"reset_mask": np.array([True, False])})
    env.reset(seed=1)
    for _ in range(3):
        env.step(np.zeros((2, 2)))
    first, info = env.reset(options={"reset_mask": np.array([True, False])})
    assert info["_scene"].tolist() == [True, False]
    again = make(num_envs=2)
    again.reset(seed=1)
    for _ in range(3):
        shown, *_ = again.step(np.zeros((2, 2)))
    assert np.array_equal(first["humanoid_gps"][1], shown["humanoid_gps"][1]), "it goes on"
    for _ in range(2):
        *_, truncated, _ = env.step(np.zeros((2, 2)))
    assert truncated.tolist() == [False, True]
    with pytest.raises(InputError, match="H3-ENV-053"):
        env.step(np.zeros((2, 2)))
    env.reset(options={"reset_mask": truncated})
    env.step(np.zeros((2, 2)))


@pytest.mark.parametrize("mask", [[True], np.zeros(2, np.bool_), np.array([1, 0]), "all", np.ones((2, 1), np.bool_)])
def test_malformed_masks_are_refused(mask: Any) -> None:
    env = make(num_envs=2)
    env.reset(seed=1)
    with pytest.raises(InputError, match="H3-ENV-051"):
        env.reset(options={"reset_mask": mask})


def test_modes_belong_to_worlds() -> None:
    assert make(num_envs=1, autoreset_mode="SameStep").autoreset_mode is AutoresetMode.SAME_STEP
    assert make(num_envs=1).metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    for mode in ("later", "same_step", 3):
        with pytest.raises(InputError, match=r"(?s)NEXT_STEP.*SAME_STEP.*DISABLED.*H3-ENV-050"):
            make(num_envs=1, autoreset_mode=mode)
    with pytest.raises(InputError, match="H3-ENV-020"):
        make(autoreset_mode="SAME_STEP")
    made = gymnasium.make_vec("h3data.envs:h3data/SocialNav-v0", num_envs=2, scenes=HOME, autoreset_mode="SAME_STEP")
    assert made.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    made.reset(seed=3)


def test_attributes_are_those_of_each_world() -> None:
    env = make(num_envs=W, render_mode="rgb_array")
    theirs = SyncVectorEnv([make] * W)
    assert env.get_attr("observation_space") == theirs.get_attr("observation_space")
    assert env.call("action_space") == theirs.call("action_space")
    assert env.call("render_mode") == ("rgb_array",) * W
    assert env.call("_max_episode_steps") == (5,) * W
    assert env.call("task") == ("social_nav",) * W
    env.set_attr("level", [1, 2, 3])
    env.set_attr("mood", "calm")
    assert env.get_attr("level") == env.call("level") == (1, 2, 3)
    assert env.call("mood") == ("calm",) * W
    env.set_attr("double", [lambda x, k=k: k * x for k in range(W)])
    assert env.call("double", 2) == (0, 2, 4)
    env.reset(seed=1)
    pictures = env.call("render")
    assert len(pictures) == W
    assert pictures[0].shape == (480, 640, 3)
    assert make(num_envs=2).call("render") == (None, None)


def test_attributes_that_cannot_be() -> None:
    env = make(num_envs=2)
    with pytest.raises(AttributeError):
        env.get_attr("nothing")
    with pytest.raises(AttributeError):
        env.call("nothing")
    for name in ("step", "reset"):
        with pytest.raises(InputError, match=rf"(?s){name}.*H3-ENV-05[45]"):
            env.call(name)
    for values in ([1], (1, 2, 3), []):
        with pytest.raises(InputError, match=r"(?s)2 worlds.*H3-ENV-056"):
            env.set_attr("level", values)
    for name in ("num_envs", "observation_space", "stepper", "task"):
        with pytest.raises(InputError, match=rf"(?s){name}.*H3-ENV-05[45]"):
            env.set_attr(name, 1)


def test_flat_and_skilled_worlds_have_the_modes_too() -> None:
    flat = make(num_envs=2, flatten=True, autoreset_mode="SAME_STEP")
    flat.reset(seed=1)
    for _ in range(5):
        shown, *_, info = flat.step(np.zeros((2, 2)))
    assert info["final_obs"][0].shape == shown[0].shape
    assert not np.array_equal(info["final_obs"][0], shown[0])


@pytest.mark.parametrize(
    "options", [{}, {"num_envs": W}, {"agents": ("robot", "human")}, {"num_envs": W, "flatten": True}]
)
@pytest.mark.parametrize("task", ["social_nav", "rearrange"])
def test_tensors_are_refused_and_move_nothing(task: str, options: dict[str, Any]) -> None:
    torch = pytest.importorskip("torch")
    env = h3data.make(task, HOME, **options)
    env.reset(seed=0)
    before = [array.copy() for array in env.stepper.play.world.state.arrays()]
    action = torch.zeros(() if options.get("num_envs") is None else W)
    given = dict.fromkeys(options["agents"], action) if "agents" in options else action
    with pytest.raises(InputError, match=rf"(?s){task}.*robot.*H3-ENV-059"):
        env.step(given)
    assert all(map(np.array_equal, before, env.stepper.play.world.state.arrays()))
