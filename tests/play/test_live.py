"""A live game without sockets: what players send becomes commands, is recorded to the letter, and comes out again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
import pytest

from h3data.bodies.people.planted_gait import drawn_in, planted_states, pose_planted
from h3data.errors import InputError
from h3data.geometry import heading_from_quat, pose_multiply, wrap_angle
from h3data.kernels import compiled_count
from h3data.recording import read_mcap
from h3data.recording.live_input import CLIENT
from h3data_motion.files import save_motion
from h3data_pipelines.validation.recordings import validate_recording
from h3data_play.app import App, Hud
from h3data_play.live import EpisodeFactory, LiveGame
from h3data_play.messages import decode
from h3data_play.plan import GameOrder, PlayPlan
from h3data_play.wire import BUSY
from h3data_play.worker import rehearse
from sim_kinematic.motion.step import discs_at
from sim_kinematic.tasks.resume import verify
from sim_kinematic.tasks.sessions import Session, StepResult
from tests.motion.test_walks import walk


def table(out: Path, **changes: Any) -> EpisodeFactory:
    """Rearrangement in a small home beside a robot that keeps still."""
    plan = {"app": "rearrange", "out": str(out), "scenes": "small:3", "partner": "still", **changes}
    return EpisodeFactory(PlayPlan(**plan))


class Player:
    """Sends messages and plays steps."""

    def __init__(self, game: LiveGame, number: int | None = None) -> None:
        self.game, self.seq, self.said = game, 0, list[str]()
        self.number = next(iter(game.drivers)) if number is None else number
        game.connected(self.number, True)

    def send(self, **message: Any) -> str:
        """Acts in the next step."""
        text = msgspec.json.encode({**message, "seq": self.seq, "ct": 1.0}).decode()
        why = self.game.take(self.number, decode(text), text, 5.0)  # type: ignore[arg-type]
        self.seq += 1
        return why

    def play(self, steps: int = 1) -> None:
        """So many steps."""
        for _ in range(steps):
            if not self.game.ended:
                self.said += [why for n, why in self.game.step().items() if n == self.number]

    def until_free(self, steps: int = 900) -> None:
        """Until nothing but keys moves the agent."""
        self.play()
        while self.busy and not self.game.ended and steps:
            self.play()
            steps -= 1
        assert steps, "it went on and on"

    @property
    def busy(self) -> bool:
        return bool(self.game.state(self.number, 0.0, whole=False)[1] & BUSY)

    @property
    def base(self) -> np.ndarray:
        return self.game.columns[f"agent_{self.number}.base_pose"][-1]


def bring(player: Player, k: int) -> None:
    """Walks to object k, takes it, and brings it to its goal."""
    goal = player.game.app.goals()[k].position
    player.send(k="pick", o=k, lead=True)
    player.until_free()
    assert player.game.columns[f"agent_{player.number}.grasp_body"][-1] >= 0, player.said
    player.send(k="place", p=list(goal), lead=True)
    player.until_free()


def test_a_whole_episode_verifies_from_raw_input(tmp_path: Path):
    game = table(tmp_path).begin(GameOrder(index=0, name="000000"))
    player = Player(game)
    for forward, turn in ((1.0, 0.0), (0.3, 0.7), (-0.4, 0.0), (0.0, 0.0)):
        player.send(k="move", f=forward, t=turn)
        player.play(10)
    for k in range(len(game.app.goals())):
        bring(player, k)
    assert game.ended == "success", player.said
    assert "2 of 2" in game.app.hud(player.number).lines[0]
    game.close()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert verify(recording).difference is None
    assert validate_recording(recording) == []
    texts = [e.payload for e in recording.inputs if e.kind == CLIENT]
    assert len(texts) == player.seq
    assert '"message":{"k":"move","f":0.3,"t":0.7,"seq":1,"ct":1.0}' in texts[1]
    assert recording.episode.info["hitl"]["seats"] == ["person"]
    assert recording.episode.info["ended"] == "success"


@pytest.mark.slow
@pytest.mark.parametrize("app", ["rearrange", pytest.param("social_nav", marks=pytest.mark.slow)])
def test_nobody_walks_through_the_robot(tmp_path: Path, app: str):
    """A person who walks straight at the robot is stopped by its discs, or slides along them; that verifies from raw input."""
    still = {"partner": "still"} if app == "rearrange" else {}
    game = table(tmp_path, app=app, scenes="small:1", **still).begin(GameOrder(index=0, name="000000"))
    player, nearest = Player(game), np.inf
    spec = game.session.episode.spec
    assert spec.solid_agents
    for _ in range(400):
        gap = places(game)[0, :2] - places(game)[1, :2]
        left = wrap_angle(np.arctan2(-gap[1], gap[0]) - places(game)[1, 2])
        if len(game.session.recorder) % 60 == 0 and np.hypot(*gap) > 1.5:  # around walls
            player.send(k="goto", p=[float(places(game)[0, 0]), 0.0, float(places(game)[0, 1])])
        elif np.hypot(*gap) < 1.5:
            player.send(k="move", f=1.0, t=float(np.clip(left / 0.2, -1, 1)))
        player.play()
        discs = discs_at(places(game)[:1, :2], places(game)[:1, 2], *robot_discs(game))[0]
        nearest = min(nearest, float(np.hypot(*(discs[:, :2] - places(game)[1, :2]).T).min()))
    least = robot_discs(game)[1] + spec.agent_radius_m
    assert nearest < least + 0.05, "they never met"
    # a robot that drives itself may come nearer by what it moves in a step
    assert nearest > least - (1e-3 if app == "rearrange" else 0.1)
    game.close()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert recording.episode.info["spec"]["solid_agents"]
    assert verify(recording).difference is None
    assert [finding for finding in validate_recording(recording) if finding.check == "penetration"] == []


def places(game: LiveGame) -> np.ndarray:
    """Robot and person, ``(x, z, heading)`` [2, 3]."""
    if not game.columns:
        return game.session.episode.starts
    poses = [game.columns[f"agent_{k}.base_pose"][-1].astype(np.float64) for k in range(2)]
    return np.array([[pose[0], pose[2], heading_from_quat(pose[3:])] for pose in poses])


def robot_discs(game: LiveGame) -> tuple[tuple[float, ...], float]:
    """Offsets and radius of the robot's discs."""
    base = game.session.episode.bases[0]
    return base.disc_offsets_m, base.disc_radius_m


@pytest.mark.slow
def test_a_game_goes_on_from_its_unfinished_log(tmp_path: Path):
    player = Player(table(tmp_path).begin(GameOrder(index=0, name="000000")))
    player.send(k="move", f=1.0, t=0.2)
    player.play(35)
    player.send(k="pick", o=0, lead=True)
    player.play(20)
    player.game.session.abort()  # as a process that is killed
    again = table(tmp_path).begin(GameOrder(index=0, name="000000"))
    assert len(again.session.recorder) == 55
    np.testing.assert_array_equal(again.columns["object_pose"], player.game.columns["object_pose"])
    other = Player(again)
    other.seq = player.seq
    assert other.busy, "the walk to the object goes on"
    other.until_free()
    assert again.columns["agent_1.grasp_body"][-1] >= 0
    again.close()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert verify(recording).difference is None
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.slow
def test_players_walk_as_a_motion_file_says(tmp_path: Path):
    file = tmp_path / "walk.npz"
    save_motion(walk(), file)
    player = Player(table(tmp_path, motion=str(file)).begin(GameOrder(index=0, name="000000")))
    player.send(k="move", f=1.0, t=0.1)
    player.play(20)
    player.game.close()
    file.unlink()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert "+motion:" in recording.agents[player.number].model
    assert verify(recording).difference is None


def test_clicking_on_the_floor_walks_there_and_keys_end_it(tmp_path: Path):
    player = Player(LiveGame(table(tmp_path), 0))
    player.play()
    goal = player.game.session.episode.starts[0]  # where the robot began
    player.send(k="goto", p=[float(goal[0]) + 1.0, 0.0, float(goal[1])])
    player.play(5)
    assert player.busy
    player.until_free()
    assert np.hypot(*(player.base[[0, 2]] - [goal[0] + 1.0, goal[1]])) < 0.7
    player.send(k="goto", p=[float(player.base[0]) + 2.0, 0.0, float(player.base[2])])
    player.play(2)
    player.send(k="move", f=-1.0, t=0.0)
    player.play()
    assert not player.busy


def test_reasons_are_sentences(tmp_path: Path):
    player = Player(LiveGame(table(tmp_path), 0))
    player.play()
    assert player.send(k="place", p=[0.0, 0.5, 0.0]) == "The hand holds nothing."
    player.send(k="pick", o=0)
    player.until_free()
    assert player.said == ["It is too far away to reach from here."]
    assert player.game.drivers[player.number].can_place((1.0, 1.0, 1.0)) == "The hand holds no such thing."
    assert player.send(k="goto", p=[500.0, 0.0, 500.0]) == "No path leads there."


def test_what_is_no_command_is_not_recorded(tmp_path: Path):
    player = Player(LiveGame(table(tmp_path), 0))
    player.play()
    before = len(player.game.session.recorder.inputs)
    for message in (
        {"k": "pick", "o": 7},
        {"k": "give", "a": 9},
        {"k": "hand", "side": "left", "p": [0, 0, 0], "q": [0] * 4},
    ):
        with pytest.raises(InputError):
            player.send(**message)
    assert len(player.game.session.recorder.inputs) == before
    player.play(3)


def test_a_session_that_nobody_played_leaves_no_file(tmp_path: Path):
    game = table(tmp_path).begin(GameOrder(index=0, name="000000"))
    assert game.close() is None
    assert not list(tmp_path.glob("*.mcap*"))


def test_plans_that_cannot_be_played(tmp_path: Path):
    for changes, message in (
        ({"app": "rearange"}, r"(?s)app.*H3-FILE-011"),
        ({"scenes": "nowhere"}, "(?s)nowhere.*H3-HABITAT-108"),
        ({"partner": "nobody"}, r"(?s)policy 'nobody'.*H3-POLICY-002"),
        ({"app": "social_nav", "partner": None, "seats": ("person", "person")}, "H3-TASK-053"),
    ):
        with pytest.raises(InputError, match=message):
            table(tmp_path, **changes).begin(GameOrder(index=0, name="000000"))


def test_follow_me(tmp_path: Path):
    game = table(tmp_path, app="social_nav", partner=None).begin(GameOrder(index=0, name="000000"))
    player = Player(game)
    player.send(k="move", f=1.0, t=0.1)
    player.play(60)
    before = player.base.copy()
    player.send(k="move", f=-1.0, t=0.0)
    player.play(5)
    np.testing.assert_array_equal(player.base, before)  # people do not walk backwards here
    place = game.session.episode.starts[0]
    player.send(k="goto", p=[float(place[0]), 0.0, float(place[1])])
    player.play(3)
    assert player.busy
    said = [game.app.hud(number).lines[0] for number in (player.number, -1)]
    assert [" you (" in line for line in said] == [True, False], "who watches reads of the person"
    state = game.state(player.number, 0.0, whole=True)
    assert len(state) == 16 + (12 + 2 * 20) + (12 + 28 + 84)
    game.close()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert verify(recording).difference is None
    assert recording.episode.info["policy"] == "rollout_expert"


def test_people_recorded_by_clips_walk_with_planted_feet(tmp_path: Path):
    game = LiveGame(table(tmp_path, app="social_nav", partner=None), 0)
    player = Player(game)
    sent, bases = [], []
    for forward, turn in ((1.0, 0.0), (0.5, 0.5), (0.0, 0.0), (0.0, 1.0)):
        player.send(k="move", f=forward, t=turn)
        for _ in range(12):
            player.play()
            sent.append(game.state(1, 0.0, whole=False))
            bases.append(player.base.astype(np.float64))
    tables = drawn_in(game.packer.bodies[1].gait_tables, game.packer.scene)  # type: ignore[union-attr, arg-type]
    _, places = pose_planted(tables, planted_states(tables, np.array(bases)))
    at = 16 + 12 + 2 * 20 + 12
    pelvis = np.array([np.frombuffer(data, "<f4", 3, at) for data in sent])
    expected = [pose_multiply(base, [*place, 0, 0, 0, 1])[:3] for base, place in zip(bases, places, strict=True)]
    np.testing.assert_allclose(pelvis, expected, atol=1e-5)


@pytest.mark.parametrize("name", ["learn_single_partner_0", "learn_pop_partner_0"])
def test_a_learned_person_walks_beside_a_robot_that_is_played(tmp_path: Path, name: str):
    game = table(tmp_path, seats=("robot",), partner=name).begin(GameOrder(index=0, name="000000"))
    before = game.session.play.team.actors[1].xz.copy()  # type: ignore[attr-defined]
    Player(game).play(90)
    assert np.hypot(*(game.session.play.team.actors[1].xz - before)) > 0.3  # type: ignore[attr-defined]
    game.close()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert recording.episode.info["partner"].startswith(name)
    assert recording.agents[0].action_names
    assert verify(recording).difference is None


@pytest.mark.slow
def test_steering_the_robot(tmp_path: Path):
    game = table(tmp_path, seats=("robot",), partner="object_2").begin(GameOrder(index=0, name="000000"))
    player = Player(game)
    assert player.number == 0
    player.send(k="move", f=0.5, t=0.3)
    player.play(20)
    player.send(k="move", f=0.0, t=0.0)
    with pytest.raises(InputError, match="H3-PLAY-014"):
        player.send(k="drop")
    bring(player, 0)
    assert game.session.play.team.at_goal[0], player.said  # type: ignore[attr-defined]
    game.close()
    assert verify(read_mcap(tmp_path / "000000.mcap")).difference is None


@pytest.mark.parametrize(
    "seats",
    [
        pytest.param(("person", "robot"), marks=pytest.mark.slow),
        pytest.param(("person", "person"), marks=pytest.mark.slow),
        ("person", "person", "spectator"),
    ],
)
def test_two_people_in_one_world(tmp_path: Path, seats: tuple[str, ...]):
    game = table(tmp_path, seats=seats, partner=None).begin(GameOrder(index=0, name="000000"))
    assert len(game.drivers) == 2
    first, second = (Player(game, number) for number in game.drivers)
    first.send(k="move", f=0.6, t=0.2)
    second.send(k="move", f=0.2, t=-0.4)
    first.play(30)
    starts = game.session.episode.starts[:, :2]
    for player in (first, second):
        assert np.hypot(*(player.base[[0, 2]] - starts[player.number])) > 0.1
    assert game.state(first.number, 0.0, whole=True)[8:12] != b"\xff" * 4
    assert game.state(-1, 0.0, whole=True)[8:12] == b"\xff" * 4, "a spectator has sent nothing"
    game.close()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert verify(recording).difference is None
    assert {event.user for event in recording.inputs} == set(game.drivers)


class Parade(App):
    """An app of one's own: the person has to walk ten steps."""

    task = "wander"
    rules: ClassVar[Mapping[str, Any]] = {"max_steps": 200}

    def reset(self, session: Session) -> None:
        super().reset(session)
        self.walked = 0

    def step(self, result: StepResult) -> str:
        self.walked += self.session.recorder.latest_columns()["agent_1.motion_blend"][-1] > 0
        return "paraded" if self.walked >= 10 else ""

    def hud(self, number: int) -> Hud:
        return Hud(task="Walk ten steps.", lines=(f"{self.walked} walked",))


def test_an_app_of_ones_own(tmp_path: Path):
    game = table(tmp_path, app=f"{__name__}:Parade", partner=None).begin(GameOrder(index=0, name="000000"))
    player = Player(game)
    player.send(k="move", f=1.0, t=0.0)
    player.play(50)
    assert game.ended == "paraded"
    assert game.app.hud(1).lines == ("10 walked",)
    game.close()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert recording.episode.info["ended"] == "paraded"
    assert verify(recording).difference is None


@pytest.mark.slow
def test_a_rehearsal_compiles_what_a_game_needs(tmp_path: Path):
    for changes in ({}, {"app": "social_nav", "partner": None}, {"seats": ("robot",), "partner": "both"}):
        rehearse(table(tmp_path, **changes))
    assert not list(tmp_path.iterdir()), "nothing is recorded"
    compiled = compiled_count()
    player = Player(LiveGame(table(tmp_path), 0))
    player.send(k="move", f=0.5, t=0.1)
    player.play(10)
    player.send(
        k="goto",
        p=[float(x) for x in (*player.game.session.episode.starts[0, :1], 0, player.game.session.episode.starts[0, 1])],
    )
    player.play(30)
    assert compiled_count() == compiled
