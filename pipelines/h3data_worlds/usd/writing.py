"""Writer of scenes as USD stages with +Y up, metres, and one prim per instance, which references its asset.

Meshes have vertex colours and UsdPreviewSurface materials. Collision shapes are guide prims with
`UsdPhysics.CollisionAPI`. Doors and drawers are bodies with revolute and prismatic joints. Categories are labels of
`UsdSemantics`. Data without a place in USD (rooms, receptacles, layers, handles) and numbers that USD keeps in single
precision are JSON in ``customData``.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, SceneError
from h3data.files import part_file
from h3data.geometry import Array, pose_inverse, pose_multiply, quat_from_axis_angle, quat_multiply
from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.png import png_bytes
from h3data.scene.records import (
    Articulation,
    Asset,
    Box,
    Capsule,
    Cylinder,
    Instance,
    LightSource,
    Part,
    Receptacle,
    Room,
    Scene,
    Shape,
)
from h3data.scene.scene_json import articulation_record, asset_record, instance_record, light_record, room_record
from h3data.srgb import bytes_to_linear
from h3data_worlds.usd.stages import USD_ENDINGS, pxr, quiet

KEY = "h3data"
"""Key of h3data's records in ``customData``."""
VERSION = 1
"""Version of the records in a stage."""
ROOT = "/Home"
_X = np.array([1.0, 0.0, 0.0])
_LIGHT_UNIT = 1000.0
"""Intensity in USD of a lamp of strength 1, for renderers; we read our own record."""


def write_usd(scene: Scene, path: str | os.PathLike[str]) -> list[Path]:
    """Write a scene as ``.usda``, ``.usdc``, ``.usd`` or ``.usdz``, and return all written files.

    A ``.usdz`` file contains its textures. The other formats have them as PNG in a folder ``<name>_textures``.

    Raises:
        MissingExtraError: usd-core is not installed.
        InputError: the file name has another ending, or the file cannot be written.
        SceneError: vertices are not finite.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in USD_ENDINGS:
        raise InputError(
            f"Expected a file name that ends in {', '.join(USD_ENDINGS)}, got: {path}", code="H3-WORLD-016"
        )
    pxr("Usd")
    try:
        with tempfile.TemporaryDirectory(prefix="h3data-usd-") as folder:
            inner = Path(folder, f"{_identifier(path.stem)}.usdc" if ending == ".usdz" else path.name)
            textures = _Textures(inner.parent, f"{inner.stem}_textures")
            with quiet():
                stage = pxr("Usd").Stage.CreateNew(str(inner))
                _StageWriter(stage, scene, textures).write()
                stage.GetRootLayer().Save()
                packed = Path(folder, "packed.usdz")
                if ending == ".usdz" and not pxr("UsdUtils").CreateNewUsdzPackage(str(inner), str(packed)):
                    raise InputError(f"usd-core cannot pack the scene. File: {path}", code="H3-WORLD-019")
            if ending == ".usdz":
                return [_copied(packed, path)]
            made = [_copied(file, path.parent / textures.folder / file.name) for file in textures.files]
            return [_copied(inner, path), *made]
    except OSError as error:
        raise InputError(
            f"Cannot write the scene: {error.strerror or error}. Path: {path}", code="H3-SCENE-051"
        ) from error


def _copied(file: Path, target: Path) -> Path:
    target.parent.mkdir(parents=True, exist_ok=True)
    with part_file(target) as part:
        shutil.copyfile(file, part)
    return target


def _identifier(text: str) -> str:
    """Return a name that USD allows for prims."""
    clean = re.sub(r"[^A-Za-z0-9_]", "_", text) or "_"
    return f"_{clean}" if clean[0].isdigit() else clean


class _Names:
    """Names of prims below one parent: allowed in USD, each once."""

    def __init__(self) -> None:
        self._used: set[str] = set()

    def __call__(self, text: str) -> str:
        name, number = _identifier(text), 1
        while name in self._used:
            number += 1
            name = f"{_identifier(text)}_{number}"
        self._used.add(name)
        return name


class _Textures:
    """Textures as PNG files, each written once."""

    def __init__(self, beside: Path, folder: str) -> None:
        self._beside, self.folder, self._names = beside, folder, _Names()
        self._paths: dict[int, str] = {}
        self.files: list[Path] = []

    def path(self, texture: Texture) -> str:
        """Return the path of the texture's file, relative to the stage."""
        if id(texture) not in self._paths:
            file = self._beside / self.folder / f"{self._names(texture.name or 'texture')}.png"
            file.parent.mkdir(exist_ok=True)
            file.write_bytes(png_bytes(texture.pixels))
            self.files.append(file)
            self._paths[id(texture)] = f"./{self.folder}/{file.name}"
        return self._paths[id(texture)]


class _StageWriter:
    """Writer of one scene into one stage."""

    def __init__(self, stage: Any, scene: Scene, textures: _Textures) -> None:
        self.stage, self.scene, self.textures = stage, scene, textures
        self.usd, self.geom, self.shade = pxr("Usd"), pxr("UsdGeom"), pxr("UsdShade")
        self.physics, self.sdf, self.gf, self.vt = pxr("UsdPhysics"), pxr("Sdf"), pxr("Gf"), pxr("Vt")
        self.assets: dict[str, str] = {}
        self.bodies: dict[str, tuple[str, Array | None]] = {}
        """Path of the prim below which an instance lies that a joint moves, or that is the base of a thing, by its name."""

    def write(self) -> None:
        """Write everything."""
        scene, stage = self.scene, self.stage
        self.geom.SetStageUpAxis(stage, self.geom.Tokens.y)
        self.geom.SetStageMetersPerUnit(stage, 1.0)
        root = self.geom.Xform.Define(stage, ROOT).GetPrim()
        stage.SetDefaultPrim(root)
        self.usd.ModelAPI(root).SetKind("assembly")
        try:
            head = {
                "version": VERSION,
                "name": scene.name,
                "source": dict(scene.source),
                "assets": list(scene.assets),
                "instances": [i.name for i in scene.instances],
                **({} if scene.lights is None else {"lights": [light_record(light) for light in scene.lights]}),
            }
            self._keep(root, head)
        except (TypeError, ValueError) as error:
            raise SceneError(
                f"Scene {scene.name!r} cannot be written: {error}. `source` must be plain JSON.", code="H3-WORLD-018"
            ) from error
        self._write_assets()
        self._write_rooms(scene.rooms)
        self._write_things(scene.articulations)
        names = _Names()
        for instance in scene.instances:
            above = self.bodies.get(instance.name, (f"{ROOT}/Instances", None))
            self._write_instance(instance, *above, names=names)
        self._write_lights(scene.lights or ())

    def _keep(self, prim: Any, record: Mapping[str, Any]) -> None:
        prim.SetCustomDataByKey(KEY, json.dumps(record, allow_nan=False))

    def _place(self, prim: Any, pose: Array, scale: NDArray[np.float64] | None = None) -> None:
        x, y, z, qx, qy, qz, qw = (float(v) for v in pose)
        form = self.geom.Xformable(prim)
        double = self.geom.XformOp.PrecisionDouble
        form.AddTranslateOp(double).Set(self.gf.Vec3d(x, y, z))
        form.AddOrientOp(double).Set(self.gf.Quatd(qw, qx, qy, qz))
        if scale is not None:
            form.AddScaleOp(double).Set(self.gf.Vec3d(*(float(s) for s in scale)))

    def _label(self, prim: Any, *labels: str) -> None:
        api = pxr("UsdSemantics").LabelsAPI.Apply(prim, "class")
        api.CreateLabelsAttr().Set(self.vt.TokenArray(list(labels)))

    # --- assets ---------------------------------------------------------------------------------------------------------
    def _write_assets(self) -> None:
        self.stage.CreateClassPrim(f"{ROOT}/Assets")
        names = _Names()
        for key, asset in self.scene.assets.items():
            path = self.assets[key] = f"{ROOT}/Assets/{names(key)}"
            prim = self.geom.Xform.Define(self.stage, path).GetPrim()
            self._keep(prim, {"key": key, **asset_record(asset, None)})
            if len(asset.mesh.faces) and len(asset.mesh.vertices):
                self._write_mesh(asset, path)
            for k, shape in enumerate(asset.shapes):
                self._write_shape(shape, f"{path}/Collider_{k}")
            for k, receptacle in enumerate(asset.receptacles):
                self._write_receptacle(receptacle, f"{path}/Receptacle_{k}")

    def _mesh(self, path: str, points: NDArray[Any], faces: NDArray[Any]) -> Any:
        mesh = self.geom.Mesh.Define(self.stage, path)
        points = np.ascontiguousarray(points, np.float32)
        mesh.CreatePointsAttr(self.vt.Vec3fArray.FromNumpy(points))
        mesh.CreateFaceVertexCountsAttr(self.vt.IntArray.FromNumpy(np.full(len(faces), faces.shape[1], np.int32)))
        mesh.CreateFaceVertexIndicesAttr(self.vt.IntArray.FromNumpy(np.ascontiguousarray(faces.ravel(), np.int32)))
        mesh.CreateSubdivisionSchemeAttr(self.geom.Tokens.none)
        if len(points):
            mesh.CreateExtentAttr(self.vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
        return mesh

    def _write_mesh(self, asset: Asset, path: str) -> None:
        mesh = asset.mesh
        if not np.isfinite(mesh.vertices).all():
            raise SceneError(
                f"Asset {asset.name!r} has vertices that are not finite; USD files cannot store them.",
                code="H3-WORLD-017",
            )
        made = self._mesh(f"{path}/Mesh", mesh.vertices, mesh.faces)
        vertex = self.geom.Tokens.vertex
        if mesh.normals is not None:
            made.CreateNormalsAttr(self.vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.normals, np.float32)))
            made.SetNormalsInterpolation(vertex)
        colors = np.ascontiguousarray(bytes_to_linear(mesh.colors), np.float32)
        variable = made.CreateDisplayColorPrimvar(vertex)
        variable.Set(self.vt.Vec3fArray.FromNumpy(colors))
        if mesh.uv is not None:
            st = np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], -1).astype(np.float32)
            types = self.sdf.ValueTypeNames
            self.geom.PrimvarsAPI(made).CreatePrimvar("st", types.TexCoord2fArray, vertex).Set(
                self.vt.Vec2fArray.FromNumpy(np.ascontiguousarray(st))
            )
        self._bind_materials(mesh, made, path)

    def _bind_materials(self, mesh: Mesh, made: Any, path: str) -> None:
        """Add one material per texture and one for vertex colours, among which faces are divided by subsets."""
        bind = self.shade.MaterialBindingAPI
        if mesh.face_textures is None:
            texture = mesh.textures[0] if mesh.textures else None
            bind.Apply(made.GetPrim()).Bind(self._material(path, 0 if texture else -1, texture))
            return
        for k in np.unique(mesh.face_textures).tolist():
            indices = np.flatnonzero(mesh.face_textures == k).astype(np.int32)
            subset = self.geom.Subset.CreateGeomSubset(
                made, f"Texture_{k}" if k >= 0 else "Colours", "face", self.vt.IntArray.FromNumpy(indices),
                self.shade.Tokens.materialBind, self.geom.Tokens.partition,
            )  # fmt: skip
            texture = mesh.textures[k] if k >= 0 else None
            bind.Apply(subset.GetPrim()).Bind(self._material(path, k, texture))

    def _material(self, asset: str, number: int, texture: Texture | None) -> Any:
        """Return a matte UsdPreviewSurface of the vertex colours or of one texture, below the asset that uses it."""
        types = self.sdf.ValueTypeNames
        path = f"{asset}/Looks/{'Colours' if texture is None else f'Texture_{number}'}"
        self.geom.Scope.Define(self.stage, f"{asset}/Looks")
        material = self.shade.Material.Define(self.stage, path)
        surface = self._shader(f"{path}/Surface", "UsdPreviewSurface")
        surface.CreateInput("roughness", types.Float).Set(1.0)
        surface.CreateInput("metallic", types.Float).Set(0.0)
        color = surface.CreateInput("diffuseColor", types.Color3f)
        if texture is None:
            reader = self._shader(f"{path}/Colours", "UsdPrimvarReader_float3")
            reader.CreateInput("varname", types.String).Set("displayColor")
            color.ConnectToSource(reader.CreateOutput("result", types.Float3))
        else:
            reader = self._shader(f"{path}/Coordinates", "UsdPrimvarReader_float2")
            reader.CreateInput("varname", types.String).Set("st")
            image = self._shader(f"{path}/Image", "UsdUVTexture")
            image.CreateInput("file", types.Asset).Set(self.textures.path(texture))
            image.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
            for axis in ("wrapS", "wrapT"):
                image.CreateInput(axis, types.Token).Set("repeat")
            image.CreateInput("st", types.Float2).ConnectToSource(reader.CreateOutput("result", types.Float2))
            color.ConnectToSource(image.CreateOutput("rgb", types.Float3))
            if texture.pixels[..., 3].min() < 255:
                surface.CreateInput("opacity", types.Float).ConnectToSource(image.CreateOutput("a", types.Float))
                surface.CreateInput("opacityThreshold", types.Float).Set(0.5)
        material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
        return material

    def _shader(self, path: str, kind: str) -> Any:
        shader = self.shade.Shader.Define(self.stage, path)
        shader.CreateIdAttr(kind)
        return shader

    def _write_shape(self, shape: Shape, path: str) -> None:
        geom = self.geom
        if isinstance(shape, Box):
            made = geom.Cube.Define(self.stage, path)
            made.CreateSizeAttr(2.0)
            self._place(made, shape.pose, shape.half_extents)
        elif isinstance(shape, Cylinder):
            made = geom.Cylinder.Define(self.stage, path)
            self._round(made, shape.radius, shape.half_height)
            self._place(made, shape.pose)
        elif isinstance(shape, Capsule):
            made = geom.Capsule.Define(self.stage, path)
            along = np.asarray(shape.end, np.float64) - shape.start
            self._round(made, shape.radius, float(np.linalg.norm(along)) / 2)
            middle = (np.asarray(shape.start, np.float64) + shape.end) / 2
            self._place(made, np.concatenate([middle, _turn_from(np.array([0.0, 1.0, 0.0]), along)]))
        else:
            points = np.asarray(shape.points)
            made = self._mesh(path, points, _hull_faces(points))
            self.physics.MeshCollisionAPI.Apply(made.GetPrim()).CreateApproximationAttr("convexHull")
        made.CreatePurposeAttr(geom.Tokens.guide)
        self.physics.CollisionAPI.Apply(made.GetPrim())
        if not isinstance(shape, Box) and hasattr(made, "GetRadiusAttr"):
            half = made.GetHeightAttr().Get() / 2 + (shape.radius if isinstance(shape, Capsule) else 0)
            high = self.gf.Vec3f(shape.radius, half, shape.radius)  # pyright: ignore[reportAttributeAccessIssue]
            made.CreateExtentAttr([-high, high])

    def _round(self, made: Any, radius: float, half_height: float) -> None:
        made.CreateAxisAttr(self.geom.Tokens.y)
        made.CreateRadiusAttr(float(radius))
        made.CreateHeightAttr(2 * float(half_height))

    def _write_receptacle(self, receptacle: Receptacle, path: str) -> None:
        (x, y, z), (dx, dz) = receptacle.center.tolist(), receptacle.half_size.tolist()
        corners = np.array([[x - dx, y, z - dz], [x - dx, y, z + dz], [x + dx, y, z + dz], [x + dx, y, z - dz]])
        made = self._mesh(path, corners, np.array([[0, 1, 2, 3]]))
        made.CreatePurposeAttr(self.geom.Tokens.guide)
        self._keep(made.GetPrim(), {"receptacle": receptacle.name})
        self._label(made.GetPrim(), "receptacle")

    # --- the home -------------------------------------------------------------------------------------------------------
    def _write_rooms(self, rooms: Sequence[Room]) -> None:
        if rooms:
            self.geom.Scope.Define(self.stage, f"{ROOT}/Rooms")
        names = _Names()
        for room in rooms:
            plan = np.asarray(room.rectangles, np.float64).reshape(-1, 4)
            corners = plan[:, [0, 1, 0, 3, 2, 3, 2, 1]].reshape(-1, 2)
            points = np.insert(corners, 1, room.floor_y, axis=1)
            made = self._mesh(f"{ROOT}/Rooms/{names(room.name)}", points, np.arange(len(points)).reshape(-1, 4))
            made.CreatePurposeAttr(self.geom.Tokens.guide)
            self._keep(made.GetPrim(), {"room": room_record(room)})
            self._label(made.GetPrim(), "room", room.category)

    def _write_things(self, things: Sequence[Articulation]) -> None:
        if things:
            self.geom.Scope.Define(self.stage, f"{ROOT}/Things")
        names = _Names()
        movable = {i.name for i in self.scene.instances if i.motion == "kinematic"}
        for thing in things:
            path = f"{ROOT}/Things/{names(thing.name)}"
            prim = self.geom.Xform.Define(self.stage, path).GetPrim()
            self._place(prim, thing.pose)
            self._keep(prim, {"thing": articulation_record(thing)})
            self.physics.ArticulationRootAPI.Apply(prim)
            if thing.base and thing.base not in movable:
                self.bodies[thing.base] = (path, thing.pose)
            inside, paths = _Names(), {"": path}
            for part in thing.parts:
                body = paths[part.name] = f"{path}/{inside(part.name)}"
                self.physics.RigidBodyAPI.Apply(self.geom.Xform.Define(self.stage, body).GetPrim())
                for name in set(part.instances) - movable:  # what lies in a drawer is a body of its own
                    self.bodies[name] = (body, thing.pose)
                self._write_joint(part, f"{path}/{inside(part.name + '_joint')}", paths[part.parent], body)

    def _write_joint(self, part: Part, path: str, parent: str, body: str) -> None:
        joint, physics, gf = part.joint, self.physics, self.gf
        turning = joint.kind == "revolute"
        made = (physics.RevoluteJoint if turning else physics.PrismaticJoint).Define(self.stage, path)
        made.CreateAxisAttr(physics.Tokens.x)
        made.CreateLowerLimitAttr(float(np.degrees(joint.lower)) if turning else float(joint.lower))
        made.CreateUpperLimitAttr(float(np.degrees(joint.upper)) if turning else float(joint.upper))
        made.CreateBody0Rel().SetTargets([parent])
        made.CreateBody1Rel().SetTargets([body])
        turn = _turn_from(_X, joint.axis)
        moved = quat_multiply(turn, quat_from_axis_angle(_X, joint.rest)) if turning else turn
        from_body = joint.origin if turning else joint.origin + joint.rest * joint.axis
        for number, (place, (qx, qy, qz, qw)) in enumerate(((joint.origin, turn), (from_body, moved))):
            at = gf.Vec3f(*(float(v) for v in place))
            getattr(made, f"CreateLocalPos{number}Attr")(at)
            getattr(made, f"CreateLocalRot{number}Attr")(gf.Quatf(float(qw), float(qx), float(qy), float(qz)))
        self._keep(made.GetPrim(), {"joint": part.name})

    def _write_instance(self, instance: Instance, above: str, frame: Array | None, *, names: _Names) -> None:
        if not self.stage.GetPrimAtPath(above):
            self.geom.Scope.Define(self.stage, above)
        path = f"{above}/{names(instance.name)}"
        prim = self.geom.Xform.Define(self.stage, path).GetPrim()
        prim.GetReferences().AddInternalReference(self.assets[instance.asset])
        prim.SetInstanceable(True)
        pose = instance.pose if frame is None else pose_multiply(pose_inverse(frame), instance.pose)
        self._place(prim, pose, instance.scale)
        asset = self.scene.assets[instance.asset]
        self._label(prim, asset.category)
        self._keep(prim, {"instance": instance_record(instance)})
        if instance.motion == "kinematic":
            self.physics.RigidBodyAPI.Apply(prim)

    def _write_lights(self, lights: Sequence[LightSource]) -> None:
        lux, names = pxr("UsdLux"), _Names()
        if lights:
            self.geom.Scope.Define(self.stage, f"{ROOT}/Lights")
        for light in lights:
            if light.frame != "global" or light.intensity <= 0:
                continue  # lamps that go with a camera, and those that take light away, are in our record alone
            path = f"{ROOT}/Lights/{names(light.name)}"
            far = light.kind == "directional"
            made = (lux.DistantLight if far else lux.SphereLight).Define(self.stage, path)
            turn = _turn_from(np.array([0.0, 0.0, -1.0]), light.vector) if far else np.array([0.0, 0.0, 0.0, 1.0])
            self._place(made, np.concatenate([np.zeros(3) if far else light.vector, turn]))
            made.CreateIntensityAttr(float(light.intensity) * (1 if far else _LIGHT_UNIT))
            made.CreateColorAttr(self.gf.Vec3f(*(float(v) for v in light.color)))
            if not far:
                made.CreateRadiusAttr(0.05)


def _turn_from(axis: Array, to: Array) -> Array:
    """Return a quaternion xyzw [4] that turns a unit vector into the direction of another; identity for a zero vector."""
    length = float(np.linalg.norm(to))
    if length == 0:
        return np.array([0.0, 0.0, 0.0, 1.0])
    to = np.asarray(to, np.float64) / length
    around = np.cross(axis, to)
    if np.linalg.norm(around) < 1e-12:
        if axis @ to > 0:
            return np.array([0.0, 0.0, 0.0, 1.0])
        around = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return quat_from_axis_angle(around, np.arctan2(np.linalg.norm(np.cross(axis, to)), axis @ to))


def _hull_faces(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return triangles of a convex hull, counter-clockwise from outside [F, 3]; of a flat set, a fan."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(np.asarray(points, np.float64))
    except (QhullError, ValueError):
        return np.array([[0, k, k + 1] for k in range(1, len(points) - 1)]).reshape(-1, 3)
    a, b, c = (np.asarray(points)[hull.simplices[:, k]] for k in range(3))
    wrong = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(1) < 0
    faces = hull.simplices.astype(np.int64)
    faces[wrong] = faces[wrong][:, ::-1]
    return faces
