"""Motion of other programs: what comes in is what was there (AMASS, Habitat, BVH), and bad files are refused in words."""

from __future__ import annotations

import os
import pickle
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.bodies import JOINT_INDEX, load_humanoid
from h3data.errors import FormatError, H3DataError, InputError
from h3data_habitat.motion.habitat_motion import read_habitat_motion
from h3data_motion import files as motion_files
from h3data_motion.amass import read_amass
from h3data_motion.bvh import BvhWarning, parse_bvh
from h3data_motion.bvh_motion import load_name_table, read_bvh
from h3data_motion.clip import Motion, in_start_frame, same_motion
from h3data_motion.files import ReadOptions, load_motion, motion_kind, read_motion, save_motion
from h3data_pipelines.cli import main
from tests.motion.motion_writers import (
    CONVENTIONS,
    SCHEMES,
    amass_arrays,
    bvh_text,
    placed,
    split_layout,
    turned,
    walked,
    write_habitat_sequence,
)

BODY = 22


@pytest.fixture(scope="module")
def walk() -> Motion:
    return walked(load_humanoid("male_1"), seconds=1.0, fps=30)


READS_WALKS = """
from h3data_motion.files import MotionReader, load_motion

READER = MotionReader(fits=lambda start, names: start.startswith(b"WALK "), suffixes=(".walk",),
                      read=lambda path, options: load_motion(path.read_text().split()[1]))
"""


def test_a_plug_in_reads_its_motion_files(
    walk: Motion, tmp_path: Path, install_package: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    save_motion(walk, tmp_path / "a.npz")
    file = tmp_path / "in" / "a.walk"
    file.write_text(f"WALK {tmp_path / 'a.npz'}")
    with pytest.raises(FormatError, match="H3-BODY-047"):
        motion_kind(file)
    install_package("acme", "h3data.motions", {"acme_walk": "acme:READER"}, READS_WALKS)
    motion_files._readers.cache_clear()  # as in the next process: pip has changed a folder that was already on sys.path
    assert motion_kind(file) == "acme_walk"
    assert main(["motion", "import", str(tmp_path / "in"), "-o", str(tmp_path / "out")]) == 0
    assert np.array_equal(load_motion(tmp_path / "out" / "a.npz").quats, walk.quats)


# --- the record -----------------------------------------------------------------------------------------------------------
def test_saved_motion_comes_back_bit_by_bit(walk: Motion, tmp_path: Path) -> None:
    for motion in (walk, replace(walk, leg_m=None, body="male_1", source="CC0, ünïcode")):
        save_motion(motion, tmp_path / "a.npz")
        save_motion(motion, tmp_path / "b.npz")
        found = load_motion(tmp_path / "a.npz")
        assert np.array_equal(found.quats, motion.quats)
        assert np.array_equal(found.pelvis, motion.pelvis)
        fields = [(m.name, m.fps, m.leg_m, m.body, m.source) for m in (motion, found)]
        assert fields[0] == fields[1]
        assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert motion_kind(tmp_path / "a.npz") == "motion"
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:  # no pickle in it
        assert set(file.files) >= {"quats", "pelvis", "fps"}


def test_poses_at_frames_are_the_frames_and_ends_hold(walk: Motion) -> None:
    quats, pelvis = walk.pose(np.arange(len(walk)) / walk.fps)
    np.testing.assert_allclose(quats, walk.quats, atol=1e-12)
    np.testing.assert_allclose(pelvis, walk.pelvis, atol=1e-12)
    quats, pelvis = walk.pose([-1.0, 99.0])
    np.testing.assert_allclose(pelvis, walk.pelvis[[0, -1]])
    single = replace(walk, quats=walk.quats[:1], pelvis=walk.pelvis[:1])
    np.testing.assert_allclose(single.pose([0.0, 3.0])[0], np.repeat(walk.quats[:1], 2, axis=0), atol=1e-12)
    half = walk.resampled(15)
    np.testing.assert_allclose(half.quats, walk.quats[::2], atol=1e-12)
    assert same_motion(half.resampled(30).resampled(15), half)[1] < 1e-12
    part = walk.part(0.2, 0.5)
    assert part.duration_s == pytest.approx(0.3)
    assert part.pelvis[0, 0] == part.pelvis[0, 2] == 0
    with pytest.raises(InputError, match="H3-BODY-040"):
        walk.pose([np.nan])


@given(heading=st.floats(-180, 180), x=st.floats(-50, 50), z=st.floats(-50, 50))
def test_the_start_frame_forgets_where_it_was(heading: float, x: float, z: float) -> None:
    motion = walked(load_humanoid("neutral_0"), seconds=0.2, fps=30)
    angle, way = same_motion(in_start_frame(placed(motion, heading, (x, 0, z))), motion)
    assert angle < 1e-7
    assert way < 1e-12 * (100 + abs(x) + abs(z))


def test_records_are_checked(walk: Motion) -> None:
    broken = walk.quats.copy()
    broken[3, 5] *= 1.1
    nan = walk.pelvis.copy()
    nan[2, 1] = np.nan
    for change, message in (
        ({"quats": broken}, r"(?s)unit quaternions.*H3-BODY-039"),
        ({"quats": walk.quats[:, :54]}, r"(?s)\[T, 55, 4\].*H3-BODY-039"),
        ({"quats": walk.quats[:0], "pelvis": walk.pelvis[:0]}, r"(?s)at least one frame.*H3-BODY-039"),
        ({"quats": np.where(walk.quats > 2, 0, np.nan)}, r"(?s)finite.*H3-BODY-039"),
        ({"pelvis": nan}, r"(?s)pelvis: expected finite.*H3-BODY-039"),
        ({"pelvis": walk.pelvis[1:]}, r"(?s)pelvis: expected.*H3-BODY-039"),
        ({"fps": 0.0}, "(?s)fps.*H3-BODY-039"),
        ({"leg_m": 90.0}, "(?s)leg_m.*H3-BODY-039"),
    ):
        with pytest.raises(FormatError, match=message):
            replace(walk, **change)


# --- AMASS ----------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("joints", [55, 52, 24, 22])
@pytest.mark.parametrize("up", ["z", "y"])
def test_amass_round_trip(walk: Motion, tmp_path: Path, joints: int, up: str) -> None:
    path = tmp_path / "walk.npz"
    np.savez(path, **amass_arrays(placed(walk, 70, (3, 0, -2)), joints=joints, up=up))
    found = read_motion(path, options=ReadOptions(up=up))  # type: ignore[arg-type]
    kept = list(range(BODY if joints < 50 else 55))
    if joints == 52:
        kept = [*range(BODY), *range(25, 55)]
    expected = np.tile([0.0, 0, 0, 1], (*walk.quats.shape[:2], 1))
    expected[:, kept] = walk.quats[:, kept]
    angle, way = same_motion(found, replace(walk, quats=expected))
    assert way < 1e-12
    assert np.abs(np.abs(np.sum(found.quats * expected, axis=-1)) - 1).max() < 1e-12
    assert angle < 1e-7
    assert np.all(np.sum(found.quats[1:] * found.quats[:-1], axis=-1) > 0)
    assert found.fps == 30
    assert found.leg_m is None


@pytest.mark.parametrize("key", ["mocap_framerate", "mocap_frame_rate", "frame_rate", "fps"])
@pytest.mark.parametrize("joints", [55, 22])
def test_amass_in_parts(walk: Motion, tmp_path: Path, key: str, joints: int) -> None:
    arrays = amass_arrays(walk, joints=joints, fps_key=key)
    np.savez(tmp_path / "a.npz", **arrays)
    np.savez(tmp_path / "b.npz", **split_layout(arrays))
    a, b = read_amass(tmp_path / "a.npz"), read_amass(tmp_path / "b.npz")
    assert same_motion(a, b)[0] < 1e-12
    assert a.fps == b.fps == 30


def test_bad_amass(walk: Motion, tmp_path: Path) -> None:
    good = amass_arrays(walk)
    nan = good["poses"].copy()
    nan[4, 7] = np.nan
    path = tmp_path / "bad.npz"
    for change, message in (
        ({"poses": good["poses"][:, :60]}, r"(?s)poses.*165.*H3-BODY-004"),
        ({"poses": nan}, r"(?s)poses.*4.*H3-BODY-008"),
        ({"poses": np.degrees(good["poses"])}, r"(?s)poses.*H3-BODY-006"),
        ({"poses": good["poses"][0]}, r"(?s)poses.*H3-BODY-005"),
        ({"poses": good["poses"].astype(str)}, r"(?s)poses.*H3-BODY-007"),
        ({"poses": np.array({"a": 1}, object)}, r"(?s)poses.*H3-FORMAT-022"),
        ({"trans": good["trans"][1:]}, r"(?s)trans.*\[30, 3\].*H3-BODY-011"),
        ({"trans": None}, r"(?s)trans or transl.*H3-BODY-001"),
        ({"mocap_frame_rate": None}, r"(?s)mocap_framerate.*H3-BODY-002"),
        ({"mocap_frame_rate": np.array(0)}, r"(?s)mocap_frame_rate.*H3-BODY-012"),
        ({"poses": None}, r"(?s)the shape of a person, without motion.*H3-BODY-045"),
    ):
        np.savez(path, **{k: v for k, v in {**good, **change}.items() if v is not None})
        with pytest.raises(FormatError, match=message) as caught:
            read_motion(path)
        assert "bad.npz" in str(caught.value)
    np.savez(path, **{k: v for k, v in good.items() if k != "mocap_frame_rate"})
    assert read_motion(path, options=ReadOptions(fps=120)).fps == 120


class _Trap:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.path),)


def test_no_pickle_runs(walk: Motion, tmp_path: Path) -> None:
    made = tmp_path / "made"
    arrays = {**amass_arrays(walk), "labels": np.array([_Trap(made)], object)}
    np.savez(tmp_path / "extra.npz", **arrays)
    assert len(read_motion(tmp_path / "extra.npz")) == len(walk)  # what nobody needs is not even looked at
    np.savez(tmp_path / "needed.npz", **{**arrays, "trans": np.array([_Trap(made)], object)})
    (tmp_path / "trap.pkl").write_bytes(pickle.dumps({"pose_motion": _Trap(made)}))
    for name, code in (("needed.npz", "H3-FORMAT-022"), ("trap.pkl", "H3-FORMAT-026")):
        with pytest.raises(FormatError, match=code):
            read_motion(tmp_path / name)
    assert not made.exists()


def test_claims_are_not_believed(tmp_path: Path, walk: Motion) -> None:
    """An npy header that claims terabytes is refused before memory is asked for."""
    np.savez(tmp_path / "a.npz", **amass_arrays(walk))
    data = (tmp_path / "a.npz").read_bytes()
    assert data.count(b"(30, 165)") == 1
    (tmp_path / "a.npz").write_bytes(data.replace(b"(30, 165), }  ", b"(3000000, 165)}"[:14].ljust(14)))
    with pytest.raises(FormatError, match="H3-FORMAT-021"):
        read_motion(tmp_path / "a.npz")


# --- Habitat --------------------------------------------------------------------------------------------------------------
def test_habitat_sequence_round_trip(walk: Motion, tmp_path: Path) -> None:
    write_habitat_sequence(tmp_path / "s.pkl", walk)
    found = read_motion(tmp_path / "s.pkl")
    angle, way = same_motion(found, walk)
    assert angle < 1e-7
    assert way < 1e-12
    roots = pickle.loads((tmp_path / "s.pkl").read_bytes())["pose_motion"]
    roots["transform_array"][2, 0] *= 1.5
    (tmp_path / "s.pkl").write_bytes(pickle.dumps({"pose_motion": roots}))
    with pytest.raises(FormatError, match="H3-BODY-048"):
        read_motion(tmp_path / "s.pkl")


def test_real_habitat_motion_files(real: Path) -> None:
    folder = real / "habitat-lab/reference/humanoid"
    if not folder.is_dir():
        pytest.skip("no humanoid reference below ../shared/real")
    walk = read_motion(folder / "synthetic_motion_data_smplx.pkl")
    clip = read_habitat_motion(folder / "synthetic_motion_data_smplx.pkl").walk
    assert len(walk) == len(clip.joints)
    assert clip.displacement is not None
    way = float(clip.displacement[-1] - clip.displacement[0])
    assert np.linalg.norm(walk.pelvis[-1, ::2] - walk.pelvis[0, ::2]) == pytest.approx(way, rel=0.1)
    sequence = read_motion(folder / "synthetic_sequence.pkl")
    assert len(sequence) > 10


# --- BVH ------------------------------------------------------------------------------------------------------------------
@pytest.mark.filterwarnings("ignore:Gimbal lock")
@pytest.mark.parametrize("convention", [name for name in CONVENTIONS if name not in SCHEMES])
@pytest.mark.parametrize("name", ["male_1", "female_3"])
def test_bvh_joints_are_where_they_were(convention: str, name: str, tmp_path: Path) -> None:
    """FK of the BVH by its own rules, and ours of what was read, agree on wrists, ankles and head to 0.1 % of the limbs."""
    body = load_humanoid(name)
    identity = np.array([0.0, 0, 0, 0, 0, 0, 1])
    for motion in (walked(body, 2.5, seconds=0.5, fps=30), turned(body, seconds=0.5, fps=30)):
        path = tmp_path / "m.bvh"
        path.write_text(bvh_text(body, placed(motion, 130, (4, 0, 1)), convention))
        found = read_bvh(path)
        assert found.fps == 30
        assert found.leg_m == pytest.approx(body.gaits.legs.length, rel=1e-6)
        ours, truth = (
            body.joint_matrices(np.tile(identity, (len(m), 1)), m.quats, m.pelvis)[..., :3, 3] for m in (found, motion)
        )
        for joint in ("left_wrist", "right_wrist", "left_ankle", "right_ankle", "left_foot", "head"):
            whole_spine = "spine2" in CONVENTIONS[convention][0]  # its bend is lost where the file does not have it
            assert np.abs(ours - truth)[:, JOINT_INDEX[joint]].max() < (0.0005 if whole_spine else 0.003)


@pytest.mark.parametrize("prefix", ["mixamorig_", "Character1:", "ann:Character1_"])
def test_a_prefix_of_all_names_does_not_count(walk: Motion, tmp_path: Path, prefix: str) -> None:
    text = bvh_text(load_humanoid("male_1"), walk, "rokoko")
    paths = tmp_path / "plain.bvh", tmp_path / "prefixed.bvh"
    for path, begins in zip(paths, ("", prefix), strict=True):
        path.write_text(re.sub(r"(ROOT|JOINT) ", rf"\1 {begins}", text))
    plain, prefixed = map(read_bvh, paths)
    np.testing.assert_array_equal(prefixed.quats, plain.quats)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_joints_are_known_by_the_names_of_many_programs(walk: Motion, tmp_path: Path, scheme: str) -> None:
    (tmp_path / "m.bvh").write_text(bvh_text(load_humanoid("male_1"), walk, scheme))
    found = read_bvh(tmp_path / "m.bvh")
    assert f"({scheme} names)" in found.source
    index = [
        JOINT_INDEX[f"{side}_{joint}"] for side in ("left", "right") for joint in ("hip", "knee", "shoulder", "elbow")
    ]
    np.testing.assert_allclose(found.quats[:, index], walk.quats[:, index], atol=1e-4)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("Frames: 2", "Frames:2"),
        ("Frames: 2", "Frames : 2"),
        ("Frame Time: 0.0333333", "Frame Time:0.0333333"),
        ("Frame Time: 0.0333333", "Frame Time: 0.0333333  // 30 frames a second"),
        ("ROOT Hips", "ROOT Hips # the pelvis"),
        ("0 90 1 0 0 0 1 2 3\n", "0 90 1 0 0 0 1 2 3\n# the end\n"),
    ],
)
def test_files_of_other_programs_are_read(before: str, after: str) -> None:
    plain, other = parse_bvh(SMALL), parse_bvh(SMALL.replace(before, after, 1))
    assert SMALL.replace(before, after, 1) != SMALL
    assert (other.joints, other.frame_s) == (plain.joints, plain.frame_s)
    np.testing.assert_array_equal(other.values, plain.values)


@pytest.mark.parametrize("claimed", [1, 3])
def test_one_frame_more_or_less_than_claimed_is_read_with_a_warning(claimed: int) -> None:
    with pytest.warns(BvhWarning, match=f"Frames: {claimed}, but the file has 2"):
        found = parse_bvh(SMALL.replace("Frames: 2", f"Frames: {claimed}"))
    np.testing.assert_array_equal(found.values, parse_bvh(SMALL).values)


def test_bvh_fk_by_hand() -> None:
    """Rz(90) Rx(90): the child at +Y goes to -X... turned first by X, then by Z."""
    text = """HIERARCHY
    ROOT Hips { OFFSET 9 9 9 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
      JOINT Spine { OFFSET 0 2 0 CHANNELS 3 Xrotation Yrotation Zrotation
        End Site { OFFSET 0 1 0 } } }
    MOTION Frames: 1 Frame Time: 0.05
    1 2 3 90 0 0 90 0 0"""
    bvh = parse_bvh(
        text.replace("{ ", "{\n").replace(" CH", "\nCH").replace(" MOTION", "\nMOTION").replace("}", "\n}\n")
    )
    quats, places = bvh.forward_kinematics()
    np.testing.assert_allclose(places[0, 0], [1, 2, 3])
    np.testing.assert_allclose(places[0, 1], [-1, 2, 3], atol=1e-12)  # +Y turned by 90 degrees about Z
    np.testing.assert_allclose(places[0, 2], [-1, 2, 4], atol=1e-12)  # its own +Y turned about its X into +Z
    assert bvh.frame_s == 0.05
    assert quats.shape == (1, 3, 4)


SMALL = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Spine
  {
    OFFSET 0 10 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 10 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333333
0 90 0 0 0 0 1 2 3
0 90 1 0 0 0 1 2 3
"""


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (SMALL, "", "H3-BODY-014"),
        ("HIERARCHY", "<html>", r"(?s)1: expected HIERARCHY.*H3-BODY-013"),
        (
            "Zrotation Xrotation Yrotation\n  J",
            "Zrotation Wrotation Yrotation\n  J",
            r"(?s)5: unknown channel 'wrotation'.*H3-BODY-013",
        ),
        ("CHANNELS 3 Zrotation Xrotation", "CHANNELS 3 Zrotation Zrotation", r"(?s)9: a channel twice.*H3-BODY-013"),
        ("CHANNELS 3 Zrotation Xrotation Yrotation\n", "", r"(?s)9: expected CHANNELS, got 'End'.*H3-BODY-013"),
        ("CHANNELS 3", "CHANNELS 999999999999", r"(?s)expected a number of channels.*H3-BODY-013"),
        ("CHANNELS 6", "CHANNELS 60", r"(?s)at most 6 channels.*H3-BODY-013"),
        ("JOINT Spine", "JOINT Hips", r"(?s)'Hips' is there twice.*H3-BODY-013"),
        ("JOINT Spine", "JOINT", r"(?s)no name.*H3-BODY-013"),
        ("OFFSET 0 10 0\n    C", "OFFSET 0 ten 0\n    C", r"(?s)8: expected a number, got 'ten'.*H3-BODY-013"),
        ("OFFSET 0 10 0\n    C", "OFFSET 0 nan 0\n    C", r"(?s)finite number.*H3-BODY-013"),
        ("Frames: 2", "Frames: 4", r"(?s)4 with 9 channels need 36 numbers, there are 18.*H3-BODY-013"),
        ("1 2 3\n0 ", "1 2 3\n", r"(?s)2 with 9 channels need 18 numbers, there are 17.*H3-BODY-013"),
        ("Frames: 2", "Frames 2", r"(?s)expected Frames:, got 'Frames'.*H3-BODY-013"),
        ("Frames: 2", "Frames: 900000000", r"(?s)the file is cut off.*H3-BODY-013"),
        ("Frames: 2", "Frames: -2", r"(?s)expected a number of frames.*H3-BODY-013"),
        ("0.0333333", "0", r"(?s)seconds per frame.*H3-BODY-013"),
        ("1 2 3\n0", "1 2 x\n0", r"(?s)something that is no number.*H3-BODY-013"),
        ("1 2 3\n0", "1 2 inf\n0", r"(?s)frame 0 has a number that is not finite.*H3-BODY-013"),
        ("}\nMOTION", "MOTION", r"(?s)got 'MOTION'.*H3-BODY-013"),
        ("MOTION", "", r"(?s)expected ROOT.*H3-BODY-013"),
        (SMALL[SMALL.index("Frames") :], "", r"(?s)the file ends where Frames: should be.*H3-BODY-013"),
        (
            "      OFFSET 0 10 0\n",
            "      OFFSET 0 10 0\n JOINT a\n{\n",
            r"(?s)an End Site has no children.*H3-BODY-013",
        ),
    ],
)
def test_bad_bvh(before: str, after: str, message: str) -> None:
    text = SMALL.replace(before, after, 1)
    assert text != SMALL
    with pytest.raises(FormatError, match=message) as caught:
        parse_bvh(text, "some/file.bvh")
    assert "some/file.bvh" in str(caught.value)


def test_bvh_of_no_person(walk: Motion, tmp_path: Path) -> None:
    path = tmp_path / "m.bvh"
    path.write_text(SMALL)
    with pytest.raises(FormatError, match=r"(?s)LeftUpLeg.*H3-BODY-020"):
        read_bvh(path)
    body = load_humanoid("male_1")
    text = bvh_text(body, walk, "mixamo")
    path.write_text(text.replace("mixamorig:LeftArm", "mixamorig:Oops"))
    with pytest.raises(FormatError, match=r"(?s)LeftArm.*H3-BODY-020"):
        read_bvh(path)
    path.write_text(text.replace("LeftForeArm", "@").replace("LeftArm", "LeftForeArm").replace("@", "LeftArm"))
    with pytest.raises(FormatError, match="H3-BODY-021"):
        read_bvh(path)
    path.write_text(bvh_text(body, walk, "lafan").replace("Toe", "ToeBase"))
    with pytest.raises(FormatError, match="H3-BODY-024"):
        read_bvh(path, names="mixamo")
    path.write_text(text)
    with pytest.raises(InputError, match="H3-BODY-018"):
        read_bvh(path, names=tmp_path / "none.toml")
    monster = "\n".join(
        f"{line[: len(line) - len(line.lstrip())]}OFFSET " + " ".join(str(float(v) * 1e4) for v in line.split()[1:])
        if line.strip().startswith("OFFSET")
        else line
        for line in text.splitlines()
    )
    path.write_text(monster)
    with pytest.raises(FormatError, match="H3-BODY-017"):
        read_bvh(path)


def test_a_table_of_ones_own(walk: Motion, tmp_path: Path) -> None:
    body, lafan = load_humanoid("male_1"), load_name_table("lafan")
    text = bvh_text(body, walk, "lafan")
    (tmp_path / "reference.bvh").write_text(text)
    theirs = {ours: f"bone {k}" for k, ours in enumerate(lafan.joints)}
    for ours, name in lafan.joints.items():
        text = text.replace(f" {name}\n", f" {theirs[ours]}\n")
    (tmp_path / "m.bvh").write_text(text)
    with pytest.raises(FormatError, match="H3-BODY-020"):
        read_bvh(tmp_path / "m.bvh")
    lines = ["unit_m = 0.01", "foot_slope_deg = 21.45", "[joints]", *(f'{k} = "{v}"' for k, v in theirs.items())]
    lines += ["[axes]", *(f'{k} = "{v}"' for k, v in lafan.axes.items())]
    mine = tmp_path / "mine.toml"
    mine.write_text("\n".join(lines))
    assert max(same_motion(read_bvh(tmp_path / "m.bvh", names=mine), read_bvh(tmp_path / "reference.bvh"))) < 1e-12
    for change, message in (
        (("left_hip", "left_hop"), r"(?s)unknown.*'left_hop'.*H3-BODY-019"),
        (('pelvis = "bone 0"', ""), r"(?s)no entry for pelvis.*H3-BODY-019"),
        (("up forward left", "up up left"), r"(?s)axes 'up up left'.*H3-BODY-019"),
        (("unit_m", "units"), "H3-BODY-023"),
    ):
        (tmp_path / "bad.toml").write_text(mine.read_text().replace(*change))
        with pytest.raises(InputError, match=message):
            load_name_table(tmp_path / "bad.toml")


# --- hostile --------------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder, body = tmp_path_factory.mktemp("files"), load_humanoid("male_1")
    motion = walked(body, seconds=0.1, fps=30)
    np.savez_compressed(folder / "amass.npz", **amass_arrays(motion))
    (folder / "m.bvh").write_text(bvh_text(body, motion, "mixamo"))
    write_habitat_sequence(folder / "s.pkl", motion)
    save_motion(motion, folder / "ours.npz")
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


@given(data=st.data(), name=st.sampled_from(["amass.npz", "m.bvh", "s.pkl", "ours.npz"]))
def test_damaged_files_are_refused_or_read(
    files: dict[str, bytes], data: st.DataObject, name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Cut off or with some bytes changed: an error of ours, or motion that holds; never anything else."""
    content = bytearray(files[name])
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    for _ in range(data.draw(st.integers(0, 4))):
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / f"hostile_{name}"
    path.write_bytes(bytes(content))
    message = ""
    try:
        assert np.isfinite(read_motion(path).quats).all()
    except H3DataError as error:
        message = str(error)
    assert not message or str(path) in message


@pytest.mark.parametrize("name", ["amass.npz", "m.bvh", "s.pkl", "ours.npz"])
def test_cut_off_files_are_refused(files: dict[str, bytes], name: str, tmp_path: Path) -> None:
    content = files[name]
    for share in (0.0, 0.01, 0.3, 0.7, 0.95):
        (tmp_path / name).write_bytes(content[: int(share * len(content))])
        with pytest.raises(FormatError):
            read_motion(tmp_path / name)
