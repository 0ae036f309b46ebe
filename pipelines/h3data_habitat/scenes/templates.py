"""Templates of Habitat (stage, object and articulated object configs, or bare meshes and URDFs) as assets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, MissingAssetError, SceneError
from h3data.mesh.loading import frame_rotation, load_mesh, load_parts
from h3data.mesh.mesh import Mesh
from h3data.mesh.primitives import is_primitive, primitive_mesh
from h3data.scene.records import Asset, Receptacle, Shape
from h3data_habitat.scenes.articulated import Link, empty_mesh, read_links, receptacles_by_link
from h3data_habitat.scenes.collision_geometry import box_shape, hull_shape, hull_shapes
from h3data_habitat.scenes.config_keys import KeyNotes
from h3data_habitat.scenes.config_values import flag, mapping, number, numbers, text
from h3data_habitat.scenes.node_boxes import node_box
from h3data_habitat.scenes.receptacles import read_receptacles
from h3data_habitat.scenes.referenced_files import ReferencedFiles
from h3data_habitat.scenes.scene_dataset import Template

if TYPE_CHECKING:
    from h3data.bodies.robots.robot import Robot

_Y_UP = ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0))
_Z_UP = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Rigid:
    """Stage or object template that has been read."""

    asset: str
    attributes: Mapping[str, Any]
    scale: NDArray[np.float64]
    """Scale of the template, shape [3]."""
    middle: NDArray[np.float64]
    """Habitat's origin of the object in the asset's frame, shape [3] [m]."""
    middle_scales: bool
    """True if Habitat's origin scales with the object, which is the case unless the config gives the origin."""

    def origin(self, scale: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return Habitat's origin of an object of a given size, in the asset's axes, shape [3] [m]."""
        return self.middle * scale if self.middle_scales else self.middle


@dataclass(frozen=True, kw_only=True, eq=False)
class Articulated:
    """An articulated template that has been read."""

    robot: Robot
    links: tuple[Link, ...]
    assets: tuple[str, ...]
    """Assets of each of the links."""
    attributes: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Frame:
    """The axes and unit of an asset's files."""

    up: tuple[float, ...]
    front: tuple[float, ...]
    units_m: float

    def load(self, file: Path) -> Mesh:
        return load_mesh(file, up=self.up, front=self.front, units_m=self.units_m)


@dataclass
class TemplateReader:
    """Reader of templates, which reads each template once."""

    files: ReferencedFiles
    keys: KeyNotes
    classes: Mapping[int, str] = field(default_factory=dict)
    """Category by semantic id."""
    assets: dict[str, Asset] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    """Files that do not exist, with the places where they were searched."""
    _read: dict[int, Rigid | Articulated | None] = field(default_factory=dict)
    _alive: list[Template] = field(default_factory=list)

    def stage(self, template: Template) -> Rigid | None:
        """Return the stage, or None if its mesh is missing."""
        return self._rigid(template, stage=True)

    def rigid(self, template: Template) -> Rigid | None:
        """Return a rigid object, or None with a warning or an entry in ``missing`` if it cannot be used."""
        read = self._once(template)
        return read if isinstance(read, Rigid) else None

    def articulated(self, template: Template) -> Articulated | None:
        """Read the template of an articulated object."""
        read = self._once(template)
        return read if isinstance(read, Articulated) else None

    def _once(self, template: Template) -> Rigid | Articulated | None:
        if id(template) not in self._read:
            self._alive.append(template)  # keeps the id unique while this reader lives
            try:
                jointed = "urdf_filepath" in template.attributes() or template.path.name.endswith(".ao_config.json")
                read = self._articulated(template) if jointed else self._rigid(template, stage=False)
            except SceneError as fault:
                self.warnings.append(f"{template.handle!r} is left out: {fault}")
                read = None
            self._read[id(template)] = read
        return self._read[id(template)]

    # --- stages and objects -------------------------------------------------------------------------------------------
    def _rigid(self, template: Template, *, stage: bool) -> Rigid | None:
        attributes, where = template.attributes(), template.path
        self.keys.note("stage_config" if stage else "object_config", attributes)
        frame = _frame(template, attributes, stage=stage)
        asset = text(attributes, "render_asset", where=where) or text(attributes, "collision_asset", where=where)
        if not asset:
            raise FormatError(f"The template {template.handle!r} names no render_asset: {where}", code="H3-HABITAT-137")
        file = None if is_primitive(asset) else self._file(asset, where)
        if file is None and not is_primitive(asset):
            return None
        mesh = primitive_mesh(asset) if file is None else frame.load(file)
        semantic = int(number(attributes, "semantic_id", 0, where=where))
        scale = np.array(numbers(attributes, "scale", (1, 1, 1), where=where), np.float64)
        # a stage has no convex parts: walls come from its mesh
        collides = flag(attributes, "is_collidable", True, where=where) and not stage
        name = self._add(
            template,
            mesh=mesh,
            category="stage" if stage else self.classes.get(semantic, "object"),
            shapes=self._shapes(template, attributes, mesh, frame) if collides else (),
            receptacles=self._receptacles(
                mapping(attributes, "user_defined", where=where),
                where,
                turn=frame_rotation(frame.up, frame.front),
                stage=stage,
            ),
        )
        # a COM in the file wins, unless it asks for the computed one
        given = attributes.get("COM") is not None and not attributes.get("compute_COM_from_shape")
        if given:
            middle = np.array(numbers(attributes, "COM", (0, 0, 0), where=where))
        elif file is None or stage:
            middle = np.zeros(3)
        else:
            middle = node_box(file, up=frame.up, front=frame.front, units_m=frame.units_m).mean(0)
        return Rigid(asset=name, attributes=attributes, scale=scale, middle=middle, middle_scales=not given)

    def _shapes(
        self, template: Template, attributes: Mapping[str, Any], mesh: Mesh, frame: _Frame
    ) -> tuple[Shape, ...]:
        """Return the convex parts of an object: of its collision asset, else of its looks."""
        where = template.path
        asset = text(attributes, "collision_asset", where=where) or text(attributes, "render_asset", where=where) or ""
        if is_primitive(asset):
            # primitives collide in the size of their own key, the scale of the template comes on top
            solid = primitive_mesh(asset)
            if attributes.get("collision_asset"):
                size = np.array(numbers(attributes, "collision_asset_size", (1, 1, 1), where=where), np.float32)
                solid = replace(solid, vertices=solid.vertices * size, normals=None)
            return (hull_shape(solid.vertices),) if len(solid.vertices) else ()
        file = self.files.find(asset, where.parent)
        if file is None:
            self.warnings.append(
                f"{template.handle!r} collides as what is seen: its collision_asset {asset!r} is missing"
            )
            return hull_shapes([mesh])
        solid = frame.load(file)
        if flag(attributes, "use_bounding_box_for_collision", False, where=where):
            return (box_shape(solid.vertices),)
        if flag(attributes, "join_collision_meshes", False, where=where):
            return (hull_shape(solid.vertices),)
        return hull_shapes(load_parts(file, up=frame.up, front=frame.front, units_m=frame.units_m))

    # --- articulated objects ------------------------------------------------------------------------------------------
    def _articulated(self, template: Template) -> Articulated | None:
        attributes, where = template.attributes(), template.path
        self.keys.note("ao_config", attributes)
        urdf = text(attributes, "urdf_filepath", where=where) or f"{template.handle}.urdf"
        file = self._file(urdf, where)
        if file is None:
            return None
        try:
            robot, links = read_links(file)
        except MissingAssetError as fault:
            self.missing.append(str(fault))
            return None
        except FormatError as fault:  # of the URDF, not of a config: the rest of the scene stays usable
            raise SceneError(str(fault), code=fault.code) from None
        semantic = int(number(attributes, "semantic_id", 0, where=where))
        on_links = receptacles_by_link(mapping(attributes, "user_defined", where=where), where=where)
        for lost in sorted(set(on_links) - {link.name for link in links}):
            self.warnings.append(f"receptacles of {template.handle!r} on {lost!r} are left out: it has no such link")
        assets = tuple(
            self._add(
                template,
                suffix=f"/{link.name}",
                mesh=link.mesh,
                category=self.classes.get(semantic, "articulated"),
                shapes=link.shapes,
                receptacles=self._receptacles(on_links.get(link.name, {}), where, turn=link.turn, stage=False),
            )
            for link in links
        )
        return Articulated(robot=robot, links=links, assets=assets, attributes=attributes)

    # --- both ---------------------------------------------------------------------------------------------------------
    def _file(self, name: str, where: Path) -> Path | None:
        file = self.files.find(name, where.parent)
        if file is None:
            places = ", ".join(dict.fromkeys(str(p) for p in self.files.missing[name]))
            self.missing.append(f"{name[:200]!r} of {where} (looked for: {places[:1000]})")
        return file

    def _receptacles(
        self, entries: Mapping[str, Any], where: Path, *, turn: NDArray[np.float64], stage: bool
    ) -> tuple[Receptacle, ...]:
        found, notes = read_receptacles(
            entries,
            find=lambda name: self.files.find(name, where.parent),
            frame=turn,
            stage=stage,
            keys=self.keys,
            where=where,
        )
        self.warnings += notes
        return found

    def _add(
        self,
        template: Template,
        *,
        suffix: str = "",
        mesh: Mesh,
        category: str,
        shapes: tuple[Shape, ...],
        receptacles: tuple[Receptacle, ...],
    ) -> str:
        name = template.handle + suffix
        while name in self.assets:  # another folder of the dataset, or the stage, has the same file name
            name += "~"
        self.assets[name] = Asset(name=name, mesh=mesh, category=category, shapes=shapes, receptacles=receptacles)
        return name

    def hidden(self, asset: str) -> str:
        """Return an asset with the same collision shapes that is not rendered."""
        name = f"{asset}~hidden"
        self.assets.setdefault(name, replace(self.assets[asset], name=name, mesh=empty_mesh()))
        return name


def _frame(template: Template, attributes: Mapping[str, Any], *, stage: bool) -> _Frame:
    """Return a mesh's frame: as in habitat-sim, a bare stage mesh is Z-up; else Y-up unless its config says more."""
    where = template.path
    # habitat-sim takes scans as they are, and scans are Z-up
    bare = stage and not template.is_config and not template.inline and not template.defaults
    up, front = _Z_UP if bare else _Y_UP
    frame = _Frame(
        up=numbers(attributes, "up", up, where=where),
        front=numbers(attributes, "front", front, where=where),
        units_m=number(attributes, "units_to_meters", 1.0, where=where),
    )
    if frame.units_m <= 0:
        raise FormatError(
            f"Expected a number above 0 under 'units_to_meters', got {frame.units_m:g}: {where}", code="H3-HABITAT-136"
        )
    # before any mesh is loaded: up and front may be parallel, where one of them is the default
    try:
        frame_rotation(frame.up, frame.front)
    except SceneError as fault:
        raise SceneError(f"{fault} Hint: give both up and front. {where}", code=fault.code) from None
    return frame
