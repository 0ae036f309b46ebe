"""Motion files of other programs, written from our own walks: for tests, and for the picture in the docs.

``python tests/motion/motion_writers.py FOLDER`` writes one file of each kind.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from h3data.bodies import JOINT_INDEX, JOINT_NAMES, Humanoid, load_humanoid
from h3data.bodies.people.skeleton import FINGERS, PARENTS
from h3data_habitat.motion.habitat_humanoid import HABITAT_JOINTS
from h3data_motion.clip import Motion, in_start_frame

Z_UP = Rotation.from_euler("x", 90, degrees=True)
"""From y up to z up."""


# --- motion ---------------------------------------------------------------------------------------------------------------
def walked(body: Humanoid, speed: float = 1.3, seconds: float = 3.0, fps: float = 60.0) -> Motion:
    """Walking straight on, or jogging above 2 m/s."""
    time = np.arange(round(seconds * fps)) / fps
    quats, pelvis = body.walk_pose(np.full(len(time), speed), speed * time / float(body.stride_m(speed)))
    pelvis = pelvis + speed * time[:, None] * np.array([1.0, 0, 0])
    return _motion(body, f"walk_{speed:g}", quats, pelvis, fps)


def turned(body: Humanoid, seconds: float = 3.0, fps: float = 60.0, rate: float = 1.0) -> Motion:
    """Stepping turns on the spot, ``rate`` in radians per second to the left."""
    index = body.motion_names.index("turn_left")
    angle = rate * np.arange(round(seconds * fps)) / fps
    quats, pelvis = body.clip_pose(np.full(len(angle), index), angle / body.clips[index].turn_rad)
    turn = Rotation.from_rotvec(angle[:, None] * [0, 1, 0])
    quats[:, 0] = (turn * Rotation.from_quat(quats[:, 0])).as_quat()
    return _motion(body, "turn", quats, turn.apply(pelvis), fps)


def _motion(body: Humanoid, name: str, quats: NDArray, pelvis: NDArray, fps: float) -> Motion:
    return in_start_frame(
        Motion(name=name, fps=fps, quats=quats, pelvis=pelvis, leg_m=body.gaits.legs.length, source="our own walk")
    )


def placed(motion: Motion, heading_deg: float, shift: tuple[float, float, float]) -> Motion:
    """The same somewhere else: turned about the vertical, then moved."""
    turn = Rotation.from_euler("y", heading_deg, degrees=True)
    quats = motion.quats.copy()
    quats[:, 0] = (turn * Rotation.from_quat(quats[:, 0])).as_quat()
    return replace(motion, quats=quats, pelvis=turn.apply(motion.pelvis) + shift)


# --- AMASS ----------------------------------------------------------------------------------------------------------------
def amass_arrays(motion: Motion, *, joints: int = 55, up: str = "z", fps_key: str = "mocap_frame_rate") -> dict:
    """Arrays of an AMASS file with ``poses``, for 55, 52, 24 or 22 joints."""
    turn = Z_UP if up == "z" else Rotation.identity()
    quats = motion.quats.copy()
    quats[:, 0] = (turn * Rotation.from_quat(quats[:, 0])).as_quat()
    rotvecs = Rotation.from_quat(quats.reshape(-1, 4)).as_rotvec().reshape(len(quats), -1, 3)
    if joints == 52:
        rotvecs = np.concatenate([rotvecs[:, :22], rotvecs[:, 25:]], axis=1)
    elif joints == 24:
        rotvecs = np.concatenate([rotvecs[:, :22], np.full((len(quats), 2, 3), 0.3)], axis=1)
    else:
        rotvecs = rotvecs[:, :joints]
    return {
        "poses": rotvecs.reshape(len(quats), -1),
        "trans": turn.apply(motion.pelvis),
        fps_key: np.array(motion.fps),
        "betas": np.zeros(16),
        "gender": np.array("neutral"),
    }


def split_layout(arrays: Mapping[str, NDArray]) -> dict:
    """The same as ``root_orient``, ``pose_body``, ..., with pickled extras that nobody needs."""
    poses = arrays["poses"]
    out = {k: v for k, v in arrays.items() if k != "poses"}
    out |= {"root_orient": poses[:, :3], "pose_body": poses[:, 3:66], "labels": np.array([{"marker": 1}], object)}
    if poses.shape[1] == 165:
        out |= {"pose_jaw": poses[:, 66:69], "pose_eye": poses[:, 69:75], "pose_hand": poses[:, 75:]}
    return out


# --- Habitat --------------------------------------------------------------------------------------------------------------
def write_habitat_sequence(path: Path, motion: Motion) -> None:
    """A sequence as habitat-lab's converter pickles it; roots look along -Z."""
    turn = Rotation.from_euler("y", 90, degrees=True)
    roots = np.tile(np.eye(4), (len(motion), 1, 1))
    roots[:, :3, :3] = (turn * Rotation.from_quat(motion.quats[:, 0])).as_matrix()
    roots[:, :3, 3] = turn.apply(motion.pelvis)
    joints = motion.quats[:, [JOINT_INDEX[name] for name in HABITAT_JOINTS]]
    part = {"joints_array": joints, "transform_array": roots, "displacement": None, "fps": int(motion.fps)}
    path.write_bytes(pickle.dumps({"pose_motion": part}))


# --- BVH ------------------------------------------------------------------------------------------------------------------
MIXAMO = {
    "pelvis": "mixamorig:Hips",
    "spine1": "mixamorig:Spine",
    "spine2": "mixamorig:Spine1",
    "spine3": "mixamorig:Spine2",
    "neck": "mixamorig:Neck",
    "head": "mixamorig:Head",
    **{
        f"{s}_{ours}": f"mixamorig:{s.capitalize()}{theirs}"
        for s in ("left", "right")
        for ours, theirs in (
            ("hip", "UpLeg"),
            ("knee", "Leg"),
            ("ankle", "Foot"),
            ("foot", "ToeBase"),
            ("collar", "Shoulder"),
            ("shoulder", "Arm"),
            ("elbow", "ForeArm"),
            ("wrist", "Hand"),
            *((f"{f}{k}", f"Hand{f.capitalize()}{k}") for f in FINGERS for k in (1, 2, 3)),
        )
    },
}
CMU = {
    **{k: v.removeprefix("mixamorig:") for k, v in MIXAMO.items() if "Hand" not in v or v.endswith("Hand")},
    "spine1": "LowerBack",
    "spine2": "Spine",
    "spine3": "Spine1",
}
CGSPEED = {
    "pelvis": "Hips",
    "spine1": "lowerback",
    "spine2": "Chest",
    "spine3": "Chest2",
    "neck": "Neck",
    "head": "Head",
    **{
        f"{s}_{ours}": s.capitalize() + theirs
        for s in ("left", "right")
        for ours, theirs in (
            ("hip", "Hip"),
            ("knee", "Knee"),
            ("ankle", "Ankle"),
            ("foot", "Toe"),
            ("collar", "Collar"),
            ("shoulder", "Shoulder"),
            ("elbow", "Elbow"),
            ("wrist", "Wrist"),
        )
    },
}
ROKOKO = {
    **{k: v.replace("UpLeg", "Thigh").replace("Leg", "Shin").replace("ToeBase", "Toe") for k, v in CMU.items()},
    "spine1": "Spine1",
    "spine2": "Spine2",
    "spine3": "Spine4",
}
XSENS = CGSPEED | {"spine1": "Chest", "spine2": "Chest2", "spine3": "Chest4"}
DAZ = {
    "pelvis": "hip",
    "spine1": "abdomen",
    "spine3": "chest",
    "neck": "neck",
    "head": "head",
    **{
        f"{s}_{ours}": s[0] + theirs
        for s in ("left", "right")
        for ours, theirs in (
            ("hip", "Thigh"),
            ("knee", "Shin"),
            ("ankle", "Foot"),
            ("collar", "Collar"),
            ("shoulder", "Shldr"),
            ("elbow", "ForeArm"),
            ("wrist", "Hand"),
        )
    },
}
LAFAN = {k: v.removeprefix("mixamorig:").replace("ToeBase", "Toe") for k, v in MIXAMO.items() if k in CMU}


def _spread(name: str) -> Rotation:
    """CMU's rest pose: legs spread by 20 degrees, feet with them; here arms also hang by 35."""
    sign = 1 if name.startswith("left") else -1
    if name.endswith(("hip", "knee", "ankle", "foot")):
        return Rotation.from_euler("z", -20 * sign, degrees=True)
    return Rotation.from_euler("z", 35 * sign, degrees=True) if name.endswith(("shoulder", "elbow", "wrist")) else ONE


def _along_bones(name: str) -> Rotation:
    """LAFAN's frames: x along the bone."""
    left, up, front = np.eye(3)
    if name.endswith(("hip", "knee")):
        axes = [-up, front, -left]
    elif name.endswith("ankle"):
        down = np.radians(21.45)
        axes = [np.cos(down) * front - np.sin(down) * up, np.cos(down) * up + np.sin(down) * front, -left]
    elif name.endswith("foot"):
        axes = [front, up, -left]
    elif name.startswith("left"):
        axes = [left, -front, up]
    elif name.startswith("right"):
        axes = [-left, -front, -up]
    else:
        axes = [up, front, left]
    return Rotation.from_matrix(np.stack(axes, axis=1))


ONE = Rotation.identity()
TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
LIMBS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")


def _named(trunk: str, limbs: str, side: str) -> dict[str, str]:
    """Names by ours, ``-`` for none; of limbs ``side`` with the name in the place of *."""
    names = {ours: theirs for ours, theirs in zip(TRUNK, trunk.split(), strict=True) if theirs != "-"}
    for own in ("left", "right"):
        form = side.format(side=own, Side=own.capitalize(), s=own[0], S=own[0].upper())
        names |= {f"{own}_{ours}": form.replace("*", name) for ours, name in zip(LIMBS, limbs.split(), strict=True)}
    return names


SCHEMES: dict[str, dict[str, str]] = {
    "smpl": _named(
        "f_avg_Pelvis f_avg_Spine1 f_avg_Spine2 f_avg_Spine3 f_avg_Neck f_avg_Head",
        "Hip Knee Ankle Foot Collar Shoulder Elbow Wrist",
        "f_avg_{S}_*",
    ),
    "smplx": _named(
        "pelvis spine1 spine2 spine3 neck head",
        "hip knee ankle foot collar shoulder elbow wrist",
        "{side}_*",
    ),
    "unreal": _named(
        "pelvis spine_01 spine_02 spine_03 neck_01 head",
        "thigh calf foot ball clavicle upperarm lowerarm hand",
        "*_{s}",
    ),
    "biped": _named(
        "Bip01_Pelvis Bip01_Spine Bip01_Spine1 Bip01_Spine2 Bip01_Neck Bip01_Head",
        "Thigh Calf Foot Toe0 Clavicle UpperArm Forearm Hand",
        "Bip01 {S} *",
    ),
    "vrm": _named(
        "hips spine chest upperChest neck head",
        "UpperLeg LowerLeg Foot Toes Shoulder UpperArm LowerArm Hand",
        "{side}*",
    ),
    "vroid": _named(
        "J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head",
        "UpperLeg LowerLeg Foot ToeBase Shoulder UpperArm LowerArm Hand",
        "J_Bip_{S}_*",
    ),
    "rigify": _named(
        "DEF-spine DEF-spine.001 DEF-spine.002 DEF-spine.003 DEF-spine.004 DEF-spine.006",
        "thigh shin foot toe shoulder upper_arm forearm hand",
        "DEF-*.{S}",
    ),
    "optitrack": _named("Hip Ab - Chest Neck Head", "Thigh Shin Foot Toe Shoulder UArm FArm Hand", "{S}*"),
    "bandai": _named(
        "Hips Spine - Chest Neck Head",
        "UpperLeg LowerLeg Foot Toes Shoulder UpperArm LowerArm Hand",
        "*_{S}",
    ),
    "biovision": _named("Hips - - Chest Neck Head", "UpLeg LowLeg Foot Toe Collar UpArm LowArm Hand", "{Side}*"),
}
"""Names of joints as these programs write them, by ours."""

CONVENTIONS: dict[str, tuple] = {
    "mixamo": (MIXAMO, "ZXY", 100.0, lambda name: ONE, ONE),
    "cmu": (CMU, "ZYX", 1 / 0.0564444, _spread, ONE),
    "cgspeed": (CGSPEED, "ZYX", 1.0, _spread, ONE),
    "rokoko": (ROKOKO, "ZXY", 100.0, lambda name: ONE, ONE),
    "xsens": (XSENS, "YXZ", 100.0, lambda name: ONE, ONE),
    "daz": (DAZ, "ZYX", 1 / 0.0254, _spread, ONE),
    "lafan": (LAFAN, "ZYX", 100.0, _along_bones, ONE),
    "z_up": (MIXAMO, "XYZ", 1.0, lambda name: ONE, Z_UP),
    **{name: (names, "ZXY", 100.0, lambda name: ONE, ONE) for name, names in SCHEMES.items()},
}
"""Names, order of rotations, units per metre, frame of a joint in a T-pose, world."""


def bvh_text(body: Humanoid, motion: Motion, convention: str) -> str:
    """A BVH file in which a skeleton with the body's lengths performs the motion."""
    names, order, units, frame, world = CONVENTIONS[convention]
    frames = len(motion)
    ours: list[Rotation] = []
    for joint, parent in enumerate(PARENTS):
        local = Rotation.from_quat(motion.quats[:, joint])
        ours.append(local if parent < 0 else ours[parent] * local)
    kept = [j for j, name in enumerate(JOINT_NAMES) if name in names]
    above = {j: next((p for p in _ancestors(j) if p in kept), -1) for j in kept}
    turns = {j: world * ours[j] * frame(JOINT_NAMES[j]) * world.inv() for j in kept}
    lines, columns = ["HIERARCHY"], []

    def add(joint: int, depth: int) -> None:
        indent, parent = "  " * depth, above[joint]
        offset = np.array([123.0, 45.0, -6.0]) if parent < 0 else _offset(body, joint, parent, frame, world) * units
        if convention == "cmu" and JOINT_NAMES[joint].endswith("hip"):  # CMU has one more joint here, that never turns
            side = JOINT_NAMES[joint][0].upper()
            lines.extend([f"{indent}JOINT {side}HipJoint", indent + "{", f"{indent}  OFFSET 0 0 0"])
            lines.append(f"{indent}  CHANNELS 3 {' '.join(f'{a}rotation' for a in order)}")
            columns.append(np.zeros((frames, 3)))
        lines.extend([f"{indent}{'ROOT' if parent < 0 else 'JOINT'} {names[JOINT_NAMES[joint]]}", indent + "{"])
        lines.append(f"{indent}  OFFSET " + " ".join(f"{v:.9f}" for v in offset))
        rotations = " ".join(f"{a}rotation" for a in order)
        local = turns[joint] if parent < 0 else turns[parent].inv() * turns[joint]
        if parent < 0:
            lines.append(f"{indent}  CHANNELS 6 Xposition Yposition Zposition {rotations}")
            columns.append(world.apply(motion.pelvis) * units)
        else:
            lines.append(f"{indent}  CHANNELS 3 {rotations}")
        columns.append(local.as_euler(order, degrees=True))
        children = [k for k in kept if above[k] == joint]
        for child in children:
            add(child, depth + 1)
        if not children:
            lines.extend([f"{indent}  End Site", indent + "  {", f"{indent}    OFFSET 0 0 0", indent + "  }"])
        lines.append(indent + "}")
        if convention == "cmu" and JOINT_NAMES[joint].endswith("hip"):
            lines.append(indent + "}")

    add(0, 0)
    lines += ["MOTION", f"Frames: {frames}", f"Frame Time: {1 / motion.fps:.9f}"]
    lines += [" ".join(f"{v:.9f}" for v in row) for row in np.concatenate(columns, axis=1)]
    return "\n".join(lines) + "\n"


def _ancestors(joint: int) -> list[int]:
    out = []
    while PARENTS[joint] >= 0:
        joint = PARENTS[joint]
        out.append(joint)
    return out


def _offset(body: Humanoid, joint: int, parent: int, frame, world: Rotation) -> NDArray:
    """A joint in the frame of the one above it, through joints that the file does not have."""
    total, at = np.zeros(3), joint
    while at != parent:
        total, at = total + body.joint_offsets[at], PARENTS[at]
    return world.apply(frame(JOINT_NAMES[parent]).inv().apply(total))


def write_all(folder: Path) -> list[Path]:
    """One file of each kind, of people of different build."""
    folder.mkdir(parents=True, exist_ok=True)
    tall, small, middle = (load_humanoid(name) for name in ("male_1", "female_3", "neutral_2"))
    np.savez(folder / "1_amass_walk.npz", **amass_arrays(walked(tall, 1.3)))
    (folder / "2_cmu_jog.bvh").write_text(bvh_text(small, walked(small, 2.5), "cmu"))
    (folder / "3_mixamo_turn.bvh").write_text(bvh_text(middle, turned(middle), "mixamo"))
    (folder / "4_lafan_walk.bvh").write_text(bvh_text(tall, walked(tall, 1.0), "lafan"))
    write_habitat_sequence(folder / "5_habitat_walk.pkl", walked(small, 1.6))
    return sorted(folder.iterdir())


if __name__ == "__main__":
    for written in write_all(Path(sys.argv[1])):
        sys.stdout.write(f"{written}\n")
