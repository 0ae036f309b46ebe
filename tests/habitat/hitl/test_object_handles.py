"""Objects that a session names by handle: found below the asset folders where one file fits, around their centre of mass."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.formats import detect
from h3data.geometry import transform_points
from h3data.mesh.primitives import box_mesh
from h3data.recording import AssetRef
from h3data.recording.assets.library import AssetLibrary
from h3data.replay import Replay
from h3data_exporters.glb_write import glb_bytes
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_habitat.hitl.episode import object_bodies
from h3data_habitat.hitl.sessions import read_hitl_episode

CAN = AssetRef(name="can", uri="handle:can")
SESSION = "habitat-lab/reference/hitl/session_1user_policy"


def put(folder: Path, name: str = "can", *, size: tuple[float, float, float] = (1, 2, 3), **config: Any) -> Path:
    """A box from corner 0 to ``size`` as GLB, with an object config if it has keys."""
    folder.mkdir(parents=True, exist_ok=True)
    half = [side / 2 for side in size]
    mesh = box_mesh(half, center=half)
    (folder / f"{name}.glb").write_bytes(glb_bytes([mesh]))
    if config:
        (folder / f"{name}.object_config.json").write_text(json.dumps({"render_asset": f"{name}.glb", **config}))
    return folder


def bounds(library: AssetLibrary) -> np.ndarray:
    mesh = library.mesh(CAN)
    assert mesh is not None
    return mesh.bounds


def test_handles_become_templates() -> None:
    track = np.tile([0.0, 0, 0, 0, 0, 0, 1], (3, 1))
    names = ["can_:0000", "can_:0001", "objects/ycb/mug_:0012", "object_63"]
    assets, bodies, _ = object_bodies(names, [track.copy() for _ in names])
    assert [(a.name, a.uri) for a in assets] == [
        ("can", "handle:can"),
        ("mug", "handle:mug"),
        ("object_63", "rearranged_objects/object_63.glb"),
    ]
    assert [b.asset for b in bodies] == ["can", "can", "mug", "object_63"]


def test_a_bare_mesh_lies_around_the_middle_of_its_box(tmp_path: Path) -> None:
    put(tmp_path / "some" / "where")
    np.testing.assert_allclose(bounds(AssetLibrary([tmp_path])), [[-0.5, -1, -1.5], [0.5, 1, 1.5]], atol=1e-6)


def test_a_config_says_size_and_centre_of_mass_and_goes_before_bare_meshes(tmp_path: Path) -> None:
    put(tmp_path / "a", scale=[2, 1, 1], COM=[0.25, 0, 0])
    put(tmp_path / "b")
    np.testing.assert_allclose(bounds(AssetLibrary([tmp_path])), [[-0.25, 0, 0], [1.75, 2, 3]], atol=1e-6)


def test_one_file_below_two_roots_is_one(tmp_path: Path) -> None:
    put(tmp_path / "a")
    assert bounds(AssetLibrary([tmp_path, tmp_path / "a"])) is not None


@pytest.mark.parametrize("config", [{}, {"mass": 1.0}])
def test_what_is_ambiguous_is_listed(tmp_path: Path, config: dict[str, Any]) -> None:
    for folder in ("a", "b"):
        put(tmp_path / folder, **config)
    library = AssetLibrary([tmp_path])
    assert library.mesh(CAN) is None
    reason = library.unreadable[CAN.uri]
    assert "2 files fit the object handle 'can'" in reason
    assert all(str(tmp_path / folder) in reason for folder in ("a", "b"))
    assert "assets=" in reason


def test_what_is_nowhere_is_missing(tmp_path: Path) -> None:
    put(tmp_path, "canister")
    library = AssetLibrary([tmp_path])
    assert library.mesh(CAN) is None
    assert library.missing == ["handle:can"]
    assert np.ptp(library.placeholder(CAN).bounds, axis=0).max() < 0.2


def test_a_config_without_its_mesh_says_so(tmp_path: Path) -> None:
    put(tmp_path, mass=1.0)
    (tmp_path / "can.glb").unlink()
    library = AssetLibrary([tmp_path])
    assert library.mesh(CAN) is None
    assert "'can.glb' was not found" in library.unreadable[CAN.uri]


def test_objects_lie_where_the_simulator_drew_them(real: Path) -> None:
    """The log holds centres of mass, the gfx-replay of the same episode places of meshes: both show the same."""
    library = AssetLibrary([real / "habitat-sim", real / "habitat-lab" / "reference" / "navmesh"])
    ours = Replay(read_hitl_episode(real / SESSION / "gen2" / "10.json.gz", assets=library), assets=library)
    drawn = Replay(read_gfx_replay(real / SESSION / "gfx" / "episode_0.gfx_replay.json.gz"), assets=library)
    assert not ours.missing
    for name in ("chair", "donut", "sphere", "nested_box"):
        mine = next(d for d in ours.drawables if d.name == f"{name}_:0000")
        theirs = next(d for d in drawn.drawables if d.name.startswith(f"{name}_"))
        a, b = (transform_points(d.matrix, d.mesh.vertices.astype(np.float64)) for d in (mine, theirs))
        np.testing.assert_allclose(a, b, atol=2e-4)


def test_physics_settings_are_told_from_stages(tmp_path: Path) -> None:
    file = tmp_path / "default.physics_config.json"
    file.write_text(json.dumps({"physics_simulator": "bullet", "gravity": [0, -9.8, 0]}))
    assert detect(file).name == "physics_config"
    file = tmp_path / "plain.stage_config.json"
    file.write_text(json.dumps({"render_asset": "a.glb", "gravity": [0, -9.8, 0]}))
    assert detect(file).name == "stage_config"
