"""Strips of an episode: which moments they show, paths until then and no farther, the command that writes them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.recording import Event, Recording, write_mcap
from h3data.replay import Replay
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from h3data_viewers import strip
from h3data_viewers.strip import MOST, PASSING_M, crossing_of, episode_strip, moments_of
from tests.simulated import rearrange_episode, simulate_rearrange


@pytest.fixture(scope="module")
def recording() -> Recording:
    episode = rearrange_episode(build_home(HomeSpec(preset="small", seed=1)), seed=1)
    return simulate_rearrange(replace(episode, spec=replace(episode.spec, max_steps=420)), solo_steps=1)


def walked(recording: Recording, robot: np.ndarray, person: np.ndarray) -> Recording:
    """The recording with other places, [T, 2] each, and no events."""
    columns = dict(recording.columns)
    for k, xz in enumerate((robot, person)):
        pose = columns[f"agent_{k}.base_pose"].copy()
        pose[:, [0, 2]] = xz
        columns[f"agent_{k}.base_pose"] = pose
    return replace(recording, columns=columns, events=())


def lines(count: int, *, gap_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Two agents that walk past each other at 1 m/s on parallel lines."""
    along = np.linspace(-count / 60, count / 60, count)
    return np.column_stack([along, np.zeros(count)]), np.column_stack([-along, np.full(count, gap_m)])


def test_a_strip_shows_how_far_it_is(
    recording: Recording, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("h3data.progress.LINE_EVERY_S", 0.0)
    monkeypatch.setattr(strip, "_view", lambda *_: np.zeros((4, strip.WIDTH_PX, 3), np.uint8))
    episode_strip(Replay(recording))
    assert f"draw: 1 of {len(moments_of(recording))} moments" in capsys.readouterr().err


def test_they_cross_where_they_pass(recording: Recording) -> None:
    robot, person = lines(len(recording), gap_m=1.4)
    crossing = crossing_of(walked(recording, robot, person))
    assert crossing is not None
    assert abs(crossing.step - len(recording) / 2) <= 1
    assert (crossing.text, crossing.agents) == ("robot and person cross, 1.4 m", (0, 1))


def test_who_stands_does_not_cross(recording: Recording) -> None:
    robot, person = lines(len(recording), gap_m=1.0)
    half = len(recording) // 2
    waits = robot.copy()
    waits[half - 60 : half + 60] = waits[half - 60]  # for four seconds around the place where they would pass
    crossing = crossing_of(walked(recording, waits, person))
    assert crossing is None or abs(crossing.step - half) >= 45
    assert crossing_of(walked(recording, robot * 0, person)) is None
    assert crossing_of(walked(recording, *lines(len(recording), gap_m=PASSING_M + 0.1))) is None
    absent = np.full_like(person, np.nan)
    assert crossing_of(walked(recording, robot, absent)) is None


def test_moments_are_in_the_order_of_time(recording: Recording) -> None:
    assert any(moment.text.startswith("robot picks") for moment in moments_of(recording))
    robot, person = lines(len(recording), gap_m=1.0)
    events = [Event(step=s, agent=s % 2, kind=kind, target=f"cup_{s}") for s, kind in ((9, "place"), (4, "pick"))]
    events += [
        Event(step=5, agent=0, kind="collision", target="human"),
        Event(step=6, agent=-1, kind="place", target="x"),
    ]
    found = moments_of(replace(walked(recording, robot, person), events=tuple(events)))
    assert [moment.text for moment in found] == [
        "robot picks cup_4",
        "person places cup_9",
        "robot and person cross, 1.0 m",
    ]
    many = [Event(step=s, agent=0, kind="pick", target="cup") for s in range(30)]
    assert len(moments_of(replace(walked(recording, robot, person), events=tuple(many)))) == MOST


def test_paths_end_at_their_moment(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strip, "_view", lambda replay, moment: np.zeros((strip.VIEW_PX, strip.WIDTH_PX, 3), np.uint8))
    events = tuple(Event(step=s, agent=0, kind="pick", target="cup") for s in (60, 200))
    still = np.zeros((len(recording), 2))
    own = recording.agent_column(0, "base_pose")[:, [0, 2]].astype(np.float64)
    later = own.copy()
    later[100:] = own[100:] + 1.0
    first, other = (episode_strip(Replay(replace(walked(recording, xz, still), events=events))) for xz in (own, later))
    width = strip.WIDTH_PX
    assert first.shape == other.shape
    assert first.shape[1] == 2 * width + strip.GAP_PX
    np.testing.assert_array_equal(first[:, :width], other[:, :width])
    assert (first[:, width + strip.GAP_PX :] != other[:, width + strip.GAP_PX :]).any()
    plan = first[strip.LABEL_PX + strip.VIEW_PX :]
    for color in strip.COLORS[:2]:
        assert (plan[:, :width] == color).all(-1).any()


@pytest.mark.slow
def test_the_command_writes_one(recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import cv2

    write_mcap(recording, tmp_path / "e.mcap")
    command = ["view", str(tmp_path / "e.mcap"), "--light", "flat", "-o", str(tmp_path / "s.png")]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "robot picks" in said
    picture = cv2.imread(str(tmp_path / "s.png"))
    assert picture is not None
    count = len(moments_of(recording))
    assert picture.shape[1] == count * strip.WIDTH_PX + (count - 1) * strip.GAP_PX
    view = picture[strip.LABEL_PX : strip.LABEL_PX + strip.VIEW_PX, : strip.WIDTH_PX]
    assert view.std() > 10
    for more, message in ((["--camera", "robot_arm"], "--camera needs a Rerun file"), ([], "Use --force")):
        assert main([*command, *more]) == 2
        assert message in capsys.readouterr().err


def test_what_makes_no_strip_is_refused(recording: Recording) -> None:
    still = np.zeros((len(recording), 2))
    with pytest.raises(InputError, match="H3-REPLAY-031"):
        episode_strip(Replay(walked(recording, still, still), detail=False))
