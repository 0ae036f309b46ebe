"""Boxes that replace missing meshes of a robot, so that a URDF alone can be simulated and rendered.

A link's own collision shapes stand in for its visuals and the other way round. A link that has neither gets a box from
its origin to the joints of its children, at least as large as the box with its mass and moments of inertia.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from h3data.bodies.robots.urdf import Urdf, UrdfLink, UrdfPart, missing_meshes
from h3data.bodies.robots.urdf_parts import UrdfGeometry


def with_stand_ins(urdf: Urdf) -> tuple[Urdf, frozenset[str]]:
    """Replace missing meshes of a URDF by boxes; return it with the names of the links that needed no replacement.

    A warning names the missing files. If no link has collision shapes, the visual shapes replace them.
    """
    missing = missing_meshes(urdf.links)
    if missing:
        named = ", ".join(str(path) for path in missing[:3]) + (", ..." if len(missing) > 3 else "")
        logging.getLogger(__name__).warning(
            "%s: boxes stand in for %d missing mesh file(s) (%s). Hint: keep the folder of the URDF whole. File: %s",
            *(urdf.name, len(missing), named, urdf.path),
        )
    there = [
        tuple(tuple(p for p in parts if p.geometry.file not in missing) for parts in (link.visuals, link.collisions))
        for link in urdf.links
    ]
    # where no link has any, what is seen is also what touches
    has_collisions = any(link.collisions for link in urdf.links)
    links = []
    for link, (visuals, collisions) in zip(urdf.links, there, strict=True):
        box = (_box(urdf, link),) if link.visuals or link.collisions else ()
        # a link whose files are all there stays as it is, also without any: frames have no shape
        shown = visuals if len(visuals) == len(link.visuals) else visuals or collisions or box
        solid = collisions if len(collisions) == len(link.collisions) else collisions or visuals or box
        links.append(replace(link, visuals=shown, collisions=solid if has_collisions else shown))
    sure = frozenset(link.name for link, (_, solid) in zip(urdf.links, there, strict=True) if solid == link.collisions)
    return replace(urdf, links=tuple(links)), sure


def _box(urdf: Urdf, link: UrdfLink) -> UrdfPart:
    ends = [joint.origin[:3, 3] for joint in urdf.joints if joint.parent == link.name]
    # distance of a joint beyond which a child is a sensor or a frame on the floor rather than the end of the
    # link [m]
    reach_m = 0.6
    points = [np.zeros(3), *(end for end in ends if np.linalg.norm(end) <= reach_m)]
    # limited, since moments that somebody made up may mean a box of many metres
    if link.inertia_box is not None:
        corners = np.array(np.meshgrid(*[(-half, half) for half in np.minimum(link.inertia_box, reach_m)])).reshape(
            3, -1
        )
        points += list((link.inertial[:3, :3] @ corners).T + link.inertial[:3, 3])
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    # 0.04: least side of a box
    spare = np.maximum(0.04 - (high - low), 0.0) / 2
    low, high = low - spare, high + spare
    origin = np.eye(4)
    origin[:3, 3] = (low + high) / 2
    x, y, z = (high - low).tolist()
    # the first colour of the visuals that are missing, so that the robot keeps its look
    color = next((part.color for part in link.visuals if part.color is not None), None)
    return UrdfPart(geometry=UrdfGeometry(kind="box", size=(x, y, z)), origin=origin, color=color)
