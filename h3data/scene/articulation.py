"""Poses of the moving parts of a scene at any joint positions: doors, drawers and the objects in them.

Joints are numbered in the order of articulated objects and their parts. The motion of a part is a product of
exponentials: each joint between the body of the object and the part rotates or shifts all parts behind it about or
along its axis at rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import Array, pose_from_matrix, pose_to_matrix, transform_points
from h3data.scene.records import Articulation, Asset, Instance, Part, Scene, instance_bounds, instance_matrix

AJAR = 0.6
"""Share of a joint's range above which its part counts as open, so that a hand can reach in."""

ON_M, STACK_M = 0.02, 0.1
"""Largest distances next to or below a receptacle, and above it, at which an object counts as lying on it [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneJoints:
    """All joints of a scene as arrays."""

    names: tuple[str, ...]
    """Names of the joints as ``thing/part``, [J]."""
    parts: tuple[tuple[Articulation, Part], ...]
    """Object and moving part of each joint."""
    closed: NDArray[np.float64]
    """Positions of the joints when closed [J] [rad or m]."""
    opened: NDArray[np.float64]
    rest: NDArray[np.float64]
    owner: Mapping[str, int]
    """Number of the joint that moves an instance, by its name."""
    enclosing: Mapping[str, tuple[int, ...]]
    """Joints that must all be open to reach a receptacle, by its name ``instance|receptacle``."""

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Return the number of a joint.

        Raises:
            InputError: no joint has this name.
        """
        # the first few names only: a home may have very many drawers
        if name not in self.names:
            some = f"It has: {', '.join(self.names[:12])}." if self.names else "Nothing in it opens."
            raise InputError(f"The scene has no joint {name!r}. {some}", code="H3-SCENE-002")
        return self.names.index(name)

    def shares(self, positions: ArrayLike) -> NDArray[np.float64]:
        """Return how far joints at ``positions`` [..., J] are open, 0..1."""
        return (np.asarray(positions, np.float64) - self.closed) / (self.opened - self.closed)

    def is_open(self, positions: ArrayLike) -> NDArray[np.bool_]:
        """Return which joints at ``positions`` [..., J] are open enough for a hand, bool [..., J]."""
        return self.shares(positions) >= AJAR

    def motions(self, positions: ArrayLike) -> NDArray[np.float64]:
        """Return the world matrices [..., J, 4, 4] by which each joint moves its part at joint ``positions`` [..., J].

        The matrices map points from their positions in the scene.
        """
        positions = np.asarray(positions, np.float64)
        out = np.empty((*positions.shape, 4, 4))
        first = 0
        # thing by thing, because each has a frame of its own; parents come before their parts (`Articulation.parts`)
        for thing in dict.fromkeys(thing for thing, _ in self.parts):
            frame = pose_to_matrix(np.asarray(thing.pose, np.float64))
            back = np.linalg.inv(frame)
            local: dict[str, Array] = {}
            for k, part in enumerate(thing.parts, first):
                own = _displacement(part, positions[..., k] - part.joint.rest)
                local[part.name] = local[part.parent] @ own if part.parent else own
                # what stays is left as it is, to the bit
                stays = (local[part.name] == np.eye(4)).all((-1, -2), keepdims=True)
                out[..., k, :, :] = np.where(stays, np.eye(4), frame @ local[part.name] @ back)
            first += len(thing.parts)
        return out


def _displacement(part: Part, by: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return matrices [..., 4, 4] in the frame of the thing, of a joint that has moved ``by`` [...] from its rest position."""
    joint = part.joint
    # an identity for each, filled in by hand because ``np.eye`` makes one only
    out = np.zeros((*by.shape, 4, 4))
    out[..., [0, 1, 2, 3], [0, 1, 2, 3]] = 1.0
    if joint.kind == "prismatic":
        out[..., :3, 3] = by[..., None] * joint.axis
        return out
    x, y, z = joint.axis
    # Rodrigues' formula; the axis is a unit vector (`Joint`)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sin, cos = np.sin(by)[..., None, None], np.cos(by)[..., None, None]
    turn = np.eye(3) + sin * cross + (1 - cos) * (cross @ cross)
    out[..., :3, :3] = turn
    out[..., :3, 3] = joint.origin - turn @ joint.origin
    return out


def joints_of(scene: Scene) -> SceneJoints:
    """Return the joints of a scene, collected once."""
    return _collected(scene) if scene.articulations else _NONE


@lru_cache(maxsize=64)
def _collected(scene: Scene) -> SceneJoints:
    parts = tuple((thing, part) for thing in scene.articulations for part in thing.parts)
    enclosing: dict[str, tuple[int, ...]] = {}
    for k, (_, part) in enumerate(parts):
        for receptacle in part.encloses:
            enclosing[receptacle] = (*enclosing.get(receptacle, ()), k)
    joints = [part.joint for _, part in parts]
    return SceneJoints(
        names=tuple(f"{thing.name}/{part.name}" for thing, part in parts),
        parts=parts,
        closed=np.array([joint.closed for joint in joints], np.float64),
        opened=np.array([joint.opened for joint in joints], np.float64),
        rest=np.array([joint.rest for joint in joints], np.float64),
        owner={name: k for k, (_, part) in enumerate(parts) for name in part.instances},
        enclosing=enclosing,
    )


_NONE = SceneJoints(
    names=(), parts=(), closed=np.zeros(0), opened=np.zeros(0), rest=np.zeros(0), owner={}, enclosing={}
)


def joint_names(scene: Scene) -> tuple[str, ...]:
    """Return the names ``thing/part`` of a scene's joints, in the order of their positions in recordings."""
    return joints_of(scene).names


def posed(scene: Scene, positions: ArrayLike | Mapping[str, float]) -> Scene:
    """Return the scene with its joints at other positions, with new poses of moving parts and new rest positions.

    Args:
        scene: The scene.
        positions: Positions of all joints [J] [rad or m], or positions by joint name; other joints stay at rest.

    Raises:
        InputError: the number of positions is wrong, a joint's name is unknown, or a position is not finite.
    """
    joints = joints_of(scene)
    wanted = joints.rest.copy()
    if isinstance(positions, Mapping):
        for name, value in positions.items():
            wanted[joints.index(name)] = value
    else:
        given = np.asarray(positions, np.float64)
        if given.shape != wanted.shape:
            raise InputError(
                f"Expected the positions of {len(wanted)} joints, got shape {list(given.shape)}.", code="H3-SCENE-003"
            )
        wanted = given
    if not np.isfinite(wanted).all():
        raise InputError("Positions of joints must be finite.", code="H3-SCENE-001")
    # the same object, so that what has been computed of the scene is found again
    if np.array_equal(wanted, joints.rest):
        return scene
    motions = joints.motions(wanted)
    moves = (motions != np.eye(4)).any((-1, -2)).tolist()
    owner = {name: k for name, k in joints.owner.items() if moves[k]}
    instances = list(scene.instances)
    for number, instance in enumerate(instances):
        # what stays keeps its pose to the last bit, which a way through matrices would not
        if instance.name in owner:
            matrix = motions[owner[instance.name]] @ pose_to_matrix(np.asarray(instance.pose, np.float64))
            instances[number] = replace(instance, pose=pose_from_matrix(matrix).astype(np.float64))
    return replace(scene, instances=tuple(instances), articulations=_at_rest(scene, wanted, motions))


def opened(scene: Scene) -> Scene:
    """Return the scene with all doors and drawers open."""
    return posed(scene, joints_of(scene).opened)


def _at_rest(scene: Scene, positions: NDArray[np.float64], motions: NDArray[np.float64]) -> tuple[Articulation, ...]:
    """Return the articulated things as they are at some joint positions, which become their positions at rest.

    Each part moves the axes and handles of the parts that hang on it.
    """
    things, k = [], 0
    for thing in scene.articulations:
        frame = pose_to_matrix(np.asarray(thing.pose, np.float64))
        back = np.linalg.inv(frame)
        numbers = {part.name: number for number, part in enumerate(thing.parts, k)}
        parts = []
        for part in thing.parts:
            own = numbers[part.name]
            carried = back @ motions[numbers[part.parent]] @ frame if part.parent else np.eye(4)
            moved = back @ motions[own] @ frame
            rest = float(positions[own])
            joint = replace(
                part.joint,
                axis=carried[:3, :3] @ part.joint.axis,
                origin=carried[:3, :3] @ part.joint.origin + carried[:3, 3],
                rest=rest,
                # a recorded position may lie beyond the limits, but a rest position may not (`Joint`)
                lower=min(part.joint.lower, rest),
                upper=max(part.joint.upper, rest),
            )
            handle = None if part.handle is None else moved[:3, :3] @ part.handle + moved[:3, 3]
            parts.append(replace(part, joint=joint, handle=handle))
        things.append(replace(thing, parts=tuple(parts)))
        k += len(thing.parts)
    return tuple(things)


def rests_on(
    instance: Instance, asset: Asset, feet: ArrayLike, *, motion: NDArray[np.float64] | None = None
) -> NDArray[np.bool_]:
    """Return which points, the lowest points of objects, are on or slightly above a receptacle of an instance.

    Args:
        instance: The instance.
        asset: Asset of the instance.
        feet: World points, shape [N, 3] [m].
        motion: Transform of the instance from its pose in the scene, as in `SceneJoints.motions`; None if it has not
            moved.
    """
    matrix = instance_matrix(instance) if motion is None else motion @ instance_matrix(instance)
    local = transform_points(np.linalg.inv(matrix), np.asarray(feet, np.float64))
    found = np.zeros(len(local), np.bool_)
    for receptacle in asset.receptacles:
        # a shelf is as high as its clearance: what lies higher above it lies on another one
        gap = local - receptacle.center
        over = (gap[:, 1] > -ON_M) & (gap[:, 1] < max(ON_M, min(receptacle.clearance_m, STACK_M)))
        found |= over & (np.abs(gap[:, [0, 2]]) <= receptacle.half_size + ON_M).all(1)
    return found


def handle_points(scene: Scene) -> NDArray[np.float64]:
    """Return the points at which hands hold each part, in the world with all joints at rest, shape [J, 3] [m].

    If the scene does not define a handle, the point is the middle of the side of the part that moves most: the edge of
    a door opposite its hinge, or the front of a drawer.
    """
    joints, by_name = joints_of(scene), {i.name: i for i in scene.instances}
    out = np.zeros((len(joints), 3))
    for k, (thing, part) in enumerate(joints.parts):
        frame = pose_to_matrix(np.asarray(thing.pose, np.float64))
        if part.handle is not None:
            out[k] = frame[:3, :3] @ part.handle + frame[:3, 3]
            continue
        own = [by_name[name] for name in part.instances if by_name[name].motion == "static"]
        seen = [i for i in own if len(scene.assets[i.asset].mesh.vertices)]
        if not seen:
            out[k] = frame[:3, :3] @ part.joint.origin + frame[:3, 3]
            continue
        boxes = np.array([instance_bounds(scene, i) for i in seen])
        low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
        axis = frame[:3, :3] @ part.joint.axis
        if part.joint.kind == "prismatic":
            outward = axis * np.sign(part.joint.opened - part.joint.closed)
        else:
            outward = (low + high) / 2 - (frame[:3, :3] @ part.joint.origin + frame[:3, 3])
            # away from the hinge, not along it
            outward -= axis * (axis @ outward)
        # by the largest component, so that the point lies on a side of the box and not inside it
        outward /= max(float(np.abs(outward).max()), 1e-9)
        out[k] = (low + high) / 2 + outward * (high - low) / 2
    return out
