"""Conversion of UsdPhysics joints to joints of articulated objects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.geometry import pose_from_matrix, quat_to_matrix
from h3data.scene.records import Articulation, Joint, Part
from h3data_worlds.usd.stages import OpenStage, pxr
from h3data_worlds.usd.things import matrix_of

_KINDS = {"PhysicsRevoluteJoint": "revolute", "PhysicsPrismaticJoint": "prismatic"}
_FIXED = "PhysicsFixedJoint"
_RANGE_MIN = 1e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class _Link:
    """A joint between two bodies, in the world with +Y up, in metres."""

    name: str
    path: str
    kind: str
    parent: str
    """Path of the body to which the link is attached; empty: the world, or things that stand still."""
    child: str
    stands_on: str
    """Path of the prim to which the link is attached, body or not; empty: the world."""
    origin: NDArray[np.float64]
    axis: NDArray[np.float64]
    lower: float
    upper: float
    rest: float


class JointReader:
    """Reader of the joints of a stage as articulated objects."""

    def __init__(self, opened: OpenStage, notes: dict[str, None]) -> None:
        self.opened, self.notes = opened, notes
        self._places = pxr("UsdGeom").XformCache(pxr("Usd").TimeCode.EarliestTime())

    def read(
        self, prims: Iterable[Any], members: Mapping[str, list[str]], names: Mapping[str, str]
    ) -> list[Articulation]:
        """Return the articulated objects of the stage.

        Args:
            prims: All joints of the stage.
            members: Names of the instances of each rigid body, by its path.
            names: Names of instances by the path of their prim.
        """
        links = [link for prim in prims if (link := self._link(prim, members)) is not None]
        # a fixed joint makes two bodies one: what it holds moves with the body that it hangs on
        fixed = {link.child: link.parent for link in links if link.kind == "fixed"}
        jointed: dict[str, _Link] = {}
        for link in links:
            if link.kind == "fixed":
                continue
            if link.child in jointed or link.child in fixed:
                self.notes[f"the joint {link.path} closes a loop and is left out"] = None
            else:
                jointed[link.child] = link
        for child in list(jointed):  # a circle of joints has no body that stands still
            seen, body = set[str](), child
            while body in jointed and body not in seen:
                seen.add(body)
                body = jointed[body].parent
            if body in seen:
                self.notes[f"the joint {jointed[body].path} closes a loop and is left out"] = None
                del jointed[body]
        return self._things(jointed, fixed, members, names)

    def _things(
        self, jointed: Mapping[str, _Link], fixed: Mapping[str, str], members: Mapping[str, list[str]],
        names: Mapping[str, str],
    ) -> list[Articulation]:  # fmt: skip
        carried: dict[str, list[str]] = {body: list(own) for body, own in members.items()}
        for child in fixed:
            into, seen = fixed[child], {child}
            while into in fixed and into not in jointed and into not in seen:
                seen.add(into)
                into = fixed[into]
            if into in jointed:
                carried[into] = [*carried.get(into, ()), *members.get(child, ())]
        groups: dict[str, list[_Link]] = {}
        for link in jointed.values():
            top = link
            while top.parent in jointed:
                top = jointed[top.parent]
            groups.setdefault(self._root(top), []).append(link)
        out: list[Articulation] = []
        for root, group in groups.items():
            parts = self._parts(group, jointed, carried, root)
            if parts:
                base = next((names[p] for p in (root, *_above(root)) if p in names), "") if root else ""
                moved = {name for part in parts for name in part.instances}
                pose = np.asarray(pose_from_matrix(self._frame(root)), np.float64)
                name = root.rpartition("/")[2] or parts[0].name
                out.append(Articulation(name=name, pose=pose, parts=tuple(parts), base="" if base in moved else base))
        return _named_apart(out)

    def _parts(
        self, group: list[_Link], jointed: Mapping[str, _Link], carried: Mapping[str, list[str]], root: str
    ) -> list[Part]:
        """Return the parts of a thing, each after the one that it hangs on; without those that hold no instance."""
        back = np.linalg.inv(self._frame(root))
        # a file lists joints in any order, while a part may only name one that comes before it
        waiting, made, parts = list(group), dict[str, str](), list[Part]()
        inside = {link.child for link in group}
        while waiting:
            ready = [link for link in waiting if link.parent not in inside or link.parent in made]
            waiting = [link for link in waiting if link not in ready]
            if not ready:
                break
            for link in ready:
                name = link.child.rpartition("/")[2]
                name = name if name not in made.values() else f"{name}_{len(made)}"
                made[link.child] = name
                try:
                    joint = Joint(
                        kind=link.kind,  # type: ignore[arg-type]
                        axis=back[:3, :3] @ link.axis, origin=back[:3, :3] @ link.origin + back[:3, 3],
                        lower=link.lower, upper=link.upper, rest=link.rest,
                    )  # fmt: skip
                except SceneError as fault:
                    self.notes[f"the joint {link.path} is left out: {fault}"] = None
                    continue
                parent = made.get(link.parent, "")
                own = tuple(carried.get(link.child, ()))
                parts.append(Part(name=name, joint=joint, instances=own, parent=parent))
        named, out = set[str](), list[Part]()
        for part in parts:
            if part.parent and part.parent not in named:
                continue
            named.add(part.name)
            out.append(part)
        return out if any(part.instances for part in out) else []

    def _root(self, link: _Link) -> str:
        """Return path of the prim for the whole thing: that of the articulation, else of the first joint's parent."""
        for path in (link.child, *_above(link.child)):
            if self.opened.stage.GetPrimAtPath(path).HasAPI(pxr("UsdPhysics").ArticulationRootAPI):
                return path if path != link.child else link.stands_on
        return link.stands_on or link.path.rpartition("/")[0]

    def _frame(self, path: str) -> NDArray[np.float64]:
        """Return the frame of a prim in the world, +Y up, in metres, without its scale."""
        prim = self.opened.stage.GetPrimAtPath(path) if path else None
        if not prim:
            return np.eye(4)
        return _unscaled(self.opened.in_metres(matrix_of(self._places.GetLocalToWorldTransform(prim))))

    def _link(self, prim: Any, members: Mapping[str, list[str]]) -> _Link | None:
        path, kind = str(prim.GetPath()), _KINDS.get(prim.GetTypeName(), "")
        joint = pxr("UsdPhysics").Joint(prim)
        if joint.GetJointEnabledAttr().Get() is False:
            return None
        if not kind and prim.GetTypeName() != _FIXED:
            self.notes[f"{prim.GetTypeName()} is not read, so what it joins stands still: {path}"] = None
        targets = [self._target(joint.GetBody0Rel()), self._target(joint.GetBody1Rel())]
        bodies = [self._body_at(target, members) for target in targets]
        if bodies[0] == bodies[1]:
            self.notes[f"the joint {path} does not join two bodies and is left out"] = None
            return None
        frames = [self._joint_frame(joint, number, target) for number, target in enumerate(targets)]
        if not np.isfinite(frames).all():
            self.notes[f"the joint {path} has a frame of numbers that are not finite and is left out"] = None
            return None
        token = str(prim.GetAttribute("physics:axis").Get() or "X")
        local = np.eye(3)[max("XYZ".find(token), 0)]
        local = self.opened.directions(local[None])[0]
        position = _position(kind, frames[0], frames[1], local)
        at, sign = (0, 1.0) if bodies[1] else (1, -1.0)  # the other body hangs on this one
        lower, upper = self._limits(prim, kind)
        # UsdPhysics locks a joint by a lower limit that is not below the upper one
        if not kind or lower >= upper or upper - lower < _RANGE_MIN:
            kind, lower, upper, position = "fixed", -1.0, 1.0, 0.0
        if not lower - 1e-3 <= position <= upper + 1e-3:
            self.notes[f"the joint {path} stands outside its limits"] = None
            lower, upper = min(lower, position), max(upper, position)
        return _Link(
            name=prim.GetName(), path=path, kind=kind, parent=bodies[at], child=bodies[1 - at], stands_on=targets[at],
            origin=frames[at][:3, 3], axis=sign * (frames[at][:3, :3] @ local),
            lower=lower, upper=upper, rest=min(max(position, lower), upper),
        )  # fmt: skip

    def _limits(self, prim: Any, kind: str) -> tuple[float, float]:
        """Return the limits of a joint [rad or m]; a hinge without limits turns half around both ways, a slide is held."""
        low, high = (prim.GetAttribute(f"physics:{side}Limit").Get() for side in ("lower", "upper"))
        low, high = (-np.inf if low is None else float(low)), (np.inf if high is None else float(high))
        if np.isnan(low) or np.isnan(high):
            return 0.0, 0.0
        if kind == "revolute":
            return max(float(np.radians(low)), -np.pi), min(float(np.radians(high)), np.pi)
        if not np.isfinite([low, high]).all():
            return 0.0, 0.0
        return low * self.opened.metres, high * self.opened.metres

    def _joint_frame(self, joint: Any, number: int, target: str) -> NDArray[np.float64]:
        """Return the frame of a joint at one of its bodies, in the world, +Y up, in metres, without scale."""
        position = getattr(joint, f"GetLocalPos{number}Attr")().Get()
        turn = getattr(joint, f"GetLocalRot{number}Attr")().Get()
        local = np.eye(4)
        if position is not None:
            local[:3, 3] = np.array(position, np.float64)
        if turn is not None:
            quat = np.array([*turn.GetImaginary(), turn.GetReal()], np.float64)
            length = np.linalg.norm(quat)
            local[:3, :3] = quat_to_matrix(quat / length) if np.isfinite(length) and length > 0 else np.eye(3)
        prim = self.opened.stage.GetPrimAtPath(target) if target else None
        world = matrix_of(self._places.GetLocalToWorldTransform(prim)) if prim else np.eye(4)
        return _unscaled(self.opened.in_metres(world @ local))

    def _target(self, relation: Any) -> str:
        targets = relation.GetTargets()
        return str(targets[0]) if targets else ""

    def _body_at(self, path: str, members: Mapping[str, list[str]]) -> str:
        """Return the rigid body at or above a prim; empty if it stands still."""
        return next((p for p in (path, *_above(path)) if p in members), "") if path else ""


def _position(kind: str, first: NDArray[np.float64], second: NDArray[np.float64], axis: NDArray[np.float64]) -> float:
    """Return the position of a joint by the frames of both bodies [rad or m]."""
    between = np.linalg.inv(first) @ second
    if kind == "prismatic":
        return float(axis @ between[:3, 3])
    turn = between[:3, :3]
    twist = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    # axis @ twist is 2 sin, and trace - 1 is 2 cos of the turn about the axis
    return float(np.arctan2(axis @ twist, np.trace(turn) - 1))


def _unscaled(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the nearest rigid matrix with the same place."""
    u, _, vt = np.linalg.svd(np.nan_to_num(matrix[:3, :3]))
    u[:, 2] *= np.sign(np.linalg.det(u @ vt)) or 1.0
    out = matrix.copy()
    out[:3, :3] = u @ vt
    return out


def _above(path: str) -> list[str]:
    """Return paths of a prim's ancestors, from its parent up."""
    out = []
    while (path := path.rpartition("/")[0]) != "":
        out.append(path)
    return out


def _named_apart(things: list[Articulation]) -> list[Articulation]:
    used: dict[str, int] = {}
    out = []
    for thing in things:
        count = used[thing.name] = used.get(thing.name, 0) + 1
        out.append(thing if count == 1 else replace(thing, name=f"{thing.name}_{count}"))
    return out
