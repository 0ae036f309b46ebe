"""Input in recordings of live play: its columns and lanes, through files, conversion, verification and viewers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from h3data.recording import Dataset, DatasetWriter, InputEvent, Recording, read_mcap, recordings_equal, state_hash
from h3data.recording.live_input import AWAY, NOTHING, STEERS, live_inputs
from h3data_pipelines.cli import main
from h3data_pipelines.commands.informing import slipped_steps
from h3data_pipelines.validation.recordings import validate_recording
from h3data_play.messages import decode
from h3data_play.plan import GameOrder
from h3data_viewers.rerun.rrd_file import write_rrd
from sim_kinematic.tasks.resume import resume, verify
from tests.play.test_live import Player, table
from tests.viewers.rerun_file import File

FIRST = GameOrder(index=0, name="000000")


def send(player: Player, rtt: float, **message: Any) -> None:
    """A message with a measured round trip."""
    text = msgspec.json.encode({**message, "seq": player.seq, "rtt": rtt}).decode()
    player.game.take(player.number, decode(text), text, 5.0)  # type: ignore[arg-type]
    player.seq += 1


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Recording]:
    """Ten steps without input, ten walking, ten away, a pick."""
    folder = tmp_path_factory.mktemp("live")
    player = Player(table(folder).begin(FIRST))
    player.play(10)
    send(player, 12.5, k="move", f=0.5, t=0.0)
    player.play(10)
    player.game.connected(player.number, False)
    player.game.slip(4)
    player.play(10)
    player.game.connected(player.number, True)
    send(player, 1e300, k="pick", o=0, lead=True)
    player.play(5)
    player.game.close()
    return folder / "000000.mcap", read_mcap(folder / "000000.mcap")


def test_each_row_says_which_message_had_acted_and_the_round_trip(played: tuple[Path, Recording]):
    columns = played[1].columns
    assert columns["input.user_1.seq"].tolist() == [-1] * 10 + [0] * 20 + [1] * 5
    assert columns["input.user_1.seq"].dtype == np.int32
    expected = np.array([np.nan] * 10 + [12.5] * 20 + [1e6] * 5, np.float32)
    np.testing.assert_array_equal(columns["input.user_1.rtt_ms"], expected)


def test_they_are_no_state(played: tuple[Path, Recording]):
    recording = played[1]
    without = {name: array for name, array in recording.columns.items() if not name.startswith("input.")}
    np.testing.assert_array_equal(state_hash(without), recording.columns["state_hash"])
    assert verify(recording).difference is None
    assert validate_recording(recording) == []
    assert validate_recording(replace(recording, columns=without)) == [], "as recordings of before"
    rules = {**recording.episode.info["spec"], "max_steps": 60}
    short = replace(recording, episode=replace(recording.episode, info={**recording.episode.info, "spec": rules}))
    assert len(resume(short, 20, partner="both")) == 60


def test_they_survive_files_and_conversion(played: tuple[Path, Recording], tmp_path: Path):
    path, recording = played
    with DatasetWriter(tmp_path / "ds", like=[recording]) as out:
        out.add(recording)
    assert recordings_equal(Dataset(tmp_path / "ds").recording(0), recording) == []
    assert main(["convert", str(path), str(tmp_path / "other"), "--to", "dataset"]) == 0
    assert recordings_equal(Dataset(tmp_path / "other").recording(0), recording) == []


def test_what_a_player_asked_for(played: tuple[Path, Recording]):
    recording = played[1]
    (player,) = live_inputs(recording)
    assert player.asked == (NOTHING,) * 10 + (STEERS,) * 10 + (AWAY,) * 10 + ("pick",) * 5
    assert player.messages == 2
    assert player.rtt_shares_ms == (12.5, pytest.approx(1e6))
    assert slipped_steps(recording) == 4
    strange = InputEvent(time_ns=0, kind="client", user=1, payload="[1]")
    assert live_inputs(replace(recording, inputs=(strange,)))[0].asked == (NOTHING,) * 35
    assert live_inputs(replace(recording, inputs=())) == []


def test_info_sums_them_up(played: tuple[Path, Recording], capsys: pytest.CaptureFixture[str]):
    assert main(["info", str(played[0])]) == 0
    said = capsys.readouterr().out
    assert "played   human: 2 messages, round trip 12 ms" in said
    assert "4 steps slipped" in said


def test_rerun_shows_lanes_of_input_and_of_latency(played: tuple[Path, Recording], tmp_path: Path):
    file = File(write_rrd(played[1], tmp_path / "e.rrd"))
    steps, states = file.column("/actions/human_input", "StateChange:state")
    assert list(zip(steps.tolist(), [s[0] for s in states], strict=True)) == [
        (0, NOTHING),
        (10, STEERS),
        (20, AWAY),
        (30, "pick"),
    ]
    _, curve = file.column("/latency/human", "Scalars:scalars")
    curve = np.array(curve)[:, 0]
    assert np.isnan(curve[:10]).all(), "not measured yet: a gap"
    assert (curve[10:30] == 12.5).all()


def test_a_killed_session_goes_on_with_them(tmp_path: Path):
    player = Player(table(tmp_path).begin(FIRST))
    send(player, 3.0, k="move", f=1.0, t=0.2)
    player.play(35)
    player.game.session.abort()
    again = Player(table(tmp_path).begin(FIRST))
    again.seq = player.seq
    send(again, 4.0, k="move", f=0.0, t=0.0)
    again.play(5)
    again.game.close()
    columns = read_mcap(tmp_path / "000000.mcap").columns
    assert columns["input.user_1.seq"].tolist() == [0] * 35 + [1] * 5
    assert columns["input.user_1.rtt_ms"].tolist() == [3.0] * 35 + [4.0] * 5
