"""Skinned meshes of glTF files, posed by recorded bones as in habitat-sim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.skinning import apply_skin, build_skin
from h3data.geometry import Array
from h3data.mesh.gltf import GltfFile
from h3data.mesh.loading import frame_rotation, load_mesh, unreadable
from h3data.mesh.mesh import Mesh

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, kw_only=True, eq=False)
class SkinnedMesh:
    """Mesh of a glTF file with its skin."""

    mesh: Mesh
    """Rest shape in h3data's frame, as `load_mesh` returns it."""
    points: csr_array
    """Skinning operator over `joint_names` and one more joint for parts without a skin
    (`h3data.bodies.people.skinning`)."""
    joint_names: tuple[str, ...]
    inverse_bind: Array
    """Inverse bind matrix of each joint, shape [J, 4, 4]."""
    to_metres: Array
    """Transform from the file's frame to h3data's, 4x4."""

    def vertices(self, root: Array, bones: Array, names: Sequence[str]) -> NDArray[np.float32]:
        """Return world vertices [T, V, 3] [m] of instances ``root`` [T, 4, 4] (scale included) with ``bones`` [T, B, 4, 4].

        ``names`` holds the name of the joint that each bone moves; a joint without a bone follows the root. Bones are
        world frames without scale. The vertex of joint j is root F rigid(root)^-1 bone_j inverse_bind_j v, where F
        converts the file's axes to h3data's and rigid() removes the scale of a pose. As in habitat-sim, the asset's
        frame and the instance's scale are applied to the result of the bones (verified with bodies of scale 0.5).
        """
        of_bone = {name: number for number, name in enumerate(names)}
        # bones are recorded without scale, so the root must lose its own before they are compared
        rigid = root.copy()
        rigid[:, :3, :3] /= np.linalg.norm(rigid[:, :3, :3], axis=1, keepdims=True)
        relative = np.linalg.inv(rigid)[:, None] @ bones
        # identity is the root itself: joints without a bone stay there, and the last frame, of parts without a skin
        local = np.broadcast_to(np.eye(4), (len(root), len(self.joint_names) + 1, 4, 4)).copy()
        for number, name in enumerate(self.joint_names):
            if name in of_bone:
                local[:, number] = relative[:, of_bone[name]] @ self.inverse_bind[number]
        return apply_skin(self.points, (root @ self.to_metres)[:, None] @ local)


def load_skinned_mesh(
    path: Path,
    *,
    up: tuple[float, float, float] = (0.0, 1.0, 0.0),
    front: tuple[float, float, float] = (0.0, 0.0, -1.0),
    units_m: float = 1.0,
) -> SkinnedMesh | None:
    """Return the skinned mesh of a glTF file, or None if it has no skin; arguments and errors are those of `load_mesh`.

    Parts that no skin moves follow the root. Only the four influences of ``JOINTS_0`` are read.
    """
    if path.suffix.lower() not in (".glb", ".gltf"):
        return None
    mesh = load_mesh(path, up=up, front=front, units_m=units_m)
    try:
        return _read(GltfFile(path), mesh, frame_rotation(up, front) * units_m)
    # damaged files fail in many ways within the reader and numpy; all of them mean the same here
    except Exception as fault:
        raise unreadable(fault, path) from None


def _read(file: GltfFile, mesh: Mesh, linear: Array) -> SkinnedMesh | None:
    read = [file.skin(index) for index in range(len(file.document.get("skins", [])))]
    skins = [([str(file.node(node).get("name", "")) for node in nodes], binds) for nodes, binds in read]
    starts = np.cumsum([0, *(len(names) for names, _ in skins)])
    loose = int(starts[-1])
    vertices, joints, weights = [], [], []
    for part, matrix, skin in file.skinned_parts():
        if not len(part.faces):
            continue
        points = part.vertices.astype(np.float64)
        if skin is None or part.influences is None:
            points = points @ matrix[:3, :3].T + matrix[:3, 3]
            own, share = np.full((len(points), 4), loose), np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))
        else:
            # a negative index would silently count from the end
            if not isinstance(skin, int) or not 0 <= skin < len(skins):
                raise ValueError(f"skins[{skin!r}] is referred to, there are {len(skins)} skins")
            own, share = part.influences
            if own.size and (own.min() < 0 or own.max() >= len(skins[skin][0])):
                raise ValueError(f"JOINTS_0 goes up to {own.max()}, skins[{skin}] has {len(skins[skin][0])} joints")
            own = own + starts[skin]
        total = share.sum(1, keepdims=True)
        if not (np.isfinite(total).all() and (total > 0).all()):
            raise ValueError("WEIGHTS_0 leaves a vertex without weight")
        vertices.append(points)
        joints.append(own)
        weights.append(share / total)
    # a file may hold a skin that none of its parts uses
    if not skins or all((own == loose).all() for own in joints):
        return None
    points = np.concatenate(vertices).astype(np.float32)
    all_weights = np.concatenate(weights).astype(np.float32)
    to_metres = np.eye(4)
    to_metres[:3, :3] = linear
    return SkinnedMesh(
        mesh=mesh,
        points=build_skin(points, None, np.concatenate(joints), all_weights, loose + 1).points,
        joint_names=tuple(name for names, _ in skins for name in names),
        inverse_bind=np.concatenate([binds for _, binds in skins]),
        to_metres=to_metres,
    )
