"""Files of other programs that are damaged, cut, huge or hostile: read or refused, and nothing half-done is left behind."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.errors import FormatError, H3DataError
from h3data.formats import detect
from h3data.mesh.loading import load_mesh
from h3data.mesh.primitives import primitive_mesh
from h3data.recording import AssetRef, read_mcap, write_mcap
from h3data.recording.assets.library import AssetLibrary
from h3data.replay import Replay
from h3data_exporters.glb_write import glb_bytes
from h3data_habitat.episodes.files import read_episodes
from h3data_habitat.gfx.keyframes import KEYFRAME_BYTES
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_habitat.hitl.paper_logs import read_hitl_log
from h3data_habitat.hitl.sessions import read_hitl_episode
from h3data_habitat.limits import MAX_AGENTS
from h3data_motion.amass import npz_arrays
from h3data_motion.bvh import read_bvh_file
from h3data_pipelines.cli import main
from tests.random_cases import examples

POSE = {"translation": [1.5, 0.25, -2], "rotation": [1, 0, 0, 0]}
FLIPPED = {"translation": [1.5, 0.25, -2], "rotation": [-0.5, 0.5, 0.5, 0.5]}
TILTED = [0.02, 0.0, 0.0, 0.9998]


def replay(**more: Any) -> dict[str, Any]:
    """A small gfx-replay that has one of everything."""
    rig = [{"t": [0, 1, 0], "r": [1, 0, 0, 0]}, {"t": [0, 2, 0], "r": [0, 1, 0, 0]}]
    phong = {"diffuse": [0.5, 0.25, 1, 1]}
    files = ["data/stages/flat.glb", "data/robots/hab_spot_arm/base.glb", "humanoids/male_0/male_0.glb", "cubeSolid"]
    return {
        "keyframes": [
            {
                "loads": [
                    {
                        "filepath": f,
                        "frame": {"up": [0, 1, 0], "front": [0, 0, -1]},
                        "virtualUnitToMeters": 1.0,
                        "overridePhongMaterial": phong,
                    }
                    for f in files
                ],
                "rigCreations": [{"id": 0, "boneNames": ["a", "b"]}],
                "creations": [
                    {"instanceKey": k, "creation": {"filepath": f, "scale": [1, 1, 1], "rigId": 0 if k == 2 else -1}}
                    for k, f in enumerate(files)
                ],
                "metadata": [{"instanceKey": 1, "metadata": {"objectId": 1, "semanticId": 7}}],
                "stateUpdates": [
                    {"instanceKey": k, "state": {"absTransform": POSE, "semanticId": k}} for k in range(4)
                ],
                "rigUpdates": [{"id": 0, "pose": rig}],
                "userTransforms": [{"name": "sensor_a", "transform": POSE}],
                "lightsChanged": True,
                "lights": [{"vector": [0, -1, 0, 0], "color": [1, 1, 1], "model": "global"}],
            },
            {},
            {"deletions": [3], "stateUpdates": [{"instanceKey": 1, "state": {"absTransform": FLIPPED}}]},
        ],
        **more,
    }


def episode() -> dict[str, Any]:
    """A small episode of the second generation."""
    camera = {"right": [1, 0, 0], "up": [0, 1, 0], "backward": [0, 0, 1], "translation": [0, 1.5, 0]}
    thing = {"position": [0, 1, 0], "rotation": [0, 0.6, 0, 0.8], "object_handle": "can_:0000", "object_id": 5}
    users = [{"events": [{"type": "pick", "obj_handle": "can_:0000"}], "held_object": 5, "camera_transform": camera}]
    agents = [
        {"position": [0, 0.48, 0], "rotation": [0, 0, 0, 1], "grasp_mgr_snap_idx": 5},
        {"position": [2, 0.92, 1], "rotation": TILTED, "grasp_mgr_snap_idx": None},
    ]
    frame = {
        "t": 0.1,
        "users": users,
        "object_states": [{**thing, "states": {"is_clean": True}}],
        "agent_states": agents,
    }
    return {
        "session": {},
        "users": [],
        "episode": {"episode_id": "3", "scene_id": "a/b.scene_instance.json"},
        "frames": [frame, {}, {**frame, "t": 0.2}],
    }


def log() -> dict[str, Any]:
    """A small log of the first generation, with a posture."""
    base = np.eye(4)
    base[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    posture = [*np.tile([0.0, 0, 0, 1], 54), *np.eye(4).ravel(), *base.T.ravel()]
    agents = [
        {"position": [0, 0.48, 0], "rotation_xyzw": [0, 0, 0, 1], "grasp_mgr_snap_idx": None},
        {"position": [1, 0.92, 0], "rotation_xyzw": TILTED, "grasp_mgr_snap_idx": 7},
    ]
    metrics = {"n": 1, "deep": {"a": True}}
    step = {
        "action": [0.5, *map(float, posture)],
        "gui_humanoid": {"cam_yaw": 0.1, "grasp_object_id": 7},
        "agent_states": agents,
        "target_object_positions": [[0, 0.5, 0]],
        "metrics": metrics,
    }
    return {
        "start_time": "x",
        "episode_id": "1",
        "scene_id": "",
        "target_obj_ids": [7],
        "goal_positions": [[0, 0, 0]],
        "steps": [step, step],
    }


def dataset() -> dict[str, Any]:
    """An episode dataset."""
    turn = np.eye(4).tolist()
    episode = {
        "episode_id": "0",
        "scene_id": "a",
        "scene_dataset_config": "b",
        "start_position": [0, 0, 0],
        "start_rotation": [0, 0, 0, 1],
        "rigid_objs": [["c.object_config.json", turn]],
        "targets": {"c_:0000": turn},
        "ao_states": {},
        "name_to_receptacle": {},
        "additional_obj_config_paths": [],
        "goal_receptacles": [],
        "target_receptacles": [],
        "markers": [],
        "info": {},
    }
    return {"config": None, "episodes": [episode]}


def text(content: Any) -> bytes:
    return json.dumps(content, separators=(",", ":")).encode()


def npz() -> bytes:
    out = io.BytesIO()
    np.savez(out, poses=np.arange(6.0).reshape(2, 3), names=np.array(["a", "bc"]))
    return out.getvalue()


BVH = """HIERARCHY
ROOT hips
{
 OFFSET 0 0 0
 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
 JOINT leg
 {
  OFFSET 0 -1 0
  CHANNELS 3 Zrotation Xrotation Yrotation
  End Site
  {
   OFFSET 0 -1 0
  }
 }
}
MOTION
Frames: 2
Frame Time: 0.033
0 1 0 0 0 0 0 0 0
0 1 0 5 0 0 0 9 0
"""

Reader = Callable[[Path], Any]
FILES: dict[str, tuple[bytes, str, Reader]] = {
    "gfx_replay": (text(replay()), "x.gfx_replay.json", read_gfx_replay),
    "hitl_episode": (text(episode()), "x.json", read_hitl_episode),
    "hitl_log": (text(log()), "x.json", read_hitl_log),
    "hitl_pickle": (pickle.dumps(log(), protocol=4), "x.pkl", read_hitl_log),
    "npz": (npz(), "x.npz", npz_arrays),
    "glb": (glb_bytes([primitive_mesh("cubeSolid")]), "x.glb", load_mesh),
    "bvh": (BVH.encode(), "x.bvh", read_bvh_file),
    "episodes": (text(dataset()), "x.json", read_episodes),
}
"""A small whole file of each kind, its name, and what reads it."""
RECORDINGS = ("gfx_replay", "hitl_episode", "hitl_log", "hitl_pickle")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def read_or_refuse(folder: Path, kind: str, data: bytes) -> None:
    """What can be read can be stored and opened again; what cannot is refused in words that name the file."""
    _, name, reader = FILES[kind]
    path = folder / name
    path.write_bytes(data)
    detect(path)
    told = "read"
    try:
        with np.errstate(all="ignore"):
            found = reader(path)
            if kind in RECORDINGS:
                write_mcap(found, folder / "x.mcap", overwrite=True)
                assert len(read_mcap(folder / "x.mcap")) == len(found)
                Replay(found, assets=AssetLibrary([folder]))
    except H3DataError as fault:
        told = str(fault)
    assert 0 < len(told) < 2000


@pytest.mark.parametrize("kind", FILES)
def test_the_files_themselves_are_whole(folder: Path, kind: str) -> None:
    data, name, reader = FILES[kind]
    path = folder / name
    path.write_bytes(data)
    assert reader(path) is not None


# --- damage -----------------------------------------------------------------------------------------------------------
def damaged(data: bytes, draw: st.DrawFn) -> bytes:
    """A few of: changed bytes, cut ends, parts twice, parts away, and numbers and words that bite."""
    out = bytearray(data)
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, max(len(out) - 1, 0)))
        length = draw(st.integers(0, 40))
        match draw(st.integers(0, 4)):
            case 0:
                out[at : at + 1] = bytes([draw(st.integers(0, 255))])
            case 1:
                del out[at : at + length]
            case 2:
                out[at:at] = out[at : at + length]
            case 3:
                out[at : at + draw(st.integers(0, 8))] = draw(st.sampled_from(BITES))
            case _:
                del out[at:]
    return bytes(out)


BITES = [
    b"NaN",
    b"-Infinity",
    b"1e999",
    b"9" * 30,
    b"-1",
    b"null",
    b"[[[[",
    b"]]]",
    b"{}",
    b'"',
    b"\\",
    b"\xff\xfe",
    b"\x00" * 4,
    b"\xff" * 8,
    b"1e30",
    b"\\ud800",
    b"../../../etc/passwd",
    b"true",
    b"0",
    b"",
]


@st.composite
def damaged_files(draw: st.DrawFn) -> tuple[str, bytes]:
    kind = draw(st.sampled_from(sorted(FILES)))
    return kind, damaged(FILES[kind][0], draw)


@settings(max_examples=examples(100), derandomize=True, deadline=None)
@given(file=damaged_files())
def test_damaged_files_are_read_or_refused(folder: Path, file: tuple[str, bytes]) -> None:
    read_or_refuse(folder, *file)


@pytest.mark.slow
@settings(max_examples=20_000, derandomize=True, deadline=None)
@given(file=damaged_files())
def test_many_damaged_files_are_read_or_refused(folder: Path, file: tuple[str, bytes]) -> None:
    read_or_refuse(folder, *file)


PLACES = [
    "loads",
    "rigCreations",
    "creations",
    "metadata",
    "stateUpdates",
    "rigUpdates",
    "userTransforms",
    "lights",
    "deletions",
]
leaf = st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=4)
anything = st.recursive(leaf, lambda s: st.lists(s, max_size=3) | st.dictionaries(st.text(max_size=6), s, max_size=3))


@settings(max_examples=examples(100), derandomize=True, deadline=None)
@given(group=st.sampled_from(PLACES), value=anything, deep=st.booleans(), data=st.data())
def test_any_value_at_any_place_of_a_replay(
    folder: Path, group: str, value: Any, deep: bool, data: st.DataObject
) -> None:
    content = json.loads(text(replay()))
    place: Any = content["keyframes"][0]
    key: Any = group
    place.setdefault("deletions", [1])
    while deep and isinstance(place[key], (dict, list)) and place[key]:
        place = place[key]
        key = data.draw(st.sampled_from(sorted(place) if isinstance(place, dict) else list(range(len(place)))))
    place[key] = value
    read_or_refuse(folder, "gfx_replay", text(content))


@pytest.mark.parametrize("kind", sorted({*FILES} - {"bvh"}))  # a shorter number is a number
def test_cut_at_many_bytes(folder: Path, kind: str) -> None:
    data, name, reader = FILES[kind]
    path = folder / name
    for end in range(0, len(data), max(1, len(data) // 100)):
        path.write_bytes(data[:end])
        with pytest.raises(H3DataError):
            reader(path)


def test_a_replay_cut_at_every_byte(folder: Path) -> None:
    path = folder / "short.gfx_replay.json"
    update = {"instanceKey": 1, "state": {"absTransform": POSE}}
    data = text(
        {
            "keyframes": [
                {"creations": [{"instanceKey": 1, "creation": {"filepath": 'a"]}'}}]},
                {"stateUpdates": [update]},
            ]
        }
    )
    for end in range(len(data)):
        path.write_bytes(data[:end])
        with pytest.raises(FormatError):
            read_gfx_replay(path)


@pytest.mark.parametrize("kind", RECORDINGS)
def test_gzip_cut_at_every_byte(folder: Path, kind: str) -> None:
    data, name, reader = FILES[kind]
    path = folder / f"{name}.gz"
    packed = gzip.compress(data)
    for end in range(2, len(packed), max(1, len(packed) // 60)):
        path.write_bytes(packed[:end])
        with pytest.raises(FormatError):
            reader(path)


# --- hostility --------------------------------------------------------------------------------------------------------
class Evil:
    def __reduce__(self) -> Any:
        return exec, ("open('owned', 'w')",)


def bomb(head: bytes, mebibytes: int = 100) -> bytes:
    """Gzip data that unpack to ``head`` and so many MiB of spaces."""
    packer = zlib.compressobj(9, wbits=31)
    return (
        packer.compress(head) + b"".join(packer.compress(b" " * (1 << 20)) for _ in range(mebibytes)) + packer.flush()
    )


HOSTILE: dict[str, tuple[str, Callable[[], bytes], str]] = {
    "gzip bomb": ("x.gfx_replay.json.gz", lambda: bomb(b'{"keyframes":[{},'), "unpack to more than"),
    "gzip bomb of a log": ("x.json.gz", lambda: bomb(b'{"steps":['), "unpack to more than"),
    "deep brackets": (
        "x.gfx_replay.json",
        lambda: b'{"keyframes":[' + b"[" * 200_000 + b"]" * 200_000 + b"]}",
        "(?s)object.*H3-HABITAT-059",
    ),
    "deep objects": (
        "x.gfx_replay.json",
        lambda: b'{"keyframes":[' + b'{"a":' * 200_000 + b"0" + b"}" * 200_000 + b"]}",
        "(?s)deep.*H3-FORMAT-008",
    ),
    "deep lights": (
        "x.gfx_replay.json",
        lambda: b'{"keyframes":[{"lights":[' + b"[" * 9000 + b"]" * 9000 + b"]}]}",
        "(?s)deep|object.*H3-FORMAT-008",
    ),
    "a keyframe without end": (
        "x.gfx_replay.json",
        lambda: b'{"keyframes":[{"a":"' + b"x" * (KEYFRAME_BYTES + 2**21),
        "longer than 64 MiB",
    ),
    "pickle with code": ("x.pkl.gz", lambda: gzip.compress(pickle.dumps(Evil())), r"(?s)builtins\.exec.*H3-FORMAT-026"),
    "pickle with code among values": (
        "x.pkl.gz",
        lambda: gzip.compress(pickle.dumps({**log(), "dataset": Evil()})),
        r"(?s)builtins\.exec.*H3-FORMAT-026",
    ),
    "not UTF-8": (
        "x.gfx_replay.json",
        lambda: b'{"keyframes":[{"loads":[{"filepath":"\xe9"}]}]}',
        "(?s)UTF-8.*H3-FORMAT-008",
    ),
    "NaN": ("x.gfx_replay.json", lambda: text(replay()).replace(b"0.25", b"NaN", 1), "(?s)NaN under.*H3-FORMAT-012"),
    "infinity": (
        "x.gfx_replay.json",
        lambda: text(replay()).replace(b"-2]", b"-Infinity]", 1),
        "(?s)Infinity.*H3-FORMAT-012",
    ),
    "beyond all numbers": (
        "x.gfx_replay.json",
        lambda: text(replay()).replace(b"0.25", b"1e40", 1),
        "(?s)1000000000.*H3-HABITAT-059",
    ),
    "quaternion of nothing": (
        "x.gfx_replay.json",
        lambda: text(replay()).replace(b"[1,0,0,0]", b"[0,0,0,0]"),
        "H3-HABITAT-066",
    ),
    "many people": (
        "x.gfx_replay.json",
        lambda: text(
            {
                "keyframes": [
                    {
                        "creations": [
                            {"instanceKey": k, "creation": {"filepath": "humanoids/a.glb"}}
                            for k in range(MAX_AGENTS + 1)
                        ]
                    }
                ]
            }
        ),
        "(?s)More than 256.*H3-FORMAT-019",
    ),
    "many instances": (
        "x.gfx_replay.json",
        lambda: text(
            {"keyframes": [{"creations": [{"instanceKey": k, "creation": {"filepath": "a"}} for k in range(2001)]}]}
        ),
        "(?s)More than 2000 instances.*H3-FORMAT-019",
    ),
    "tracks that fill the memory": (
        "x.gfx_replay.json",
        lambda: (
            b'{"keyframes":['
            + b"{}," * 30_000
            + text({"creations": [{"instanceKey": k, "creation": {"filepath": "a"}} for k in range(900)]})
            + b"]}"
        ),
        "H3-FORMAT-018",
    ),
}
HEAVY = ("a keyframe without end", "gzip bomb", "gzip bomb of a log")
"""Cases that take more than a second."""


@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.slow) if c in HEAVY else c for c in HOSTILE])
def test_hostile_files_leave_nothing_behind(
    tmp_path: Path, case: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    name, content, reason = HOSTILE[case]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("h3data_habitat.gfx.fold.MAX_BODIES", 2000)
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / name
    path.write_bytes(content())
    read = read_gfx_replay if "gfx" in name else read_hitl_log
    with pytest.raises(FormatError, match=reason) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 1000
    assert main(["import", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--json"]) == 1
    row = json.loads(capsys.readouterr().out)["files"][0]
    assert row["status"] == "failed"
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == [
        path
    ]  # neither a recording nor a part of one, nor "owned"


def test_a_path_leads_nowhere_outside_the_assets(tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / "outside.glb").write_bytes(FILES["glb"][0])
    library = AssetLibrary([tmp_path / "assets"])
    for uri in (str(tmp_path / "outside.glb"), "../outside.glb", "a/../../outside.glb", "./../outside.glb"):
        assert library.mesh(AssetRef(name="a", uri=uri)) is None, uri
    content = json.loads(text(replay()))
    for k, item in enumerate(content["keyframes"][0]["creations"]):
        item["creation"]["filepath"] = ["../outside.glb", str(tmp_path / "outside.glb"), "/etc/passwd", "..\\x.glb"][k]
    path = tmp_path / "x.gfx_replay.json"
    path.write_bytes(text(content))
    assert len(Replay(read_gfx_replay(path), assets=library).missing) == 4


def test_ten_million_loads_are_read_without_holding_them(tmp_path: Path) -> None:
    """A path that is loaded again and again; here a hundred thousand times."""
    path = tmp_path / "x.gfx_replay.json"
    load = text({"loads": [{"filepath": "cubeSolid"}] * 100})
    created = text({"creations": [{"instanceKey": 0, "creation": {"filepath": "cubeSolid"}}]})
    path.write_bytes(b'{"keyframes":[' + b",".join([created, *[load] * 1000]) + b"]}")
    recording = read_gfx_replay(path)
    assert len(recording) == 1001
    assert len(recording.assets) == 1


def test_keys_that_are_used_over_and_over_are_told_apart_in_linear_time(tmp_path: Path) -> None:
    path = tmp_path / "x.gfx_replay.json"
    item = {"instanceKey": 1, "creation": {"filepath": "cubeSolid"}}
    path.write_bytes(text({"keyframes": [{"creations": [item] * 3_000}]}))
    recording = read_gfx_replay(path)
    assert len({body.name for body in recording.bodies}) == 3_000
    assert "2999 creations under a key that was still in use" in recording.episode.info["warnings"][0]


def test_an_npz_that_claims_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    data = FILES["npz"][0]
    at = data.index(b"(2, 3)")
    path = tmp_path / "x.npz"
    path.write_bytes(data[:at] + b"(9, 9)" + data[at + 6 :])
    with pytest.raises(FormatError):
        npz_arrays(path)
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000, 1000), }"
    npy = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", npy)
    with pytest.raises(FormatError, match=r"(?s)a\.npy.*H3-FORMAT-023"):
        npz_arrays(path)
