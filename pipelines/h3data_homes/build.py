"""Generation of a home with `build_home`: plan, structure, furniture and small objects become one `Scene`."""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from h3data.errors import SceneError
from h3data.geometry import IDENTITY_POSE, quat_from_heading
from h3data.scene.kinds import KINDS
from h3data.scene.records import Articulation, Asset, Instance, Room, Scene
from h3data_homes import structure
from h3data_homes.check import faults
from h3data_homes.doors import SWINGS_M, closed_by_chance, with_doors
from h3data_homes.floors import floor_mesh
from h3data_homes.furnishing.clutter import clutter, object_assets
from h3data_homes.furnishing.furniture_living import ceiling_lamp
from h3data_homes.furnishing.groups import NoRoomError
from h3data_homes.furnishing.opening.placing import carrying, opening_assets, placed_opening
from h3data_homes.furnishing.place import Placed, RoomState, room_state
from h3data_homes.layout import WALL_HEIGHT, Layout, RoomPlan, plan_layout
from h3data_homes.lived_in.clutter import leave_about
from h3data_homes.lived_in.looks import sample_look
from h3data_homes.lived_in.rooms import furnish
from h3data_homes.rooms import FURNISH
from h3data_homes.solids import subdivided
from h3data_homes.spec import HomeSpec, stage_rng
from h3data_homes.storeys.join import joined_storeys
from h3data_homes.storeys.plan import plan_storeys, upper_seed
from h3data_homes.storeys.stairwell import TOP_M, stairwell_assets
from h3data_homes.style import Style, sample_style

_log = logging.getLogger(__name__)
_ATTEMPTS = 12
_ROOM_ATTEMPTS = 3
_LAMP_EVERY_M = 4.5
_STAIR_LAMPS = (0.2, 0.8)
"""Places of the lamps along a stairwell, as shares of its length."""


class _Collector:
    """Assets and instances of a home under construction; names are numbered in order of appearance."""

    def __init__(self) -> None:
        self.assets: dict[str, Asset] = {}
        self.instances: list[Instance] = []
        self.articulations: list[Articulation] = []
        self._names: dict[int, str] = {}
        self._kinds: dict[str, int] = {}
        self._count: dict[str, int] = {}

    def structure(self, asset: Asset, layer: str = "") -> None:
        self.assets[asset.name] = asset
        self.instances.append(
            Instance(
                name=asset.name,
                asset=asset.name,
                pose=IDENTITY_POSE.copy(),
                semantic_id=KINDS[asset.category].semantic_id,
                layer=layer,
            )
        )

    def furniture(self, placed: Placed) -> Instance:
        piece = placed.piece
        if id(piece) not in self._names:
            number = self._kinds[piece.category] = self._kinds.get(piece.category, -1) + 1
            name = self._names[id(piece)] = f"{piece.category}_model_{number}"
            self.assets[name] = piece.asset(name)
        number = self._count[piece.category] = self._count.get(piece.category, -1) + 1
        heading = placed.quarter * np.pi / 2 + placed.yaw
        pose = np.concatenate([[placed.x, placed.y, placed.z], quat_from_heading(heading)])
        instance = Instance(
            name=f"{piece.category}_{number}",
            asset=self._names[id(piece)],
            pose=pose,
            semantic_id=KINDS[piece.category].semantic_id,
            layer=placed.layer,
        )
        self.instances.append(instance)
        return instance

    def opening(self, placed: Placed) -> list[Instance]:
        """Return a piece with doors and drawers: its body and its parts."""
        piece = placed.piece
        assert piece.opens is not None
        copies = self._count[f"of {id(piece)}"] = self._count.get(f"of {id(piece)}", -1) + 1
        opening = piece.opens(copies)
        number = self._count[opening.kind] = self._count.get(opening.kind, -1) + 1
        design = self._kinds[opening.kind] = self._kinds.get(opening.kind, -1) + 1
        model = f"{opening.kind}_model_{design}"
        self.assets.update(opening_assets(opening, model))
        heading = placed.quarter * np.pi / 2 + placed.yaw
        body = Instance(
            name=f"{opening.kind}_{number}",
            asset=model,
            pose=np.concatenate([[placed.x, placed.y, placed.z], quat_from_heading(heading)]),
            semantic_id=KINDS[piece.category].semantic_id,
            layer=placed.layer,
        )
        parts, thing = placed_opening(opening, body)
        self.instances += [body, *parts]
        self.articulations.append(thing)
        return [body, *parts]


def build_home(spec: HomeSpec) -> Scene:
    """Return a furnished home with rooms, walls, doors, windows, furniture, and small objects to carry.

    World frame, +Y up, floor at y = 0, footprint from (0, 0) to (width, depth) in (x, z); an upper storey lies beside
    it. The ceiling and its lamps are in the layer ``ceiling``. The same spec gives the same bytes. A disc of 0.30 m
    radius can reach every room and every receptacle; plans that fail this are replaced by new samples, up to 12 times.

    Raises:
        SceneError: no attempt succeeded.
    """
    reasons = []
    for attempt in range(_ATTEMPTS):
        try:
            scene, scene_faults = _attempt(spec, attempt) if spec.storeys == 1 else _attempt_storeys(spec, attempt)
        except SceneError as error:
            reasons.append(str(error))
            _log.debug("%s, attempt %d: %s", spec, attempt, error)
            continue
        if not scene_faults:
            return closed_by_chance(scene, stage_rng(spec, "closed doors", attempt)) if spec.doors else scene
        reasons += scene_faults
        _log.debug("%s, attempt %d: %s", spec, attempt, "; ".join(scene_faults))
    raise SceneError(
        f"No home found for {spec} in {_ATTEMPTS} attempts; last reason: {reasons[-1]} Hint: use another seed.",
        code="H3-SCENE-021",
    )


def _attempt(spec: HomeSpec, attempt: int) -> tuple[Scene, list[str]]:
    """Build a home once and return it with its faults."""
    layout = plan_layout(spec, attempt)
    return _sound_storey(spec, attempt, layout, _style(spec, layout, attempt))


def _attempt_storeys(spec: HomeSpec, attempt: int) -> tuple[Scene, list[str]]:
    """Return a home with two storeys and the faults of either."""
    below = replace(spec, storeys=1)
    above = replace(below, seed=upper_seed(spec.seed), style=spec.look)
    plan = plan_storeys(below, above, attempt)
    style = _style(below, plan.ground, attempt)
    upstairs = replace(style, paint=_style(above, plan.upper, attempt).paint)
    ground, below_faults = _sound_storey(below, attempt, plan.ground, style)
    upper, above_faults = _sound_storey(above, attempt, plan.upper, upstairs)
    home = _Collector()
    for asset, layer in stairwell_assets(plan, style, stage_rng(below, "stairs", attempt)):
        home.structure(asset, layer)
    (x0, z0, x1, z1), lamp = plan.well.rect, ceiling_lamp(stage_rng(below, "stair lamps", attempt), style)
    for share in _STAIR_LAMPS:
        x, z = (x0 + x1) / 2, z0 + share * (z1 - z0)
        home.furniture(Placed(piece=lamp, room="stairs", x=x, z=z, quarter=0, y=TOP_M, layer="ceiling"))
    well = Scene(name="stairs", assets=_dense(home.assets, spec), instances=tuple(home.instances))
    scene = replace(joined_storeys(plan, ground, upper, well), name=_name(spec), source=_source(spec))
    return scene, [*below_faults, *above_faults]


def _dense(assets: dict[str, Asset], spec: HomeSpec) -> dict[str, Asset]:
    if spec.density == 1:
        return assets
    return {n: replace(a, mesh=subdivided(a.mesh, spec.density)) for n, a in assets.items()}


def _sound_storey(spec: HomeSpec, attempt: int, layout: Layout, style: Style) -> tuple[Scene, list[str]]:
    """Return a furnished plan at y = 0, with its doors open, and its faults.

    Leaves of doors slide if the home has faults where they swing.
    """
    scene = _storey(spec, attempt, layout, style)
    if not spec.doors:
        return scene, faults(scene)
    hung, found = scene, list[str]()
    for swing_m in SWINGS_M:
        hung = with_doors(scene, layout, style, stage_rng(spec, "doors", attempt), swing_m=swing_m)
        if not (found := faults(hung)):
            break
    return hung, found


def _storey(spec: HomeSpec, attempt: int, layout: Layout, style: Style) -> Scene:
    """Return a furnished plan at y = 0."""
    states = _furnish(spec, attempt, layout, style)
    home = _Collector()
    _add_structure(home, layout, style, spec, attempt)
    pieces: list[tuple[Instance, Asset]] = []
    for state in states:
        for placed in state.placed:
            opens = spec.articulated and placed.piece.opens is not None
            instances = home.opening(placed) if opens else [home.furniture(placed)]
            pieces += [(instance, home.assets[instance.asset]) for instance in instances]
    rng = stage_rng(spec, "lamps", attempt)
    lamp = ceiling_lamp(rng, style)
    for room in layout.rooms:
        x0, z0, x1, z1 = room.interior
        nx, nz = (max(1, round((b - a) / _LAMP_EVERY_M)) for a, b in ((x0, x1), (z0, z1)))
        for i, k in product(range(nx), range(nz)):
            x, z = x0 + (i + 0.5) * (x1 - x0) / nx, z0 + (k + 0.5) * (z1 - z0) / nz
            home.furniture(Placed(piece=lamp, room=room.name, x=x, z=z, quarter=0, y=WALL_HEIGHT, layer="ceiling"))
    rng = stage_rng(spec, "clutter", attempt)
    if spec.look is None:
        variants = object_assets(rng, style)
        things = clutter(rng, variants, pieces, spec.clutter)
        used = {i.asset for i in things}
        home.assets.update({a.name: a for group in variants.values() for a in group if a.name in used})
    else:
        things, assets = leave_about(rng, spec.look, states, pieces, spec.clutter)
        home.assets.update(assets)
    rooms = tuple(
        Room(name=r.name, category=r.category, rectangles=np.array([r.rect], np.float64)) for r in layout.rooms
    )
    home.assets = _dense(home.assets, spec)
    return Scene(
        name=_name(spec),
        assets=home.assets,
        instances=(*home.instances, *things),
        rooms=rooms,
        source=_source(spec),
        articulations=carrying(home.articulations, home.instances, home.assets, things),
    )


def _source(spec: HomeSpec) -> dict[str, Any]:
    source = {"kind": "home", "preset": spec.preset, "seed": int(spec.seed), **spec.changes}
    return source if spec.look is None else {**source, "style": spec.look}


def _style(spec: HomeSpec, layout: Layout, attempt: int) -> Style:
    rng = stage_rng(spec, "style", attempt)
    return sample_style(rng, layout) if spec.look is None else sample_look(rng, layout, spec.look)


def _name(spec: HomeSpec) -> str:
    options = "".join(
        f"_{name}" if v is True else f"_{name}_{v if isinstance(v, str) else f'{v:g}'}"
        for name, v in spec.changes.items()
    )
    return f"home_{spec.preset}_{int(spec.seed)}{options}"


def _furnish(spec: HomeSpec, attempt: int, layout: Layout, style: Style) -> list[RoomState]:
    """Return all rooms with their furniture.

    The dining table stands in the dining room if there is one, else in a kitchen above 10.5 m2 or in the living room; the
    other of the two is the fallback. A plan without a kitchen is that of an upper storey, where nobody dines.
    """
    kinds = [r.category for r in layout.rooms]
    if "kitchen" not in kinds:
        return [_furnish_room(spec, attempt, layout, style, r, dining=False) for r in layout.rooms]
    kitchen = layout.rooms[kinds.index("kitchen")]
    hosts = ["kitchen", "living"] if kitchen.area > 10.5 else ["living", "kitchen"]
    if "dining" in kinds:
        hosts = ["dining"]
    for last in (False, True):
        host = layout.rooms[kinds.index(hosts[-1] if last else hosts[0])]
        try:
            # The host comes first: if the table does not fit, furnishing the other rooms would be wasted.
            rooms = sorted(layout.rooms, key=lambda r: r is not host)
            states = {r.name: _furnish_room(spec, attempt, layout, style, r, dining=r is host) for r in rooms}
            return [states[r.name] for r in layout.rooms]
        except NoRoomError:
            if last:
                raise
    raise AssertionError


def _furnish_room(
    spec: HomeSpec, attempt: int, layout: Layout, style: Style, room: RoomPlan, *, dining: bool
) -> RoomState:
    for again in range(_ROOM_ATTEMPTS):
        state = room_state(layout, room)
        try:
            rng = stage_rng(spec, f"furnish/{room.name}/{again}", attempt)
            if spec.generation == 1:
                FURNISH[room.category](rng, style, state, dining)
            else:
                furnish(rng, style, state, dining)
            return state
        except NoRoomError:
            if again == _ROOM_ATTEMPTS - 1:
                raise
    raise AssertionError


def _add_structure(home: _Collector, layout: Layout, style: Style, spec: HomeSpec, attempt: int) -> None:
    rng = stage_rng(spec, "structure", attempt)
    home.structure(structure.walls_asset(layout, style))
    for room in layout.rooms:
        mesh = floor_mesh(room, style, rng)
        home.structure(Asset(name=f"floor_{room.name}", mesh=mesh, category="floor"))
    home.structure(structure.ceiling_asset(layout, style), layer="ceiling")
    home.structure(structure.trim_asset(layout, style))
    windows = [o for o in layout.openings if o.kind == "window"]
    for i, opening in enumerate(windows):
        home.structure(structure.window_asset(layout, opening, i, style))
    rng = stage_rng(spec, "blinds", attempt)
    for i, opening in enumerate(windows):
        if layout.room(opening.rooms[0]).category not in ("hall", "laundry", "garage") and rng.random() < 0.7:
            home.structure(structure.blind_asset(layout, opening, i, style, rng))
    for opening in layout.openings:
        if opening.kind == "entrance":
            home.structure(structure.entrance_asset(layout, opening, style))
        elif opening.kind == "gate":
            home.structure(structure.entrance_asset(layout, opening, style, f"gate_{opening.rooms[0]}"))
    for i, opening in enumerate(o for o in layout.openings if o.kind == "parapet"):
        home.structure(structure.balustrade_asset(layout, opening, i, style))
