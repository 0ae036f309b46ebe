"""Joints of Habitat's articulated objects, as articulated things of a `Scene`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, pose_from_matrix, transform_points
from h3data.scene.records import Articulation, Asset, Instance, Joint, Part, instance_matrix

if TYPE_CHECKING:
    from h3data.bodies import Robot

_TURNS, _SLIDES = 1, 2
_BESIDE_M, _OVER_M = 0.02, 0.1
"""Distance beside a door within which things count as behind it; twice the height up to which things lie on a surface."""


def articulation_of(
    name: str,
    robot: Robot,
    frames: NDArray[np.float64],
    positions: NDArray[np.float64],
    instances: Mapping[str, Instance],
    assets: Mapping[str, Asset],
) -> tuple[Articulation | None, list[str]]:
    """Return the moving parts of an articulated object, one for each joint that turns or slides, and warnings.

    The result is None if nothing moves.

    Joints without a range, spherical joints and joints that mimic others do not move. What a closed drawer contains is
    out of reach, and so is what lies behind a closed door.

    Args:
        name: Name of the object.
        robot: Its tree.
        frames: World matrices of its links, [L, 4, 4].
        positions: Joint positions at which the links have these matrices, [J].
        instances: Instances by the name of their link, of the links that are seen or collide.
        assets: Assets of these instances.
    """
    root = frames[0].copy()
    back = np.linalg.inv(root)
    leads = set(robot.joint_links.tolist())
    joints: dict[int, Joint] = {}
    warnings: list[str] = []
    for k, link in enumerate(robot.links):
        # balls have no single position, and followers none of their own
        if robot.kinds[k] not in (_TURNS, _SLIDES) or k not in leads:
            continue
        column = int(robot.columns[k])
        position, lower, upper = float(positions[column]), float(robot.lower[column]), float(robot.upper[column])
        # continuous joints have no limits: half a turn to either side is all that can be told apart
        if robot.kinds[k] == _TURNS:
            lower, upper = max(lower, -np.pi), min(upper, np.pi)
        if not np.isfinite((lower, upper)).all() or lower >= upper:
            warnings.append(
                f"{link.name!r} of {name!r} does not move: the limits of its joint are {lower:g} and {upper:g}"
            )
            continue
        frame = back @ frames[k]
        joints[k] = Joint(
            kind="revolute" if robot.kinds[k] == _TURNS else "prismatic",
            axis=frame[:3, :3] @ robot.axes[k],
            origin=frame[:3, 3],
            # the file may put a joint beyond its own limits, where it has to stay
            lower=min(lower, position),
            upper=max(upper, position),
            rest=position,
        )
    if not joints:
        return None, warnings
    mover = _movers(robot, joints)
    moved: dict[int, list[Instance]] = {k: [] for k in joints}
    still = ""
    for k, link in enumerate(robot.links):
        if (instance := instances.get(link.name)) is None:
            continue
        if mover[k] in moved:
            moved[mover[k]].append(instance)
        else:
            still = still or instance.name
    everything = list(instances.values())
    body = _box(everything, assets, back)
    parts = []
    for k, joint in joints.items():
        above = mover[robot.links[k].parent]
        parts.append(
            Part(
                name=robot.links[k].name,
                joint=joint,
                instances=tuple(i.name for i in moved[k]),
                parent=robot.links[above].name if above >= 0 else "",
                encloses=_enclosed(joint, moved[k], everything, assets, back, body),
            )
        )
    return Articulation(
        name=name, pose=np.asarray(pose_from_matrix(root), np.float64), parts=tuple(parts), base=still
    ), warnings


def _movers(robot: Robot, joints: Mapping[int, Joint]) -> list[int]:
    """Return the link with a joint that moves each link, itself or the nearest above it; -1: none."""
    mover: list[int] = []
    for k, link in enumerate(robot.links):  # parents come first
        mover.append(k if k in joints else mover[link.parent] if link.parent >= 0 else -1)
    return mover


def _enclosed(
    joint: Joint,
    own: Sequence[Instance],
    everything: Sequence[Instance],
    assets: Mapping[str, Asset],
    back: Array,
    body: Array,
) -> tuple[str, ...]:
    """Return receptacles that a part shuts off: those of a drawer itself, and those behind a door."""
    if joint.kind == "prismatic":
        return tuple(f"{i.name}|{r.name}" for i in own for r in assets[i.asset].receptacles)
    if joint.rest != joint.closed or not own:  # an open door does not say what is behind it
        return ()
    names, low, high = {i.name for i in own}, *_box(own, assets, back)
    # a door is thin along one axis, and what lies behind it is along that axis
    thin = int(np.argmin(high - low))
    low, high = low - _BESIDE_M, high + _BESIDE_M
    low[thin], high[thin] = body[0, thin], body[1, thin]
    found = []
    for instance in everything:
        for receptacle in assets[instance.asset].receptacles if instance.name not in names else ():
            # a little above the surface, where things would lie
            over = receptacle.center + np.array([0.0, min(receptacle.clearance_m, _OVER_M) / 2, 0.0])
            place = transform_points(back @ instance_matrix(instance), over[None])[0]
            if (place >= low).all() and (place <= high).all():
                found.append(f"{instance.name}|{receptacle.name}")
    return tuple(found)


def _box(instances: Sequence[Instance], assets: Mapping[str, Asset], back: Array) -> NDArray[np.float64]:
    """Return bounds of the visible part of instances in the frame of the thing, [2, 3]; at its origin if none is."""
    points = [
        transform_points(back @ instance_matrix(i), assets[i.asset].mesh.vertices.astype(np.float64))
        for i in instances
        if len(assets[i.asset].mesh.vertices)
    ]
    every = np.concatenate(points) if points else np.zeros((1, 3))
    return np.stack([every.min(0), every.max(0)])
