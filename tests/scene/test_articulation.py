"""Things that open: their records, files and poses."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.errors import FormatError, InputError, SceneError
from h3data.geometry import pose_to_matrix, quat_from_axis_angle, transform_points
from h3data.mesh.glb import unpack_glb
from h3data.scene import Articulation, Asset, Instance, Joint, Mesh, Part, Scene, load_scene, save_scene, scene_digest
from h3data.scene.articulation import handle_points, joints_of, opened, posed
from h3data.scene.scene_file import scene_bytes
from tests.habitat.scenes.dataset_folder import CHEST, Dataset

CUBE = Mesh(
    vertices=np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32) / 2,
    faces=np.array([[0, 1, 2], [3, 1, 2]], np.int32),
    colors=np.full((8, 3), 128, np.uint8),
)


def pose(x: float, y: float, z: float, *, turn: float = 0.0) -> np.ndarray:
    return np.concatenate([[x, y, z], quat_from_axis_angle(np.array([1.0, 2.0, 3.0]), turn)])


def chain(*, rest: float = 0.0) -> Scene:
    """A cabinet that leans, with a door, and on the door a box that slides out of it; a cup lies in the box."""
    things = ("body", "door", "box", "cup")
    instances = tuple(
        Instance(
            name=name, asset="cube", pose=pose(k, 0.5 * k, 1, turn=0.3 * k), motion="kinematic" if k == 3 else "static"
        )
        for k, name in enumerate(things)
    )
    door = Joint(
        kind="revolute", axis=np.array([0, 2, 1]), origin=np.array([0.5, 0, 0.5]), lower=-0.2, upper=2.0, rest=rest
    )
    box = Joint(kind="prismatic", axis=np.array([1.0, 0, 0]), lower=-0.4, upper=0.0)
    parts = (
        Part(name="door", joint=door, instances=("door",)),
        Part(name="box", joint=box, instances=("box", "cup"), parent="door", handle=np.array([1.0, 0, 0])),
    )
    thing = Articulation(name="cabinet", base="body", pose=pose(3, 0, 1, turn=0.8), parts=parts)
    return Scene(name="s", assets={"cube": Asset(name="cube", mesh=CUBE)}, instances=instances, articulations=(thing,))


def matrices(scene: Scene) -> np.ndarray:
    return np.array([pose_to_matrix(i.pose) for i in scene.instances])


# --- poses ------------------------------------------------------------------------------------------------------------
def test_positions_compose_and_rest_moves_nothing() -> None:
    scene = chain()
    assert posed(scene, [0.0, 0.0]) is scene
    for a, b in (([1.2, -0.3], [0.4, -0.1]), ([-0.1, 0.0], [2.0, -0.4])):
        there = posed(posed(scene, a), b)
        np.testing.assert_allclose(matrices(there), matrices(posed(scene, b)), atol=1e-12)
        np.testing.assert_allclose(handle_points(there), handle_points(posed(scene, b)), atol=1e-12)
        np.testing.assert_array_equal(joints_of(there).rest, b)
    with pytest.raises(InputError, match=r"(?s)'cabinet/lid'.*cabinet/door.*H3-SCENE-002"):
        posed(scene, {"cabinet/lid": 1.0})
    with pytest.raises(InputError, match="H3-SCENE-001"):
        posed(scene, {"cabinet/door": np.nan})
    with pytest.raises(InputError, match=r"(?s)2.*H3-SCENE-003"):
        posed(scene, [0.1])


def test_points_on_the_axis_stay_and_what_hangs_on_a_door_goes_with_it() -> None:
    scene = chain()
    joints = joints_of(scene)
    motions = joints.motions(np.array([[0.7, 0.0], [0.7, -0.4]]))
    frame = pose_to_matrix(scene.articulations[0].pose)
    joint = scene.articulations[0].parts[0].joint
    axis = transform_points(frame, joint.origin + np.array([[0.0], [1.0]]) * joint.axis)
    np.testing.assert_allclose(transform_points(motions[0, 0], axis), axis, atol=1e-12)
    np.testing.assert_allclose(motions[0, 1], motions[0, 0], atol=1e-12)  # the box is shut: it moves as the door does
    # along the box's own axis, as the door has turned it
    slide = motions[1, 0, :3, :3] @ frame[:3, 0] * -0.4
    np.testing.assert_allclose(motions[1, 1, :3, 3] - motions[0, 1, :3, 3], slide, atol=1e-12)
    assert [i.name for i, j in zip(scene.instances, opened(scene).instances, strict=True) if i is j] == ["body"]


def test_closed_is_zero_and_open_is_the_far_limit() -> None:
    joints = joints_of(chain())
    np.testing.assert_array_equal(joints.closed, [0, 0])
    np.testing.assert_array_equal(joints.opened, [2.0, -0.4])
    np.testing.assert_allclose(joints.shares([1.0, -0.4]), [0.5, 1.0])
    assert joints.is_open([[1.0, -0.4], [1.5, 0.0]]).tolist() == [[False, True], [True, False]]


def test_habitats_joint_positions_are_those_of_the_scene(tmp_path: Path) -> None:
    """Read with joints at some positions, or read closed and then posed: the same."""
    entry = {"translation": [3, 1, -2], "rotation": [0.8, 0.0, 0.6, 0.0], "uniform_scale": 2}
    dataset = Dataset(tmp_path)
    closed = dataset.chest(**entry)
    assert joints_of(closed).names == ("chest_:0000/b_drawer", "chest_:0000/a_lid")
    for slide, hinge in ((0.3, 0.7), (0.5, -1.0)):
        read = dataset.chest(**entry, initial_joint_pose={"hinge": hinge, "slide": slide})
        np.testing.assert_allclose(matrices(posed(closed, [slide, hinge])), matrices(read), atol=1e-6)
        np.testing.assert_allclose(matrices(posed(read, [0, 0])), matrices(closed), atol=1e-6)


def test_what_lies_behind_a_closed_door_of_habitat_is_enclosed(tmp_path: Path) -> None:
    dataset = Dataset(tmp_path)
    inside = {"position": [0, 0.3, 0], "scale": [0.2, 0.1, 0.2], "rotation": [1, 0, 0, 0], "parent_link": "base"}
    above = {**inside, "position": [0, 1.3, 0]}
    drawer = {**inside, "parent_link": "b_drawer"}
    dataset.json(
        "urdf/chest/chest.ao_config.json",
        {
            "urdf_filepath": "chest.urdf",
            "user_defined": {
                "receptacle_aabb_in": inside,
                "receptacle_aabb_top": above,
                "receptacle_aabb_drawer": drawer,
            },
        },
    )
    scene = dataset.chest(translation=[1, 2, 3])
    assert joints_of(scene).enclosing == {
        "chest_:0000/base|receptacle_aabb_in": (1,),
        "chest_:0000/b_drawer|receptacle_aabb_drawer": (0, 1),
    }


# --- files ------------------------------------------------------------------------------------------------------------
def test_files_hold_them_exactly_and_scenes_without_are_as_before() -> None:
    scene = chain()
    again = load_scene(scene_bytes(scene))
    assert scene_digest(again) == scene_digest(scene)
    assert scene_bytes(again) == scene_bytes(scene)
    np.testing.assert_array_equal(matrices(opened(again)), matrices(opened(scene)))
    plain = replace(scene, articulations=())
    assert scene_digest(plain) != scene_digest(scene)
    assert [_record(s)["version"] for s in (scene, plain)] == [[1, 2], [1, 1]]
    assert "articulations" not in _record(plain)


def _record(scene: Scene) -> dict[str, Any]:
    buffer = io.BytesIO()
    save_scene(scene, buffer)
    return unpack_glb(buffer.getvalue(), "here")[0]["extras"]["h3data"]


def _changed(change: dict[str, Any], *, part: bool = False) -> bytes:
    """The file of `chain` with fields of the first joint, or of the first part, replaced; None removes a field."""
    document, binary = unpack_glb(scene_bytes(chain()), "here")
    record = document["extras"]["h3data"]["articulations"][0]["parts"][0]
    record = record if part else record["joint"]
    for name, value in change.items():
        record.pop(name) if value is None else record.update({name: value})
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = (0x46546C67).to_bytes(4, "little") + (2).to_bytes(4, "little")
    chunks = (
        len(text).to_bytes(4, "little") + b"JSON" + text + len(binary).to_bytes(4, "little") + b"BIN\0" + bytes(binary)
    )
    return head + (12 + len(chunks)).to_bytes(4, "little") + chunks


@pytest.mark.parametrize(
    ("change", "part", "told"),
    [
        ({"lower": 2.0}, False, r"(?s)equal limits.*H3-SCENE-053"),
        ({"lower": 3.0}, False, r"(?s)reversed.*H3-SCENE-053"),
        ({"axis": [0, float("nan"), 0]}, False, "(?s)axis.*H3-SCENE-053"),
        ({"axis": [0, 0, 0]}, False, "(?s)axis.*H3-SCENE-053"),
        ({"rest": 9.0}, False, r"(?s)outside its limits.*H3-SCENE-053"),
        ({"kind": "ball"}, False, r"(?s)Unknown kind of joint 'ball'.*H3-SCENE-053"),
        ({"joint": None}, True, r"(?s)'door' has no joint.*H3-SCENE-053"),
        ({"instances": ["nobody"]}, True, r"(?s)do not exist.*nobody.*H3-SCENE-053"),
        ({"instances": ["body"]}, True, r"(?s)stands still.*H3-SCENE-053"),
        ({"instances": ["cup"]}, True, r"(?s)another part moves.*H3-SCENE-053"),
        ({"parent": "box"}, True, r"(?s)hangs on 'box'.*H3-SCENE-053"),
        ({"handle": [0, 0, float("inf")]}, True, "(?s)handle.*H3-SCENE-053"),
    ],
)
def test_damaged_files_say_what_is_wrong(change: dict[str, Any], part: bool, told: str) -> None:
    with pytest.raises(FormatError, match=told):
        load_scene(_changed(change, part=part))


def test_habitats_joints_that_cannot_move_are_told_and_shown(tmp_path: Path) -> None:
    dataset = Dataset(tmp_path)
    dataset.write("urdf/chest/chest.urdf", CHEST.replace('lower="0" upper="0.5"', 'lower="0.2" upper="0.2"'))
    scene = dataset.chest()
    assert joints_of(scene).names == ("chest_:0000/a_lid",)
    assert any("limits of its joint are 0.2 and 0.2" in warning for warning in scene.source["warnings"])
    assert "chest_:0000/b_drawer" in [i.name for i in scene.instances]
    with pytest.raises(SceneError, match="H3-HABITAT-120"):
        dataset.chest(options={"strict": True})
