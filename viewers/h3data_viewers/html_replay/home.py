"""Home and agents of an HTML replay as a GLB in pieces: thinned meshes, rounded coordinates, and textures as JPEG."""

from __future__ import annotations

import io
import json
import logging
import struct
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from h3data.geometry import IDENTITY_POSE, Array
from h3data.mesh.glb import FLOAT32, UINT16, UINT32
from h3data.mesh.images import reduced, reduced_size
from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.thinning import thin_mesh
from h3data.recording import Recording
from h3data_exporters.gltf_animation import write_gltf_animation
from h3data_exporters.posed_parts import PosedPart
from h3data_viewers.html_replay.packing import Payload
from h3data_viewers.rerun.mesh_budget import baked_colors

MAX_VERTICES = 130_000
"""Greatest number of vertices of all meshes in an HTML replay. Above it, all meshes are thinned by the same factor. A
vertex takes about 6 bytes of the file: a medium home has 62,000 vertices."""
LEAST_VERTICES = 100
"""Smallest number of vertices to which a mesh is thinned."""
MAX_TEXELS = 1 << 20
TEXTURE_SIDE_PX = 256


def add_home(payload: Payload, recording: Recording, parts: Sequence[PosedPart]) -> None:
    """Add the meshes of the home and its agents at their first pose.

    Joints of bodies that belong to no agent are named ``<body>/<joint>``. The file ``home`` is the JSON of a GLB. Its
    buffer view k is ``home.k``, either a file or an array whose type is the member ``numbers``; this takes half as many
    bytes as a compressed GLB. `web/src/replay/home.ts` puts the GLB together.
    """
    drawn = _within_budget([part for part in parts if len(part.mesh.faces)])
    with tempfile.TemporaryDirectory(prefix="h3data-") as folder:
        path = Path(folder, "home.glb")
        # one pose each: the page moves the nodes itself, by the tracks of the payload
        write_gltf_animation(recording, [_at_first(part) for part in drawn], path)
        data = path.read_bytes()
    # a GLB is a header of 12 bytes and two chunks, JSON and binary, each after 8 bytes with its length and type
    (length,) = struct.unpack_from("<I", data, 12)
    document, chunk = json.loads(data[20 : 20 + length]), memoryview(data)[28 + length :]
    node = len(recording.agents)  # the writer's nodes are those of the agents, then each part with its joints
    for part in drawn:
        node += 1
        for name in part.skeleton.names if part.skeleton is not None else ():
            if part.body is not None:  # two bodies may have joints of one name
                document["nodes"][node]["name"] = f"{part.name}/{name}"
            node += 1
    # uid, task and scene, which the page has among its facts
    del document["asset"]["extras"]
    _add_views(payload, document, chunk)
    payload.add_file("home", json.dumps(document, separators=(",", ":")).encode())


def first_pose(poses: Array) -> Array:
    """Return the first pose that is not NaN, shape [1, ..., 7], of poses [T, ..., 7]."""
    there = np.isfinite(poses).reshape(len(poses), -1).all(1)
    if there.any():
        return poses[int(np.argmax(there))][None]
    return np.broadcast_to(IDENTITY_POSE, poses[:1].shape)


def _at_first(part: PosedPart) -> PosedPart:
    skeleton = part.skeleton
    if skeleton is not None:
        skeleton = replace(skeleton, poses=first_pose(skeleton.poses))
    return replace(part, poses=first_pose(part.poses), skeleton=skeleton)


# --- budgets ----------------------------------------------------------------------------------------------------------
def _within_budget(parts: Sequence[PosedPart]) -> list[PosedPart]:
    """Return the parts with meshes and textures that keep `MAX_VERTICES` and `MAX_TEXELS`."""
    # by identity: many parts share a mesh, which the file holds once
    distinct = {id(part.mesh): part.mesh for part in parts}
    total = sum(len(mesh.vertices) for mesh in distinct.values())
    if (share := MAX_VERTICES / max(total, 1)) < 1:
        logging.getLogger(__name__).info("Thinning %d vertices to %.0f%%", total, 100 * share)
    textures = {id(texture): texture for mesh in distinct.values() for texture in mesh.textures}
    sizes, side = [t.pixels.shape[1::-1] for t in textures.values()], TEXTURE_SIDE_PX
    while side > 1 and sum(np.prod(reduced_size(w, h, side)) for w, h in sizes) > MAX_TEXELS:
        side //= 2
    textures = {key: Texture(pixels=reduced(t.pixels, side), name=t.name) for key, t in textures.items()}
    # thinning does not carry the weights of bones
    rigged = {id(part.mesh) for part in parts if part.skeleton is not None}
    small = {
        key: _thinned(mesh, share)
        if share < 1 and key not in rigged
        else replace(mesh, textures=tuple(textures[id(texture)] for texture in mesh.textures))
        for key, mesh in distinct.items()
    }
    return [replace(part, mesh=small[id(part.mesh)]) for part in parts if len(small[id(part.mesh)].faces)]


def _thinned(mesh: Mesh, share: float) -> Mesh:
    """Return a mesh with ``share`` of its vertices and the colours of its textures in them."""
    most = max(LEAST_VERTICES, int(share * len(mesh.vertices)))
    if len(mesh.vertices) <= most and not mesh.textures:
        return mesh
    thin = thin_mesh(mesh, most)
    if not len(thin.faces):
        return mesh
    # 32 levels of a colour: more colours would be more triangles with corners of their own
    colors = baked_colors(mesh)[thin.keep] // 8 * 8 + 4
    # without normals, a mesh stays faceted
    normals = None if mesh.normals is None else mesh.normals[thin.keep]
    return Mesh(vertices=mesh.vertices[thin.keep], faces=thin.faces, colors=colors.astype(np.uint8), normals=normals)


# --- the file ---------------------------------------------------------------------------------------------------------
def _add_views(payload: Payload, document: dict[str, Any], old: memoryview) -> None:
    """Add the buffer views: opaque pictures as JPEG, indices of 16 bits where they suffice."""
    images = {image["bufferView"]: image for image in document.get("images", ())}
    primitives = [p for mesh in document.get("meshes", ()) for p in mesh["primitives"]]
    # a quarter of a millimetre, half a degree, and an 8,192th of a texture, which nobody sees; indices stay exact
    steps = {p["indices"]: 1.0 for p in primitives}
    for name, step in {"POSITION": 2.0**-12, "NORMAL": 2.0**-7, "TEXCOORD_0": 2.0**-13}.items():
        steps |= {p["attributes"][name]: step for p in primitives if name in p["attributes"]}
    accessors = {document["accessors"][k]["bufferView"]: (document["accessors"][k], step) for k, step in steps.items()}
    for number, view in enumerate(document["bufferViews"]):
        data = bytes(old[view["byteOffset"] : view["byteOffset"] + view["byteLength"]])
        if number in accessors:
            accessor, step = accessors[number]
            kind = {FLOAT32: "<f4", UINT32: "<u4", UINT16: "<u2"}[accessor["componentType"]]
            values = np.frombuffer(data, kind).reshape(accessor["count"], -1)
            # glTF allows no index that is the greatest number of its type
            if kind == "<u4" and values.max(initial=0) < 65535:
                kind, accessor["componentType"] = "<u2", UINT16
            view["numbers"] = kind[1:]
            payload.add_array(f"home.{number}", values, step)
            continue
        if image := images.get(number):
            data, image["mimeType"] = _picture(data, image["name"])
        payload.add_file(f"home.{number}", data)


def _picture(png: bytes, name: str) -> tuple[bytes, str]:
    """Return a PNG and its type, as JPEG if that is smaller; the palette and pictures with holes stay exact."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as picture:
        opaque = picture.mode in ("RGB", "L") or picture.convert("RGBA").getchannel("A").getextrema() == (255, 255)
        out = io.BytesIO()
        picture.convert("RGB").save(out, "JPEG", quality=80, optimize=True)
    # JPEG would mix the colours of neighbouring cells of the palette
    small = name != "palette" and opaque and out.tell() < len(png)
    return (out.getvalue(), "image/jpeg") if small else (png, "image/png")
