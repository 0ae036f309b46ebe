"""Replacements for missing assets of an imported recording, of similar appearance.

They are built-in robots and people in the recorded postures, and plain boxes with names on them for the rest.
`h3data.recording.assets.placeholders` has the marked ones, which are the default.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot, humanoid_names, load_humanoid, load_robot, robot_names
from h3data.bodies.people.skeleton import JOINT_NAMES, PARENTS
from h3data.geometry import (
    Array,
    pose_inverse,
    pose_multiply,
    quat_conjugate,
    quat_from_matrix,
    quat_multiply,
    quat_rotate,
    quat_sign_continuous,
)
from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.primitives import box_mesh
from h3data.recording.assets.library import AssetLibrary
from h3data.recording.assets.placeholders import PlaceholderKind, placeholder_kind, placeholder_mesh
from h3data.recording.records import Agent, Body, Recording
from h3data_motion.walk_synthesis import SYNTHETIC_BODY, fitting_body, floor_below, walk_columns

BOX_COLORS: dict[PlaceholderKind, tuple[int, int, int]] = {
    "stage": (186, 182, 176),
    "human": (120, 150, 200),
    "robot_link": (214, 186, 110),
    "small_object": (122, 176, 138),
    "furniture": (196, 178, 152),
}
"""Colours of the boxes that replace missing objects, by kind."""
MODELS = {"spot": "quad_arm", "stretch": "lift_arm", "fetch": "lift_arm"}
"""Built-in robots, by a part of the folder name of the robots that they replace."""
_SPOT_LINKS = {
    "base": "base_link",
    **{
        f"{theirs}.{link}": f"{ours}_{part}"
        for theirs, ours in {"fl": "front_left", "fr": "front_right", "hl": "rear_left", "hr": "rear_right"}.items()
        for link, part in {"hip": "hip", "uleg": "thigh", "lleg": "shank"}.items()
    },
    "arm0.link_sh0": "arm_turret",
    "arm0.link_sh1": "arm_upper",
    "arm0.link_hr0": "arm_upper_end",
    "arm0.link_el0": "arm_elbow",
    "arm0.link_el1": "arm_forearm",
    "arm0.link_wr0": "arm_wrist",
    "arm0.link_wr1": "arm_hand",
    "arm0.link_fngr": "gripper_jaw",
}
"""Links of Spot and those of ``quad_arm`` with the same frames and joints."""
LEAST_BONES = 18
"""Number of the 22 body joints (without hands and face) that a rig must have to count as a person's skeleton."""
_GENERIC = re.compile(r"textured(_mesh)?|mesh|model|visual|google_\d+k|nontextured|meshes|poisson|tsdf", re.IGNORECASE)
_HASH = re.compile(r"[0-9a-f]{16,}\w*|[\d_]+|[0-9a-f]{8}-[0-9a-f-]+", re.IGNORECASE)
TEXTURE_PX = 128
LONGEST_NAME = 32


def with_stand_ins(recording: Recording, library: AssetLibrary) -> tuple[Recording, dict[str, int]]:
    """Return the recording with built-in bodies for agents without assets, and the number of their bodies by file name.

    Recorded data are kept: robots keep their base and the joints of links that the built-in robot also has, and people
    keep the posture of their bones. For people with only a recorded root, a walk is synthesised from their path, as for
    imported HITL sessions. Robots that resemble no built-in robot remain plain bodies.
    """
    refs = {ref.name: ref for ref in recording.assets}
    rigs = {rig["body"]: rig for rig in recording.episode.info.get("rigs", ())}
    agents, columns, missing = list(recording.agents), dict(recording.columns), dict[str, int]()
    replaced: set[int] = set()
    for index, agent in enumerate(agents):
        bodies = [body for body in recording.bodies if body.agent == index]
        if agent.model or not bodies or f"agent_{index}.base_pose" not in columns:
            continue
        uris = [refs[body.asset].uri for body in bodies]
        # the recorded meshes of an agent are better than any built-in body
        if any(library.resolve(uri) is not None for uri in uris):
            continue
        found = str(_recognised(recording, index).get("found_as", ""))
        if agent.kind == "robot":
            posed = _robot(recording, index, bodies, uris, found)
        else:
            posed = _person(recording, index, bodies[0], rigs.get(bodies[0].name), found)
        if posed is None:
            continue
        agents[index], more = posed
        columns |= {f"agent_{index}.{name}": column for name, column in more.items()}
        replaced.add(index)
        for uri in uris:
            missing[uri] = missing.get(uri, 0) + 1
    if not replaced:
        return recording, {}
    kept = [body for body in recording.bodies if body.agent not in replaced]
    # bodies that are replaced leave gaps in the tracks, which have to be consecutive
    tracks = [body.moving for body in kept if body.moving >= 0]
    if "object_pose" in columns:
        columns["object_pose"] = columns["object_pose"][:, tracks]
    if not tracks:
        columns.pop("object_pose", None)
    bodies = [replace(b, moving=tracks.index(b.moving)) if b.moving >= 0 else b for b in kept]
    return replace(recording, agents=tuple(agents), bodies=tuple(bodies), columns=columns), missing


_Posed = tuple[Agent, dict[str, NDArray[Any]]]


def _recognised(recording: Recording, index: int) -> Mapping[str, Any]:
    """Return how the reader of a gfx-replay recognised an agent."""
    records = recording.episode.info.get("agents", ())
    record = records[index] if isinstance(records, Sequence) and index < len(records) else {}
    return record if isinstance(record, Mapping) else {}


def _poses_of(recording: Recording, body: Body) -> NDArray[np.float64]:
    """Return pose7 of a body at every step, shape [T, 7]; NaN where it was absent."""
    if body.moving >= 0:
        return recording.columns["object_pose"][:, body.moving].astype(np.float64)
    return np.broadcast_to(body.pose.astype(np.float64), (len(recording), 7))


# --- robots -----------------------------------------------------------------------------------------------------------
def _robot(recording: Recording, index: int, bodies: Sequence[Body], uris: Sequence[str], found: str) -> _Posed | None:
    name = found if found in robot_names() else next((m for key, m in MODELS.items() if key in found.lower()), None)
    if name is None:
        return None
    robot = load_robot(name)
    table = _SPOT_LINKS if name != found and name == "quad_arm" else {link: link for link in robot.link_names}
    links: dict[int, Array] = {
        robot.link_index(table[stem]): _poses_of(recording, body)
        for body, stem in zip(bodies, (PurePosixPath(uri).stem for uri in uris), strict=True)
        if stem in table
    }
    if table is _SPOT_LINKS and {robot.link_index("arm_hand"), robot.link_index("gripper_jaw")} <= links.keys():
        hand, jaw = links[robot.link_index("arm_hand")], robot.link_index("gripper_jaw")
        turned = pose_multiply(pose_inverse(hand), links[jaw])  # Spot's jaw opens upwards, ours downwards
        links[jaw] = pose_multiply(hand, pose_inverse(turned))
    joints = joints_of_links(robot, links, len(recording))
    agent = replace(recording.agents[index], model=f"robot/{name}", joint_names=tuple(robot.joint_names))
    return agent, {"joint_pos": joints.astype(np.float32)}


def joints_of_links(robot: Robot, links: Mapping[int, Array], steps: int) -> Array:
    """Return the joint positions [T, J] of links with poses ``links`` (pose7 in the world [T, 7] by link).

    Joints with a link on only one side, and all where a link is absent (NaN), have their resting position.
    """
    joints = np.tile(robot.rest, (steps, 1))
    for link in robot.joint_links:
        parent = robot.links[link].parent
        if link not in links or parent not in links or robot.kinds[link] not in (1, 2):
            continue
        child = pose_multiply(pose_inverse(links[parent]), links[link])
        origin = robot.origins[link]
        turn = quat_conjugate(quat_from_matrix(origin[:3, :3]))
        if robot.kinds[link] == 1:
            turned = quat_multiply(turn, child[:, 3:])
            # twice the angle whose tangent is the quaternion's part along the axis over w
            value = 2 * np.arctan2(turned[:, :3] @ robot.axes[link], turned[:, 3])
            value = (value + np.pi) % (2 * np.pi) - np.pi
        else:
            value = quat_rotate(turn, child[:, :3] - origin[:3, 3]) @ robot.axes[link]
        column, gain = robot.columns[link], robot.gains[link]
        value = (value - robot.offsets[link]) / (gain or 1.0)
        # angles are known up to whole turns: the one nearest to the limits is meant
        if robot.kinds[link] == 1 and np.nanmedian(value) < robot.lower[column] - np.pi / 2:
            value = value + 2 * np.pi
        elif robot.kinds[link] == 1 and np.nanmedian(value) > robot.upper[column] + np.pi / 2:
            value = value - 2 * np.pi
        joints[:, column] = np.where(np.isfinite(value), value, robot.rest[column])
    return np.clip(joints, robot.lower, robot.upper)


# --- people -----------------------------------------------------------------------------------------------------------
def _person(recording: Recording, index: int, body: Body, rig: Mapping[str, Any] | None, found: str) -> _Posed | None:
    agent = recording.agents[index]
    base = recording.columns[f"agent_{index}.base_pose"].astype(np.float64)
    bones = None if rig is None else recording.columns.get(f"rig.{rig['id']}")
    posture = None if rig is None or bones is None else posture_of_bones(rig["bones"], bones.astype(np.float64))
    if posture is None:
        human = load_humanoid(found if found in humanoid_names() else SYNTHETIC_BODY)
        robots = [
            recording.columns[f"agent_{k}.base_pose"][:, 1].astype(np.float64)
            for k, other in enumerate(recording.agents)
            if other.kind == "robot" and f"agent_{k}.base_pose" in recording.columns
        ]
        base[:, 1] = floor_below(_poses_of(recording, body)[:, 1], robots[0] if robots else None)
        columns: dict[str, NDArray[Any]] = {"base_pose": base.astype(np.float32)}
        columns |= walk_columns(human, base, recording.columns["time_ns"])
        return replace(agent, model=f"humanoid/{human.name}", motion_names=human.motion_names), columns
    root, joints = posture
    name = found if found in humanoid_names() else fitting_body(root, joints, base[:, 1])
    columns = {"root_pose": root.astype(np.float32), "joint_quat": joints.astype(np.float32)}
    return replace(agent, model=f"humanoid/{name}"), columns


def posture_of_bones(names: Sequence[str], bones: NDArray[np.float64]) -> tuple[Array, Array] | None:
    """Return the pose of a person from world poses of bones [T, B, 7].

    Returns the pelvis [T, 7] and the local rotations of the other 54 joints [T, 54, 4]; None if the bones do not have
    the names of SMPL-X. Fingers and faces without bones are straight.
    """
    at = {str(name).lower(): k for k, name in enumerate(names)}
    known = [joint for joint in JOINT_NAMES[:22] if joint in at]
    if "pelvis" not in at or len(known) < LEAST_BONES or len(names) > bones.shape[1]:
        return None
    turns = np.zeros((len(bones), len(JOINT_NAMES), 4))
    local = np.zeros_like(turns)
    for joint, (name, parent) in enumerate(zip(JOINT_NAMES, PARENTS, strict=True)):
        # a joint without a bone keeps straight: it turns as its parent does
        above = turns[:, parent] if joint else np.tile([0.0, 0.0, 0.0, 1.0], (len(bones), 1))
        turns[:, joint] = bones[:, at[name], 3:] if name in at else above
        local[:, joint] = quat_multiply(quat_conjugate(above), turns[:, joint])
    return bones[:, at["pelvis"]], quat_sign_continuous(local[:, 1:])


# --- boxes ------------------------------------------------------------------------------------------------------------
@lru_cache(maxsize=512)
def named_box(uri: str) -> Mesh:
    """Return a plain box with the name of a missing file on its sides, instead of the striped one of `placeholder_mesh`."""
    kind = placeholder_kind(uri)
    low, high = placeholder_mesh(uri).bounds.astype(np.float64)
    color = BOX_COLORS[kind]
    box = box_mesh((high - low) / 2, center=(low + high) / 2, color=color)
    if kind not in ("small_object", "furniture"):
        return box
    corners = box.vertices[box.faces].reshape(-1, 3)
    normals = np.cross(corners[1::3] - corners[::3], corners[2::3] - corners[::3])
    outward = np.repeat(normals / np.linalg.norm(normals, axis=1, keepdims=True), 3, axis=0)
    upward = np.abs(outward[:, 1:2]) > 0.5
    down = np.where(upward, [0.0, 0.0, 1.0], [0.0, -1.0, 0.0])  # as somebody sees it who looks along -outward
    right = np.cross(outward, down)
    share = (corners - (low + high) / 2) / (high - low)
    uv = np.stack([(share * right).sum(1), (share * down).sum(1)], axis=1) + 0.5
    return Mesh(
        vertices=corners.astype(np.float32),
        faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
        colors=np.full(corners.shape, 255, np.uint8),
        uv=uv.astype(np.float32),
        textures=(_plate(readable_name(uri), color),),
    )


def readable_name(uri: str) -> str:
    """Return the name in words of an object from its recorded path, such as ``cracker box``.

    That is the name for ``ycb/003_cracker_box/google_16k/textured.obj``. If the file is named by a number or a digest,
    it is the object's kind.
    """
    path = PurePosixPath(uri.removeprefix("handle:"))
    # from the file outwards: many objects are called textured.obj, and their folder has the name
    for part in (path.name.split(".")[0], *reversed(path.parent.parts)):
        name = re.sub(r"_?:\d+$", "", part)
        if not _GENERIC.fullmatch(name):
            break
    else:
        name = ""
    if _HASH.fullmatch(name) or not name:
        return "door or window" if "/openings/" in uri else placeholder_kind(uri).replace("_", " ")
    plain = re.sub(r"^\d+_(?=\D)|(_model)?(_\d+)?$", "", name)
    return re.sub(r"[\s_\-]+", " ", plain).strip()[:LONGEST_NAME]


def _plate(text: str, color: Sequence[int]) -> Texture:
    """Return the words of a text, one below the other, on a square of ``color``."""
    import cv2

    image = np.full((TEXTURE_PX, TEXTURE_PX, 3), color, np.uint8)
    cv2.rectangle(image, (0, 0), (TEXTURE_PX - 1, TEXTURE_PX - 1), tuple(int(0.7 * c) for c in color), 3)
    words, font = text.split() or [""], cv2.FONT_HERSHEY_SIMPLEX
    widest = max(cv2.getTextSize(word, font, 1.0, 2)[0][0] for word in words)
    scale = min(1.0, 0.85 * TEXTURE_PX / max(widest, 1), 0.85 * TEXTURE_PX / (34 * len(words)))
    for line, word in enumerate(words):
        (width, height), _ = cv2.getTextSize(word, font, scale, 2)
        middle = TEXTURE_PX / 2 + (line - (len(words) - 1) / 2) * 34 * scale
        place = (round((TEXTURE_PX - width) / 2), round(middle + height / 2))
        cv2.putText(image, word, place, font, scale, (30, 30, 30), 2, cv2.LINE_AA)
    opaque = np.full((TEXTURE_PX, TEXTURE_PX, 1), 255, np.uint8)
    return Texture(pixels=np.concatenate([image, opaque], axis=2), name=text)
