"""Robots by path: a recording is drawn and simulated only with the files that it was made with."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from h3data.bodies import robot_digest
from h3data.errors import FormatError, InputError
from h3data.recording import Recording, read_mcap, write_mcap
from h3data.replay import Replay
from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.tasks.resume import resume, verify
from tests.bodies.robots.cart_robot import CART_SETTINGS, write_cart
from tests.simulated import simulate_social_nav, social_nav_episode

MESH = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n"
LINK = """<link name="flag"><visual><geometry><mesh filename="flag.obj"/></geometry></visual></link>
<joint name="flag" type="fixed"><parent link="base"/><child link="flag"/></joint></robot>"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Recording]:
    """A robot's URDF and 15 steps with it."""
    urdf = write_cart(tmp_path_factory.mktemp("made") / "cart", CART_SETTINGS)
    urdf.write_text(urdf.read_text().replace("</robot>", LINK))
    (urdf.parent / "flag.obj").write_text(MESH)
    episode = social_nav_episode(build_home(HomeSpec(seed=0)), spec=SocialNavSpec(max_steps=15), robot=str(urdf))
    return urdf, simulate_social_nav(episode)


@pytest.fixture
def cart(made: tuple[Path, Recording], tmp_path: Path) -> tuple[Path, Recording]:
    """A copy of the robot that a test may change, and the recording as if it had been made with the copy."""
    urdf, recording = made
    shutil.copytree(urdf.parent, tmp_path / "cart")
    return tmp_path / "cart" / "cart.urdf", _with_robot(recording, tmp_path / "cart" / "cart.urdf")


def _with_robot(recording: Recording, urdf: Path) -> Recording:
    (digest,) = recording.episode.info["robots_sha256"].values()
    agents = (replace(recording.agents[0], model=f"robot/{urdf}"), *recording.agents[1:])
    return replace(_with_digests(recording, {str(urdf): digest}), agents=agents)


def _with_digests(recording: Recording, digests: object) -> Recording:
    info = {**recording.episode.info, "robots_sha256": digests}
    return replace(recording, episode=replace(recording.episode, info=info))


def test_the_recording_holds_the_digest(made: tuple[Path, Recording]) -> None:
    urdf, recording = made
    assert recording.episode.info["robots_sha256"] == {str(urdf): robot_digest(urdf)}
    assert len(robot_digest(urdf)) == 64


def test_built_in_robots_have_no_digest() -> None:
    episode = social_nav_episode(build_home(HomeSpec(seed=0)), spec=SocialNavSpec(max_steps=2))
    assert "robots_sha256" not in simulate_social_nav(episode).episode.info
    assert robot_digest("quad_arm") == ""


@pytest.mark.parametrize("name", ["cart.urdf", "robot.toml", "flag.obj"])
def test_a_changed_file_is_refused(cart: tuple[Path, Recording], name: str) -> None:
    urdf, recording = cart
    Replay(recording)
    before, file = robot_digest(urdf), urdf.parent / name
    file.write_text(file.read_text() + "\n")
    expected = f"has changed since it was recorded: expected SHA-256 {before}, got {robot_digest(urdf)}"
    for use in (Replay, verify, lambda r: resume(r, 5)):
        with pytest.raises(InputError, match=f"(?s){expected}.*H3-BODY-107"):
            use(recording)


def test_a_lost_mesh_is_refused_and_not_drawn_as_a_box(cart: tuple[Path, Recording]) -> None:
    urdf, recording = cart
    (urdf.parent / "flag.obj").unlink()
    with pytest.raises(InputError, match="H3-BODY-107"):
        Replay(recording)


def test_a_lost_robot_is_named_with_its_digest(cart: tuple[Path, Recording]) -> None:
    urdf, recording = cart
    digest = robot_digest(urdf)
    shutil.rmtree(urdf.parent)
    for use in (Replay, verify):
        with pytest.raises(InputError) as fault:
            use(recording)
        assert all(part in str(fault.value) for part in ("'robot'", str(urdf), digest, "put its folder back"))


def test_a_moved_recording_is_read_while_its_robot_is_there(cart: tuple[Path, Recording], tmp_path: Path) -> None:
    write_mcap(cart[1], tmp_path / "a.mcap")
    (tmp_path / "elsewhere").mkdir()
    moved = read_mcap(shutil.move(tmp_path / "a.mcap", tmp_path / "elsewhere" / "b.mcap"))
    assert len(Replay(moved)) == len(cart[1])
    assert verify(moved).equal


def test_an_older_recording_without_digest_is_read(cart: tuple[Path, Recording]) -> None:
    urdf, recording = cart
    info = {key: value for key, value in recording.episode.info.items() if key != "robots_sha256"}
    (urdf.parent / "flag.obj").write_text(MESH + "\n")
    old = replace(recording, episode=replace(recording.episode, info=info))
    assert len(Replay(old)) == len(recording)
    assert verify(old).equal


@pytest.mark.parametrize("digests", [["a"], {"a": 1}, "a"])
def test_malformed_digests_are_refused(cart: tuple[Path, Recording], digests: object) -> None:
    with pytest.raises(FormatError, match="H3-REPLAY-028"):
        Replay(_with_digests(cart[1], digests))
