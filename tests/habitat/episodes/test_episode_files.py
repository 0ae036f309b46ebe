"""Episode datasets of habitat-lab: round trips, real files, hostile files; social-navigation episodes inside them."""

from __future__ import annotations

import contextlib
import gzip
import json
import pickle
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import FormatError, InputError
from h3data.formats import detect
from h3data.geometry import pose_from_matrix, pose_to_matrix
from h3data.recording.task_episodes.rearrange_episode import (
    ContentFile,
    EpisodeSet,
    Marker,
    RearrangeEpisode,
    RigidObject,
    goal_poses,
    instance_handles,
    object_poses,
)
from h3data_habitat.episodes.files import read_episodes, write_episodes

IDENTITY = np.eye(4).tolist()
HABITAT_KEYS = {
    "episode_id",
    "scene_id",
    "scene_dataset_config",
    "additional_obj_config_paths",
    "start_position",
    "start_rotation",
    "info",
    "ao_states",
    "rigid_objs",
    "targets",
    "markers",
    "target_receptacles",
    "goal_receptacles",
    "name_to_receptacle",
}
"""What habitat-lab's own class takes; any other key is a TypeError there."""


def episode(**changes: Any) -> dict[str, Any]:
    """A valid episode as JSON, with ``changes``."""
    return {
        "episode_id": "0",
        "scene_id": "scenes/a.scene_instance.json",
        "scene_dataset_config": "a.scene_dataset_config.json",
        "additional_obj_config_paths": ["objects/"],
        "start_position": [0, 0, 0],
        "start_rotation": [0, 0, 0, 1],
        "info": {"object_labels": {"cup_:0000": "any_targets|0"}},
        "ao_states": {"fridge_:0000": {"2": 1.5}},
        "rigid_objs": [["cup.object_config.json", IDENTITY]],
        "targets": {"cup_:0000": IDENTITY},
        "markers": [],
        "target_receptacles": [["shelf_:0000", None]],
        "goal_receptacles": [["fridge_:0000", 2]],
        "name_to_receptacle": {"cup_:0000": "shelf_:0000|top"},
    } | changes


def put(path: Path, *episodes: Any, **top: Any) -> Path:
    """A dataset file as Python would write it (NaN included)."""
    text = json.dumps({**top, "episodes": list(episodes)}).encode()
    path.write_bytes(gzip.compress(text) if path.name.endswith(".gz") else text)
    return path


def content(path: Path) -> Any:
    with gzip.open(path, "rt") as file:
        return json.load(file)


# --- real files ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("name", "count"), [("demo.json.gz", 2), ("hitl_teleop_episodes.json.gz", 2000)])
def test_real_files_come_back_as_they_were(real: Path, tmp_path: Path, name: str, count: int) -> None:
    episodes = read_episodes(real / "habitat-lab" / name, strict=True)
    assert len(episodes) == count
    write_episodes(episodes, tmp_path / name)
    assert content(tmp_path / name) == content(real / "habitat-lab" / name)
    assert detect(tmp_path / name).name == "rearrange_episodes"


def test_the_demo_says_what_the_file_says(real: Path) -> None:
    first = read_episodes(real / "habitat-lab" / "demo.json.gz").episodes[0]
    raw = content(real / "habitat-lab" / "demo.json.gz")["episodes"][0]
    handles = instance_handles(first)
    assert handles[:3] == ["024_bowl_:0000", "005_tomato_soup_can_:0000", "005_tomato_soup_can_:0001"]
    assert set(handles) <= set(raw["name_to_receptacle"])  # it names one more, which is not there
    assert set(first.object_labels) <= set(handles)
    poses = object_poses(first)
    assert next(iter(poses)) == "003_cracker_box_:0000"  # Habitat adds them by name
    np.testing.assert_allclose(poses["024_bowl_:0000"][:3], [-12.25237, 0.4951, 5.98036])
    for (_, rows), handle in zip(raw["rigid_objs"], handles, strict=True):
        np.testing.assert_allclose(pose_to_matrix(poses[handle]), rows, atol=2e-5)  # row-major, five decimals
    goals = goal_poses(first)
    assert list(goals) == list(raw["targets"])
    np.testing.assert_allclose(goals["024_bowl_:0000"][:3], [-4.15417, 0.26085, 5.59822])


def test_other_real_files_are_refused_by_their_name(real: Path) -> None:
    hitl = real / "habitat-lab" / "reference" / "hitl" / "session_2users"
    with pytest.raises(FormatError, match="H3-HABITAT-002"):
        read_episodes(hitl / "gen2" / "session.json.gz")
    with pytest.raises(FormatError, match="H3-HABITAT-002"):
        read_episodes(hitl / "gen1" / "session.gfx_replay.json.gz")
    with pytest.raises(FormatError, match="H3-FORMAT-026"):
        read_episodes(hitl / "gen1" / "session.0.pkl.gz")


# --- round trips --------------------------------------------------------------------------------------------------------
numbers = st.floats(-100, 100)
words = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=8)
names = st.sampled_from(["cup", "bowl", "a.b", "Becher ü", "x_:0000"])
json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | numbers | words,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)
unknown = st.dictionaries(words.map(lambda w: "new_" + w), json_values, max_size=2)


@st.composite
def matrices(draw: st.DrawFn) -> np.ndarray[Any, Any]:
    quat = np.array(draw(st.tuples(*[numbers] * 4)))
    length = float(np.linalg.norm(quat))
    quat = quat / length if length > 1e-3 else np.array([0.0, 0.0, 0.0, 1.0])
    return pose_to_matrix(np.concatenate([draw(st.tuples(*[numbers] * 3)), quat]))


@st.composite
def episodes_json(draw: st.DrawFn) -> dict[str, Any]:
    objects = [[draw(names) + ".object_config.json", draw(matrices()).tolist()] for _ in range(draw(st.integers(0, 4)))]
    labels = draw(st.dictionaries(words, words, max_size=2))
    marker = {
        "name": "m",
        "type": "articulated_object",
        "params": {"offset": [0.1, 0, 0], "link": "door", "object": "f"},
    }
    full = episode(
        episode_id=draw(st.integers(0, 99) | words),
        rigid_objs=objects,
        targets={draw(names) + "_:0000": draw(matrices()).tolist() for _ in range(draw(st.integers(0, 2)))},
        start_position=draw(st.lists(numbers, min_size=3, max_size=3)),
        markers=draw(
            st.sampled_from([[], [marker], [marker | {"more": 1, "params": marker["params"] | {"w": [2]}}], {}])
        ),
        info=draw(st.none() | unknown.map(lambda d: {"object_labels": labels, **d})),
        ao_states=draw(st.dictionaries(words, st.dictionaries(st.integers(0, 9).map(str), numbers, max_size=2))),
    )
    leave_out = draw(st.sets(st.sampled_from(sorted(HABITAT_KEYS - {"episode_id", "scene_id"})), max_size=3))
    return {k: v for k, v in full.items() if k not in leave_out} | draw(unknown)


@given(st.lists(episodes_json(), min_size=1, max_size=3), unknown)
def test_reading_and_writing_loses_nothing(tmp_path_factory: Any, some: list[Any], top: dict[str, Any]) -> None:
    folder = tmp_path_factory.mktemp("episodes")
    first = read_episodes(put(folder / "a.json", *some, **top))
    write_episodes(first, folder / "b.json.gz")
    assert content(folder / "b.json.gz") == {**top, "episodes": some}
    write_episodes(read_episodes(folder / "b.json.gz"), folder / "c.json.gz")
    assert (folder / "b.json.gz").read_bytes() == (folder / "c.json.gz").read_bytes()
    assert (folder / "b.json.gz").read_bytes()[4:8] == bytes(4)  # gzip's time stamp


@given(st.lists(names, max_size=12))
def test_handles_count_per_template_in_the_order_of_names(stems: list[str]) -> None:
    things = tuple(RigidObject(f"{stem}.object_config.json", np.eye(4)) for stem in stems)
    handles = instance_handles(RearrangeEpisode(episode_id="0", scene_id="s", rigid_objects=things))
    assert len(set(handles)) == len(stems)
    for k, stem in enumerate(stems):  # equal names keep their order, so the count is that of the earlier ones
        assert handles[k] == f"{stem}_:{stems[:k].count(stem):04d}"


def test_handles_of_one_template_in_two_folders_differ() -> None:
    things = tuple(
        RigidObject(name, np.eye(4)) for name in ("b/cup.object_config.json", "a/cup.object_config.json", "cup")
    )
    assert instance_handles(RearrangeEpisode(episode_id="0", scene_id="s", rigid_objects=things)) == [
        "cup_:0001",
        "cup_:0000",
        "cup_:0002",
    ]


@given(matrices(), matrices())
def test_poses_are_those_of_the_matrices(start: Any, goal: Any) -> None:
    made = RearrangeEpisode(
        episode_id="0", scene_id="s", rigid_objects=(RigidObject("cup", start),), targets={"cup_:0000": goal}
    )
    np.testing.assert_allclose(pose_to_matrix(object_poses(made)["cup_:0000"]), start, atol=1e-9)
    np.testing.assert_allclose(pose_to_matrix(goal_poses(made)["cup_:0000"]), goal, atol=1e-9)
    np.testing.assert_array_equal(made.rigid_objects[0].pose, pose_from_matrix(start))


def test_an_episode_of_ours_has_what_the_loader_of_habitat_wants(tmp_path: Path) -> None:
    made = RearrangeEpisode(
        episode_id="7",
        scene_id="s",
        rigid_objects=(RigidObject("cup.object_config.json", np.eye(4)),),
        markers=(Marker(name="m", kind="articulated_object", offset=(0, 0, 1), link="door", object="fridge_:0000"),),
    )
    write_episodes(EpisodeSet(episodes=(made,)), tmp_path / "ours.json.gz")
    [raw] = content(tmp_path / "ours.json.gz")["episodes"]
    assert set(raw) == HABITAT_KEYS
    assert raw["markers"][0]["params"] == {"offset": [0, 0, 1], "link": "door", "object": "fridge_:0000"}
    [back] = read_episodes(tmp_path / "ours.json.gz").episodes
    assert back.markers == made.markers
    assert back.absent == frozenset()


def test_pose_arrays_of_a_file_cannot_be_changed_by_accident(tmp_path: Path) -> None:
    [first] = read_episodes(put(tmp_path / "a.json", episode())).episodes
    with pytest.raises(ValueError, match="read-only"):
        first.rigid_objects[0].matrix[0, 3] = 1.0


def test_a_set_split_by_scene_is_followed_and_written_back(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    (old / "content").mkdir(parents=True)
    new.mkdir()
    put(old / "val.json.gz")
    navigation = {"episode_id": 0, "scene_id": "b.glb", "goals": [{"position": [1, 2, 3], "radius": None}]}
    put(old / "content" / "b.json.gz", navigation, navigation | {"episode_id": 1}, category_to_id={"chair": 0})
    put(old / "content" / "a.json.gz", navigation | {"scene_id": "a.glb", "start_rotation": [0, 1, 0, 0]})
    found = read_episodes(old / "val.json.gz")
    assert [e.scene_id for e in found.episodes] == ["a.glb", "b.glb", "b.glb"]
    assert [(part.name, part.episodes) for part in found.contents] == [("a", 1), ("b", 2)]
    assert found.episodes[0].rigid_objects == ()
    write_episodes(found, new / "val.json.gz")
    for name in ("val.json.gz", "content/a.json.gz", "content/b.json.gz"):
        assert content(new / name) == content(old / name)
    write_episodes(msgspec.structs.replace(found, contents=()), new / "one.json.gz")
    assert len(content(new / "one.json.gz")["episodes"]) == 3


# --- pickled datasets -----------------------------------------------------------------------------------------------------
def pickled(episodes: list[dict[str, Any]], dtype: str = "f8") -> dict[str, Any]:
    """The layout of spec/habitat.md 6.5, with arrays where habitat-lab puts them."""
    index: dict[str, int] = {}
    transforms: list[Any] = []

    def at(name: str) -> int:
        return index.setdefault(name, len(index))

    out = []
    for e in episodes:
        rigid = []
        for name, matrix in e["rigid_objs"]:
            rigid.append([at(name), len(transforms)])
            transforms.append(matrix)
        markers = [
            [
                at(m["name"]),
                at(m["type"]),
                np.array(m["params"]["offset"]),
                at(m["params"]["link"]),
                at(m["params"]["object"]),
            ]
            for m in e["markers"]
        ]
        out.append(
            e
            | {
                "rigid_objs": np.array(rigid),
                "targets": {handle: np.array(matrix) for handle, matrix in e["targets"].items()},
                "ao_states": {at(h): {int(k): np.float64(v) for k, v in s.items()} for h, s in e["ao_states"].items()},
                "name_to_receptacle": np.array([[at(a), at(b)] for a, b in e["name_to_receptacle"].items()]),
                "markers": markers,
            }
        )
    return {
        "all_transforms": np.array(transforms, dtype),
        "idx_to_name": {v: k for k, v in index.items()},
        "all_eps": out,
    }


MARKER = {"name": "m", "type": "t", "params": {"offset": [0.5, 0.0, 0.0], "link": "door", "object": "fridge_:0000"}}


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("dtype", ["f8", ">f8", "f4"])
def test_pickled_sets_say_the_same_as_json(tmp_path: Path, protocol: int, dtype: str) -> None:
    quarter = [[0, 0, 1, 0.5], [0, 1, 0, -2], [-1, 0, 0, 3], [0, 0, 0, 1]]
    some = [
        episode(markers=[MARKER], rigid_objs=[["cup.object_config.json", quarter]], instruction="bring it"),
        episode(rigid_objs=[], targets={}, name_to_receptacle={}),
    ]
    file = tmp_path / "val.pickle"
    file.write_bytes(pickle.dumps(pickled(some, dtype), protocol=protocol))
    write_episodes(read_episodes(file, strict=True), tmp_path / "val.json.gz")
    assert content(tmp_path / "val.json.gz") == {"episodes": some}


def test_real_episodes_survive_pickling(real: Path, tmp_path: Path) -> None:
    demo = content(real / "habitat-lab" / "demo.json.gz")["episodes"]
    (tmp_path / "demo.pickle").write_bytes(pickle.dumps(pickled(demo)))
    write_episodes(read_episodes(tmp_path / "demo.pickle"), tmp_path / "demo.json.gz")
    assert content(tmp_path / "demo.json.gz")["episodes"] == demo


class Evil:
    """Pickles as a call of what must never be called."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


def test_forbidden_pickles_run_nothing(tmp_path: Path) -> None:
    import os

    trap = tmp_path / "trap"
    file = tmp_path / "evil.pickle"
    for evil in (
        Evil(os.mkdir, str(trap)),
        Evil(exec, f"open({str(trap)!r}, 'w')"),
        Evil(np.save, str(trap), np.ones(2)),
    ):
        for body in (evil, pickled([episode()]) | {"all_eps": [episode(info={"x": evil})]}):
            file.write_bytes(pickle.dumps(body))
            with pytest.raises(FormatError, match=r"(?s)asks for.*only NumPy arrays.*H3-FORMAT-026"):
                read_episodes(file)
    assert not list(tmp_path.glob("trap*"))


def _laughs(depth: int) -> list[Any]:
    laughs: list[Any] = ["ha"]
    for _ in range(depth):
        laughs = [laughs, laughs]
    return laughs


def _loop() -> list[Any]:
    loop: list[Any] = []
    loop.append(loop)
    return loop


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"all_transforms": np.array([[1, 2]])}, "H3-HABITAT-028"),
        ({"all_transforms": np.full((1, 4, 4), np.nan)}, r"(?s)all_transforms\[0\].*H3-HABITAT-029"),
        ({"all_transforms": np.zeros((0, 4, 4))}, r"(?s)all_eps\[0\].*there is no transform 0.*H3-HABITAT-031"),
        ({"all_transforms": np.array([object()])}, r"(?s)only NumPy arrays are admitted.*H3-FORMAT-026"),
        ({"all_transforms": np.array(["text", None])}, r"(?s)object \[2\].*H3-HABITAT-028"),
        ({"all_transforms": np.array(["text"])}, r"(?s)arrays of 'U4' are not admitted.*H3-FORMAT-026"),
        ({"all_transforms": 3}, "H3-HABITAT-028"),
        ({"idx_to_name": {}}, r"(?s)all_eps\[0\].*0.*idx_to_name.*H3-HABITAT-030"),
        ({"idx_to_name": [1]}, "H3-HABITAT-026"),
        ({"all_eps": {}}, "H3-HABITAT-027"),
        ({"all_eps": [episode(rigid_objs=np.array([[0, -1]]))]}, r"(?s)there is no transform -1.*H3-HABITAT-031"),
        ({"all_eps": [episode(rigid_objs=np.array([[0.5, 0]]))]}, r"(?s)0\.5.*idx_to_name.*H3-HABITAT-030"),
        (pickled([episode(info={"x": np.array([np.inf])})]), r"(?s)all_eps\[0\].*NaN or infinity.*H3-HABITAT-031"),
        ({"all_eps": [episode(info={"x": 1j})]}, r"(?s)builtins\.complex.*H3-FORMAT-026"),
        ({"all_eps": [episode(info={"x": b"bytes"})]}, r"(?s)a bytes.*not a plain value.*H3-FORMAT-026"),
        ({"all_eps": [episode(info={"x": _laughs(60)})]}, "(?s)unfolds to far more.*H3-FORMAT-026"),
        ({"all_eps": [episode(info={"x": _loop()})]}, "(?s)unfolds to far more.*H3-FORMAT-026"),
    ],
)
def test_broken_pickles_say_where(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    file = tmp_path / "bad.pickle"
    file.write_bytes(pickle.dumps(pickled([episode()]) | change))
    with pytest.raises(FormatError, match=words) as fault:
        read_episodes(file)
    assert str(file) in str(fault.value)


def test_every_cut_and_many_flips_of_a_pickle_are_format_errors(tmp_path: Path) -> None:
    data = pickle.dumps(pickled([episode()]))
    file = tmp_path / "cut.pickle"
    rng = np.random.default_rng(0)
    for size in range(3, len(data), 7):
        file.write_bytes(data[:size])
        with pytest.raises(FormatError):
            read_episodes(file)
    for _ in range(400):
        broken = bytearray(data)
        broken[rng.integers(2, len(data))] = rng.integers(256)
        file.write_bytes(broken)
        with contextlib.suppress(FormatError):
            read_episodes(file)


# --- hostile files --------------------------------------------------------------------------------------------------------
def test_files_of_other_kinds_are_named(tmp_path: Path) -> None:
    file = tmp_path / "x.json.gz"
    cases = {
        b"": "H3-FORMAT-010",
        b"not gzip": "H3-FORMAT-008",
        b"[1, 2]": r"(?s)a list.*H3-HABITAT-005",
        b"null": r"(?s)null.*H3-HABITAT-005",
        b'{"stage_instance": {}}': r"(?s)a scene instance.*H3-HABITAT-002",
        b'{"stages": {}, "objects": {}}': r"(?s)a scene.*configuration.*H3-HABITAT-002",
        b'{"keyframes": []}': r"(?s)a gfx-replay recording.*H3-HABITAT-002",
        b'{"hello": 1}': r"(?s)JSON of.*unknown kind.*hello\).*H3-HABITAT-002",
        b'{"episodes": {"0": 1}}': r"(?s)an object.*H3-HABITAT-004",
        b'{"episodes": [{"episode_id": "0", "scene': "H3-FORMAT-009",
        b'{"episodes": []} x': "H3-FORMAT-008",
        b"\xff\xfe{}": "H3-FORMAT-008",
        b"glTF\x02": r"(?s)a glTF model \(\.glb\).*H3-FORMAT-011",
        gzip.compress(b'{"episodes": []}' * 50)[:-9]: "H3-FORMAT-017",
        b"\x1f\x8b" + b"\0" * 30: "H3-FORMAT-017",
    }
    for data, words in cases.items():
        file.write_bytes(data)
        with pytest.raises(FormatError, match=words) as fault:
            read_episodes(file)
        assert str(file) in str(fault.value)
    with pytest.raises(InputError, match="H3-FORMAT-013"):
        read_episodes(tmp_path / "none.json.gz")
    with pytest.raises(InputError, match="H3-FORMAT-014"):
        read_episodes(tmp_path)


BAD_ROW = [[1, 0, 0, 0], [0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"rigid_objs": [["cup", BAD_ROW]]},
            r"(?s)episodes\[1\]\.rigid_objs\[0\]\[1\]\[1\]: Expected array of length 4.*H3-HABITAT-023",
        ),
        (
            {"rigid_objs": [["cup", IDENTITY[:3]]]},
            r"(?s)episodes\[1\]\.rigid_objs\[0\]\[1\]: Expected array of length 4.*H3-HABITAT-023",
        ),
        (
            {"rigid_objs": [["cup", 17]]},
            r"(?s)episodes\[1\]\.rigid_objs\[0\]\[1\].*separate file of transformations.*H3-HABITAT-023",
        ),
        (
            {"rigid_objs": [[3, IDENTITY]]},
            r"(?s)episodes\[1\]\.rigid_objs\[0\]\[0\]: Expected str, got int.*H3-HABITAT-023",
        ),
        ({"rigid_objs": None}, r"(?s)episodes\[1\]\.rigid_objs: Expected array, got null.*H3-HABITAT-023"),
        (
            {"targets": {"cup_:0000": [["1"] * 4] * 4}},
            r"(?s)episodes\[1\]\.targets\['cup_:0000'\]\[0\]\[0\]: Expected float, got str.*H3-HABITAT-023",
        ),
        ({"scene_id": 3}, r"(?s)episodes\[1\]\.scene_id: Expected str, got int.*H3-HABITAT-023"),
        ({"start_position": [0, 0]}, r"(?s)episodes\[1\]\.start_position: Expected array of length 3.*H3-HABITAT-023"),
        (
            {"start_rotation": [0, 0, 0, True]},
            r"(?s)episodes\[1\]\.start_rotation\[3\]: Expected float, got bool.*H3-HABITAT-023",
        ),
        (
            {"ao_states": {"f": {"door": 1}}},
            r"(?s)episodes\[1\]\.ao_states\['f'\]: Expected int, got str.*H3-HABITAT-023",
        ),
        ({"markers": [{"name": "m", "type": "t"}]}, r"(?s)episodes\[1\]\.markers\[0\]\.params.*H3-HABITAT-016"),
        ({"markers": [MARKER | {"name": 3}]}, r"(?s)episodes\[1\]\.markers\[0\]\.name: Expected str.*H3-HABITAT-020"),
        (
            {"info": {"object_labels": ["a"]}},
            r"(?s)episodes\[1\]\.info\.object_labels: Expected an object of names.*H3-HABITAT-015",
        ),
        (
            {"info": {"object_labels": {"a": 3}}},
            r"(?s)episodes\[1\]\.info\.object_labels: Expected an object of names.*H3-HABITAT-015",
        ),
        (
            {"name_to_receptacle": [["a", "b"]]},
            r"(?s)episodes\[1\]\.name_to_receptacle: Expected object, got array.*H3-HABITAT-023",
        ),
        (
            {"rigid_objs": [["cup", [[float("nan")] * 4] * 4]]},
            r"(?s)episodes\[1\]\.rigid_objs\[0\]\[1\]\[0\]\[0\].*nan.*H3-HABITAT-010",
        ),
        ({"info": {"reward": float("-inf")}}, r"(?s)episodes\[1\]\.info\.reward.*-inf.*H3-HABITAT-010"),
        ({"start_position": [0, 10**400, 0]}, r"(?s)episodes\[1\]\.start_position.*H3-HABITAT-023"),
    ],
)
def test_wrong_values_are_named_by_episode_and_key(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    file = put(tmp_path / "bad.json.gz", episode(), episode(**change))
    with pytest.raises(FormatError, match=words) as fault:
        read_episodes(file)
    assert str(file) in str(fault.value)


def test_episodes_without_a_name_or_no_objects(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"(?s)episodes\[0\].*episode_id and scene_id.*H3-HABITAT-013"):
        read_episodes(put(tmp_path / "a.json", {}))
    with pytest.raises(FormatError, match=r"(?s)episodes\[1\]: Expected object, got int.*H3-HABITAT-019"):
        read_episodes(put(tmp_path / "a.json", episode(), 3))


SCALED = [[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1]]
MIRRORED = [[-1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1]]
TRANSPOSED = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [3.0, 4.0, 5.0, 1]]
HUGE = [[1e300] * 4] * 4


@pytest.mark.parametrize("matrix", [SCALED, MIRRORED, TRANSPOSED, HUGE, [[0] * 4] * 4])
def test_matrices_that_are_not_rigid_are_kept_but_give_no_pose(tmp_path: Path, matrix: Any) -> None:
    some = [episode(), episode(targets={"cup_:0000": matrix}), episode(rigid_objs=[["cup", matrix]], targets={})]
    file = put(tmp_path / "odd.json.gz", *some)
    found = read_episodes(file)
    assert found.warnings == (
        "a matrix is not a rotation and a translation: 2 times, first at episodes[1].targets['cup_:0000'] in odd.json.gz",
    )
    with pytest.raises(InputError, match=r"(?s)goal.*cup_:0000.*H3-HABITAT-038"):
        goal_poses(found.episodes[1])
    with pytest.raises(InputError, match="H3-HABITAT-038"):
        object_poses(found.episodes[2])
    assert len(object_poses(found.episodes[1])) == 1
    write_episodes(found, tmp_path / "again.json.gz")
    assert content(tmp_path / "again.json.gz")["episodes"] == some
    with pytest.raises(
        FormatError, match=r"(?s)episodes\[1\]\.targets\['cup_:0000'\]: a matrix is not.*H3-HABITAT-018"
    ):
        read_episodes(file, strict=True)


def test_rounded_matrices_are_rigid(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(200, 4))
    poses = np.concatenate([rng.normal(size=(200, 3)), quats / np.linalg.norm(quats, axis=1, keepdims=True)], axis=1)
    rounded = np.round(pose_to_matrix(poses), 3).tolist()  # coarser than any real file
    file = put(tmp_path / "a.json", episode(rigid_objs=[["cup", m] for m in rounded]))
    assert len(read_episodes(file).warnings) == 1
    file = put(
        tmp_path / "a.json", episode(rigid_objs=[["cup", np.round(m, 4).tolist()] for m in pose_to_matrix(poses)])
    )
    assert not read_episodes(file, strict=True).warnings


def test_odd_starts_and_targets_are_warnings(tmp_path: Path) -> None:
    file = put(tmp_path / "a.json", episode(start_rotation=[0, 0, 0, 0]), episode(targets={"mug_:0000": IDENTITY}))
    assert [w.split(":")[0] for w in read_episodes(file).warnings] == [
        "start_rotation is not a unit quaternion",
        "a target is no object of the episode",
    ]
    for index, words in (
        (0, r"(?s)unit quaternion.*H3-HABITAT-018"),
        (1, r"(?s)targets\['mug_:0000'\]: a target is no object.*H3-HABITAT-018"),
    ):
        one = put(tmp_path / "b.json", content_of(file)["episodes"][index])
        with pytest.raises(FormatError, match=words):
            read_episodes(one, strict=True)


def content_of(path: Path) -> Any:
    return json.loads(path.read_text())


def test_a_handle_twice_is_refused(tmp_path: Path) -> None:
    text = json.dumps({"episodes": [episode()]})
    one = f'"cup_:0000": {json.dumps(IDENTITY)}'
    (tmp_path / "a.json").write_text(text.replace(one, f"{one}, {one}"))
    with pytest.raises(FormatError, match=r"(?s)episodes\[0\]\.targets.*'cup_:0000'.*H3-HABITAT-014"):
        read_episodes(tmp_path / "a.json")
    odd = put(tmp_path / "b.json", episode(rigid_objs=[["c[u]p[", IDENTITY]], targets={"c[u]p[_:0000": IDENTITY}))
    assert len(read_episodes(odd, strict=True)) == 1


@pytest.mark.parametrize(
    "frame",
    [
        "%s",
        *(
            pytest.param(frame, marks=pytest.mark.slow)
            for frame in (
                '{"episodes": %s}',
                '{"episodes": [{"episode_id": "0", "scene_id": "s", "x": %s}]}',
                '{"x": %s, "episodes": []}',
            )
        ),
    ],
)
def test_a_million_brackets(tmp_path: Path, frame: str) -> None:
    file = tmp_path / "deep.json"
    for deep in ("[" * 10**6 + "]" * 10**6, "[" * 10**6, '{"a":' * 10**6 + "1" + "}" * 10**6):
        file.write_text(frame.replace("%s", deep))
        with pytest.raises(FormatError):
            read_episodes(file)
    body = b"\x80\x02" + pickle.EMPTY_LIST * 10**6 + pickle.APPEND * (10**6 - 1) + pickle.STOP
    file.write_bytes(body)
    with pytest.raises(FormatError):
        read_episodes(file)


@pytest.mark.parametrize(
    "pattern",
    [
        "{data_path}/../{scene}.json.gz",
        "/etc/{scene}",
        "{data_path}//etc/{scene}.x",
        3,
        "{data_path}/content",
        "{data_path}/{scene}/x.json",
    ],
)
def test_content_must_stay_in_its_folder(tmp_path: Path, pattern: Any) -> None:
    with pytest.raises(FormatError, match=r"(?s)content_scenes_path.*H3-HABITAT-00(6|7)"):
        read_episodes(put(tmp_path / "val.json.gz", content_scenes_path=pattern))


def test_a_content_file_cannot_be_written_elsewhere(tmp_path: Path) -> None:
    one = RearrangeEpisode(episode_id="0", scene_id="s")
    wrong = EpisodeSet(episodes=(one,), contents=(ContentFile(name="../../x", episodes=1),))
    with pytest.raises(InputError, match="H3-HABITAT-011"):
        write_episodes(wrong, tmp_path / "val.json.gz")
    with pytest.raises(InputError, match=r"(?s)2.*1.*H3-HABITAT-009"):
        write_episodes(
            msgspec.structs.replace(wrong, contents=(ContentFile(name="x", episodes=2),)), tmp_path / "v.json"
        )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rigid_objects": (RigidObject("cup", np.full((4, 4), np.nan)),)}, r"(?s)episodes\[1\].*H3-HABITAT-021"),
        ({"targets": {"cup": np.eye(3)}}, r"(?s)episodes\[1\].*\[4, 4\].*H3-HABITAT-021"),
        ({"start_position": (float("inf"), 0.0, 0.0)}, r"(?s)episodes\[1\] cannot be written.*H3-HABITAT-022"),
        ({"info": {"x": {"y": float("nan")}}}, r"(?s)episodes\[1\] cannot be written.*H3-HABITAT-022"),
        ({"info": {"x": object()}}, r"(?s)episodes\[1\] cannot be written.*H3-HABITAT-022"),
        ({"extra": {"targets": {}}}, r"(?s)episodes\[1\].*\['targets'\].*H3-HABITAT-017"),
    ],
)
def test_what_cannot_be_written_leaves_no_file(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    good = RearrangeEpisode(episode_id="0", scene_id="s")
    bad = msgspec.structs.replace(good, **changes)
    (tmp_path / "out.json.gz").write_bytes(b"old")
    with pytest.raises(InputError, match=words):
        write_episodes(EpisodeSet(episodes=(good, bad)), tmp_path / "out.json.gz")
    assert [(f.name, f.read_bytes()) for f in tmp_path.iterdir()] == [("out.json.gz", b"old")]
    with pytest.raises(InputError, match="H3-HABITAT-008"):
        write_episodes(EpisodeSet(episodes=(good,)), tmp_path / "out.pickle")
