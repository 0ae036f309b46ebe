"""Pictures drawn from real gfx-replays beside the pictures that habitat-sim itself drew."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.geometry import pose_to_matrix
from h3data.interop import AssetLibrary, read_gfx_replay
from h3data.recording.records import Recording
from h3data.render import OPENGL_TO_OPENCV, Renderer, RenderInstance, RenderScene, pinhole

REAL = Path(__file__).resolve().parents[2] / "shared" / "real" / "habitat-sim"
pytestmark = pytest.mark.skipif(not REAL.is_dir(), reason="habitat-sim's reference images are not on this machine")


def world_matrices(rec: Recording, step: int) -> np.ndarray:
    """4x4 of every body at a step, NaN where it is away."""
    poses = [rec.columns["object_pose"][step, b.moving] if b.moving >= 0 else b.pose for b in rec.bodies]
    matrices = pose_to_matrix(np.array(poses, np.float64))
    matrices[:, :3, :3] *= np.array([b.scale for b in rec.bodies])[:, None, :]
    matrices[np.isnan(matrices).any((1, 2))] = np.nan
    return matrices


def on_silhouette(depth: np.ndarray) -> np.ndarray:
    """Pixels whose 3x3 neighbourhood holds a jump in depth of more than 10 cm."""
    far = np.pad(np.where(depth == 0, 1e3, depth), 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(far, (3, 3))
    return windows.max((2, 3)) - windows.min((2, 3)) > 0.1


@pytest.mark.parametrize("name", ["room_rigid", "room_articulated", "room_rigid_flat"])
def test_depth_and_semantics_agree_with_habitat_sim(name: str) -> None:
    """Also the cube and the capsule, which habitat-sim's own player drops: they have a creation but no load."""
    folder = REAL / "reference" / "replays" / name
    rec = read_gfx_replay(folder / "replay.gfx_replay.json")
    meta: dict[str, Any] = json.loads((folder / "meta.json").read_text())
    library = AssetLibrary([REAL])
    meshes = [library.mesh(ref) for ref in rec.assets]
    assert not library.missing
    names = [ref.name for ref in rec.assets]
    instances = [
        RenderInstance(mesh=names.index(b.asset), matrix=m, semantic_id=b.semantic_id)
        for b, m in zip(rec.bodies, world_matrices(rec, 0), strict=True)
    ]
    renderer = Renderer(RenderScene([m for m in meshes if m is not None], instances))
    everything = np.arange(len(instances))
    off, total, labels_off, labels = 0, 0, 0, 0
    for step in meta["gt_keyframes"]:
        truth = meta["keyframes"][step]
        renderer.set_transforms(everything, world_matrices(rec, step))
        for sensor in ("depth_256x256", "depth_224x171"):
            c = meta["cameras"][sensor]
            pose = np.array(truth["camera_to_world"]) @ OPENGL_TO_OPENCV
            camera = pinhole(c["width"], c["height"], hfov_deg=c["hfov_deg"], pose=pose)
            assert camera.fx == pytest.approx(c["fx"])
            ours = renderer.render(camera, outputs=("depth", "semantic"))
            expected = np.load(folder / truth["gt"][sensor])
            inside = ~on_silhouette(expected)
            wrong = np.abs(ours["depth"] - expected) > 1e-3
            assert wrong.mean() < 1.5e-3  # silhouettes included; measured 9e-4 at worst, 5e-5 as a rule
            off, total = off + int((wrong & inside).sum()), total + int(inside.sum())
            if sensor == "depth_256x256":
                semantic = np.load(folder / truth["gt"]["semantic_256x256"])
                labels_off += int((np.maximum(ours["semantic"], 0) != semantic).sum())
                labels += semantic.size
    assert off / total < 2e-5
    assert labels_off / labels < 5e-5
