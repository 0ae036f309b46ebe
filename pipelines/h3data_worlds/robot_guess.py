"""Guessed settings of a robot from its URDF, as a first ``robot.toml`` to edit or as defaults without one.

Base, height and resting posture are guessed from geometry; hand and cameras are guessed by name.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.robots.robot import Robot
from h3data.bodies.robots.robot_settings import CameraSettings, RobotSettings
from h3data.geometry import IDENTITY_POSE, Array, normalized
from h3data.scene.records import Shape
from h3data_worlds.robot_posture import compact_posture
from h3data_worlds.shape_points import shape_points

HANDS = (r"gripper|hand|palm", r"tool|tcp|eef?\b|end_?effector|grasp")
"""Patterns of names of links that grasp, the most specific first."""
NOT_HANDS = r"finger|thumb|jaw|knuckle|pad|tip\b|camera|optical|wheel|leg|foot|toe|head|caster"
EYES = r"camera|optical|rgb|eye|head"
MOST_LINKS = 300
"""Number of links above which a file does not count as a robot (humanoids have about 60)."""
LEAST_ARM_JOINTS = 4
"""Number of joints below which a chain without a hand's name is a leg, a head or a wheel."""
BASE_TOP_M = 0.35
"""Height below which the lowest point of a part must lie to belong to the base's footprint [m]."""
TIGHT = 1.25
"""Multiple of half the base's width at which the discs of a row are small enough; more discs would hardly be smaller."""
MOST_SEGMENTS = 10_000
"""Largest number of pieces into which the outline of a base is cut, such as that of a ground plane."""
DISCS = 5
LEAST_RADIUS_M = 0.1
WIDEST_M = 0.36
"""Largest radius to which discs are widened to cover a folded arm next to the base [m]; larger ones do not fit doors of
0.8 m."""
HAND_CAMERA_UP_M, HAND_CAMERA_BACK_M, HAND_CAMERA_AIM_M = 0.06, 0.08, 0.25
"""Place of the camera of a hand above the hand's shapes and behind its load, and the distance of the point that it looks at."""
SHELLS = 4
"""Largest number of nested shapes out of which a camera is moved."""
LENS_M = 0.01
SNAP = 0.9
"""Cosine between a direction and an axis of its link above which the axis is used instead (26 degrees)."""


class Hand(NamedTuple):
    """Grasp point and directions of a robot's hand, in the frame of a link."""

    link: int
    position: Array
    forward: Array
    up: Array


def guess_settings(robot: Robot, sure: Collection[str], *, fold: bool = True) -> RobotSettings:
    """Return guessed settings for a robot without a settings file.

    Args:
        robot: Robot loaded without settings, with its base frame on the floor.
        sure: Names of the links whose shapes are real ones, not stand-ins.
        fold: True folds the arm over the base; False keeps the posture in which the robot was loaded.
    """
    if len(robot.links) > MOST_LINKS:
        return RobotSettings()
    hand = guess_hand(robot)
    zeros = robot.rest  # of default settings: 0, or the nearest limit
    arm = _moved_by(robot, hand) if hand is not None else set()
    body = [k for k in range(len(robot.links)) if k not in arm]
    height = _base_height(robot, zeros, [k for k in body if robot.links[k].name in sure])
    discs, radius = guess_base(robot, zeros, body, height)
    rest = (
        zeros
        if hand is None or not fold
        else compact_posture(robot, hand.link, body, zeros, float(max(map(abs, discs)) + radius))
    )
    frames = robot.link_matrices(IDENTITY_POSE[None], zeros[None])[0]
    resting = robot.link_matrices(IDENTITY_POSE[None], np.asarray(rest, np.float64)[None])[0]
    radius = _wide_enough(robot, discs, radius, resting)
    tops = [_points(robot, k, frames)[:, 1].max() for k in body if robot.links[k].shapes]
    return RobotSettings(
        base_height_m=round(float(height), 4),
        body_height_m=round(float(max([top + height for top in tops], default=0.5)), 3),
        base_discs_m=tuple(round(float(x), 3) for x in discs),
        base_radius_m=float(radius),
        rest=tuple(round(float(q), 3) for q in rest),
        hand_link="" if hand is None else robot.links[hand.link].name,
        hand_position=(0.0, 0.0, 0.0) if hand is None else _vector(hand.position),
        hand_forward=(1.0, 0.0, 0.0) if hand is None else _vector(hand.forward),
        hand_up=(0.0, 0.0, 1.0) if hand is None else _vector(hand.up),
        cameras=tuple(_cameras(robot, hand, frames, resting)),
    )


# --- base -------------------------------------------------------------------------------------------------------------
def _base_height(robot: Robot, joints: Array, sure: Sequence[int]) -> float:
    """Return the height of the base frame above the lowest point of some links [m]; 0 if none is below it."""
    frames = robot.link_matrices(IDENTITY_POSE[None], joints[None])[0]
    lowest = [_points(robot, k, frames)[:, 1].min() for k in sure if robot.links[k].shapes]
    return max(-min(lowest, default=0.0), 0.0)


def guess_base(robot: Robot, joints: Array, body: Sequence[int], height: float) -> tuple[list[float], float]:
    """Return a row of discs that covers the low parts of the body: positions along x [D] [m] and their radius [m]."""
    frames = robot.link_matrices(IDENTITY_POSE[None], joints[None])[0]
    parts = [_points(robot, k, frames) for k in body if robot.links[k].shapes]
    low = [part[:, [0, 2]] for part in parts if part[:, 1].min() + height < BASE_TOP_M]
    if not low:
        return [0.0], LEAST_RADIUS_M
    import shapely

    hull = shapely.MultiPoint(np.concatenate(low)).convex_hull.boundary
    outline = np.array(shapely.segmentize(hull, max(0.02, hull.length / MOST_SEGMENTS)).coords)
    if len(outline) < 3:
        return [0.0], LEAST_RADIUS_M
    back, front = outline[:, 0].min(), outline[:, 0].max()
    half_width = np.abs(outline[:, 1]).max()
    rows = []
    for count in range(1, DISCS + 1):
        places = back + (np.arange(count) + 0.5) * (front - back) / count
        rows.append((places.tolist(), row_radius(places, outline)))
        if rows[-1][1] <= TIGHT * half_width:
            break
    places, radius = min(rows, key=lambda row: row[1])
    return places, max(float(np.ceil(1000 * radius - 1e-6) / 1000), LEAST_RADIUS_M)


def _wide_enough(robot: Robot, places: Sequence[float], radius: float, resting: Array) -> float:
    """Return the radius [m] with which discs at places [D] cover the whole resting robot, arm and all, up to `WIDEST_M`."""
    shown = [k for k, link in enumerate(robot.links) if link.shapes]
    if not shown or radius >= WIDEST_M:
        return radius
    points = np.concatenate([_points(robot, k, resting)[:, [0, 2]] for k in shown])
    covers = float(np.ceil(1000 * row_radius(np.asarray(places), points) - 1e-6) / 1000)
    return min(max(radius, covers), WIDEST_M)


# --- hand -------------------------------------------------------------------------------------------------------------
def guess_hand(robot: Robot) -> Hand | None:
    """Return the hand at the end of the longest chain of joints; None if there is none.

    Links that are named like a hand come first, then any link after at least `LEAST_ARM_JOINTS` joints.
    """
    chains = [_chain(robot, k) for k in range(len(robot.links))]
    joints = [len({int(robot.columns[k]) for k in chain if robot.kinds[k] in (1, 2)}) for chain in chains]
    names = [link.name.lower() for link in robot.links]
    eligible = [k for k, name in enumerate(names) if joints[k] and not re.search(NOT_HANDS, name)]
    for pattern in HANDS:
        named = [k for k in eligible if re.search(pattern, names[k])]
        if named:
            # of links that move as one, the last is where things are held: a tool centre point behind the palm
            most = max(joints[k] for k in named)
            return _grasp(
                robot, max((k for k in named if joints[k] == most), key=lambda k: (len(chains[k]), -k)), chains
            )
    longest = max(eligible, key=lambda k: (joints[k], -len(chains[k]), -k), default=-1)
    return _grasp(robot, longest, chains) if longest >= 0 and joints[longest] >= LEAST_ARM_JOINTS else None


def _grasp(robot: Robot, link: int, chains: list[list[int]]) -> Hand:
    """Return where a hand holds things (between its fingers, else at the far end of its shapes) and its direction."""
    frames = robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0]
    to_hand = np.linalg.inv(frames[link])
    fingers = [
        k for k, chain in enumerate(chains) if link in chain[:-1] and robot.kinds[k] in (1, 2) and robot.links[k].shapes
    ]
    position = np.zeros(3)
    is_point = re.search(HANDS[1], robot.links[link].name.lower()) is not None
    if fingers and not is_point:
        middles = [_middle(_points(robot, k, frames)) for k in fingers]
        position = (to_hand @ np.append(np.mean(middles, axis=0), 1.0))[:3]
    # from the last joint, or the one before it if that is at the same place, to there
    tip = frames[link] @ np.append(position, 1.0)
    away = next(
        (
            tip[:3] - frames[k][:3, 3]
            for k in reversed(chains[link])
            if np.linalg.norm(tip[:3] - frames[k][:3, 3]) > 0.03
        ),
        frames[link][:3, 0],
    )
    forward = _snapped(to_hand[:3, :3] @ away)
    if not fingers and not is_point and robot.links[link].shapes:
        points = _points(robot, link, frames) @ to_hand[:3, :3].T + to_hand[:3, 3]
        position = forward * float((points @ forward).max())
    opens = next((to_hand[:3, :3] @ frames[k][:3, :3] @ robot.axes[k] for k in fingers if robot.kinds[k] == 2), None)
    up = np.eye(3)[2] if opens is None else np.cross(forward, _snapped(opens))
    if np.linalg.norm(np.cross(forward, up)) < 0.1:
        up = np.eye(3)[0]
    return Hand(link, np.round(position, 4), forward, _snapped(up - forward * (up @ forward)))


def _snapped(direction: Array) -> Array:
    """Return a unit vector; an axis if it is nearly one."""
    unit = normalized(np.asarray(direction, np.float64))
    axis = int(np.abs(unit).argmax())
    return np.sign(unit[axis]) * np.eye(3)[axis] if abs(unit[axis]) > SNAP else unit


# --- cameras ----------------------------------------------------------------------------------------------------------
def _cameras(robot: Robot, hand: Hand | None, frames: Array, resting: Array) -> list[CameraSettings]:
    """Return one on the hand, and one where the robot's own camera is: an optical frame, else a camera, else its head."""
    cameras = []
    if hand is not None:
        eye, view = _over_the_hand(robot, hand)
        cameras.append(_camera("robot_arm", robot, hand.link, view, hand.up, (224, 171), eye))
    named = [k for k, link in enumerate(robot.links) if re.search(EYES, link.name.lower())]
    ranks = ("rgb_optical|color_optical", "optical", "rgb|color", "camera|eye", "head")
    eyes = [k for rank in ranks for k in named if re.search(rank, robot.links[k].name.lower())]
    if eyes:
        optical = "optical" in robot.links[eyes[0]].name.lower()  # ROS: z ahead, y down
        forward, up = (np.eye(3)[2], -np.eye(3)[1]) if optical else _level(frames[eyes[0]])
        eye = forward * _free_ahead(robot, resting, eyes[0], forward)
        cameras.append(_camera("robot_head", robot, eyes[0], forward, up, (480, 640), eye))
    return cameras


def _free_ahead(robot: Robot, frames: Array, link: int, forward: Array) -> float:
    """Return the distance ahead of a link's origin beyond which no part of the robot is in front of a camera [m].

    With boxes instead of meshes, a robot's own camera is often inside its head.
    """
    eye, ahead, moved = frames[link][:3, 3], frames[link][:3, :3] @ forward, 0.0
    for _ in range(SHELLS):
        exits = []
        for number, other in enumerate(robot.links):
            turn, origin = frames[number][:3, :3], frames[number][:3, 3]
            at, way = turn.T @ (eye + moved * ahead - origin), turn.T @ ahead
            seen = [] if other.mesh is None else [np.asarray(other.mesh.vertices, np.float64)]
            for points in (*seen, *map(shape_points, other.shapes)):
                low, high = points.min(0), points.max(0)
                if ((at > low) & (at < high)).all():
                    with np.errstate(divide="ignore"):
                        exits.append(float((np.where(way > 0, high - at, low - at) / way)[way != 0].min()))
        if not exits:
            return moved
        moved += max(exits) + LENS_M
    return moved


def _over_the_hand(robot: Robot, hand: Hand) -> tuple[Array, Array]:
    """Return the position and viewing direction of a camera above a hand, in its link's frame.

    Between the fingers, where things are held, it would see nothing but these.
    """
    shapes = robot.links[hand.link].shapes
    tops = [float((shape_points(shape) @ hand.up).max() - hand.position @ hand.up) for shape in shapes]
    eye = hand.position + hand.up * (max([*tops, 0.0]) + HAND_CAMERA_UP_M) - hand.forward * HAND_CAMERA_BACK_M
    return eye, normalized(hand.position + hand.forward * HAND_CAMERA_AIM_M - eye)


def _level(frame: Array) -> tuple[Array, Array]:
    """Return the robot's forward and upward directions in the frame of a link."""
    return frame[:3, :3].T @ np.array([1.0, 0, 0]), frame[:3, :3].T @ np.array([0, 1.0, 0])


def _camera(
    name: str, robot: Robot, link: int, forward: Array, up: Array, size: tuple[int, int], position: Array | None = None
) -> CameraSettings:
    at = np.zeros(3) if position is None else position
    return CameraSettings(
        name=name,
        link=robot.links[link].name,
        position=_vector(at),
        forward=_vector(forward),
        up=_vector(up),
        width=size[0],
        height=size[1],
        hfov_deg=55.0,
    )


# --- links ------------------------------------------------------------------------------------------------------------
def _chain(robot: Robot, link: int) -> list[int]:
    """Return the links from the base to a link."""
    chain = []
    while link >= 0:
        chain.append(link)
        link = robot.links[link].parent
    return chain[::-1]


def _moved_by(robot: Robot, hand: Hand) -> set[int]:
    """Return links that move with the first turning joint of the arm and all below; a lift belongs to the body."""
    turning = next((k for k in _chain(robot, hand.link) if robot.kinds[k] == 1), hand.link)
    moved: set[int] = set()
    for k, link in enumerate(robot.links):
        if k == turning or link.parent in moved:
            moved.add(k)
    return moved


def _points(robot: Robot, link: int, frames: NDArray) -> NDArray[np.float64]:
    """Return points [N, 3] around the shapes of a link in the root frame."""
    shapes: tuple[Shape, ...] = robot.links[link].shapes
    points = np.concatenate([shape_points(shape) for shape in shapes])
    return points @ frames[link][:3, :3].T + frames[link][:3, 3]


def _middle(points: Array) -> Array:
    return (points.min(0) + points.max(0)) / 2


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 4) + 0.0 for v in values)
    return x, y, z


def row_radius(places: Array, points: Array) -> float:
    """Return the smallest radius [m] of discs at positions [D] [m] along x that cover floor points ``(x, z)`` [N, 2] [m]."""
    return float(np.hypot(points[:, None, 0] - places, points[:, None, 1]).min(1).max())
