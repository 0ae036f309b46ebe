"""Players in tasks without skills who sit, lie down and make gestures: scripted participants send what the page sends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.bodies import JOINT_INDEX
from h3data.errors import InputError
from h3data.recording import Recording, read_mcap
from h3data.replay.posed_recording import PosedRecording
from h3data.scene.seats import seats_of
from h3data_pipelines.validation.recordings import validate_recording
from h3data_play.drivers import OFFER_STEPS, SittingDriver
from h3data_play.live import LiveGame
from h3data_play.plan import GameOrder
from h3data_play.wire import GESTURES, LIES, SEATED, SITS
from sim_kinematic.agents.skills import sentence
from sim_kinematic.policies.policy import External, PoseAction
from sim_kinematic.tasks.resume import verify
from tests.play.test_live import Player, table


def begun(out: Path, **changes: Any) -> LiveGame:
    return table(out, **changes).begin(GameOrder(index=0, name="000000"))


def driver_of(player: Player) -> SittingDriver:
    driver = player.game.drivers[player.number]
    assert isinstance(driver, SittingDriver)
    return driver


def walked_to_a_seat(player: Player, *, lies: bool = False) -> str:
    """Walk before the nearest seat of the home, and return its name."""
    driver = driver_of(player)
    player.play()
    place = driver.seats.nearest(driver._state.xz[0], driver.taken, within_m=30.0, lies=lies)
    assert place is not None
    x, z = place.before[:2].tolist()
    player.send(k="goto", p=[x, 0.0, z])
    player.until_free()
    return place.seat.name


def share(player: Player) -> float:
    return driver_of(player)._state.seat.item(0, 1)


def played_until(player: Player, wanted: float, most: int = 600) -> None:
    """Until the share of sitting is as ``wanted``."""
    while abs(share(player) - wanted) > 1e-9:
        player.play()
        most -= 1
        assert most, player.said


def watched(player: Player) -> list[np.ndarray]:
    """World frames of the joints that the page shows in each step, which fill up while steps are played."""
    packer, shown = player.game.packer, list[np.ndarray]()
    pose = packer._pose

    def noted(k: int, body: Any, base: np.ndarray, columns: Any) -> tuple[np.ndarray, np.ndarray]:
        pelvis, quats = pose(k, body, base, columns)
        if k == player.number:
            shown.append(body.joint_matrices_free(pelvis[None], quats[None])[0])
        return pelvis, quats

    packer._pose = noted  # type: ignore[method-assign]
    return shown


def posed(recording: Recording, number: int) -> np.ndarray:
    return PosedRecording(recording).joint_matrices(number, np.arange(len(recording)))


def finished(player: Player, out: Path) -> Recording:
    """The recording, which is valid and verifies."""
    player.game.close()
    recording = read_mcap(out / "000000.mcap")
    assert verify(recording).difference is None
    assert validate_recording(recording) == []
    return recording


@pytest.mark.slow
@pytest.mark.parametrize(("app", "lies"), [("social_nav", False), ("crowd", True)])
def test_a_player_sits_and_gets_up_by_the_same_key(tmp_path: Path, app: str, lies: bool) -> None:
    player = Player(begun(tmp_path, app=app, scenes="small:1"))
    walked_to_a_seat(player, lies=lies)
    player.play(OFFER_STEPS)
    driver = driver_of(player)
    assert driver.offers & (LIES if lies else SITS)
    assert player.send(k="sit", lies=lies) == ""
    player.play(3)
    assert driver.offers == 0, "a body that is led has no buttons"
    assert player.busy
    played_until(player, 2.0 if lies else 1.0)
    player.play(30)
    assert driver.offers == SEATED
    seated = driver._state.xz[0].copy()
    assert player.send(k="sit", lies=False) == ""
    player.until_free()
    assert share(player) == 0
    player.send(k="move", f=1.0, t=0.2)
    player.play(30)
    assert np.hypot(*(driver._state.xz[0] - seated)) > 0.4
    recording = finished(player, tmp_path)
    agent = f"agent_{player.number}."
    seats, base = recording.columns[agent + "motion_seat"], recording.columns[agent + "base_pose"]
    assert seats[:, 1].max() == (2 if lies else 1)
    assert 0.3 < seats[:, 0].max() < 0.7
    assert np.hypot(*np.diff(base[:, [0, 2]], axis=0).T).max() < 0.05
    assert (base[1:, 3:] * base[:-1, 3:]).sum(1).min() > 0.99
    hips = posed(recording, player.number)[:, 0, 1, 3]
    assert hips.min() < 0.75 < 0.8 < hips[-1]


def test_walking_keys_end_a_seat_wherever_the_body_is(tmp_path: Path) -> None:
    player = Player(begun(tmp_path, app="social_nav", scenes="small:1"))
    walked_to_a_seat(player)
    player.send(k="sit", lies=False)
    while not 0.3 < share(player) < 0.7:
        player.play()
    player.send(k="move", f=0.0, t=0.5)
    player.until_free()
    assert share(player) == 0
    # on the way there, a key ends the walk at once
    player.send(k="sit", lies=False)
    player.play(5)
    player.send(k="stop")
    player.play(60)
    assert share(player) == 0
    assert not player.busy
    assert finished(player, tmp_path).columns[f"agent_{player.number}.motion_seat"][:, 1].max() < 0.75


def test_reasons_are_sentences(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    player = Player(begun(tmp_path, app="social_nav", scenes="small:1"))
    driver = driver_of(player)
    walked_to_a_seat(player)
    monkeypatch.setattr(driver.seats, "nearest", lambda *_, **__: None)
    assert player.send(k="sit", lies=True) == sentence("no_seat")
    player.game.close()


@pytest.mark.parametrize("app", ["social_nav", "crowd"])
def test_gestures_are_shown_as_they_are_recorded(tmp_path: Path, app: str) -> None:
    player = Player(begun(tmp_path, app=app, scenes="small:1"))
    driver, shown = driver_of(player), watched(player)
    player.play()
    assert driver.offers & GESTURES
    player.send(k="gesture", name="wave")
    player.play(130)
    player.send(k="gesture", name="phone")
    player.play(40)
    player.send(k="move", f=0.5, t=0.1)
    player.play(40)
    player.send(k="gesture", name="phone")
    player.play(40)
    player.send(k="gesture", name="wave")
    player.play(10)
    player.send(k="gesture", name="phone")
    player.play(30)
    recording = finished(player, tmp_path)
    told = [event.target for event in recording.events if event.kind == "activity" and event.agent == player.number]
    assert told == ["wave", "stand", "phone", "stand", "wave", "phone"]
    frames = posed(recording, player.number)
    hand = frames[:, JOINT_INDEX["right_wrist"], 1, 3]
    assert hand[30:60].min() > hand[0] + 0.4
    assert hand[160:165].min() > hand[0] + 0.15
    assert abs(hand[125] - hand[0]) < 0.05
    # from one gesture straight into another the replay lowers the hand first, which nobody could know live
    steps = [k for k in range(len(recording)) if not 251 <= k < 265]
    assert np.abs(np.stack(shown)[steps] - frames[steps])[:, :, :3, 3].max() < 0.002


def test_who_sits_gets_up_before_a_gesture(tmp_path: Path) -> None:
    player = Player(begun(tmp_path, app="social_nav", scenes="small:1"))
    walked_to_a_seat(player)
    player.send(k="gesture", name="phone")
    player.play(30)
    assert player.send(k="sit", lies=False) == ""
    played_until(player, 1.0)
    assert player.send(k="gesture", name="wave") == "Get up first."
    assert driver_of(player).doing is None
    recording = finished(player, tmp_path)
    put_away = next(event.step for event in recording.events if (event.kind, event.target) == ("activity", "stand"))
    assert recording.columns[f"agent_{player.number}.motion_seat"][: put_away + 1, 1].max() < 0.1


@pytest.mark.slow
def test_two_players_do_not_take_one_seat(tmp_path: Path) -> None:
    game = begun(tmp_path, app="crowd", scenes="small:1", seats=("person", "person"))
    first, second = (Player(game, number) for number in game.drivers)
    name = walked_to_a_seat(first)
    assert first.send(k="sit", lies=False) == ""
    # the second one goes to the same seat before the first one sits, and finds it taken
    driver = driver_of(second)
    place = driver.seats.place(next(seat for seat in seats_of(game.session.episode.scene) if seat.name == name))
    driver._goal = place
    assert driver.go(place.before[:2], place.before.item(2)) == ""
    played_until(first, 1.0)
    taken = driver.taken
    assert any(np.hypot(*(each[:2] - place.stand[:2])) < 0.1 for each in taken)
    driver.guide, driver._goal = None, place._replace(before=driver._here)
    second.play(2)
    assert second.said[-1] == sentence("no_seat")
    assert driver.seat is None
    first.send(k="sit", lies=False)
    first.until_free()
    assert finished(first, tmp_path).episode.info["hitl"]["seats"] == ["person", "person"]


def test_people_of_a_crowd_leave_the_seat_of_a_player(tmp_path: Path) -> None:
    home = "small:1"
    agents = {"human_1": External(), "human_2": "orca+morning", "robot": "still"}
    roster = ["robot", "human", "human"]
    session = h3data.session("wander", home, agents=agents, roster=roster, spawn_distance_m=1.0)
    driver = SittingDriver(session, 1)
    place = driver.seats.nearest(driver._state.xz[0], within_m=30.0)
    assert place is not None
    session.step()
    session.act("human_1", PoseAction(place.stand[:2], place.stand.item(2), (place.seat.height_m, 1.0)))
    for _ in range(2):
        session.step()
    stations = session.play.team.stations
    np.testing.assert_allclose(stations[1].taken[:2], place.stand[:2])
    other = SittingDriver(session, 2)
    with pytest.raises(InputError, match="H3-SIM-064"):
        other.seats.place(place.seat, other.taken)
    session.act("human_1", (0.5, 0.0))
    session.act("human_1", PoseAction(place.before[:2], place.before.item(2)))
    for _ in range(2):
        session.step()
    assert 1 not in session.play.team.stations
    assert verify(session.close()).difference is None


@pytest.mark.parametrize(
    "pose",
    [
        PoseAction(np.full(2, np.nan), 0.0),
        PoseAction(np.zeros(3), 0.0),
        PoseAction(np.zeros(2), 0.0, (1.0,)),  # type: ignore[arg-type]
    ],
)
def test_malformed_poses_are_refused(pose: PoseAction) -> None:
    session = h3data.session("social_nav", "small:1", agents={"person": External()})
    with pytest.raises(InputError, match="H3-TASK-082"):
        session.act("person", pose)
    with pytest.raises(InputError, match="H3-TASK-064"):
        session.act("person", PoseAction("here", 0.0))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="H3-TASK-046"):
        session.act("robot", PoseAction(np.zeros(2), 0.0))
