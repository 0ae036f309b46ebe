"""Players who play captured motions of their body: the page shows what the recording holds, and a key ends them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.dance import write_bvh
from h3data.bodies import JOINT_INDEX
from h3data.errors import InputError
from h3data_play.assets import manifest
from h3data_play.drivers import SETTLE_STEPS
from h3data_play.plan import GameOrder
from h3data_play.wire import BUSY
from sim_kinematic.agents.skills import sentence
from sim_kinematic.tasks import resume
from tests.play.test_live import Player, table
from tests.play.test_sitting import finished, posed, watched

Played = resume.Played


@pytest.fixture(scope="module")
def dance(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("acts") / "dance.bvh"
    write_bvh(path)
    return path


def begun(out: Path, dance: Path, **changes: Any) -> Player:
    plan = {"app": "social_nav", "scenes": "small:1", "human": f"female_1+dance={dance}", **changes}
    return Player(table(out, **plan).begin(GameOrder(index=0, name="000000")))


def place_with_room(player: Player) -> np.ndarray:
    """Middle (x, z) of the largest free floor of the home."""
    free = player.game.session.episode.free
    places = free.sample(np.random.default_rng(3), 400)
    reached = places[np.isfinite([free.geodesic(player.base[[0, 2]], xz) for xz in places])]
    return reached[int(np.argmax(free.signed_distance(reached)))]


def walked_to_room(player: Player) -> None:
    """Walk there."""
    x, z = place_with_room(player).tolist()
    player.send(k="goto", p=[x, 0.0, z])
    player.until_free()
    player.play(20)


@pytest.mark.parametrize("app", ["social_nav", "rearrange"])
def test_a_motion_is_shown_as_it_is_recorded(
    tmp_path: Path, dance: Path, app: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    player = begun(tmp_path, dance, app=app)
    shown = watched(player)
    agents = manifest(player.game.session, player.game.app, {})["agents"]
    assert agents[player.number]["acts"] == ["dance"]
    player.play()
    walked_to_room(player)
    start = len(shown)
    assert player.send(k="perform", name="dance") == ""
    player.play(60)
    assert player.busy
    player.play(75)
    assert not player.busy
    # the same key ends a motion before its end, in half a second
    player.send(k="perform", name="dance")
    player.play(60)
    player.send(k="perform", name="dance")
    player.play(8)
    assert player.busy
    player.play(25)
    assert not player.busy
    player.send(k="move", f=0.6, t=0.3)
    player.play(30)
    again = list[resume.Played]()

    def played(*args: Any, **options: Any) -> resume.Played:
        again.append(Played(*args, **options))
        return again[-1]

    monkeypatch.setattr(resume, "Played", played)
    recording = finished(player, tmp_path)
    assert again[0].events == recording.events
    frames = posed(recording, player.number)
    assert np.abs(np.stack(shown) - frames)[:, :, :3, 3].max() < 0.002
    hands = frames[:, [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]], 1, 3]
    moved = np.ptp(hands, axis=0)
    assert moved.min() > 0.3
    assert np.abs(hands[start - 1] - hands[start + 135]).max() < 0.06, "they stand again"
    turned = np.linalg.inv(frames[:-1, :, :3, :3]) @ frames[1:, :, :3, :3]
    angles = np.degrees(np.arccos(np.clip((np.trace(turned, axis1=2, axis2=3) - 1) / 2, -1, 1)))
    assert angles[start - 2 : start + 225, :22].max() < 25, "no joint pops"


def test_who_walks_stands_before_a_motion_and_a_walking_key_ends_it(tmp_path: Path, dance: Path) -> None:
    player = begun(tmp_path, dance)
    player.play()
    walked_to_room(player)
    player.send(k="move", f=0.3, t=0.0)
    player.play(10)
    begins = len(player.game.session.recorder)
    player.send(k="perform", name="dance")
    player.send(k="move", f=0.0, t=0.0)
    player.play(70)
    place = player.base.copy()
    player.send(k="move", f=0.7, t=0.0)
    player.play(10)
    np.testing.assert_array_equal(player.base, place)
    player.play(40)
    assert np.abs(player.base - place).max() > 0.2
    recording = finished(player, tmp_path)
    told = [(event.target, event.step) for event in recording.events if event.kind == "activity"]
    assert [target for target, _ in told] == ["dance", "stand"]
    assert told[0][1] == begins + SETTLE_STEPS
    assert told[1][1] <= begins + 70 + 16


def test_what_cannot_be_performed_is_refused(tmp_path: Path, dance: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    player = begun(tmp_path, dance)
    player.play()
    with pytest.raises(InputError, match="H3-PLAY-030"):
        player.send(k="perform", name="juggle")
    act = player.game.drivers[player.number].acts["dance"]
    monkeypatch.setattr(type(act), "fits", lambda *_: False)
    assert player.send(k="perform", name="dance") == sentence("no_room")
    player.play(2)
    assert not player.game.state(player.number, 0.0, whole=False)[1] & BUSY
    assert not [event for event in finished(player, tmp_path).events if event.kind == "activity"]


def test_the_floor_below_a_motion_is_free(dance: Path) -> None:
    from h3data.bodies import load_humanoid
    from tests.crowds.test_routines import FREE

    act = load_humanoid(f"female_1+dance={dance}").acts["dance"]
    nobody, places = np.zeros((0, 3)), FREE.sample(np.random.default_rng(2), 40)
    fits = [act.fits(FREE, xz, 0.7, nobody) for xz in places]
    assert 0 < sum(fits) < len(fits)
    inside = places[int(np.argmax(fits))]
    assert not act.fits(FREE, inside, 0.7, np.array([[*inside, 0.2]]))
