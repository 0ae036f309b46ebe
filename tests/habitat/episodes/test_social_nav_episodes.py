"""Social-navigation episodes in Habitat's files: starts and waypoints that come back."""

from __future__ import annotations

import gzip
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import FormatError, InputError
from h3data.geometry import heading_direction, quat_rotate
from h3data.recording import Event, Recording
from h3data.recording.task_episodes.rearrange_episode import EpisodeSet, RearrangeEpisode, RigidObject
from h3data.recording.task_episodes.social_nav_episodes import SocialNavEpisode, read_social_nav, social_nav_episode
from h3data.scene import FreeSpace
from h3data_habitat.episodes.files import read_episodes, write_episodes
from h3data_habitat.episodes.recorded_episodes import social_nav_of
from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import HOME_WALKER, SocialNavSpec
from tests.simulated import SOCIAL_NAV, simulate_social_nav

numbers = st.floats(-1e3, 1e3)
starts = st.tuples(numbers, numbers, st.floats(-3.2, 3.2))
episodes = st.builds(
    SocialNavEpisode,
    robot_start=starts,
    human_start=starts,
    human_goals=st.lists(st.tuples(numbers, numbers), max_size=4).map(tuple),
    floor_y=numbers,
    goals_complete=st.booleans(),
    max_steps=st.integers(1, 10**6),
    seed=st.integers(0, 2**62),
    robot=st.just("robot/quad_arm"),
    scene_source=st.dictionaries(st.sampled_from("abc"), st.integers() | st.none(), max_size=2),
)


@given(st.lists(episodes, min_size=1, max_size=3))
def test_what_is_written_comes_back(tmp_path_factory: Any, navs: list[SocialNavEpisode]) -> None:
    file = tmp_path_factory.mktemp("nav") / "val.json.gz"
    made = [social_nav_episode(nav, episode_id=str(k), scene_id="home_7") for k, nav in enumerate(navs)]
    write_episodes(EpisodeSet(episodes=tuple(made)), file)
    found = read_episodes(file, strict=True)
    assert [read_social_nav(e) for e in found.episodes] == navs


@given(starts)
def test_habitat_sees_the_robot_where_it_starts(start: tuple[float, float, float]) -> None:
    nav = SocialNavEpisode(robot_start=start, human_start=(0, 0, 0), human_goals=(), floor_y=0.5)
    made = social_nav_episode(nav, episode_id="0", scene_id="s")
    assert made.start_position == (start[0], 0.5, start[1])
    looks = quat_rotate(np.array(made.start_rotation), np.array([0.0, 0.0, -1.0]))  # Habitat's forward is -Z
    np.testing.assert_allclose(looks[[0, 2]], heading_direction(start[2]), atol=1e-12)


def test_the_file_is_one_of_habitat(tmp_path: Path) -> None:
    nav = SocialNavEpisode(robot_start=(1, 2, 0), human_start=(3, 4, 1), human_goals=((5, 6),))
    things = tuple(RigidObject(f"{name}.object_config.json", np.eye(4)) for name in ("cup", "bowl"))
    made = social_nav_episode(nav, episode_id="0", scene_id="s", rigid_objects=things, targets={"cup_:0000": np.eye(4)})
    write_episodes(EpisodeSet(episodes=(made,)), tmp_path / "a.json.gz")
    with gzip.open(tmp_path / "a.json.gz") as file:
        [raw] = json.load(file)["episodes"]
    # the keyword arguments of habitat-lab's RearrangeEpisode, no other: it refuses unknown ones
    assert set(raw) == {
        "episode_id",
        "scene_id",
        "scene_dataset_config",
        "additional_obj_config_paths",
        "start_position",
        "start_rotation",
        "info",
        "ao_states",
        "rigid_objs",
        "targets",
        "markers",
        "target_receptacles",
        "goal_receptacles",
        "name_to_receptacle",
    }
    assert [name for name, _ in raw["rigid_objs"]] == ["bowl.object_config.json", "cup.object_config.json"]
    assert raw["info"]["h3data"]["human_goals"] == [[5, 6]]


@pytest.fixture(scope="module")
def recording() -> Recording:
    home = build_home(HomeSpec(preset="small", seed=1))
    free = FreeSpace.from_scene(home, radius_m=0.25, cache=False)
    world = SOCIAL_NAV.episode(home, seed=5, spec=SocialNavSpec(max_steps=200, human=HOME_WALKER), free=free)
    return simulate_social_nav(world, episode_id="5")


def test_a_recording_becomes_an_episode(recording: Recording, tmp_path: Path) -> None:
    nav = social_nav_of(recording)
    info = recording.episode.info
    assert list(nav.robot_start) == info["robot_start"]
    assert list(nav.human_start) == info["human_start"]
    assert nav.seed == 5
    assert nav.max_steps == 200
    assert nav.goals_complete == (len(recording) == 200)
    assert (nav.robot, nav.human) == (recording.agents[0].model, recording.agents[1].model)
    assert nav.scene_sha256 == info["scene_sha256"]
    assert nav.rules["max_steps"] == 200
    made = social_nav_episode(nav, episode_id="5", scene_id=recording.episode.scene)
    write_episodes(EpisodeSet(episodes=(made,)), tmp_path / "a.json.gz")
    assert read_social_nav(read_episodes(tmp_path / "a.json.gz").episodes[0]) == nav


def test_goals_are_where_the_person_went(recording: Recording) -> None:
    nav = social_nav_of(recording)
    goal = recording.columns["sim.human_goal"]
    assert len(nav.human_goals) == goal.max() + 1 >= 2
    person = recording.agent_column(1, "base_pose")[:, [0, 2]]
    arrived = np.flatnonzero(np.diff(goal))  # the last step on the way to each goal
    reached = np.array(nav.human_goals)[: len(arrived)]
    apart = np.hypot(*(person[arrived] - reached).T)
    assert (apart <= recording.episode.info["spec"]["human"]["arrive_m"] + nav.goals_within_m).all()


def changed(recording: Recording, **info: Any) -> Recording:
    return replace(recording, episode=replace(recording.episode, info={**recording.episode.info, **info}))


def test_goals_of_an_episode_that_ended_early_are_not_all(recording: Recording) -> None:
    assert social_nav_of(recording).goals_complete
    assert not social_nav_of(changed(recording, max_steps=500)).goals_complete


def test_goals_in_events_are_those_of_the_plan_to_the_centimetre(recording: Recording) -> None:
    exact, named = social_nav_of(recording), social_nav_of(changed(recording, human_goals=None))
    assert exact.goals_within_m == 0.0 < named.goals_within_m
    np.testing.assert_allclose(named.human_goals, exact.human_goals[: len(named.human_goals)], atol=0.00501)


def test_exact_goals_are_preferred(recording: Recording) -> None:
    nav = social_nav_of(changed(recording, human_goals=[[1.23456789, 2.0]]))
    assert nav.human_goals == ((1.23456789, 2.0),)
    assert nav.goals_within_m == 0.0


def test_recordings_that_do_not_say_enough(recording: Recording) -> None:
    with pytest.raises(InputError, match=r"(?s)Expected array, got null - at \$\.robot_start.*H3-HABITAT-043"):
        social_nav_of(changed(recording, robot_start=None))
    with pytest.raises(InputError, match=r"(?s)length 3, got 2 - at \$\.human_start.*H3-HABITAT-043"):
        social_nav_of(changed(recording, human_start=[1.0, 2.0]))
    with pytest.raises(InputError, match="H3-HABITAT-042"):
        social_nav_of(changed(recording, human_start=[1.0, 2.0, float("nan")]))
    with pytest.raises(InputError, match="H3-HABITAT-043"):
        social_nav_of(changed(recording, max_steps="many"))
    with pytest.raises(InputError, match=r"(?s)'gfx_replay'.*H3-HABITAT-039"):
        social_nav_of(replace(recording, episode=replace(recording.episode, task="gfx_replay")))
    old = changed(recording, human_goals=None)  # recordings that name goals in events only
    with pytest.raises(InputError, match=r"(?s)0.*new_goal.*H3-HABITAT-041"):
        social_nav_of(replace(old, events=()))
    odd = Event(step=0, agent=1, kind="new_goal", detail="the kitchen")
    with pytest.raises(InputError, match="H3-HABITAT-044"):
        social_nav_of(replace(old, events=(odd,)))
    alone = replace(recording, agents=recording.agents[:1])
    with pytest.raises(InputError, match="H3-HABITAT-040"):
        social_nav_of(alone)


def test_episodes_of_others_and_damaged_ones() -> None:
    plain = RearrangeEpisode(episode_id="3", scene_id="s")
    assert read_social_nav(plain) is None
    assert read_social_nav(msgspec.structs.replace(plain, info={"h3data": 3})) is None
    good = social_nav_episode(
        SocialNavEpisode(robot_start=(0, 0, 0), human_start=(0, 0, 0), human_goals=()), episode_id="3", scene_id="s"
    ).info["h3data"]
    for change, words in (
        ({"version": 2}, r"(?s)episode '3': info\.h3data.*1.*2.*H3-HABITAT-045"),
        ({"version": "x"}, r"(?s)1.*H3-HABITAT-045"),
        ({"robot_start": [0, 0]}, r"(?s)info\.h3data: Expected array of length 3.*H3-HABITAT-046"),
        ({"human_goals": [[0, "a"]]}, r"(?s)Expected float, got str - at \$\.human_goals\[0\]\[1\].*H3-HABITAT-046"),
    ):
        with pytest.raises(FormatError, match=words):
            read_social_nav(msgspec.structs.replace(plain, info={"h3data": {**good, **change}}))
    later = msgspec.structs.replace(plain, info={"h3data": {**good, "weather": "fine"}})
    assert read_social_nav(later) is not None  # a field that was added later
    nowhere = SocialNavEpisode(robot_start=(float("nan"), 0, 0), human_start=(0, 0, 0), human_goals=())
    with pytest.raises(InputError, match="H3-HABITAT-042"):
        social_nav_episode(nowhere, episode_id="0", scene_id="s")
