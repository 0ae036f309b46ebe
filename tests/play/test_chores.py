"""Players do chores as simulated people do: fridge, tray and phone, recorded and simulated again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.bodies import Humanoid
from h3data.bodies.people.gestures import BOTH
from h3data.bodies.people.reach import hand_points
from h3data.errors import InputError
from h3data.recording import read_mcap, write_mcap
from h3data.recording.records import JOINTS
from h3data.replay import Replay
from h3data.scene.articulation import handle_points, joints_of
from h3data_crowds.chores import GRIP_BACK_M
from h3data_exporters.posing import posed_parts
from h3data_habitat.exporters.gfx_replay_export import write_gfx_replay
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_pipelines.validation.recordings import validate_recording
from h3data_play.drivers import OFFER_STEPS, PersonDriver
from h3data_play.messages import Chore, Gesture, Move, Pick, Sit, decode
from h3data_play.wire import StatePacker
from sim_kinematic.agents.driven.commands import Chore as ChoreCommand
from sim_kinematic.agents.skills import sentence
from sim_kinematic.crowd.crowd import VERSION
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.policies.policy import External
from sim_kinematic.tasks.resume import counterfactual, verify

HOME, SHORT_HOME = "medium-open:3", "small:1"


class Player:
    """A player without a page, whose messages go to a driver."""

    def __init__(self, home: str, version: int = VERSION, **rules: Any) -> None:
        player = AssignedPolicy(External(interrupts_when_close=False), "external", "human", version=version)
        agents = {"person": [player], "robot": "still"}
        self.session = h3data.session("rearrange", home, agents=agents, seed=3, max_steps=4000, **rules)
        number = next(k for k, agent in enumerate(self.session.episode.roster) if agent.kind == "human")
        self.driver = PersonDriver(self.session, number)
        self.chores: Any = self.driver.body.chores

    def step(self, count: int = 1) -> None:
        """Play some steps."""
        for _ in range(count):
            command = self.driver.command()
            if command is not None:
                self.session.act("person", command)
            self.driver.after(self.session.step())

    def until(self, done: Callable[[], bool]) -> None:
        """Play until something holds."""
        for _ in range(900):
            self.step()
            if done():
                return
        raise AssertionError("it does not happen")

    def do(self, name: Any) -> None:
        """Do a chore from beginning to end."""
        assert self.driver.follow(Chore(name=name)) == ""
        self.step(3)
        self.until(lambda: not self.driver.busy)

    def go(self, xz: Any) -> None:
        """Walk to a place."""
        assert self.driver.go(xz) == ""
        self.until(lambda: not self.driver.busy)

    def offered(self) -> list[dict[str, str]]:
        """Return the chores that are offered where the player stands."""
        self.step(OFFER_STEPS + 1)
        _ = self.driver.offers
        return self.driver.chores


def put_nearby(player: Player) -> None:
    """Put down what is held on the nearest furniture that has room."""
    wide, xz = player.chores.routine.holds[1] == 2, player.driver.body.xz
    plans = [player.chores._planned(name, wide, 0) for name, _ in player.chores._tops]
    places = sorted((plan.root[[0, 2]] for plan in plans if plan is not None), key=lambda at: np.hypot(*(at - xz)))
    for place in places:
        if player.driver.go(place) == "":
            player.until(lambda: not player.driver.busy)
        if player.session.refusal("person", ChoreCommand("put")) is None:
            assert player.offered() in ([{"name": "put", "thing": thing}] for thing in ("tray", "carton"))
            return player.do("put")
    raise AssertionError("there is no place for it")


@pytest.fixture(scope="module")
def played() -> tuple[Player, h3data.Recording]:
    """A player who does all chores, and the recording."""
    player = Player(HOME, chores=True, end_on_collision=False)
    for number, (name, thing) in enumerate((("take", "carton"), ("lift", "tray"))):
        player.go(player.chores.plans[number].root[[0, 2]])
        assert {"name": name, "thing": thing} in player.offered()
        player.do(name)
        assert player.driver.follow(Move(f=-0.4, t=0.5)) == ""
        player.step(30)
        player.driver.follow(Move())
        put_nearby(player)
    player.do("phone")
    player.step(40)
    player.do("phone")
    player.step(10)
    return player, player.session.close()


@pytest.mark.slow
def test_a_session_with_chores_is_simulated_again_bit_for_bit(played: Any, tmp_path: Path) -> None:
    player, recording = played
    told = [(event.kind, event.target) for event in recording.events if event.kind in ("takes", "puts")]
    carton, tray = "human_carton_0", "human_tray_0"
    assert told == [("takes", carton), ("puts", carton), ("takes", tray), ("puts", tray)]
    assert verify(recording).difference is None
    assert [finding.text for finding in validate_recording(recording) if finding.severity == "error"] == []
    write_mcap(recording, tmp_path / "played.mcap")
    again = read_mcap(tmp_path / "played.mcap")
    number, steps = player.driver.number, np.arange(0, len(recording), 31)
    frames = [Replay(each).joint_matrices(number, steps) for each in (recording, again)]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert verify(again).difference is None
    file = tmp_path / "played.gfx_replay.json"
    write_gfx_replay(recording, posed_parts(Replay(recording)), file)
    tracks = read_gfx_replay(file).columns["object_pose"][..., :3]
    (ours,) = [body.moving for body in recording.moving_bodies if body.name == carton]
    track = recording.columns["object_pose"][:, ours, :3]
    assert np.nanmin(np.nanmax(np.abs(tracks - track[:, None]), (0, 2))) < 1e-3
    other = counterfactual(recording, "still").columns["object_pose"]
    np.testing.assert_array_equal(other[0], recording.columns["object_pose"][0])


@pytest.mark.slow
def test_hands_are_at_handle_tray_and_phone(played: Any) -> None:
    player, recording = played
    replay, number = Replay(recording), player.driver.number
    body, scene = replay.model(number), replay.scene
    assert isinstance(body, Humanoid)
    assert scene is not None

    def palms(rows: Any) -> Any:
        frames = replay.joint_matrices(number, rows)
        return np.stack([hand_points(frames, body, hand) for hand in BOTH], 1)

    joints, k = joints_of(scene), joints_of(scene).index("fridge_0/door")
    positions = recording.columns[JOINTS].astype(np.float64)
    assert joints.is_open(positions.max(0))[k]
    moving = np.flatnonzero(np.abs(np.diff(positions[:, k])) > 1e-4)
    motions = joints.motions(positions[moving])[:, k]
    handle = motions[:, :3, :3] @ handle_points(scene)[k] + motions[:, :3, 3]
    assert np.linalg.norm(palms(moving) - handle[:, None], axis=2).min(1).max() < 0.02

    tracks = {thing.name: thing.moving for thing in recording.moving_bodies}
    steps = {(event.kind, event.target): event.step for event in recording.events}
    rows = np.arange(steps["takes", "human_tray_0"], steps["puts", "human_tray_0"], 7)
    tray = recording.columns["object_pose"][rows, tracks["human_tray_0"], :3].astype(np.float64)
    assert np.abs(np.linalg.norm(palms(rows).mean(1) - tray, axis=1) - GRIP_BACK_M).max() < 0.02
    phone = recording.columns["object_pose"][:, tracks["human_phone"]].astype(np.float64)
    shown = np.flatnonzero(np.isfinite(phone[:, 0]))
    assert len(shown) > 40
    assert np.linalg.norm(palms(shown)[:, 1] - phone[shown, :3], axis=1).max() < 0.05
    assert np.isnan(phone[-1]).all(), "it is put away"


def test_a_phone_is_a_thing_and_fills_the_hand() -> None:
    player = Player(SHORT_HOME, chores=True)
    assert player.driver.follow(Gesture(name="phone")) == ""
    player.step(40)
    assert player.chores.shows_phone
    assert player.offered() == [{"name": "phone", "thing": "phone"}]
    assert player.driver.offers == 0
    assert player.driver.follow(Gesture(name="wave")) == sentence("hand_full")
    for command in (ChoreCommand("lift"), ChoreCommand("take")):
        assert player.session.refusal("person", command) == sentence("hand_full")
    assert player.session.refusal("person", ChoreCommand("put")) == sentence("not_held")
    player.driver.follow(Pick(o=0))
    player.driver.follow(Sit())
    player.step(3)
    assert player.chores.shows_phone, "neither is started"
    packer = StatePacker(player.session.recorder.header, tuple(m.body for m in player.session.episode.roster))
    first = len(player.session.play.team.objects.names)  # type: ignore[attr-defined]
    columns = player.session.recorder.latest_columns()
    packed = packer.pack(columns, {first + player.chores.phone: player.driver.number})
    assert packed.objects["held"].tolist() == [-1] * first + [-1] * player.chores.phone + [player.driver.number]
    # a chore that keys interrupt is finished first
    player.driver.follow(Gesture(name="phone"))
    player.step(4)
    player.driver.follow(Move(f=1.0))
    player.step(40)
    assert not player.driver.hands_full
    assert verify(player.session.close()).difference is None


def test_players_follow_the_newest_rules_and_recordings_of_before_theirs() -> None:
    recordings = {}
    for version in (1, VERSION):
        player = Player(SHORT_HOME, version, chores=True)
        assert player.chores.routine.version == version, "by version 7, nothing is put down through walls"
        player.step(5)
        recordings[version] = player.session.close()
    older, newer = recordings[1], recordings[VERSION]
    assert newer.episode.info["people"] == {"human": {"version": VERSION}}
    info = {name: value for name, value in older.episode.info.items() if name != "people"}
    for recording in (newer, replace(older, episode=replace(older.episode, info=info))):
        assert verify(recording).difference is None


def test_sessions_have_no_things_of_chores_unless_their_rules_say_so() -> None:
    player = Player(SHORT_HOME)
    assert player.chores is None
    player.step(2)
    assert player.session.refusal("person", ChoreCommand("phone")) == sentence("no_chore")
    assert player.session.recorder.header.episode.info["spec"].get("chores") is None
    assert not [body for body in player.session.recorder.header.bodies if "tray" in body.name]
    with pytest.raises(InputError, match="H3-SIM-001"):
        player.session.act("person", ChoreCommand("juggle"))
    assert decode('{"k": "chore", "name": "take"}') == Chore(name="take")
    with pytest.raises(Exception, match="name"):
        decode('{"k": "chore", "name": "juggle"}')
