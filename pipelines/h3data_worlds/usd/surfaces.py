"""Conversion of a stage's visible prims to meshes with colours and textures.

It supports polygons (subdivided ones by their control cage), boxes, balls, cylinders, cones, capsules and planes.
Materials are `UsdPreviewSurface` (colour, image, vertex colours), and the base colour and image of Omniverse's
materials.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.geometry import normalized
from h3data.mesh.images import image_texture
from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.primitives import box_mesh, capsule_mesh
from h3data.srgb import linear_to_bytes
from h3data_worlds.usd.polygons import triangles_of
from h3data_worlds.usd.stages import OpenStage, is_inside, pxr

MAX_TRIANGLES = 20_000_000
"""Largest number of triangles of all prims of a stage, where instanced ones are counted once."""
_GRAY = (0.5, 0.5, 0.5)


@dataclass(frozen=True, kw_only=True)
class Look:
    """Colour and image of a material; a colour of None stands for vertex colours."""

    color: tuple[float, float, float] | None = None
    """Colour in linear RGB; None stands for vertex colours."""
    texture: Texture | None = None
    st: str = "st"
    """Name of the texture coordinates."""


@dataclass(kw_only=True, eq=False)
class SurfaceReader:
    """Reader of the surfaces of one stage, which reads each material and image once."""

    open: OpenStage
    ours: bool = False
    """True if h3data wrote the stage, so that images are multiplied by vertex colours."""
    notes: dict[str, None] = field(default_factory=dict)
    """Sentences on omitted content, in order."""
    missing: dict[str, None] = field(default_factory=dict)
    """Names of images that do not exist."""
    triangles: int = 0
    _looks: dict[Any, Look] = field(default_factory=dict)
    _images: dict[str, Texture | None] = field(default_factory=dict)

    def mesh(self, prim: Any) -> Mesh | None:
        """Return the mesh of a prim in its own frame with +Y up [m]; None, with a note, if it has no usable triangles."""
        maker = MAKERS.get(prim.GetTypeName())
        if maker is None:
            self.notes[f"{prim.GetTypeName()} prims are not read, such as {prim.GetPath()}"] = None
            return None
        try:
            mesh = maker(self, prim)
        except (SceneError, ValueError) as fault:
            self.notes[f"{prim.GetPath()} is left out: {fault}"] = None
            return None
        self.triangles += 0 if mesh is None else len(mesh.faces)
        if self.triangles > MAX_TRIANGLES:
            raise SceneError(
                f"The stage has more than {MAX_TRIANGLES:,} triangles, which is the limit. Hint: reduce its meshes. "
                f"File: {self.open.path}",
                code="H3-WORLD-012",
            )
        return mesh

    @property
    def files(self) -> set[str]:
        """Paths of the image files that were read."""
        return set(self._images)

    # --- polygons -------------------------------------------------------------------------------------------------------
    def _polygons(self, prim: Any) -> Mesh | None:
        geom, time = pxr("UsdGeom"), pxr("Usd").TimeCode.EarliestTime()
        gprim = geom.Mesh(prim)
        points = _array(gprim.GetPointsAttr().Get(time), 3)
        counts = _array(gprim.GetFaceVertexCountsAttr().Get(time), 0).astype(np.int64)
        indices = _array(gprim.GetFaceVertexIndicesAttr().Get(time), 0).astype(np.int64)
        if not len(points) or not len(counts):
            return None
        if not np.isfinite(points).all():
            raise ValueError("its points are not finite numbers")
        if counts.min() < 0 or counts.sum() != len(indices):
            raise ValueError(f"its faces need {counts.sum()} indices, it has {len(indices)}")
        if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
            raise ValueError(f"its indices go from {indices.min()} to {indices.max()}, it has {len(points)} points")
        corners, face_of = triangles_of(points, counts, indices)
        holes = _array(gprim.GetHoleIndicesAttr().Get(time), 0)
        if len(holes):
            solid = ~np.isin(face_of, holes)
            corners, face_of = corners[solid], face_of[solid]
        if not len(corners):
            return None
        if gprim.GetOrientationAttr().Get(time) == geom.Tokens.leftHanded:
            corners = corners[:, ::-1]
        return self._assembled(gprim, points, counts, indices, corners, face_of)

    def _assembled(
        self, gprim: Any, points: NDArray[Any], counts: NDArray[Any], indices: NDArray[Any], corners: NDArray[Any],
        face_of: NDArray[Any],
    ) -> Mesh:  # fmt: skip
        """Return the mesh of triangles given as corners [F, 3] of polygons, each of the polygon ``face_of`` [F]."""
        looks, look_of_face = self._looks_of(gprim.GetPrim(), len(counts))
        look_of = look_of_face[face_of]
        values: dict[str, tuple[NDArray[Any], str]] = {}
        api = pxr("UsdGeom").PrimvarsAPI(gprim)
        time = pxr("Usd").TimeCode.EarliestTime()
        normals = _variable(api.GetPrimvar("normals")) or (
            _array(gprim.GetNormalsAttr().Get(time), 3), str(gprim.GetNormalsInterpolation())
        )  # fmt: skip
        if len(normals[0]):
            values["normals"] = normals
        textures = tuple(dict.fromkeys(look.texture for look in looks if look.texture is not None))
        if textures:
            name = next(look.st for look in looks if look.texture is not None)
            found = _variable(api.GetPrimvar(name)) or _variable(api.GetPrimvar("st")) or self._any_coordinates(api)
            if found is None:
                self.notes[f"{gprim.GetPath()} has an image but no texture coordinates"] = None
                textures = ()
            else:
                values["uv"] = found
        if not textures and (found := _variable(api.GetPrimvar("st"))) is not None:
            values["uv"] = found  # kept, so that our own meshes come back whole
        display = _variable(api.GetPrimvar("displayColor"))
        painted = display is not None and any(look.color is None for look in looks)
        if display is not None and painted:
            values["colors"] = display
        placed = {key: _placed(*value, len(points), len(counts), len(indices)) for key, value in values.items()}
        placed = {key: value for key, value in placed.items() if value is not None}
        by_point = all(kind in ("vertex", "constant") for _, kind in placed.values())
        one_color = all(look.color is None for look in looks) or len({look.color for look in looks}) == 1
        if by_point and one_color:
            faces, rows = indices[corners], np.arange(len(points))
            face_of_row = np.zeros(len(points), np.int64)
            corner_of_row = rows
        else:
            faces = np.arange(corners.size).reshape(-1, 3)
            rows, corner_of_row = indices[corners].ravel(), corners.ravel()
            face_of_row = np.repeat(face_of, 3)

        def of_rows(key: str) -> NDArray[np.float64] | None:
            if key not in placed:
                return None
            array, kind = placed[key]
            if kind == "constant":
                return np.broadcast_to(array[0], (len(rows), array.shape[1]))
            return array[{"vertex": rows, "uniform": face_of_row, "faceVarying": corner_of_row}[kind]]

        linear = of_rows("colors")
        base = np.full((len(rows), 3), _GRAY) if linear is None else np.asarray(linear)
        table = np.array([(np.nan,) * 3 if look.color is None else look.color for look in looks])
        flat = table[look_of_face[face_of_row]]
        colors = linear_to_bytes(np.clip(np.nan_to_num(np.where(np.isnan(flat), base, flat)), 0, 1))
        uv, shading = of_rows("uv"), of_rows("normals")
        place = {texture: k for k, texture in enumerate(textures)}
        texture_of = np.array([place.get(look.texture, -1) if look.texture else -1 for look in looks], np.int16)
        face_textures = texture_of[look_of] if textures and len(looks) > 1 else None
        coordinates = None if uv is None else np.stack([uv[:, 0], 1 - uv[:, 1]], -1).astype(np.float32)
        if coordinates is not None and not np.isfinite(coordinates).all():
            coordinates = np.nan_to_num(coordinates)
        up = self.open
        exact = up.metres == 1 and np.array_equal(up.turn, np.eye(4))
        turned = None if shading is None else (shading if exact else normalized(up.directions(shading)))
        return Mesh(
            vertices=(points[rows] if exact else up.points(points[rows])).astype(np.float32),
            faces=faces.astype(np.int32),
            colors=colors,
            normals=None if turned is None or not np.isfinite(turned).all() else turned.astype(np.float32),
            uv=coordinates,
            textures=textures,
            face_textures=face_textures,
        )

    def _any_coordinates(self, api: Any) -> tuple[NDArray[Any], str] | None:
        kinds = ("texCoord2f[]", "texCoord2d[]", "texCoord2h[]")
        named = [v for v in api.GetPrimvars() if str(v.GetTypeName()) in kinds]
        return _variable(named[0]) if named else None

    def _looks_of(self, prim: Any, faces: int) -> tuple[list[Look], NDArray[np.int64]]:
        """Return the materials of a mesh and the number of each face's, shape [faces]."""
        shade, geom = pxr("UsdShade"), pxr("UsdGeom")
        looks, of_face = [self._bound(prim)], np.zeros(faces, np.int64)
        subsets = shade.MaterialBindingAPI(prim).GetMaterialBindSubsets() if prim.IsA(geom.Mesh) else ()
        for subset in subsets:
            indices = _array(subset.GetIndicesAttr().Get(pxr("Usd").TimeCode.EarliestTime()), 0).astype(np.int64)
            indices = indices[(indices >= 0) & (indices < faces)]
            of_face[indices] = len(looks)
            looks.append(self._bound(subset.GetPrim()))
        used = np.unique(of_face)
        return [looks[k] for k in used], np.searchsorted(used, of_face)

    # --- materials ------------------------------------------------------------------------------------------------------
    def _bound(self, prim: Any) -> Look:
        material = pxr("UsdShade").MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        if not material:
            return Look()
        key = material.GetPath()
        if key not in self._looks:
            self._looks[key] = self._look(material)
        return self._looks[key]

    def _look(self, material: Any) -> Look:
        for context in ("", "mdl"):
            shader = material.ComputeSurfaceSource(context)[0] if context else material.ComputeSurfaceSource()[0]
            if not shader:
                continue
            if shader.GetShaderId() == "UsdPreviewSurface":
                return self._preview(shader)
            if context == "mdl" or shader.GetImplementationSource() == "sourceAsset":
                return self._omniverse(shader)
        self.notes[f"the material {material.GetPath()} is not a UsdPreviewSurface, its surfaces are gray"] = None
        return Look(color=_GRAY)

    def _preview(self, shader: Any) -> Look:
        source, value = _value_of(shader.GetInput("diffuseColor"))
        if source is None:
            return Look(color=_color(value, (0.18, 0.18, 0.18)))
        kind = source.GetShaderId()
        if kind.startswith("UsdPrimvarReader"):
            return Look()
        if kind == "UsdUVTexture":
            texture = self._image(_value_of(source.GetInput("file"))[1])
            if texture is None:
                return Look(color=_color(_value_of(source.GetInput("fallback"))[1], _GRAY))
            reader = _value_of(source.GetInput("st"))[0]
            name = _value_of(reader.GetInput("varname"))[1] if reader is not None else None
            scale = _value_of(source.GetInput("scale"))[1]
            color = None if self.ours else _color(scale, (1.0, 1.0, 1.0))
            return Look(color=color, texture=texture, st=str(name or "st"))
        self.notes[f"the colour of {shader.GetPath()} comes from {kind or 'a shader'}, which is not read"] = None
        return Look(color=_GRAY)

    def _omniverse(self, shader: Any) -> Look:
        """Return base colour and image of OmniPBR and materials like it."""
        named = ("diffuse_color_constant", "diffuse_tint", "base_color", "diffuse_color")
        color = next((v for name in named if (v := _value_of(shader.GetInput(name))[1]) is not None), None)
        files = ("diffuse_texture", "base_color_texture")
        file = next((v for name in files if (v := _value_of(shader.GetInput(name))[1]) is not None), None)
        texture = None if file is None or not getattr(file, "path", "") else self._image(file)
        if texture is None and color is None:
            self.notes[f"the material {shader.GetPath()} has no base colour that is read, its surfaces are gray"] = None
        return Look(color=(1.0, 1.0, 1.0) if texture is not None else _color(color, _GRAY), texture=texture)

    def _image(self, asset: Any) -> Texture | None:
        path = getattr(asset, "path", "") or ""
        resolved = getattr(asset, "resolvedPath", "") or ""
        if not path:
            return None
        if not resolved or not is_inside(resolved, self.open.path):
            self.missing[path] = None
            return None
        if resolved not in self._images:
            opened = pxr("Ar").GetResolver().OpenAsset(pxr("Ar").ResolvedPath(resolved))
            try:
                stem = path.replace("\\", "/").rpartition("/")[2].rpartition(".")[0]
                data = b"" if opened is None else bytes(opened.GetBuffer())
                self._images[resolved] = image_texture(data, name=stem)
            except SceneError as fault:
                self.notes[f"the image {path} is left out: {fault}"] = None
                self._images[resolved] = None
        return self._images[resolved]

    # --- other prims ----------------------------------------------------------------------------------------------------
    def painted(self, prim: Any, mesh: Mesh) -> Mesh:
        """Return the mesh of a shape prim in the colour of its material, or else in its display colour."""
        look = self._bound(prim)
        display = _variable(pxr("UsdGeom").PrimvarsAPI(prim).GetPrimvar("displayColor"))
        color = look.color or (tuple(display[0][0]) if display is not None and len(display[0]) else _GRAY)
        srgb = linear_to_bytes(np.clip(np.nan_to_num(np.array(color, np.float64)), 0, 1))
        return Mesh(
            vertices=mesh.vertices, faces=mesh.faces, normals=mesh.normals,
            colors=np.broadcast_to(srgb, mesh.vertices.shape).copy(),
        )  # fmt: skip


def prim_size(prim: Any, name: str, default: float, *, least: float = 1e-9) -> float:
    """Return a positive length attribute of a prim in units of the stage, or ``default`` if it has none.

    Raises:
        ValueError: the value is not a positive number.
    """
    value = prim.GetAttribute(name).Get(pxr("Usd").TimeCode.EarliestTime())
    value = default if value is None else float(value)
    if not np.isfinite(value) or value < least:
        raise ValueError(f"its {name} is {value:g}, not a positive number")
    return value


def prim_axis(prim: Any) -> NDArray[np.float64]:
    """Return the unit vector [3] of a prim's axis, in its own frame."""
    axis = str(prim.GetAttribute("axis").Get() or "Z")
    return np.eye(3)["XYZ".find(axis)] if axis in "XYZ" else np.eye(3)[2]


def _ball(reader: SurfaceReader, prim: Any) -> Mesh:
    radius = prim_size(prim, "radius", 1.0) * reader.open.metres
    return reader.painted(prim, capsule_mesh(np.zeros(3), np.zeros(3), radius))


def _cube(reader: SurfaceReader, prim: Any) -> Mesh:
    half = prim_size(prim, "size", 2.0) * reader.open.metres / 2
    return reader.painted(prim, box_mesh(np.full(3, half)))


def _plane(reader: SurfaceReader, prim: Any) -> Mesh:
    half = np.array([prim_size(prim, "width", 2.0) / 2, prim_size(prim, "length", 2.0) / 2])
    k = int(np.argmax(prim_axis(prim)))
    points = np.zeros((4, 3))
    points[:, [(k + 1) % 3, (k + 2) % 3]] = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    return reader.painted(prim, _plain(reader.open.points(points), np.array([[0, 1, 2], [0, 2, 3]])))


def _capsule(reader: SurfaceReader, prim: Any) -> Mesh:
    half = reader.open.points(prim_axis(prim)[None] * prim_size(prim, "height", 1.0, least=0.0) / 2)[0]
    radius = prim_size(prim, "radius", 0.5) * reader.open.metres
    return reader.painted(prim, capsule_mesh(-half, half, radius))


def _tapered(reader: SurfaceReader, prim: Any, tip: float) -> Mesh:
    """Return a cylinder, or a cone whose tip has a share of its radius, about the prim's axis."""
    sides, k = 24, int(np.argmax(prim_axis(prim)))
    radius, half = prim_size(prim, "radius", 1.0), prim_size(prim, "height", 2.0) / 2
    angle = np.arange(sides) * 2 * np.pi / sides
    points = np.zeros((2 * sides, 3))
    for row, (at, share) in enumerate(((-half, 1.0), (half, tip))):
        ring = points[row * sides : (row + 1) * sides]
        ring[:, k] = at
        ring[:, (k + 1) % 3], ring[:, (k + 2) % 3] = radius * share * np.cos(angle), radius * share * np.sin(angle)
    here = np.arange(sides)
    after = (here + 1) % sides
    walls = np.concatenate(
        [np.stack([here, after, after + sides], -1), np.stack([here, after + sides, here + sides], -1)]
    )
    fan = np.stack([np.zeros(sides - 2, np.int64), here[1:-1], here[2:]], -1)
    return reader.painted(prim, _plain(reader.open.points(points), np.concatenate([walls, fan[:, ::-1], fan + sides])))


def _plain(points: NDArray[np.float64], faces: NDArray[np.int64]) -> Mesh:
    return Mesh(
        vertices=points.astype(np.float32), faces=faces.astype(np.int32), colors=np.zeros((len(points), 3), np.uint8)
    )


MAKERS: dict[str, Callable[[SurfaceReader, Any], Mesh | None]] = {
    "Mesh": lambda reader, prim: reader._polygons(prim),
    "Cube": _cube,
    "Sphere": _ball,
    "Capsule": _capsule,
    "Cylinder": lambda reader, prim: _tapered(reader, prim, 1.0),
    "Cone": lambda reader, prim: _tapered(reader, prim, 0.0),
    "Plane": _plane,
}
"""Readers of prims by type."""


def _array(value: Any, columns: int) -> NDArray[Any]:
    """Return an array of a stage; empty if it is not given."""
    if value is None:
        return np.zeros((0, columns) if columns else 0)
    array = np.asarray(value)
    return array.reshape(-1, columns) if columns else array.ravel()


def _variable(variable: Any) -> tuple[NDArray[Any], str] | None:
    """Return values [N, C] of a primvar, without indices, and its interpolation; None if there is none."""
    if not variable or not variable.HasValue():
        return None
    value = variable.ComputeFlattened(pxr("Usd").TimeCode.EarliestTime())
    array = None if value is None else np.asarray(value)
    if array is None or array.ndim != 2 or not len(array):
        return None
    return array.astype(np.float64 if array.dtype == np.float64 else np.float32), str(variable.GetInterpolation())


def _placed(array: NDArray[Any], kind: str, points: int, faces: int, corners: int) -> tuple[NDArray[Any], str] | None:
    """Return values with an interpolation that fits their number; None if none does."""
    sizes = {"constant": 1, "uniform": faces, "vertex": points, "varying": points, "faceVarying": corners}
    if len(array) != sizes.get(kind, -1):
        kind = next((k for k in ("vertex", "faceVarying", "uniform", "constant") if sizes[k] == len(array)), "")
    return (array, "vertex" if kind == "varying" else kind) if kind else None


def _value_of(entry: Any) -> tuple[Any, Any]:
    """Return the shader that feeds an input, or None, and the input's own value."""
    if not entry:
        return None, None
    for attribute in entry.GetValueProducingAttributes():
        if pxr("UsdShade").Utils.GetType(attribute.GetName()) == pxr("UsdShade").AttributeType.Output:
            return pxr("UsdShade").Shader(attribute.GetPrim()), None
        return None, attribute.Get(pxr("Usd").TimeCode.EarliestTime())
    return None, entry.Get()


def _color(value: Any, default: tuple[float, float, float]) -> tuple[float, float, float]:
    if value is None:
        return default
    r, g, b = (float(v) for v in tuple(value)[:3])
    return (r, g, b)
