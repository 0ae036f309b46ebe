"""People shown as skin, as collision capsules or as bones: the same posture in pictures, Rerun and exported files."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

import h3data
from h3data.bodies import load_humanoid
from h3data.bodies.people.rigid_parts import PeopleStyle, rigid_parts
from h3data.errors import InputError
from h3data.recording import Recording, write_mcap
from h3data.replay import Replay
from h3data_pipelines.cli import main

PERSON = 1


@pytest.fixture(scope="module")
def recording() -> Recording:
    return h3data.simulate("social_nav", "small:0", max_steps=90)


@pytest.fixture(scope="module")
def log(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(recording, tmp_path_factory.mktemp("people") / "episode.mcap")


@pytest.mark.parametrize("style", ["capsules", "bones"])
def test_parts_move_with_their_joints(recording: Recording, style: PeopleStyle) -> None:
    replay, steps = Replay(recording, people=style), np.array([0, 40, 89])
    parts = rigid_parts(load_humanoid("female_0"), style)
    joints = replay.joint_matrices(PERSON, steps)
    found = replay.link_matrices(PERSON, steps)
    np.testing.assert_allclose(found, joints[:, [part.joint for part in parts]], atol=1e-6)
    mine = [d for d in replay.drawables if d.agent == PERSON]
    assert [d.name for d in mine] == [f"human/{part.name}" for part in parts]
    assert not any(d.deformable for d in mine)


def test_capsules_cover_the_skin_and_bones_lie_inside_the_capsules(recording: Recording) -> None:
    def pixels(style: PeopleStyle) -> np.ndarray:
        replay = Replay(recording, people=style)
        image = h3data.render_frame(replay, camera="third_person", step=60, outputs=("instance",))["instance"]
        return np.isin(image, [k for k, d in enumerate(replay.drawables) if d.agent == PERSON])

    skin, capsules, bones = pixels("skin"), pixels("capsules"), pixels("bones")
    assert (skin & capsules).sum() > 0.75 * (skin | capsules).sum()
    assert 0 < bones.sum() < 0.6 * capsules.sum()
    assert (bones & ~capsules).sum() < 0.15 * bones.sum()


@pytest.mark.slow
def test_commands_show_people_as_asked(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def render(style: str) -> str:
        command = ["rerender", str(log), "--camera", "third_person", "--steps", "60:61", "--format", "png"]
        assert main([*command, "--people", style, "-o", str(tmp_path / style)]) == 0
        (picture,) = (tmp_path / style).rglob("*.png")
        return picture.read_bytes().hex()

    assert len({render("skin"), render("capsules"), render("bones")}) == 3
    assert main(["view", str(log), "--people", "bones", "-o", str(tmp_path / "bones.rrd")]) == 0
    assert main(["export", str(log), "--to", "gltf", "--people", "capsules", "-o", str(tmp_path / "e.glb")]) == 0
    content = (tmp_path / "e.glb").read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    assert "skins" not in json.loads(content[20 : 20 + length])
    capsys.readouterr()
    assert main(["export", str(log), "--to", "csv", "--people", "bones", "-o", str(tmp_path / "csv")]) == 2
    assert "--people is not for csv" in capsys.readouterr().err


@pytest.mark.slow
def test_videos_of_another_style_are_not_taken_for_complete(log: Path, tmp_path: Path) -> None:
    command = [
        "rerender",
        str(log),
        "--camera",
        "top_down",
        "--steps",
        "0:2",
        "--format",
        "png",
        "-o",
        str(tmp_path / "v"),
    ]
    assert main(command) == 0
    assert main(command) == 0  # complete
    assert main([*command, "--people", "bones"]) == 2  # other pictures would replace them
    assert main([*command, "--people", "bones", "--force"]) == 0


def test_an_unknown_style_is_refused(recording: Recording) -> None:
    with pytest.raises(InputError, match=r"(?s)skin, capsules, bones.*H3-REPLAY-022"):
        Replay(recording, people="ghosts")  # type: ignore[arg-type]
