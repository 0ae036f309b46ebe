"""Conversion of BVH motion to the SMPL-X skeleton, with joints matched by name (h3data docs motion).

Joint j of the file has the world rotation G_j, and ours has H_j = G_j A_j, where A_j rotates our T-pose into the file's
rest pose. Local rotations are then q' = H_parent^-1 H_j, which is A_parent^-1 q A_j if no joint lies between.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

import msgspec
import numpy as np

from h3data.bodies.people.skeleton import JOINT_COUNT, JOINT_INDEX, JOINT_NAMES, PARENTS
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from h3data.geometry import (
    Array,
    normalized,
    quat_conjugate,
    quat_from_matrix,
    quat_multiply,
    quat_to_matrix,
)
from h3data_motion.bvh import Bvh, read_bvh_file
from h3data_motion.clip import Motion, in_start_frame

BUILTIN_TABLES = (
    "cmu",
    "cgspeed",
    "daz",
    "mixamo",
    "rokoko",
    "xsens",
    "lafan",
    "smpl",
    "smplx",
    "unreal",
    "biped",
    "vrm",
    "vroid",
    "rigify",
    "optitrack",
    "bandai",
    "biovision",
)
SIDES = ("left", "right")
REQUIRED = ("pelvis", *(f"{s}_{j}" for s in SIDES for j in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")))
DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "left": (1, 0, 0),
    "right": (-1, 0, 0),
    "up": (0, 1, 0),
    "down": (0, -1, 0),
    "forward": (0, 0, 1),
    "back": (0, 0, -1),
}
"""Directions by name in the body frame."""
BONES: dict[str, tuple[str, tuple[float, float, float]]] = {
    f"{side}_{joint}": (f"{side}_{child}", DIRECTIONS[side] if direction == "aside" else DIRECTIONS[direction])
    for side in SIDES
    for joint, child, direction in (
        ("hip", "knee", "down"),
        ("knee", "ankle", "down"),
        ("shoulder", "elbow", "aside"),
        ("elbow", "wrist", "aside"),
    )
}
"""Limbs that are straight in a T-pose, as joint, next joint, and direction in the body frame."""
UNITS_M = (1.0, 0.01, 0.0254, 0.0564444, 0.001)
"""Candidate units of length [m]: metre, centimetre, inch, CMU's unit, millimetre."""
LEG_M = (0.5, 1.2)
"""Least and greatest length of a person's leg (hip to ankle) [m]."""
TILT_DEG, BEND_DEG = 30.0, 100.0
"""Largest angles of a rest pose from an upright stance, and of its limbs from a T-pose [deg]."""


class NameTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Table of joint names of BVH files and the corresponding SMPL-X joints, in TOML.

    ``{side}``, ``{Side}`` and ``{s}`` stand for left, Left and l, or for right, Right and r.
    """

    joints: dict[str, str]
    """Names of joints in the file by SMPL-X name; only letters and digits are compared. Joints in `REQUIRED` must be
    included."""
    axes: dict[str, str] = {}
    """Directions of the x, y and z axes of joint frames in a T-pose by SMPL-X name, such as "up forward left"; for
    files whose rest pose is not that of a person."""
    unit_m: float | None = None
    """Metres per unit; guessed from the length of the legs if it does not fit or is not given."""
    feet_follow_shanks: bool = False
    """True if the feet rotate with the shanks in the rest pose; False if they are flat."""
    foot_slope_deg: float = 0.0
    """Angle by which the x axis of a flat foot points down, with ``axes`` [deg]."""


@dataclass(frozen=True)
class _Mapped:
    """A table that fits a file."""

    name: str
    table: NameTable
    index: Mapping[str, int]
    """Index in the file of each of our joints."""


def load_name_table(name: str | Path) -> NameTable:
    """Return a built-in table (one of `BUILTIN_TABLES`) or one in a TOML file.

    Raises:
        InputError: the table does not exist or is malformed; the message says what is wrong.
    """
    path = builtin_path(f"motion_names/{name}.toml") if str(name) in BUILTIN_TABLES else Path(name)
    if not path.is_file():
        raise InputError(
            f"No table of joint names there. Expected {', '.join(BUILTIN_TABLES)} or a TOML file: {path}",
            code="H3-BODY-018",
        )
    try:
        table = msgspec.toml.decode(path.read_bytes(), type=NameTable)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError(f"Not a table of joint names: {error}: {path}", code="H3-BODY-023") from None
    joints, axes = _both_sides(table.joints), _both_sides(table.axes)
    unknown = [j for j in (*joints, *axes) if j not in JOINT_INDEX]
    missing = [j for j in REQUIRED if j not in joints]
    wrong = [text for text in axes.values() if _axes(text) is None]
    if unknown or missing or wrong:
        faults = [f"unknown joint {unknown[0]!r}, ours are SMPL-X names such as left_hip"] if unknown else []
        faults += [f"no entry for {', '.join(missing)}"] if missing else []
        faults += [f"axes {wrong[0]!r}, expected three of {', '.join(DIRECTIONS)}, right-handed"] if wrong else []
        raise InputError(f"The table of joint names has {'; '.join(faults)}: {path}", code="H3-BODY-019")
    return msgspec.structs.replace(table, joints=joints, axes=axes)


def read_bvh(
    path: str | Path, *, names: str | Path | None = None, unit_m: float | None = None, source: str = ""
) -> Motion:
    """Return the motion in a BVH file, with the rest pose corrected to our T-pose.

    Args:
        path: BVH file.
        names: Table of joint names: built-in or a TOML file; None takes the built-in one that fits best.
        unit_m: Metres per unit of the file; None: the table's, or a unit that gives legs of human length.
        source: Origin and licence, stored with the motion.

    Raises:
        FormatError: the file is damaged, or its skeleton fits no table.
        InputError: there is no such file or table.
    """
    path = Path(path)
    bvh = read_bvh_file(path)
    where = str(path)
    found = _fitting_table(bvh, names, where)
    places = bvh.rest_places()
    leg = float(np.mean([_leg_length(places, found.index, side) for side in SIDES]))
    unit = unit_m or _unit(leg, found.table.unit_m, where)
    upright = np.eye(3) if found.table.axes else _upright(places, found.index, where)
    corrections = _corrections(found, places, upright, where)
    theirs, at = bvh.forward_kinematics()
    turned = np.empty((len(theirs), JOINT_COUNT, 4))
    for joint, (name, parent) in enumerate(zip(JOINT_NAMES, PARENTS, strict=True)):
        if name in found.index:
            turned[:, joint] = quat_multiply(theirs[:, found.index[name]], corrections[name])
        else:
            turned[:, joint] = turned[:, parent]
    quats = turned.copy()
    parents = np.array(PARENTS[1:])
    quats[:, 1:] = quat_multiply(quat_conjugate(turned[:, parents]), turned[:, 1:])
    back = quat_from_matrix(upright.T)  # the file's world, brought to y up
    quats[:, 0] = quat_multiply(back, turned[:, 0])
    pelvis = at[:, found.index["pelvis"]] @ upright * unit
    return in_start_frame(
        Motion(
            name=path.stem,
            fps=_fps(bvh.frame_s),
            quats=normalized(quats),
            pelvis=pelvis,
            leg_m=leg * unit,
            source=source or f"BVH ({found.name} names), {path.name}; licence unknown",
        )
    )


def _fps(frame_s: float) -> float:
    """Return frames per second; files round the time of a frame, 30 frames/s are 0.033333 s."""
    fps, whole = 1 / frame_s, round(1 / frame_s)
    return float(whole) if abs(fps - whole) < 2e-4 * fps else fps


# --- names ----------------------------------------------------------------------------------------------------------------
def _both_sides(entries: Mapping[str, str]) -> dict[str, str]:
    out: dict[str, str] = {}
    for key, value in entries.items():
        for side in SIDES if "{side}" in key else ("",):
            theirs = value.replace("{side}", side).replace("{Side}", side.capitalize()).replace("{s}", side[:1])
            out[key.replace("{side}", side)] = theirs
    return out


def _bare(name: str) -> str:
    """Return a joint name for comparison: lower case, without spaces, dots, hyphens and underscores (``Bip01 L Thigh``)."""
    return "".join(letter for letter in name.rpartition(":")[2].lower() if letter.isalnum())


def _numbers(bvh: Bvh) -> dict[str, int]:
    """Return numbers of joints by their bare names.

    They can also be looked up without the prefix that all names share: exporters put the name of the character there
    (``mixamorig:Hips``, ``mixamorig_Hips``, ``Character1_Hips``).
    """
    bare = {_bare(joint.name): k for k, joint in enumerate(bvh.joints) if not joint.end_site}
    first, last = min(bare), max(bare)
    shared = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(first, last, strict=False)))
    return {name[shared:]: k for name, k in bare.items()} | bare


def _fitting_table(bvh: Bvh, names: str | Path | None, where: str) -> _Mapped:
    known = _numbers(bvh)
    fits: list[tuple[int, _Mapped]] = []
    nearest: list[str] | None = None
    for name in BUILTIN_TABLES if names is None else (str(names),):
        table = load_name_table(name)
        index = {ours: known[_bare(theirs)] for ours, theirs in table.joints.items() if _bare(theirs) in known}
        missing = [table.joints[joint] for joint in REQUIRED if joint not in index]
        if not missing:
            fits.append((len(index) - len(table.joints), _Mapped(Path(name).stem, table, index)))
        elif nearest is None or len(missing) < len(nearest):
            nearest = missing
    if not fits:
        some = ", ".join(j.name for j in bvh.joints if not j.end_site)
        raise FormatError(
            f"The joints of this BVH fit no table: {', '.join(nearest or [])} not found. Hint: give your own names in a TOML "
            f"file, h3data motion import --names FILE (h3data docs motion). The file has {some[:300]}: {where}",
            code="H3-BODY-020",
        )
    best = max(fits, key=lambda fit: fit[0])[1]
    faults = _order_faults(bvh, best.index)
    if faults:
        raise FormatError(
            f"The joints hang on each other in another way than a person's: {faults[0]}: {where}", code="H3-BODY-021"
        )
    return best


def _order_faults(bvh: Bvh, index: Mapping[str, int]) -> list[str]:
    """Return the mapped joints that do not descend from the mapped joint from which ours descend."""
    faults = []
    for name, at in index.items():
        parent = PARENTS[JOINT_INDEX[name]]
        while parent >= 0 and JOINT_NAMES[parent] not in index:
            parent = PARENTS[parent]
        if parent < 0:
            continue
        above = bvh.joints[at].parent
        while above >= 0 and above != index[JOINT_NAMES[parent]]:
            above = bvh.joints[above].parent
        if above < 0:
            faults.append(f"{bvh.joints[at].name!r} is not below {bvh.joints[index[JOINT_NAMES[parent]]].name!r}")
    return faults


# --- rest poses -----------------------------------------------------------------------------------------------------------
def _leg_length(places: Array, index: Mapping[str, int], side: str) -> float:
    hip, knee, ankle = (places[index[f"{side}_{j}"]] for j in ("hip", "knee", "ankle"))
    return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))


def _unit(leg: float, stated: float | None, where: str) -> float:
    for unit in ((stated,) if stated else ()) + UNITS_M:
        if LEG_M[0] <= leg * unit <= LEG_M[1]:
            return unit
    raise FormatError(
        f"Legs of {leg:g} units are those of a person in no unit known (metre, centimetre, inch, CMU, millimetre). "
        f"Hint: h3data motion import --unit-m 0.01. File: {where}",
        code="H3-BODY-017",
    )


def _upright(places: Array, index: Mapping[str, int], where: str) -> Array:
    """Return the rotation [3, 3] from our body frame to the figure that stands in the file's rest pose, in quarter turns."""
    top = next((index[j] for j in ("head", "neck", "spine3") if j in index), None)
    hips = (places[index["left_hip"]] + places[index["right_hip"]]) / 2
    shoulders = (places[index["left_shoulder"]] + places[index["right_shoulder"]]) / 2
    up = (shoulders if top is None else places[top]) - hips
    left = places[index["left_hip"]] - places[index["right_hip"]]
    axes = [_nearest_axis(left), _nearest_axis(up)]
    if any(a is None for a in axes) or abs(np.dot(*axes)) > 0.5:  # type: ignore[arg-type]
        raise FormatError(
            "Without rotations this figure does not stand upright (its joint frames follow its bones). Hint: say in a table "
            f"where the axes point, names=FILE with [axes] (h3data docs motion): {where}",
            code="H3-BODY-022",
        )
    return np.stack([axes[0], axes[1], np.cross(axes[0], axes[1])], axis=1)  # type: ignore[arg-type]


def _nearest_axis(vector: Array) -> Array | None:
    """Return the coordinate axis next to a vector, if it is within `TILT_DEG`."""
    unit = normalized(vector)
    k = int(np.argmax(np.abs(unit)))
    return np.sign(unit[k]) * np.eye(3)[k] if abs(unit[k]) > np.cos(np.radians(TILT_DEG)) else None


def _axes(text: str) -> Array | None:
    """Return the frame [3, 3] with the named directions as columns, in the body frame.

    The result is None if the directions are no right-handed frame.
    """
    words = text.split()
    if len(words) != 3 or any(w not in DIRECTIONS for w in words):
        return None
    frame = np.array([DIRECTIONS[w] for w in words], np.float64).T
    return frame if np.linalg.det(frame) > 0.5 else None


def _corrections(found: _Mapped, places: Array, upright: Array, where: str) -> dict[str, Array]:
    """Return A_j as quaternions: from our T-pose to the joint's frame without rotations."""
    index, out = found.index, dict[str, Array]()
    turns: dict[str, Array] = {}  # how limbs of the rest pose are off a T-pose, in the body frame
    for name in JOINT_NAMES:
        if name not in index:
            continue
        frame, turn = _rest_frame(found.table, name, upright), np.eye(3)
        if name in BONES:
            child, straight = BONES[name]
            bone = frame @ normalized(places[index[child]] - places[index[name]])
            if np.dot(bone, straight) < np.cos(np.radians(BEND_DEG)):
                raise FormatError(
                    f"Without rotations, {name} points away from a T-pose by more than {BEND_DEG:g} degrees. Hint: say in "
                    f"a table where the axes point, names=FILE with [axes] (h3data docs motion): {where}",
                    code="H3-BODY-024",
                )
            turn = _shortest_turn(np.array(straight), bone)
        elif name.startswith(SIDES) and not name.endswith(_OWN_TURN[found.table.feet_follow_shanks]):
            turn = turns.get(_mapped_parent(name, turns), turn)
        turns[name] = turn
        out[name] = quat_from_matrix(frame.T @ turn)
    return out


_OWN_TURN = {False: ("_hip", "_collar", "_ankle"), True: ("_hip", "_collar")}
"""Joints that do not turn with a limb whose rest pose differs from a T-pose; hands, fingers and toes do."""


def _mapped_parent(name: str, mapped: Mapping[str, Array]) -> str:
    parent = PARENTS[JOINT_INDEX[name]]
    while parent >= 0 and JOINT_NAMES[parent] not in mapped:
        parent = PARENTS[parent]
    return JOINT_NAMES[parent] if parent >= 0 else ""


def _rest_frame(table: NameTable, name: str, upright: Array) -> Array:
    """Return the frame of a joint without rotations in a T-pose, as columns [3, 3] in the body frame."""
    if not table.axes:
        return upright.T
    while name not in table.axes:
        parent = PARENTS[JOINT_INDEX[name]]
        if parent < 0:
            return np.eye(3)
        name = JOINT_NAMES[parent]
    frame = _axes(table.axes[name])
    assert frame is not None  # checked when the table was read
    return _pitched(table.foot_slope_deg) @ frame if name.endswith("_ankle") else frame


def _pitched(down_deg: float) -> Array:
    """Return the rotation [3, 3] about left that lowers what points forward."""
    angle = np.radians(down_deg)
    return quat_to_matrix(np.array([np.sin(angle / 2), 0, 0, np.cos(angle / 2)]))


def _shortest_turn(a: Array, b: Array) -> Array:
    """Return the rotation [3, 3] by the shortest way from unit vector ``a`` [3] to ``b`` [3]."""
    half = np.append(np.cross(a, b), 1 + np.dot(a, b))
    return quat_to_matrix(normalized(half))
