"""JSON records of everything in a scene except its meshes, and the digest of a whole scene."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import struct
from collections.abc import Callable, Mapping
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from h3data.mesh.mesh import Mesh
from h3data.scene.records import (
    Articulation,
    Asset,
    Box,
    Capsule,
    Cylinder,
    Hull,
    Instance,
    Joint,
    LightFrame,
    LightKind,
    LightSource,
    Part,
    Ramp,
    Receptacle,
    Room,
    Scene,
    Shape,
)


def floats(values: NDArray[np.float64]) -> list[Any]:
    """Return an array as nested lists of floats."""
    return np.asarray(values, np.float64).tolist()


_SHAPE_WRITERS: Mapping[type, Callable[[Any], dict[str, Any]]] = {
    Box: lambda s: {"type": "box", "pose": floats(s.pose), "half_extents": floats(s.half_extents)},
    Cylinder: lambda s: {
        "type": "cylinder",
        "pose": floats(s.pose),
        "radius": float(s.radius),
        "half_height": float(s.half_height),
    },
    Capsule: lambda s: {"type": "capsule", "start": floats(s.start), "end": floats(s.end), "radius": float(s.radius)},
    Hull: lambda s: {"type": "hull", "points": floats(s.points)},
}


def _array(value: Any, *shape: int | None) -> NDArray[np.float64]:
    array = np.array(value, np.float64)
    # NumPy sees no second axis in an empty list
    if array.size == 0 and len(shape) == 2:
        array = array.reshape(0, shape[1] or 0)
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise ValueError(f"expected an array of shape {list(shape)}, got {list(array.shape)}")
    return array


_SHAPE_READERS: Mapping[str, Callable[[dict[str, Any]], Shape]] = {
    "box": lambda d: Box(pose=_array(d["pose"], 7), half_extents=_array(d["half_extents"], 3)),
    "cylinder": lambda d: Cylinder(
        pose=_array(d["pose"], 7), radius=float(d["radius"]), half_height=float(d["half_height"])
    ),
    "capsule": lambda d: Capsule(start=_array(d["start"], 3), end=_array(d["end"], 3), radius=float(d["radius"])),
    "hull": lambda d: Hull(points=_array(d["points"], None, 3)),
}


def asset_record(asset: Asset, mesh: dict[str, Any] | None) -> dict[str, Any]:
    """Return an asset as plain JSON, without its arrays; ``mesh`` names the accessors and textures that hold them."""
    return {
        "name": asset.name,
        "category": asset.category,
        "mesh": mesh,
        "has_normals": asset.mesh.normals is not None,
        "shapes": [_SHAPE_WRITERS[type(s)](s) for s in asset.shapes],
        "receptacles": [
            {
                "name": r.name,
                "center": floats(r.center),
                "half_size": floats(r.half_size),
                "clearance_m": float(r.clearance_m),
            }
            for r in asset.receptacles
        ],
    }


def instance_record(i: Instance) -> dict[str, Any]:
    """Return an instance as plain JSON."""
    record = {
        "name": i.name,
        "asset": i.asset,
        "pose": floats(i.pose),
        "scale": floats(i.scale),
        "semantic_id": int(i.semantic_id),
        "motion": i.motion,
        "layer": i.layer,
    }
    return record if i.receptacles is None else {**record, "receptacles": list(i.receptacles)}


def read_instance(record: dict[str, Any]) -> Instance:
    """Read an instance from the record that `instance_record` writes."""
    if record["motion"] not in ("static", "kinematic"):
        raise ValueError(f"unknown motion {record['motion']!r}")
    return Instance(
        name=str(record["name"]),
        asset=str(record["asset"]),
        pose=_array(record["pose"], 7),
        scale=_array(record["scale"], 3),
        semantic_id=int(record["semantic_id"]),
        motion=record["motion"],
        layer=str(record["layer"]),
        receptacles=None if (used := record.get("receptacles")) is None else tuple(str(name) for name in used),
    )


def room_record(r: Room) -> dict[str, Any]:
    """Return a room as plain JSON."""
    record: dict[str, Any] = {
        "name": r.name,
        "category": r.category,
        "rectangles": floats(r.rectangles),
        "floor_y": float(r.floor_y),
    }
    return record if r.ramp is None else {**record, "ramp": dataclasses.asdict(r.ramp)}


def read_room(record: dict[str, Any]) -> Room:
    """Read a room from the record that `room_record` writes."""
    return Room(
        name=str(record["name"]),
        category=str(record["category"]),
        rectangles=_array(record["rectangles"], None, 4),
        floor_y=float(record["floor_y"]),
        ramp=None if (ramp := record.get("ramp")) is None else _read_ramp(ramp),
    )


def _read_ramp(record: dict[str, Any]) -> Ramp:
    ramp = Ramp(
        axis=record["axis"],
        start=float(record["start"]),
        end=float(record["end"]),
        top_y=float(record["top_y"]),
        steps=int(record["steps"]),
    )
    if ramp.axis not in (0, 1) or not np.isfinite([ramp.start, ramp.end, ramp.top_y]).all():
        raise ValueError("a ramp needs an axis, 0 or 1, and finite ends")
    if ramp.start == ramp.end or ramp.steps < 1:
        # the ramp's length and its steps are divisors wherever the height of a floor is asked for
        raise ValueError("a ramp needs two different ends and at least 1 step")
    return ramp


def light_record(light: LightSource) -> dict[str, Any]:
    """Return a light as plain JSON."""
    return {
        "name": light.name,
        "kind": light.kind,
        "vector": floats(light.vector),
        "color": floats(light.color),
        "intensity": float(light.intensity),
        "frame": light.frame,
        "cone_rad": [float(a) for a in light.cone_rad],
    }


def read_light(record: dict[str, Any]) -> LightSource:
    """Read a light from the record that `light_record` writes."""
    # unpacked, so that another number of angles is refused
    inner, outer = (float(a) for a in record["cone_rad"])
    if record["kind"] not in get_args(LightKind) or record["frame"] not in get_args(LightFrame):
        raise ValueError(f"unknown light {record['kind']!r} in frame {record['frame']!r}")
    return LightSource(
        name=str(record["name"]),
        kind=record["kind"],
        vector=_array(record["vector"], 3),
        color=_array(record["color"], 3),
        intensity=float(record["intensity"]),
        frame=record["frame"],
        cone_rad=(inner, outer),
    )


def articulation_record(thing: Articulation) -> dict[str, Any]:
    """Return an articulated object as plain JSON."""
    return {
        "name": thing.name,
        "pose": floats(thing.pose),
        "base": thing.base,
        "parts": [
            {
                "name": part.name,
                "joint": {
                    "kind": part.joint.kind,
                    "axis": floats(part.joint.axis),
                    "origin": floats(part.joint.origin),
                    "lower": float(part.joint.lower),
                    "upper": float(part.joint.upper),
                    "rest": float(part.joint.rest),
                },
                "instances": list(part.instances),
                "parent": part.parent,
                "encloses": list(part.encloses),
                "handle": None if part.handle is None else floats(part.handle),
            }
            for part in thing.parts
        ],
    }


def read_articulation(record: dict[str, Any]) -> Articulation:
    """Read an articulation from the record that `articulation_record` writes."""
    return Articulation(
        name=str(record["name"]),
        pose=_array(record["pose"], 7),
        base=str(record["base"]),
        parts=tuple(_read_part(part) for part in record["parts"]),
    )


def _read_part(record: dict[str, Any]) -> Part:
    joint = record.get("joint")
    if not isinstance(joint, dict):
        raise ValueError(f"the part {record['name']!r} has no joint")
    made = Joint(
        kind=joint["kind"],
        axis=_array(joint["axis"], 3),
        origin=_array(joint["origin"], 3),
        lower=float(joint["lower"]),
        upper=float(joint["upper"]),
        rest=float(joint["rest"]),
    )
    handle = record.get("handle")
    return Part(
        name=str(record["name"]),
        joint=made,
        instances=tuple(str(name) for name in record["instances"]),
        parent=str(record["parent"]),
        encloses=tuple(str(name) for name in record["encloses"]),
        handle=None if handle is None else _array(handle, 3),
    )


def read_asset(record: dict[str, Any], mesh: Mesh) -> Asset:
    """Read an asset from its record and mesh; the inverse of `asset_record`."""
    return Asset(
        name=str(record["name"]),
        mesh=mesh,
        category=str(record["category"]),
        shapes=tuple(_SHAPE_READERS[s["type"]](s) for s in record["shapes"]),
        receptacles=tuple(
            Receptacle(
                name=str(r["name"]),
                center=_array(r["center"], 3),
                half_size=_array(r["half_size"], 2),
                clearance_m=float(r["clearance_m"]),
            )
            for r in record["receptacles"]
        ),
    )


# --- digest -----------------------------------------------------------------------------------------------------------
def scene_digest(scene: Scene) -> str:
    """Return the SHA-256 (hex) of a scene's content: assets by name, instances in order, rooms, lights, doors and drawers.

    It does not depend on files, on the order of assets, or on which meshes share a texture. The scene's name and source
    are not content.
    """
    pixels_of: dict[int, str] = {}
    h = hashlib.sha256(b"h3data.scene.digest/1")

    def feed(text: str) -> None:
        data = text.encode()
        # lengths before contents, so that no two different scenes give the same stream of bytes
        h.update(struct.pack("<Q", len(data)) + data)

    def feed_array(array: NDArray[Any] | None, dtype: str) -> None:
        if array is None:
            h.update(b"-")
            return
        h.update(struct.pack(f"<{array.ndim + 1}Q", array.ndim, *array.shape))
        h.update(np.ascontiguousarray(array, dtype).tobytes())

    # sorted, since the order of a mapping is not content
    for key in sorted(scene.assets):
        asset = scene.assets[key]
        feed(key)
        mesh = asset.mesh
        for array, dtype in ((mesh.vertices, "<f4"), (mesh.faces, "<i4"), (mesh.colors, "u1"), (mesh.normals, "<f4")):
            feed_array(array, dtype)
        if mesh.uv is not None:  # untextured meshes keep the digest they had before textures existed
            feed("uv")
            feed_array(mesh.uv, "<f4")
            feed_array(mesh.face_textures, "<i2")
            for texture in mesh.textures:
                # hashed once for each texture, because many assets share a large one
                if id(texture) not in pixels_of:
                    pixels_of[id(texture)] = (
                        f"{texture.pixels.shape} {hashlib.sha256(texture.pixels.tobytes()).hexdigest()}"
                    )
                feed(f"texture {texture.name!r} {pixels_of[id(texture)]}")
        feed(json.dumps(asset_record(asset, None)))
    feed(json.dumps([instance_record(i) for i in scene.instances]))
    feed(json.dumps([room_record(r) for r in scene.rooms]))
    if scene.lights is not None:
        feed(json.dumps([light_record(light) for light in scene.lights]))
    if scene.articulations:  # scenes without keep the digest they had before there were such things
        feed(json.dumps([articulation_record(thing) for thing in scene.articulations]))
    return h.hexdigest()
