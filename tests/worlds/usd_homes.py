"""USD homes as other programs write them: Z up, centimetres, references, variants, instancers, joints. All made here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdSemantics, UsdShade, Vt

from h3data.mesh.png import png_bytes
from h3data.scene import Mesh, Texture


def quad(*, texture: Texture | None = None, colors: np.ndarray | None = None) -> Mesh:
    """A square of 1 m in the plane z = 0."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    return Mesh(
        vertices=vertices,
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        colors=np.full((4, 3), 200, np.uint8) if colors is None else colors,
        uv=vertices[:, :2].copy() if texture else None,
        textures=(texture,) if texture else (),
    )


def box(stage: Usd.Stage, path: str, low: tuple, high: tuple, color: tuple = (0.5, 0.5, 0.5)) -> UsdGeom.Mesh:
    """A mesh of six quads between two corners."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    points = [(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]
    quads = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([Gf.Vec3f(*p) for p in points])
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr(quads)
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*color)])
    return mesh


def label(prim: Usd.Prim, name: str) -> None:
    UsdSemantics.LabelsAPI.Apply(prim, "class").CreateLabelsAttr().Set(Vt.TokenArray([name]))


def flat(folder: Path, *, up: str = "Z", metres: float = 0.01, ending: str = "usda") -> Path:
    """A room of 6 x 4 m with walls, a table by reference, four chairs by an instancer, a cabinet and a fridge that open."""
    (folder / "props").mkdir(parents=True, exist_ok=True)
    unit = 1 / metres

    def p(x: float, y: float, z: float) -> tuple:  # written with Z up, in metres
        return tuple(unit * v for v in ((x, y, z) if up == "Z" else (x, z, -y)))

    def made(stage: Usd.Stage, path: str, a: tuple, b: tuple, color: tuple = (0.5, 0.5, 0.5)) -> UsdGeom.Mesh:
        low, high = p(*a), p(*b)
        return box(stage, path, tuple(map(min, low, high)), tuple(map(max, low, high)), color)

    def begun(file: Path, root: str) -> Usd.Stage:
        stage = Usd.Stage.CreateNew(str(file))
        UsdGeom.SetStageUpAxis(stage, up)
        UsdGeom.SetStageMetersPerUnit(stage, metres)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, root).GetPrim())
        return stage

    table = begun(folder / "props" / f"table.{ending}", "/Table")
    (folder / "props" / "wood.png").write_bytes(png_bytes(np.tile(np.array([140, 90, 50, 255], np.uint8), (8, 8, 1))))
    top = made(table, "/Table/Top", (-0.6, -0.4, 0.70), (0.6, 0.4, 0.74))
    UsdGeom.PrimvarsAPI(top).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying").Set(
        [Gf.Vec2f(*v) for v in [(0, 0), (1, 0), (1, 1), (0, 1)] * 6]
    )
    material = UsdShade.Material.Define(table, "/Table/Looks/Wood")
    surface = UsdShade.Shader.Define(table, "/Table/Looks/Wood/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    image = UsdShade.Shader.Define(table, "/Table/Looks/Wood/Image")
    image.CreateIdAttr("UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./wood.png")
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
        image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    )
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(top.GetPrim()).Bind(material)
    for k, (x, y) in enumerate([(-0.55, -0.35), (0.55, -0.35), (0.55, 0.35), (-0.55, 0.35)]):
        made(table, f"/Table/Leg_{k}", (x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, 0.70))
    table.Save()

    stage = begun(folder / f"flat.{ending}", "/World")
    made(stage, "/World/Building/Floor", (0, 0, -0.1), (6, 4, 0), (0.6, 0.5, 0.4))
    for name, a, b in [
        ("South", (-0.1, -0.1, 0), (6.1, 0, 2.5)), ("North", (-0.1, 4, 0), (6.1, 4.1, 2.5)),
        ("West", (-0.1, 0, 0), (0, 4, 2.5)), ("East", (6, 0, 0), (6.1, 4, 2.5)),
        ("Middle", (3, 0, 0), (3.1, 2.8, 2.5)),
    ]:  # fmt: skip
        label(made(stage, f"/World/Building/{name}", a, b, (0.9, 0.9, 0.85)).GetPrim(), "wall")

    here = UsdGeom.Xform.Define(stage, "/World/Table")
    here.GetPrim().GetReferences().AddReference(f"./props/table.{ending}")
    here.AddTranslateOp().Set(Gf.Vec3d(*p(1.5, 2.0, 0)))
    here.GetPrim().SetInstanceable(True)
    label(here.GetPrim(), "Table")

    chairs = UsdGeom.PointInstancer.Define(stage, "/World/Chairs")
    UsdGeom.Xform.Define(stage, "/World/Chairs/Chair")
    made(stage, "/World/Chairs/Chair/Seat", (-0.2, -0.2, 0), (0.2, 0.2, 0.45), (0.7, 0.2, 0.1))
    label(stage.GetPrimAtPath("/World/Chairs/Chair"), "chair")
    chairs.CreatePrototypesRel().SetTargets(["/World/Chairs/Chair"])
    chairs.CreateProtoIndicesAttr([0, 0, 0, 0])
    chairs.CreatePositionsAttr([Gf.Vec3f(*p(x, y, 0)) for x, y in [(1.2, 1.3), (1.8, 1.3), (1.2, 2.7), (1.8, 2.7)]])

    variants = UsdGeom.Xform.Define(stage, "/World/Lamp").GetPrim()
    label(variants, "lamp")
    which = variants.GetVariantSets().AddVariantSet("size")
    for size, height in (("small", 0.5), ("tall", 1.5)):
        which.AddVariant(size)
        which.SetVariantSelection(size)
        with which.GetVariantEditContext():
            made(stage, "/World/Lamp/Pole", (5.6, 0.2, 0), (5.8, 0.4, height))
    which.SetVariantSelection("tall")

    mug = UsdGeom.Xform.Define(stage, "/World/Mug")
    mug.AddTranslateOp().Set(Gf.Vec3d(*p(1.5, 2.0, 0.74)))
    mug.AddScaleOp().Set(Gf.Vec3f(0.5, 0.5, 0.5))
    cup = UsdGeom.Cylinder.Define(stage, "/World/Mug/Cup")
    cup.CreateAxisAttr(up)
    cup.CreateRadiusAttr(0.08 * unit)
    cup.CreateHeightAttr(0.2 * unit)
    cup.AddTranslateOp().Set(Gf.Vec3d(*p(0, 0, 0.1)))
    UsdPhysics.RigidBodyAPI.Apply(mug.GetPrim())
    UsdPhysics.CollisionAPI.Apply(cup.GetPrim())
    attribute = mug.GetPrim().CreateAttribute("semantic:Semantics:params:semanticData", Sdf.ValueTypeNames.String)
    attribute.Set("mug")
    mug.GetPrim().CreateAttribute("semantic:Semantics:params:semanticType", Sdf.ValueTypeNames.String).Set("class")
    mug.GetPrim().SetMetadata("apiSchemas", Sdf.TokenListOp.Create(["PhysicsRigidBodyAPI", "SemanticsAPI:Semantics"]))

    opens(stage, "/World/Cabinet", p, made, x=4.5, kind="prismatic")
    opens(stage, "/World/Fridge", p, made, x=3.6, kind="revolute")
    stage.Save()
    return folder / f"flat.{ending}"


def opens(stage: Usd.Stage, path: str, p, made, *, x: float, kind: str) -> None:
    """A body against the north wall with a front that slides out towards the south by 0.4 m, or turns about its edge."""
    top = UsdGeom.Xform.Define(stage, path)
    top.AddTranslateOp().Set(Gf.Vec3d(*p(x, 3.7, 0)))
    label(top.GetPrim(), path.rpartition("/")[2].lower())
    UsdPhysics.ArticulationRootAPI.Apply(top.GetPrim())
    made(stage, f"{path}/Body", (-0.3, -0.25, 0), (0.3, 0.3, 0.8), (0.3, 0.3, 0.6))
    front = UsdGeom.Xform.Define(stage, f"{path}/Front")
    front.AddTranslateOp().Set(Gf.Vec3d(*p(0, -0.27, 0.4)))
    UsdPhysics.RigidBodyAPI.Apply(front.GetPrim())
    panel = made(stage, f"{path}/Front/Panel", (-0.3, -0.02, -0.35), (0.3, 0.02, 0.35), (0.8, 0.7, 0.2))
    UsdPhysics.CollisionAPI.Apply(panel.GetPrim())
    UsdPhysics.MeshCollisionAPI.Apply(panel.GetPrim()).CreateApproximationAttr("convexHull")
    schema = UsdPhysics.PrismaticJoint if kind == "prismatic" else UsdPhysics.RevoluteJoint
    joint = schema.Define(stage, f"{path}/Joint")
    joint.CreateBody0Rel().SetTargets([path])
    joint.CreateBody1Rel().SetTargets([f"{path}/Front"])
    up = UsdGeom.GetStageUpAxis(stage)
    unit = 1 / UsdGeom.GetStageMetersPerUnit(stage)
    if kind == "prismatic":
        joint.CreateAxisAttr("Y" if up == "Z" else "Z")
        sign = -1 if up == "Z" else 1
        joint.CreateLowerLimitAttr(min(0.0, sign * 0.4 * unit))
        joint.CreateUpperLimitAttr(max(0.0, sign * 0.4 * unit))
        at = (0, -0.27, 0.4)
        joint.CreateLocalPos1Attr(Gf.Vec3f(0, 0, 0))
    else:
        joint.CreateAxisAttr(up)
        joint.CreateLowerLimitAttr(0.0)
        joint.CreateUpperLimitAttr(90.0)
        at = (0.3, -0.27, 0.4)
        joint.CreateLocalPos1Attr(Gf.Vec3f(*p(0.3, 0, 0)))
    joint.CreateLocalPos0Attr(Gf.Vec3f(*p(*at)))
