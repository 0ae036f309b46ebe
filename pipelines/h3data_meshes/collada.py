"""Reader of Collada files (1.4, 1.5): scene graph, triangles and polygons with holes, colours and textures.

Vertices are transformed by unit x up_axis x nodes, as in Gazebo and Bullet. The result is in metres with +Z up for any
``up_axis`` of the file, which is the frame of robots.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.geometry import Array, normalized
from h3data.mesh.gltf_primitives import DEFAULT_COLOR, MAX_TRIANGLES
from h3data.mesh.images import image_texture
from h3data.mesh.mesh import Mesh, Texture
from h3data_meshes.polygons import triangulated, with_holes

_log = logging.getLogger(__name__)

Element = ElementTree.Element

_MAX_NODES = 1_000_000
"""Limit of nodes with all their instances: nested instances can make a small file endless."""
_MAX_DEPTH = 500

_UP_AXES = {
    "X_UP": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],  # about y, as Bullet has it
    "Y_UP": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "Z_UP": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
}
_PRIMITIVES = ("triangles", "polylist", "polygons", "tristrips", "trifans")


@dataclass(frozen=True, kw_only=True, eq=False)
class ColladaPart:
    """Triangles of one primitive with separate corners, with the matrix of the node that places them."""

    mesh: Mesh
    """Mesh in the geometry's own frame and units."""
    matrix: Array
    """Matrix from the geometry's frame to metres and +Z up, 4x4."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Primitive:
    """One primitive before a material paints it: one row per corner of its triangles."""

    symbol: str
    positions: Array
    normals: Array | None
    uv: dict[int, Array]
    """Texture coordinates by the number of their set."""
    colors: Array | None


@dataclass(frozen=True, kw_only=True)
class _Look:
    color: tuple[int, int, int] = DEFAULT_COLOR
    texture: Texture | None = None
    texcoord: str = ""
    """Name that the material gives to its texture coordinates."""


def read_collada(path: Path, resource: Callable[[str], bytes]) -> list[ColladaPart]:
    """Return the parts of the file's scene; ``resource`` returns the bytes of an image by its name in the file.

    Raises:
        SceneError, ValueError, ParseError: the file is damaged; the message states where, and `h3data.mesh.loading`
            adds the name of the file.
    """
    return list(_Collada(path, resource).parts())


@dataclass(eq=False)
class _Collada:
    path: Path
    resource: Callable[[str], bytes]
    _primitives: dict[int, list[_Primitive]] = field(default_factory=dict)
    _looks: dict[str, _Look] = field(default_factory=dict)
    _said: set[str] = field(default_factory=set)

    @cached_property
    def root(self) -> Element:
        data = self.path.read_bytes().strip(b"\0 \t\r\n")
        if re.search(rb"<!(DOCTYPE|ENTITY)", data, re.IGNORECASE):
            raise SceneError("Collada with a DOCTYPE or entities is refused", code="H3-MESH-030")
        root = ElementTree.fromstring(data)
        for element in root.iter():
            element.tag = str(element.tag).rpartition("}")[2]
        if root.tag != "COLLADA":
            raise ValueError(f"its root element is <{root.tag}>, not <COLLADA>")
        return root

    @cached_property
    def _by_id(self) -> dict[tuple[str, str], Element]:
        """Elements by their kind and id: some exporters give a node and its geometry the same id."""
        found: dict[tuple[str, str], Element] = {}
        for element in self.root.iter():
            if "id" in element.attrib:
                found.setdefault((element.tag, element.attrib["id"]), element)
        return found

    def _target(self, element: Element, kind: str, attribute: str = "url") -> Element | None:
        """Return the element of this kind that ``element`` refers to; None, said once, if it is not there."""
        name = element.get(attribute, "")
        target = self._by_id.get((kind, unquote(name).removeprefix("#"))) or self._by_id.get((kind, name[1:]))
        if target is None:
            self._say(f"<{element.tag}> refers to the {kind} {name[:100]!r}, which is not there")
        return target

    def _say(self, what: str) -> None:
        if what not in self._said:
            self._said.add(what)
            _log.warning("%s; it is left out: %s", what, self.path)

    # --- scene graph --------------------------------------------------------------------------------------------------
    def parts(self) -> Iterator[ColladaPart]:
        """Yield every primitive, once per node that shows it."""
        shown = 0
        for geometry, matrix, looks in self._instances():
            for primitive in self._geometry(geometry):
                shown += len(primitive.positions) // 3
                if shown > MAX_TRIANGLES:
                    raise ValueError(f"its nodes show more than {MAX_TRIANGLES} triangles")
                yield ColladaPart(mesh=self._painted(primitive, looks), matrix=matrix)

    def _to_metres(self) -> Array:
        unit, axis = self.root.find("asset/unit"), self.root.findtext("asset/up_axis", "Y_UP").strip().upper()
        metres = 1.0 if unit is None else _numbers(unit.get("meter", "1"), 1, "<unit meter>")[0]
        if not (np.isfinite(metres) and metres > 0):
            raise ValueError(f"<unit meter> is {metres:g}, not a positive number")
        if axis not in _UP_AXES:
            raise ValueError(f"<up_axis> is {axis[:40]!r}, not one of {', '.join(_UP_AXES)}")
        matrix = np.eye(4)
        matrix[:3, :3] = np.array(_UP_AXES[axis], np.float64) * metres
        return matrix

    def _instances(self) -> Iterator[tuple[Element, Array, dict[str, Element]]]:
        """Yield geometries that the scene shows, each with its matrix and the materials of its primitives by symbol."""
        to_metres = self._to_metres()
        scene = self.root.find("scene/instance_visual_scene")
        shown = None if scene is None else self._target(scene, "visual_scene")
        if shown is None:
            shown = self.root.find("library_visual_scenes/visual_scene")
        if shown is None:  # a library alone shows all that it has
            yield from ((g, to_metres, {}) for g in self.root.iterfind("library_geometries/geometry"))
            return
        waiting = [(node, to_metres, frozenset[int]()) for node in reversed(shown.findall("node"))]
        count = 0
        while waiting:
            node, above, ancestors = waiting.pop()
            count += 1
            if id(node) in ancestors or len(ancestors) > _MAX_DEPTH or count > _MAX_NODES:
                raise ValueError(f"the node {node.get('id', node.get('name', ''))!r} is inside itself, or too deep")
            matrix = above @ _node_matrix(node)
            for instance in node.iterfind("instance_geometry"):
                geometry = self._target(instance, "geometry")
                if geometry is not None:
                    yield geometry, matrix, _bindings(instance)
            for instance in node.iterfind("instance_controller"):
                controller = self._target(instance, "controller")
                if controller is not None:
                    yield from self._controlled(controller, matrix, _bindings(instance), to_metres)
            below = node.findall("node")
            for instance in node.iterfind("instance_node"):
                target = self._target(instance, "node")
                if target is not None:
                    below.append(target)
            waiting += [(child, matrix, ancestors | {id(node)}) for child in reversed(below)]

    def _controlled(
        self, controller: Element, matrix: Array, looks: dict[str, Element], to_metres: Array
    ) -> Iterator[tuple[Element, Array, dict[str, Element]]]:
        """Add a skin in its bind pose, which is in the scene's frame, or the base of a morph."""
        for _ in range(10):
            skin, morph = controller.find("skin"), controller.find("morph")
            deformer = skin if skin is not None else morph
            if deformer is None:
                return
            if skin is not None:
                text = skin.findtext("bind_shape_matrix")
                matrix = (
                    to_metres if text is None else to_metres @ _numbers(text, 16, "<bind_shape_matrix>").reshape(4, 4)
                )
            name = deformer.get("source", "").removeprefix("#")
            geometry = self._by_id.get(("geometry", name))
            if geometry is not None:
                yield geometry, matrix, looks
                return
            below = self._by_id.get(("controller", name))
            if below is None:
                self._say(f"a controller refers to {name[:100]!r}, which is not there")
                return
            controller = below

    # --- triangles ----------------------------------------------------------------------------------------------------
    def _geometry(self, geometry: Element) -> list[_Primitive]:
        if id(geometry) not in self._primitives:
            mesh = geometry.find("mesh")
            where = f"geometry {geometry.get('id', '')!r}"
            found = [] if mesh is None else [self._primitive(p, mesh, where) for p in mesh if p.tag in _PRIMITIVES]
            self._primitives[id(geometry)] = [p for p in found if p is not None]
        return self._primitives[id(geometry)]

    def _primitive(self, element: Element, mesh: Element, where: str) -> _Primitive | None:
        where = f"{where}, <{element.tag}>"
        inputs = self._inputs(element, mesh, where)
        if "POSITION" not in {semantic for semantic, _ in inputs}:
            self._say(f"{where} has no positions")
            return None
        width = max(_natural(record.get("offset", "0"), where) for record in element.iterfind("input")) + 1
        position_at, position = next(v for (semantic, _), v in inputs.items() if semantic == "POSITION")
        if position.shape[1] < 3:
            raise ValueError(f"{where} has positions of {position.shape[1]} numbers, not 3")
        corners = self._corners(element, width, position_at, position, where)
        if not len(corners):
            return None

        def taken(offset: int, values: Array, semantic: str) -> Array:
            index = corners[:, offset]
            if index.min() < 0 or index.max() >= len(values):
                raise ValueError(f"{where} has {semantic} indices up to {index.max()}, there are {len(values)}")
            return values[index]

        positions = taken(position_at, position, "POSITION")[:, :3]
        others = [(s, k, taken(*v, s)) for (s, k), v in inputs.items() if s in ("NORMAL", "TEXCOORD", "COLOR")]
        normals = next((v[:, :3] for s, _, v in others if s == "NORMAL" and v.shape[1] >= 3), None)
        return _Primitive(
            symbol=element.get("material", ""),
            positions=positions,
            normals=normals,
            uv={k: v[:, :2] for s, k, v in others if s == "TEXCOORD" and v.shape[1] >= 2},
            colors=next((v[:, :3] for s, _, v in others if s == "COLOR" and v.shape[1] >= 3), None),
        )

    def _inputs(self, element: Element, mesh: Element, where: str) -> dict[tuple[str, int], tuple[int, Array]]:
        """Return offset and values [N, width] of every input by its meaning and set.

        The input VERTEX stands for those of <vertices>.
        """
        found: dict[tuple[str, int], tuple[int, Array]] = {}
        for record in element.iterfind("input"):
            offset, number = _natural(record.get("offset", "0"), where), _natural(record.get("set", "0"), where)
            if record.get("semantic") == "VERTEX":
                name = record.get("source", "").removeprefix("#")
                vertices = next((v for v in mesh.iterfind("vertices") if v.get("id", name) == name), None)
                inner = [] if vertices is None else vertices.findall("input")
            else:
                inner = [record]
            for one in inner:
                semantic = one.get("semantic", "")
                if semantic in ("POSITION", "NORMAL", "TEXCOORD", "COLOR"):
                    found.setdefault((semantic, number), (offset, self._source(one, mesh, where)))
        return found

    def _source(self, record: Element, mesh: Element, where: str) -> Array:
        """Return the named values of a source, [N, width]."""
        name = record.get("source", "").removeprefix("#")
        source = next((s for s in mesh.iterfind("source") if s.get("id") == name), None)
        source = self._by_id.get(("source", name)) if source is None else source
        if source is None:
            raise ValueError(f"{where} refers to the source {name[:100]!r}, which is not there")
        array = source.find("float_array")
        array = source.find("int_array") if array is None else array
        values = _numbers((array.text or "") if array is not None else "", None, f"source {name!r}")
        accessor = source.find("technique_common/accessor")
        if accessor is None:
            return values[: len(values) // 3 * 3].reshape(-1, 3)
        stride, start = _natural(accessor.get("stride", "1"), where), _natural(accessor.get("offset", "0"), where)
        parameters = accessor.findall("param")
        named = [k for k, p in enumerate(parameters) if p.get("name")] or list(range(stride))
        count = min(_natural(accessor.get("count", "0"), where), (len(values) - start) // max(stride, 1))
        if not stride or count <= 0 or max(named) >= stride:
            return np.zeros((0, max(len(named), 1)))
        return values[start : start + count * stride].reshape(count, stride)[:, named]

    def _corners(self, element: Element, width: int, at: int, positions: Array, where: str) -> NDArray[np.int64]:
        """Return rows of indices [C, width], three for each triangle."""
        tag = element.tag
        texts = [e.text or "" for e in element.iterfind("p")]
        rows = [_rows(text, width, where) for text in texts]
        if tag == "triangles":
            corners = np.concatenate([np.zeros((0, width), np.int64), *rows])
            return corners[: len(corners) // 3 * 3]
        if tag in ("tristrips", "trifans"):
            cut = [r[_strip(len(r)) if tag == "tristrips" else _fan(len(r))].reshape(-1, width) for r in rows]
            return np.concatenate([np.zeros((0, width), np.int64), *cut])
        if tag == "polylist":
            counts = _integers(element.findtext("vcount") or "", f"{where} <vcount>")
            if len(counts) and (counts.min() < 0 or counts.sum() > sum(map(len, rows))):
                raise ValueError(f"{where} has {sum(map(len, rows))} corners, <vcount> needs {counts.sum()}")
        else:
            for hollow in element.iterfind("ph"):
                rings = [_rows(e.text or "", width, where) for e in hollow if e.tag in ("p", "h")]
                rings = [r for r in rings if len(r) >= 3]
                if rings:
                    rows.append(np.concatenate(rings)[with_holes(*_outline(rings, at, positions, where))])
            counts = np.array([len(r) for r in rows], np.int64)
        corners = np.concatenate([np.zeros((0, width), np.int64), *rows])
        triangles, _ = triangulated(_at(positions, corners[:, at], where), counts)
        return corners[triangles.ravel()]

    # --- materials ----------------------------------------------------------------------------------------------------
    def _painted(self, primitive: _Primitive, bindings: Mapping[str, Element]) -> Mesh:
        binding = bindings.get(primitive.symbol)
        material = binding.get("target", "") if binding is not None else f"#{primitive.symbol}"
        look = self._look(material.removeprefix("#"))
        count = len(primitive.positions)
        uv = None if look.texture is None else _texture_coordinates(primitive.uv, binding, look.texcoord)
        colors = np.full((count, 3), DEFAULT_COLOR, np.uint8)
        if uv is not None:
            colors[:] = 255
        elif primitive.colors is not None:
            colors = np.rint(np.nan_to_num(primitive.colors).clip(0, 1) * 255).astype(np.uint8)
        else:
            colors[:] = look.color
        normals = primitive.normals
        if normals is not None:
            normals = normalized(np.nan_to_num(normals)).astype(np.float32)
        return Mesh(
            vertices=primitive.positions.astype(np.float32),
            faces=np.arange(count, dtype=np.int32).reshape(-1, 3),
            colors=colors,
            normals=normals,
            uv=uv,
            textures=() if uv is None or look.texture is None else (look.texture,),
        )

    def _look(self, name: str) -> _Look:
        if name not in self._looks:
            material = self._by_id.get(("material", name))
            instance = None if material is None else material.find("instance_effect")
            effect = None if instance is None else self._target(instance, "effect")
            self._looks[name] = _Look() if effect is None else self._effect(effect, name)
        return self._looks[name]

    def _effect(self, effect: Element, name: str) -> _Look:
        parameters = {p.get("sid", ""): p for p in effect.iter("newparam")}
        models = [m for kind in ("phong", "blinn", "lambert", "constant") for m in effect.iter(kind)]
        diffuse = next(
            (d for m in models for d in m if d.tag == ("emission" if m.tag == "constant" else "diffuse")), None
        )
        if diffuse is None:
            return _Look()
        color, shown = diffuse.find("color"), diffuse.find("texture")
        if shown is not None:
            image = self._image(shown.get("texture", ""), parameters)
            texture = None if image is None else self._texture(image, name)
            return _Look(texture=texture, texcoord=shown.get("texcoord", ""))
        if color is None:
            return _Look()
        rgb = _numbers(color.text or "", None, f"material {name!r}")[:3]
        if len(rgb) < 3:
            return _Look()
        r, g, b = np.rint(np.nan_to_num(rgb).clip(0, 1) * 255).astype(int).tolist()
        return _Look(color=(r, g, b))

    def _image(self, name: str, parameters: Mapping[str, Element]) -> Element | None:
        """Return the image behind a sampler, its surface, or the image's own id."""
        for _ in range(3):
            parameter = parameters.get(name)
            if parameter is None:
                return self._by_id.get(("image", name))
            found = next((e for e in parameter.iter() if e.tag in ("source", "init_from", "instance_image")), None)
            if found is None:
                return None
            name = (found.get("url") or found.text or "").strip().removeprefix("#")
        return self._by_id.get(("image", name))

    def _texture(self, image: Element, name: str) -> Texture | None:
        text = image.findtext("init_from/ref") or image.findtext("init_from") or ""
        try:
            return image_texture(self.resource(unquote(text.strip())), name=name, alpha="OPAQUE")
        except OSError:
            return None  # the resource says so
        except SceneError as reason:
            _log.warning("a texture is left out, its surfaces show another colour (%s): %s", reason, self.path)
            return None


def _bindings(instance: Element) -> dict[str, Element]:
    return {m.get("symbol", ""): m for m in instance.iter("instance_material")}


def _texture_coordinates(sets: Mapping[int, Array], binding: Element | None, name: str) -> NDArray[np.float32] | None:
    """Return the coordinates of the set that the instance binds to the material's name; else of the first set."""
    if not sets:
        return None
    bound = [] if binding is None else [b for b in binding.iterfind("bind_vertex_input") if b.get("semantic") == name]
    wanted = next((int(b.get("input_set", "0")) for b in bound if b.get("input_set", "0").isdigit()), min(sets))
    values = np.nan_to_num(sets.get(wanted, sets[min(sets)]))
    return np.column_stack([values[:, 0], 1 - values[:, 1]]).astype(
        np.float32
    )  # from the lower left corner to the upper


def _node_matrix(node: Element) -> Array:
    """Return the product of a node's transforms, in the order in which they stand."""
    matrix = np.eye(4)
    for element in node:
        make = _TRANSFORMS.get(element.tag)
        if make is not None:
            matrix = matrix @ make(element.text or "")
    return matrix


def _matrix(text: str) -> Array:
    return _numbers(text, 16, "<matrix>").reshape(4, 4)


def _translate(text: str) -> Array:
    matrix = np.eye(4)
    matrix[:3, 3] = _numbers(text, 3, "<translate>")
    return matrix


def _scale(text: str) -> Array:
    return np.diag([*_numbers(text, 3, "<scale>"), 1.0])


def _rotate(text: str) -> Array:
    x, y, z, degrees = _numbers(text, 4, "<rotate>")
    axis, angle = normalized(np.array([x, y, z])), np.radians(degrees)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return matrix


def _lookat(text: str) -> Array:
    """Return the transform of a view from the eye along -z to the point of interest."""
    eye, interest, up = _numbers(text, 9, "<lookat>").reshape(3, 3)
    forward = normalized(interest - eye)
    right = normalized(np.cross(forward, up))
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([right, np.cross(right, forward), -forward, eye])
    return matrix


def _skew(text: str) -> Array:
    """Return RenderMan's skew, which turns the first axis by an angle [deg] towards the second one.

    All points slide along the second axis.
    """
    values = _numbers(text, 7, "<skew>")
    angle, turned, along = np.radians(values[0]), normalized(values[1:4]), normalized(values[4:])
    across = turned - along * (turned @ along)
    if not np.linalg.norm(across) > 1e-9:
        raise ValueError("<skew> has two axes that are one")
    across = normalized(across)
    x, y = turned @ across, turned @ along
    new_x, new_y = x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)
    if new_x <= 0:
        raise ValueError(f"<skew> has the angle {values[0]:g}, which is too large")
    matrix = np.eye(4)
    matrix[:3, :3] += (new_y / new_x - y / x) * np.outer(along, across)
    return matrix


_TRANSFORMS: dict[str, Callable[[str], Array]] = {
    "matrix": _matrix,
    "translate": _translate,
    "scale": _scale,
    "rotate": _rotate,
    "lookat": _lookat,
    "skew": _skew,
}


def _numbers(text: str, count: int | None, where: str) -> Array:
    try:
        values = np.array(text.split(), np.float64)
    except ValueError:
        raise ValueError(f"{where} is not numbers but {text.strip()[:60]!r}") from None
    if count is not None and values.shape != (count,):
        raise ValueError(f"{where} has {len(values)} numbers, not {count}")
    return values


def _integers(text: str, where: str) -> NDArray[np.int64]:
    try:
        return np.array(text.split(), np.int64)
    except (ValueError, OverflowError):
        raise ValueError(f"{where} is not integers but {text.strip()[:60]!r}") from None


def _natural(text: str, where: str) -> int:
    if not re.fullmatch(r"\s*\d{1,9}\s*", text):
        raise ValueError(f"{where}: {text[:40]!r} is not a count")
    return int(text)


def _rows(text: str, width: int, where: str) -> NDArray[np.int64]:
    values = _integers(text, where)
    return values[: len(values) // width * width].reshape(-1, width)


def _at(values: Array, index: NDArray[np.int64], where: str) -> Array:
    if len(index) and (index.min() < 0 or index.max() >= len(values)):
        raise ValueError(f"{where} has POSITION indices up to {index.max()}, there are {len(values)}")
    return values[index][:, :3]


def _outline(rings: list[NDArray[np.int64]], at: int, positions: Array, where: str) -> tuple[Array, list[Array]]:
    outline, *holes = (_at(positions, ring[:, at], where) for ring in rings)
    return outline, holes


def _strip(count: int) -> NDArray[np.int64]:
    """Return corners of a strip's triangles, [F, 3]; every second one is turned."""
    first = np.arange(max(count - 2, 0))
    odd = first % 2
    return np.stack([first, first + 1 + odd, first + 2 - odd], 1)


def _fan(count: int) -> NDArray[np.int64]:
    second = np.arange(1, max(count - 1, 1))
    return np.stack([np.zeros_like(second), second, second + 1], 1)
