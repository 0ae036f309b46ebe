"""Small objects that residents left on furniture and on the floor, placed by the tables of `habits`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from h3data.geometry import IDENTITY_QUAT, pose_multiply, quat_from_heading, quat_multiply
from h3data.scene.kinds import KINDS
from h3data.scene.records import Asset, Instance, Receptacle
from h3data_homes.furnishing.objects import OBJECT_MAKERS, renamed
from h3data_homes.furnishing.place import RoomState, footprint, overlap
from h3data_homes.kinds.kind import is_aligned, thing_of
from h3data_homes.lived_in.habits import CHANCE, ON_FLOOR, ON_FURNITURE, Habit
from h3data_homes.lived_in.looks import thing_style
from h3data_homes.spec import Look
from h3data_homes.zoning import Rect

_VARIANTS = 3
"""Different models of one kind of thing in each style."""
_LIFT, _APART = 0.001, 0.012
"""Height of things above what they lie on, so that no contact is reported, and least distance between them [m]."""
_TRIES = 6
_SINK_M = 0.3
"""Width of surfaces of kitchen counters below which they count as next to a sink [m]."""
_FLOOR_GAP = (0.03, 0.09)
"""Distance of things on the floor from the wall or furniture behind them [m]."""
_SEAT_M = 0.62
"""Width of a place at a table."""


@lru_cache(maxsize=2048)  # 10 kB each
def model_of(kind: str, look: Look, variant: int) -> Asset:
    """Return one of the models of a kind of object in a style, which all homes share."""
    name = f"{kind}_{look}_{variant}"
    rng = np.random.default_rng(list(name.encode()))
    if KINDS[kind].model:
        return thing_of(KINDS[kind], rng, thing_style(look), name)
    return renamed(OBJECT_MAKERS[kind](rng, thing_style(look)), name)


@dataclass
class _Things:
    """Instances so far, and the assets that they use, made when they are first needed."""

    rng: np.random.Generator
    look: Look
    made: dict[str, Asset] = field(default_factory=dict)
    instances: list[Instance] = field(default_factory=list)
    count: dict[str, int] = field(default_factory=dict)

    def sample(self, kind: str) -> Asset:
        asset = model_of(kind, self.look, int(self.rng.integers(_VARIANTS)))
        self.made[asset.name] = asset
        return asset

    def put(self, asset: Asset, frame: np.ndarray, at: Sequence[float], heading: float) -> None:
        """Add an instance with its underside at ``at`` [3] in a frame given by its pose [7]."""
        local = np.array([at[0], at[1] + _LIFT - float(asset.mesh.bounds[0, 1]), at[2]])
        pose = np.empty(7)
        pose[:3] = pose_multiply(frame, np.concatenate([local, IDENTITY_QUAT]))[:3]
        pose[3:] = quat_multiply(frame[3:], quat_from_heading(heading))
        kind = asset.category
        self.count[kind] = self.count.get(kind, -1) + 1
        self.instances.append(
            Instance(
                name=f"{kind}_{self.count[kind]}",
                asset=asset.name,
                pose=pose,
                semantic_id=KINDS[kind].semantic_id,
                motion="kinematic",
            )
        )


@dataclass
class _Board:
    """A rectangle about the origin, in part occupied; ``height`` is the free height above it [m]."""

    half: tuple[float, float]
    height: float
    taken: list[Rect] = field(default_factory=list)

    def fits(self, rect: Rect) -> bool:
        inside = (
            rect[0] >= -self.half[0]
            and rect[2] <= self.half[0]
            and rect[1] >= -self.half[1]
            and rect[3] <= self.half[1]
        )
        return inside and not any(overlap(rect, other, -_APART) for other in self.taken)


def _size(asset: Asset) -> tuple[float, float, float]:
    low, high = asset.mesh.bounds.astype(float)
    return tuple((2 * np.maximum(-low, high)).tolist())  # type: ignore[return-value]


def _turned_half(asset: Asset, heading: float) -> tuple[float, float]:
    """Return half the extents along x and z of a thing's footprint turned by a heading."""
    w, _, d = _size(asset)
    c, s = abs(np.cos(heading)), abs(np.sin(heading))
    return (c * w + s * d) / 2, (s * w + c * d) / 2


def _heading(rng: np.random.Generator, asset: Asset) -> float:
    if is_aligned(KINDS[asset.category]):
        return float(rng.choice([0.0, np.pi])) if rng.random() < 0.4 else 0.0
    return float(rng.uniform(-np.pi, np.pi))


def _scatter(things: _Things, habit: Habit, count: int, board: _Board, frame: np.ndarray) -> None:
    rng = things.rng
    order = rng.permutation(len(habit.kinds)).tolist()
    for k in range(count):
        asset = things.sample(habit.kinds[order[k % len(order)]])
        if _size(asset)[1] + 0.02 > board.height:
            continue
        for _ in range(_TRIES):
            heading = _heading(rng, asset)
            a, b = _turned_half(asset, heading)
            if a > board.half[0] or b > board.half[1]:
                break
            x, z = float(rng.uniform(-1, 1)) * (board.half[0] - a), float(rng.uniform(-1, 1)) * (board.half[1] - b)
            if board.fits((x - a, z - b, x + a, z + b)):
                board.taken.append((x - a, z - b, x + a, z + b))
                things.put(asset, frame, (x, 0.0, z), heading)
                break


def _stack(things: _Things, habit: Habit, count: int, board: _Board, frame: np.ndarray) -> None:
    """Put things on top of each other, the lower ones at least as large."""
    rng = things.rng
    pile = sorted((things.sample(str(rng.choice(habit.kinds))) for _ in range(count)), key=lambda a: -_size(a)[0])
    if not pile:
        return
    half = [_turned_half(asset, 0.0) for asset in pile]
    a, b = max(h[0] for h in half) + 0.015, max(h[1] for h in half) + 0.015
    if a > board.half[0] or b > board.half[1]:
        return
    for _ in range(_TRIES):
        x, z = float(rng.uniform(-1, 1)) * (board.half[0] - a), float(rng.uniform(-1, 1)) * (board.half[1] - b)
        if board.fits((x - a, z - b, x + a, z + b)):
            break
    else:
        return
    board.taken.append((x - a, z - b, x + a, z + b))
    level = 0.0
    for asset in pile:
        tall = _size(asset)[1] if abs(asset.mesh.bounds.sum(0)[1]) < 1e-3 else float(np.ptp(asset.mesh.bounds[:, 1]))
        if level + tall + 0.02 > board.height:
            return
        dx, dz = rng.uniform(-0.006, 0.006, 2).tolist()
        things.put(asset, frame, (x + dx, level, z + dz), float(rng.uniform(-0.04, 0.04)))
        level += tall + _LIFT


def _row(things: _Things, habit: Habit, count: int, board: _Board, frame: np.ndarray) -> None:
    """Put things side by side along the back, from one end."""
    sign = float(things.rng.choice([-1.0, 1.0]))
    at = -board.half[0]
    for _ in range(count):
        asset = things.sample(str(things.rng.choice(habit.kinds)))
        w, h, d = _size(asset)
        x, z = sign * (at + w / 2), -board.half[1] + d / 2
        rect = (x - w / 2, z - d / 2, x + w / 2, z + d / 2)
        if h + 0.01 > board.height or not board.fits(rect):
            return
        board.taken.append(rect)
        things.put(asset, frame, (x, 0.0, z), 0.0)
        at += w + _APART + 0.002


def _settings(things: _Things, habit: Habit, count: int, board: _Board, frame: np.ndarray) -> None:
    """Put plate, fork, knife and glass at places along the two long sides."""
    plate, fork, knife, glass = (things.sample(k) for k in ("plate", "fork", "table_knife", "tumbler"))
    per_side = max(1, int(2 * board.half[0] / _SEAT_M))
    places = [(((i + 0.5) / per_side - 0.5) * 2 * board.half[0], s) for i in range(per_side) for s in (1, -1)]
    for x, s in places[:count]:
        turn = 0.0 if s > 0 else np.pi
        z = s * (board.half[1] - _size(plate)[2] / 2 - 0.01)
        for asset, dx, dz in ((plate, 0.0, 0.0), (fork, -0.17, 0.0), (knife, 0.17, 0.0), (glass, 0.15, -0.17)):
            px, pz = x + s * dx, z + s * dz
            a, b = _turned_half(asset, turn)
            rect = (px - a, pz - b, px + a, pz + b)
            if board.fits(rect):
                board.taken.append(rect)
                things.put(asset, frame, (px, 0.0, pz), turn)


def _pair(things: _Things, habit: Habit, count: int, board: _Board, frame: np.ndarray) -> None:
    """Put two things of one kind beside each other."""
    rng = things.rng
    for _ in range(count):
        asset = things.sample(str(rng.choice(habit.kinds)))
        w, h, d = _size(asset)
        a, b = w + 0.008, d / 2
        if a > board.half[0] or b > board.half[1] or h + 0.02 > board.height:
            continue
        for _ in range(_TRIES):
            x = float(rng.uniform(-1, 1)) * (board.half[0] - a)
            z = float(rng.uniform(-1, 1)) * (board.half[1] - b)
            if board.fits((x - a, z - b, x + a, z + b)):
                board.taken.append((x - a, z - b, x + a, z + b))
                for s in (-1, 1):
                    things.put(asset, frame, (x + s * (w / 2 + 0.006), 0.0, z), 0.0)
                break


_MANNERS = {"scatter": _scatter, "stack": _stack, "row": _row, "settings": _settings, "pair": _pair}


# --- where ------------------------------------------------------------------------------------------------------------
def _host(asset: Asset, receptacle: Receptacle) -> str:
    if asset.category == "kitchen_counter" and 2 * receptacle.half_size[0] < _SINK_M:
        return "sink"
    return asset.category


def _numbers(rng: np.random.Generator, habit: Habit, amount: float) -> int:
    low, high = habit.count
    return round(int(rng.integers(low, high + 1)) * min(amount, 2.0))


def leave_about(
    rng: np.random.Generator,
    look: Look,
    states: Sequence[RoomState],
    furniture: Sequence[tuple[Instance, Asset]],
    amount: float = 1.0,
) -> tuple[list[Instance], dict[str, Asset]]:
    """Place objects on furniture and floors; return their kinematic instances and their assets.

    Objects do not overlap, and each lies within its receptacle and fits under its clearance. ``amount`` scales
    probabilities and numbers of objects.
    """
    things = _Things(rng, look)
    if amount <= 0:
        return [], {}
    for instance, asset in furniture:
        for receptacle in asset.receptacles:
            host = _host(asset, receptacle)
            habits = ON_FURNITURE.get(host)
            if habits is None or rng.random() > CHANCE.get(host, 0.7) * amount:
                continue
            center = np.concatenate([receptacle.center, IDENTITY_QUAT])
            frame = pose_multiply(instance.pose, center)
            board = _Board((float(receptacle.half_size[0]), float(receptacle.half_size[1])), receptacle.clearance_m)
            weights = np.array([h.weight for h in habits])
            rounds = 1 if board.half[0] * board.half[1] < 0.06 else 2
            for _ in range(min(rounds + (amount > 1.5), len(habits))):
                habit = habits[int(rng.choice(len(habits), p=weights / weights.sum()))]
                _MANNERS[habit.manner](things, habit, _numbers(rng, habit, amount), board, frame)
    for state in states:
        taken = [footprint(p) for p in state.placed if p.y < 0.6 and p.piece.category not in ("rug", "picture")]
        taken += state.keep
        for habit in ON_FLOOR.get(state.room.category, ()):
            _on_floor(things, habit, _numbers(rng, habit, amount), state, taken)
    used = {i.asset for i in things.instances}
    return things.instances, {name: asset for name, asset in things.made.items() if name in used}


def _on_floor(things: _Things, habit: Habit, count: int, state: RoomState, taken: list[Rect]) -> None:
    """Put things close to the walls of a room, clear of the rectangles ``taken``, to which their own are added."""
    rng, (x0, z0, x1, z1) = things.rng, state.interior
    for _ in range(count):
        asset = things.sample(str(rng.choice(habit.kinds)))
        w, _, d = _size(asset)
        both = habit.manner == "pair"
        a, b = (w + 0.01 if both else w / 2), d / 2
        for _ in range(_TRIES):
            side, gap = int(rng.integers(4)), float(rng.uniform(*_FLOOR_GAP))
            u = float(rng.uniform(0, 1))
            half = (a, b) if side % 2 == 0 else (b, a)
            if x1 - x0 < 2 * half[0] + 0.2 or z1 - z0 < 2 * half[1] + 0.2:
                continue
            x, z = (
                x0 + half[0] + 0.04 + u * (x1 - x0 - 2 * half[0] - 0.08),
                z0 + half[1] + 0.04 + u * (z1 - z0 - 2 * half[1] - 0.08),
            )
            if side % 2 == 0:
                z = z0 + gap + half[1] if side == 0 else z1 - gap - half[1]
            else:
                x = x0 + gap + half[0] if side == 1 else x1 - gap - half[0]
            rect = (x - half[0], z - half[1], x + half[0], z + half[1])
            if any(overlap(rect, r, -0.02) for r in taken):
                continue
            taken.append(rect)
            heading = side * np.pi / 2 + (
                0.0 if both or is_aligned(KINDS[asset.category]) else float(rng.uniform(-0.08, 0.08))
            )
            frame = np.concatenate([[x, 0.0, z], quat_from_heading(heading)])
            for s in (-1, 1) if both else (0,):
                things.put(asset, frame, (s * (w / 2 + 0.006), 0.0, 0.0), 0.0)
            break
