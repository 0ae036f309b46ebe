"""Scenario cards: all of them in plans, places in homes, modes and how they are judged, errors, environments."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.errors import InputError, SceneError
from h3data.recording import Recording
from h3data.scene import FreeSpace
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data_crowds.cards import choose_cards, load_cards
from h3data_crowds.places import build_plan
from h3data_crowds.scenarios import Scenarios, ScenarioSpec, _person
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import verify

CARDS = sorted(load_cards())


def sampled(card: str, seed: int = 1, **rules: Any) -> Episode:
    task, spec = Scenarios(), ScenarioSpec(card=card, where="plan", **rules)
    scene = build_plan("hall")
    return task.sample(scene, FreeSpace.from_scene(scene), seed, spec, make_roster(task.agents))


def played(card: str, policy: str, **rules: Any) -> Recording:
    return simulate(Scenarios(), sampled(card, **rules), {"robot": policy})


def test_there_are_25_cards():
    assert len(CARDS) == 25
    assert choose_cards("all") == list(load_cards())


@pytest.mark.parametrize("card", CARDS)
def test_every_card_stands_on_free_floor_in_its_plan(card: str):
    for seed in range(10):
        episode = sampled(card, seed)
        assert len(episode.roster) == 1 + len(load_cards()[card].people)
        places = [episode.starts[:, :2], np.array([episode.extra["goal"]])]
        places += [np.array(person["path"]).reshape(-1, 2) for person in episode.extra["people"]]
        assert (episode.free.signed_distance(np.concatenate(places)) > 0.3).all()
        gaps = np.hypot(*(episode.starts[1:, :2] - episode.starts[0, :2]).T)
        assert gaps.min() > 0.65


def test_the_two_sides_of_a_blind_corner_do_not_see_each_other():
    episode = sampled("blind_corner")
    robot, person = episode.starts[0, :2], episode.starts[1, :2]
    line = robot + (person - robot) * np.linspace(0.0, 1.0, 50)[:, None]
    assert not episode.free.is_navigable(line).all()


@pytest.mark.slow
def test_a_card_is_found_in_a_home_and_plays_again():
    recording = h3data.simulate("scenarios", "medium:1", seed=1, card="blind_corner", where="home")
    assert recording.episode.info["extra"]["where"] == "home"
    assert verify(recording).difference is None


@pytest.mark.slow
def test_every_card_can_be_generated_in_20_of_25_homes():
    task, spec = Scenarios(), ScenarioSpec()
    roster, generated, at_home = make_roster(task.agents), Counter[str](), Counter[str]()
    for home in range(25):
        (named,) = named_scenes(f"h3-homes/train#{home}")
        scene, free = open_scene(named.source), open_free_space(named.source, spec.agent_radius_m, spec.agent_height_m)
        for card in CARDS:
            episode = task.sample(scene, free, 7, ScenarioSpec(card=card), roster)
            generated[card] += 1
            at_home[card] += episode.extra["where"] == "home"
    assert min(generated.values()) >= 20
    for card in ("blind_corner", "join_group", "leave_group", "following", "leading"):
        assert at_home[card] == 25, "what docs/scenarios.md says"


@pytest.mark.slow
def test_a_plan_travels_with_the_recording():
    recording = played("narrow_doorway", "dwa")
    assert recording.episode.info["extra"]["where"] == "plan"
    assert verify(recording).difference is None


def test_a_card_that_does_not_fit_a_home_is_refused():
    with pytest.raises(SceneError, match="H3-TASK-079"):
        h3data.simulate("scenarios", "small:0", card="entering_elevator", where="home")


@pytest.mark.parametrize(
    ("rules", "code"),
    [
        ({"card": "blind_conrer"}, "H3-TASK-076"),
        ({"card": ","}, "H3-TASK-076"),
        ({"where": "moon"}, "H3-TASK-077"),
        ({"card": "join_group", "roster": "robot,human"}, "H3-TASK-078"),
    ],
)
def test_errors(rules: dict[str, Any], code: str):
    with pytest.raises(InputError, match=code):
        h3data.simulate("scenarios", "small:0", **rules)


@pytest.mark.parametrize("card", ["following", "leading", "accompanying", "join_group"])
def test_modes_are_met_by_a_planner_and_not_by_a_robot_that_stands(card: str):
    assert played(card, "dwa").episode.info["ended"] == "success"
    assert played(card, "still", max_steps=400).episode.info["ended"] != "success"


def test_who_does_not_give_way_at_a_door_fails_and_who_waits_succeeds():
    assert played("narrow_doorway", "shortest_path").episode.info["ended"] != "success"
    episode = sampled("narrow_doorway")
    away = np.array(episode.extra["people"][0]["path"][0])
    through = replace(episode, starts=np.vstack([episode.starts[0], [*away, 0.0]]))  # the person has passed already
    recording = simulate(Scenarios(), through, {"robot": "shortest_path"})
    assert recording.episode.info["ended"] == "success"


def test_who_passes_through_a_group_fails():
    episode = sampled("leave_group")
    out = replace(episode, extra={**episode.extra, "goal": (2 * episode.starts[0, :2]).tolist()})
    assert simulate(Scenarios(), out, {"robot": "dwa"}).episode.info["ended"] == "success"
    start = np.array([-2.8, 0.0, 0.0])
    inside = replace(
        episode,
        starts=np.vstack([start, episode.starts[1:]]),
        extra={**episode.extra, "goal": [0.0, 0.0]},
    )
    assert (
        simulate(
            Scenarios(),
            inside,
            {"robot": "dwa"},
        ).episode.info["ended"]
        != "success"
    )


def test_environments_of_modes_begin_and_need_the_card_s_people():
    env = h3data.make("crowd_follow", "small:0", num_envs=2, observations=["goal_gps", "gesture"])
    seen, _ = env.reset(seed=1)
    assert seen["gesture"].shape == (2, 1)
    for _ in range(5):
        seen, reward, *_ = env.step(np.tile(np.array([[1.0, 0.0]], np.float32), (2, 1)))
        assert np.isfinite(reward).all()
    env.close()
    few = h3data.make("scenarios", "small:0", spec=ScenarioSpec(card="following"))
    with pytest.raises(InputError, match="H3-TASK-080"):
        few.reset(seed=1)


def test_a_recording_holds_the_version_of_people_s_rules_and_verifies_by_it(monkeypatch: pytest.MonkeyPatch):
    def by_version(version: int) -> Recording:
        def person(_task: Any, episode: Episode, number: int) -> Any:
            policy = _person(episode, number)
            policy.repeat(version)
            return policy

        with monkeypatch.context() as patch:
            patch.setattr(Scenarios, "policies", {**Scenarios.policies, "human": {"card": person}})
            return played("crowd_navigation", "still", max_steps=150)

    old, new = by_version(2), by_version(8)
    assert {facts["version"] for facts in old.episode.info["people"].values()} == {2}
    assert not np.array_equal(old.columns["agent_1.base_pose"], new.columns["agent_1.base_pose"])
    assert verify(old).difference is None
    # recordings of before the version was stored have the rules of version 8
    for recording, same in ((new, True), (old, False)):
        info = {name: fact for name, fact in recording.episode.info.items() if name != "people"}
        bare = replace(recording, episode=replace(recording.episode, info=info))
        assert (verify(bare).difference is None) == same
