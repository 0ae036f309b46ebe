"""FreeSpace on disk: round trip, hostile files, the cache and its keys."""

from __future__ import annotations

import dataclasses
import errno
import logging
import os
import subprocess
import sys

import numpy as np
import pytest
from shapely.geometry import box

from h3data.errors import FormatError, InputError
from h3data.mesh.mesh import Mesh
from h3data.scene import FreeSpace
from h3data.scene.freespace.build import build_from_walkable, scene_key
from h3data.scene.freespace.store import cache_folder
from h3data.scene.records import Asset, Box, Instance, Room, Scene
from tests.paths import ROOT
from tests.random_cases import examples

SIZES = {"radius_m": 0.25, "height_m": 1.41, "max_climb_m": 0.2, "cell_m": 0.05}


@pytest.fixture(scope="module")
def space() -> FreeSpace:
    return FreeSpace.from_map(
        build_from_walkable(box(0, 0, 5, 4).difference(box(2, 1, 3, 2)), **SIZES, key="k", floor_y=0.5)
    )


def make_scene(*, half=0.5, x=0.0, side=4.0) -> Scene:
    mesh = Mesh(
        vertices=np.array([[-9, 0, -9], [9, 0, -9], [0, 0, 9]], np.float32),
        faces=np.array([[0, 2, 1]], np.int32),
        colors=np.zeros((3, 3), np.uint8),
    )
    shape = Box(pose=np.array([0, 0.5, 0, 0, 0, 0, 1.0]), half_extents=np.full(3, half))
    return Scene(
        name="s",
        assets={"a": Asset(name="a", mesh=mesh, shapes=(shape,))},
        instances=(Instance(name="i", asset="a", pose=np.array([x, 0, 0, 0, 0, 0, 1.0])),),
        rooms=(Room(name="r", category="room", rectangles=np.array([[-side, -4, 4, 4]])),),
    )


@pytest.mark.parametrize("with_lattice", [False, True])
def test_round_trip(space, tmp_path, with_lattice):
    space = dataclasses.replace(space)
    if with_lattice:
        _ = space.lattice
    space.save(tmp_path / "f.npz")
    again = FreeSpace.load(tmp_path / "f.npz")
    for field in dataclasses.fields(FreeSpace):
        if field.name not in ("graph", "polygon"):
            np.testing.assert_array_equal(getattr(again, field.name), getattr(space, field.name))
    assert again.polygon.equals_exact(space.polygon, 0)
    for mine, theirs in zip(space.graph, again.graph, strict=True):
        np.testing.assert_array_equal(mine, theirs)
        assert mine.dtype == theirs.dtype
    assert ("lattice" in again.__dict__) is with_lattice
    a, b = space.sample(np.random.default_rng(0), 40).reshape(2, 20, 2)
    np.testing.assert_array_equal(again.geodesic(a, b), space.geodesic(a, b))
    np.testing.assert_array_equal(again.geodesic_lattice(a, b), space.geodesic_lattice(a, b))
    assert [p.name for p in tmp_path.iterdir()] == ["f.npz"]


def test_broken_files_are_refused(space, tmp_path):
    path = tmp_path / "f.npz"
    space.save(path)
    whole = path.read_bytes()
    for broken in (b"", b"not a zip", whole[: len(whole) // 2], whole[:-10]):
        path.write_bytes(broken)
        with pytest.raises(FormatError, match="H3-SCENE-020"):
            FreeSpace.load(path)
    with pytest.raises(InputError, match="H3-SCENE-017"):
        FreeSpace.load(tmp_path / "absent.npz")
    with np.load(_rewritten(path, whole)) as file:
        arrays = dict(file)
    for change, message in (
        ({"format": np.array(99)}, r"(?s)99.*H3-SCENE-018"),
        ({"sdf": arrays["sdf"][0]}, "(?s)finite float32 grid.*H3-SCENE-020"),
        ({"sdf": arrays["sdf"] * np.nan}, "(?s)finite float32 grid.*H3-SCENE-020"),
        ({"graph.distance": arrays["graph.distance"][:2]}, r"(?s)corners.*H3-SCENE-020"),
        ({"polygon": arrays["polygon"][:9]}, "H3-SCENE-019"),
        ({"key": np.array([{}], object)}, "H3-SCENE-020"),
    ):
        np.savez(path, **(arrays | change))
        with pytest.raises(FormatError, match=message):
            FreeSpace.load(path)
    np.savez(path, **{k: v for k, v in arrays.items() if k != "origin"})
    with pytest.raises(FormatError, match=r"(?s)origin.*H3-SCENE-020"):
        FreeSpace.load(path)


def _rewritten(path, content):
    path.write_bytes(content)
    return path


def test_keys_follow_the_geometry_and_nothing_else():
    def key(scene, **changes):
        return scene_key(scene, **(SIZES | {"floor_y": None, "method": "auto"} | changes))

    base = key(make_scene())
    assert base == key(make_scene())
    assert len(base) == 64
    different = [
        key(make_scene(half=0.6)),
        key(make_scene(x=0.1)),
        key(make_scene(side=3.9)),
        key(make_scene(), radius_m=0.3),
        key(make_scene(), height_m=1.5),
        key(make_scene(), max_climb_m=0.1),
        key(make_scene(), cell_m=0.1),
        key(make_scene(), floor_y=0.0),
        key(make_scene(), method="mesh"),
    ]
    assert len({base, *different}) == 10


def test_the_cache_is_used_and_heals_itself(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path))
    first = FreeSpace.from_scene(make_scene())
    (path,) = (tmp_path / "freespace").iterdir()
    assert path.stem == first.key
    marked = dataclasses.replace(first, floor_y=0.125)
    marked.save(path)
    assert FreeSpace.from_scene(make_scene()).floor_y == 0.125  # it came from the file
    assert FreeSpace.from_scene(make_scene(), cache=False).floor_y == 0.0
    path.write_bytes(path.read_bytes()[:500])
    with caplog.at_level(logging.WARNING):
        assert FreeSpace.from_scene(make_scene()).floor_y == 0.0
    assert "broken" in caplog.text
    assert FreeSpace.load(path).key == first.key
    dataclasses.replace(first, key="other").save(path)
    assert FreeSpace.from_scene(make_scene()).key == first.key


def test_without_a_cache_folder_it_still_works(tmp_path, monkeypatch):
    monkeypatch.setenv("H3DATA_CACHE", "off")
    assert cache_folder() is None
    FreeSpace.from_scene(make_scene())
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    monkeypatch.setenv("H3DATA_CACHE", str(blocked))
    FreeSpace.from_scene(make_scene())
    assert blocked.read_text() == "in the way"
    monkeypatch.delenv("H3DATA_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "h3data" / "freespace"


def test_any_flipped_bit_gives_the_same_space_or_is_noticed(space, tmp_path):
    """Sums of the data are in the file; damage elsewhere is refused, or does not matter (time stamps, flags)."""
    path = tmp_path / "f.npz"
    space.save(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    headers = [k for k in range(len(whole)) if whole[k : k + 2] == b"PK"]
    marks = [int(h + d) for h in headers for d in rng.integers(0, 46, examples(12))]
    places = [*rng.integers(0, len(whole), examples(150)), *marks]
    noticed = 0
    for place in places:
        broken = bytearray(whole)
        broken[min(place, len(whole) - 1)] ^= 1 << int(rng.integers(8))
        path.write_bytes(broken)
        try:
            again = FreeSpace.load(path)
        except FormatError:
            noticed += 1
            continue
        np.testing.assert_array_equal(again.sdf, space.sdf)
        np.testing.assert_array_equal(again.graph.distance, space.graph.distance)
        assert again.polygon.equals_exact(space.polygon, 0)
    assert noticed > len(places) / 2


def test_a_full_disk_is_no_fault_and_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path))

    def full(file, **_):
        file.write(b"the first block")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("h3data.scene.freespace.store.np.savez", full)
    assert FreeSpace.from_scene(make_scene()).floor_y == 0.0
    assert list((tmp_path / "freespace").iterdir()) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write to read-only folders")
def test_a_read_only_cache_is_read_and_not_written(tmp_path, monkeypatch):
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path))
    key = FreeSpace.from_scene(make_scene()).key
    (tmp_path / "freespace").chmod(0o555)
    try:
        assert FreeSpace.from_scene(make_scene()).key == key
        FreeSpace.from_scene(make_scene(x=0.5))
        assert len(list((tmp_path / "freespace").iterdir())) == 1
    finally:
        (tmp_path / "freespace").chmod(0o755)


@pytest.mark.slow
def test_processes_that_build_the_same_scene_do_not_disturb_each_other(tmp_path):
    """Both miss the cache, both build, both write; the file is whole at every moment, and nothing else is left."""
    script = (
        "import sys; from tests.scene.freespace.test_store import *; sys.stdin.readline()\n"
        "for _ in range(20):\n"
        "    space = FreeSpace.from_scene(make_scene())\n"
        "    (cache_folder() / f'{space.key}.npz').unlink(missing_ok=True)\n"
        "print(len(space.graph.nodes), float(space.sdf.sum()))\n"
    )
    environment = os.environ | {
        "H3DATA_CACHE": str(tmp_path),
        "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]),
    }
    workers = [
        subprocess.Popen(
            [sys.executable, "-W", "error", "-c", script],
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for _ in range(2)
    ]
    for worker in workers:
        assert worker.stdin is not None
        worker.stdin.write("\n")
        worker.stdin.flush()
    answers = [worker.communicate(timeout=300) for worker in workers]
    assert [w.returncode for w in workers] == [0, 0], answers
    assert answers[0] == answers[1]  # and no warnings of broken files
    assert not [p for p in (tmp_path / "freespace").iterdir() if p.suffix == ".part"]
