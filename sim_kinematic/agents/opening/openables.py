"""Doors and drawers of one world: positions, contents, and the room in front of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, pose_from_matrix, pose_to_matrix, smoothstep, transform_points
from h3data.scene import Box, Instance, Scene
from h3data.scene.articulation import SceneJoints, handle_points, joints_of, posed, rests_on
from h3data.scene.floor_heights import floor_heights, room_heights
from h3data.scene.records import Asset, Shape
from h3data.scene.shape_bounds import shape_bounds
from sim_kinematic.agents.company import Company
from sim_kinematic.agents.driven.object_room import object_extent
from sim_kinematic.agents.skills import Objects
from sim_kinematic.contact import FclScene, MovingShapes
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.motion.state import NOBODY


@dataclass(frozen=True)
class OpeningSpec:
    """Speeds of doors and drawers, and the sampling of their motion."""

    swing_rad_s: float = 1.2
    """Mean speed at which a door turns while it is opened or closed [rad/s]."""
    slide_mps: float = 0.45
    """Mean speed at which a drawer slides while it is opened or closed [m/s]."""
    steps_least: int = 12
    """Smallest number of steps that opening or closing takes."""
    frames: int = 8
    """Number of positions of a moving part at which collisions are tested."""
    samples: int = 6
    """Number of points along each edge of a part's boxes that represent its outline from above."""
    shrunk_m: float = 0.008
    """Depth by which moving parts may overlap the things beside them [m]."""
    passes_m: float = 0.03
    """Depth of an agent's disc in a part above which the part hits the agent [m]."""
    tall_m: float = 1.8
    """Height over the floor above which a part passes over the heads of all agents [m]."""


OPENING = OpeningSpec()


@dataclass(eq=False)
class ArticulatedParts:
    """Joints of a scene, shared by all actors; positions are in ``objects.state``."""

    scene: Scene
    objects: Objects
    floor_y: float
    company: Company | None = None
    """Agents that the parts may obstruct; None: there are none."""
    doors: frozenset[int] = frozenset()
    """Joints of the doors between rooms: they are opened from both sides, and walls do not obstruct them."""
    _scenes: dict[bytes, Scene] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.joints: SceneJoints = joints_of(self.scene)
        self._heights = room_heights(self.scene.rooms)
        by_name = {i.name: i for i in self.scene.instances}
        self._instances = [
            # objects that lie on a part belong to it too, but they move by `_lying`, wherever they are then
            [by_name[name] for name in part.instances if by_name[name].motion == "static"]
            for _, part in self.joints.parts
        ]
        named = [by_name[name] for name in self.objects.names]
        self._extents = [object_extent(self.scene, i) for i in named]
        self._handles = handle_points(self.scene)
        self._scenery: dict[int, FclScene] = {}
        self._shapes: dict[int, list[MovingShapes]] = {}

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def positions(self) -> NDArray[np.float64]:
        """Positions of all joints [J] [rad or m]; a view."""
        return self.objects.state.joint_pos[0]

    def is_open(self, k: int) -> bool:
        """Return whether a part is open far enough for hands to reach in."""
        return bool(self.joints.is_open(self.positions)[k])

    def handles(self, positions: Array) -> Array:
        """Return the world points [..., J, 3] of all handles with the joints at ``positions`` [..., J]."""
        motions = self.joints.motions(positions)
        return np.einsum("...jab,jb->...ja", motions[..., :3, :3], self._handles) + motions[..., :3, 3]

    def scene_now(self) -> Scene:
        """Return the scene with its joints at their present positions."""
        key = self.positions.tobytes()
        if key not in self._scenes:
            if len(self._scenes) >= 8:
                # the oldest: every position of a joint is a scene of its own
                self._scenes.pop(next(iter(self._scenes)))
            self._scenes[key] = posed(self.scene, self.positions)
        return self._scenes[key]

    # --- what is shut in ------------------------------------------------------------------------------------------------
    def barrier(self, foot: Array) -> int:
        """Return the joint to open first to reach an object whose lowest point is at a world point [3], or -1."""
        motions = self.joints.motions(self.positions)
        is_open = self.joints.is_open(self.positions)
        for instance, asset, needed in self._enclosed:
            shut = [k for k in needed if not is_open[k]]
            if not shut:
                continue
            mover = self.joints.owner.get(instance.name, -1)
            if rests_on(instance, asset, foot[None], motion=motions[mover] if mover >= 0 else None)[0]:
                return shut[0]
        return -1

    def barrier_of(self, k: int, *, at_goal: bool = False) -> int:
        """Return the joint to open first to take object ``k``, or to put it at its goal; -1 if there is none."""
        point = self.objects.goals[k] if at_goal else self.objects.poses[k, :3]
        # what is in a hand is shut in by nothing, wherever the hand is
        if not at_goal and self.objects.held_by[k] != NOBODY:
            return -1
        return self.barrier_for(k, point)

    def barrier_for(self, k: int, point: Array) -> int:
        """Return the joint to open first to put object ``k`` at a world point [3] (its origin); -1 if there is none."""
        # receptacles carry things by their lowest point
        return self.barrier(point + np.array([0.0, self._extents[k][1], 0.0]))

    @cached_property
    def _enclosed(self) -> list[tuple[Instance, Asset, tuple[int, ...]]]:
        """Receptacles that are shut off, each as an asset with nothing else, and the joints that do so, doors first."""
        found, by_name = [], {i.name: i for i in self.scene.instances}
        for name, needed in self.joints.enclosing.items():
            instance = by_name[name.partition("|")[0]]
            asset = self.scene.assets[instance.asset]
            own = tuple(r for r in asset.receptacles if r.name == name.partition("|")[2])
            kinds = [self.joints.parts[k][1].joint.kind for k in needed]
            # doors first: a rack behind one cannot slide out before the door is open
            order = sorted(zip(needed, kinds, strict=True), key=lambda pair: pair[1] == "prismatic")
            only = Asset(name=asset.name, mesh=asset.mesh, receptacles=own)
            found.append((instance, only, tuple(k for k, _ in order)))
        return found

    # --- what moves -----------------------------------------------------------------------------------------------------
    def travel(self, k: int, *, opens: bool) -> NDArray[np.float64]:
        """Return the positions [T] [rad or m] of a joint in each step from now to its open or its closed end."""
        joint, start = self.joints.parts[k][1].joint, float(self.positions[k])
        end = joint.opened if opens else joint.closed
        speed = OPENING.swing_rad_s if joint.kind == "revolute" else OPENING.slide_mps
        steps = max(OPENING.steps_least, int(np.ceil(abs(end - start) / (speed * STEP_S))))
        way = start + smoothstep(np.arange(1, steps + 1) / steps) * (end - start)
        # to the bit: a start plus a difference may miss it by rounding
        way[-1] = end
        return way

    def move(self, k: int, position: float) -> None:
        """Move a joint, together with the objects that lie on its moving parts."""
        state, before = self.objects.state, self.joints.motions(self.positions)
        # asked before it moves, while they lie where the part is
        lying = self._lying(k, before)
        # float32, as recordings have it: what is replayed is what was done
        state.joint_pos[0, k] = np.float32(position)
        after = self.joints.motions(self.positions)
        for n, owner in lying:
            pose = after[owner] @ np.linalg.inv(before[owner]) @ pose_to_matrix(self.objects.poses[n])
            self.objects.poses[n] = pose_from_matrix(pose)

    def _lying(self, k: int, motions: Array) -> list[tuple[int, int]]:
        """Return objects that nobody holds, on part ``k`` or parts below it, with the joint of that part."""
        feet = self.objects.poses[:, :3] + np.array([[0.0, low, 0.0] for _, low, _ in self._extents]).reshape(-1, 3)
        found: dict[int, int] = {}
        for j in self._carried(k):
            for instance in self._instances[j]:
                on = rests_on(instance, self.scene.assets[instance.asset], feet, motion=motions[j])
                found |= {int(n): j for n in np.flatnonzero(on) if self.objects.held_by[n] == NOBODY}
        return sorted(found.items())

    def _carried(self, k: int) -> list[int]:
        """Return the joint and all those of the same thing that hang on it."""
        thing, part = self.joints.parts[k]
        names, found = {part.name}, [k]
        first = next(n for n, (other, _) in enumerate(self.joints.parts) if other is thing)
        # parts come after those that carry them, so one pass finds all
        for n, other in enumerate(thing.parts, first):
            if other.parent in names:
                names.add(other.name)
                found.append(n)
        return found

    # --- what is in the way ---------------------------------------------------------------------------------------------
    def points(self, k: int, way: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return world points [P, 3] [m] on all that a joint moves, at its positions [T], up to `OPENING.tall_m`."""
        positions = np.tile(self.positions, (len(way), 1))
        positions[:, k] = way
        motions = self.joints.motions(positions)
        out = [transform_points(motion, self._samples[j]) for j in self._carried(k) for motion in motions[:, j]]
        every = np.concatenate([np.zeros((0, 3)), *out]).astype(np.float64)
        return every[every[:, 1] < floor_heights(self._heights, self.floor_y, every[:, ::2]) + OPENING.tall_m]

    @cached_property
    def _samples(self) -> list[NDArray[np.float64]]:
        """Points on the boxes around the shapes of each part, in the world with the joints at rest, [P, 3]."""
        grid = np.array(
            [p for p in product(np.linspace(0, 1, OPENING.samples), repeat=3) if min(p) == 0 or max(p) == 1]
        )
        found = []
        for own in self._instances:
            points: list[Array] = [np.zeros((0, 3))]
            for instance in own:
                matrix = pose_to_matrix(np.asarray(instance.pose, np.float64))
                for shape in self.scene.assets[instance.asset].shapes:
                    low, high = shape_bounds(shape, np.eye(4))
                    points.append(transform_points(matrix, (low + grid * (high - low)) * instance.scale))
            found.append(np.concatenate(points).astype(np.float64))
        return found

    def open_points(self) -> NDArray[np.float64]:
        """Return floor points [P, 2] below parts that are not closed, where agents cannot stand."""
        ajar = np.flatnonzero(self.joints.shares(self.positions) > 0.05)
        found = [self.points(int(k), self.positions[[k]])[:, [0, 2]] for k in ajar]
        return np.concatenate([np.zeros((0, 2)), *found])

    def hits_agent(self, k: int, way: NDArray[np.float64]) -> int:
        """Return the first agent whose discs a joint would hit at positions [T], or -1 if there is none."""
        points = self.points(k, way)[:, [0, 2]]
        for number in range(0 if self.company is None else len(self.company.actors)):
            if bool(_covered(points, self.company.discs_of(number)).any()):  # type: ignore[union-attr]
                return number
        return -1

    def obstacle(self, k: int, *, opens: bool) -> str:
        """Return the name of the instance or object that blocks a joint; empty if there is none."""
        way = self.travel(k, opens=opens)
        # a short way has fewer steps than frames, and none is tested twice
        frames = way[np.unique(np.linspace(0, len(way) - 1, OPENING.frames).astype(int))]
        positions = np.tile(self.positions, (len(frames), 1))
        positions[:, k] = frames
        motions = self.joints.motions(positions)
        own = {name for j in self._carried(k) for name in self.joints.parts[j][1].instances}
        # a part always touches the body that it hangs in
        own.add(self.joints.parts[k][0].base)
        if k in self.doors:
            own |= {i.name for i in self.scene.instances if self.scene.assets[i.asset].category == "wall"}
        scenery = self._scene_shapes()
        for j in self._carried(k):
            for instance, shapes in zip(self._instances[j], self._part_shapes(j), strict=True):
                rigid = pose_to_matrix(np.asarray(instance.pose, np.float64))
                transforms = np.repeat((motions[:, j] @ rigid)[:, None], len(shapes), axis=1)
                if len(shapes) and shapes.touches_along(scenery, transforms, except_for=own):
                    return next((n for n in _touched(shapes, scenery, transforms) if n not in own), "the home")
        points = self.points(k, frames)
        lying = {n for n, _ in self._lying(k, self.joints.motions(self.positions))}
        for n, (radius, low, high) in enumerate(self._extents):
            # what lies on the part goes with it
            if n in lying or self.objects.held_by[n] != NOBODY:
                continue
            gap = points - self.objects.poses[n, :3]
            if bool(((np.hypot(gap[:, 0], gap[:, 2]) < radius) & (gap[:, 1] > low) & (gap[:, 1] < high)).any()):
                return self.objects.names[n]
        return ""

    def _scene_shapes(self) -> FclScene:
        from sim_kinematic.contact.clearance import scenery_of

        return scenery_of(self.scene_now())

    def _part_shapes(self, j: int) -> list[MovingShapes]:
        if j not in self._shapes:
            self._shapes[j] = [
                MovingShapes([_shrunk(s) for s in self.scene.assets[i.asset].shapes], i.scale.tolist())
                for i in self._instances[j]
            ]
        return self._shapes[j]


def stands_clear(stands: Array, points: Array, offsets: Sequence[float], radius_m: float) -> NDArray[np.bool_]:
    """Return whether the base at each stand ``(x, z, heading)`` [N, 3] keeps off the floor points [P, 2], as bool [N].

    The base is a row of discs of ``radius_m``, whose centres are ``offsets`` [m] ahead of its middle.
    """
    clear = np.ones(len(stands), np.bool_)
    if not len(points):
        return clear
    for offset in offsets:
        x = stands[:, 0] + offset * np.cos(stands[:, 2])
        z = stands[:, 1] - offset * np.sin(stands[:, 2])
        gap = np.hypot(x[:, None] - points[:, 0], z[:, None] - points[:, 1])
        clear &= gap.min(1) > radius_m
    return clear


def _covered(points: Array, discs: Array) -> NDArray[np.bool_]:
    """Return which points [P, 2] are in one of some discs ``(x, z, radius)`` [N, 3]."""
    gap = np.hypot(points[:, None, 0] - discs[:, 0], points[:, None, 1] - discs[:, 1])
    return np.any(gap < np.maximum(discs[:, 2] - OPENING.passes_m, 0.0), axis=1)


def _shrunk(shape: Shape) -> Shape:
    if not isinstance(shape, Box):
        return shape
    # a thin panel keeps half of its thickness
    return Box(
        pose=shape.pose, half_extents=np.maximum(shape.half_extents - OPENING.shrunk_m, 0.5 * shape.half_extents)
    )


def _touched(shapes: MovingShapes, scenery: FclScene, transforms: Array) -> list[str]:
    from sim_kinematic.contact import contacts

    names = []
    for frame in transforms:
        shapes.set_transforms(frame)
        names += [scenery.names[contact.index_a] for contact in contacts(scenery, shapes)]
    return names
