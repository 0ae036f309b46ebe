"""PARTNR's episode files: a made-up file in PARTNR's form, of an exported home, is read, counted, played and measured."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.errors import H3DataError
from h3data.geometry import pose_to_matrix
from h3data.scene import FreeSpace
from h3data_habitat.episodes.files import read_episodes
from h3data_habitat.exporters.scenes import export_habitat
from h3data_language.episode import evaluate_errands
from h3data_language.evaluation.layout import Layout, owner_of
from h3data_language.evaluation.profile import verdict_of
from h3data_language.task import Language
from h3data_pipelines.cli import main
from sim_kinematic.tasks.codec import EpisodePlace
from sim_kinematic.tasks.resume import verify

HOME = "small2-open:0"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as PARTNR's users have it: ``data/`` with scenes in which furniture opens."""
    folder = tmp_path_factory.mktemp("partnr")
    export_habitat(h3data.load_scene(HOME), folder / "data" / "home")
    return folder


class Maker:
    """Makes episodes of the exported home."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.scene_id = next(root.glob("data/home/scenes/*.json")).relative_to(root).as_posix()
        scene = h3data.load_scene(str(root / self.scene_id))
        self.layout = Layout.of_scene(scene, [])
        self.receptacles = {
            owner_of(scene, i.name): f"{owner_of(scene, i.name)}|{r.name}" for i, r in scene.receptacles()
        }
        templates = [i.name.partition("_:")[0] for i in scene.instances if i.motion == "kinematic"]
        self.mug, self.cup = (next(t for t in templates if t.startswith(kind)) for kind in ("mug", "teacup"))
        self.objects = [f"{name}_:0000" for name in (self.mug, self.cup)]

    def furniture(self, kind: str, *, inside: bool = False) -> str:
        """Handle of a piece of furniture of a kind, with an inside or an open surface."""
        return next(
            n
            for n, f in self.layout.furniture.items()
            if n.startswith(kind) and any(s.inside == inside for s in f.surfaces)
        )

    def episode(self, propositions: list[Any], **more: Any) -> dict[str, Any]:
        """An episode in PARTNR's form, in which a mug and a cup stand at the ends of the TV stand."""
        on = self.furniture("tv_stand")
        surfaces = [[s for s in self.layout.furniture[on].surfaces if not s.inside][k] for k in (0, -1)]
        poses = [np.array([s.center[0], s.center[1] + 0.05, s.center[2], 0, 0, 0, 1.0]) for s in surfaces]
        config = next(self.root.glob("data/home/*.scene_dataset_config.json")).relative_to(self.root)
        return {
            "episode_id": "334",
            "scene_id": self.scene_id,
            "scene_dataset_config": config.as_posix(),
            "additional_obj_config_paths": [],
            "start_position": [0, 0, 0],
            "start_rotation": [0, 0, 0, 1],
            "info": {"object_labels": {}, "initial_state": []},
            "ao_states": {},
            "rigid_objs": [
                [f"{n}.object_config.json", pose_to_matrix(p).tolist()]
                for n, p in zip((self.mug, self.cup), poses, strict=True)
            ],
            "targets": {},
            "markers": [],
            "target_receptacles": [],
            "goal_receptacles": [],
            "name_to_receptacle": dict.fromkeys(self.objects, self.receptacles[on]),
            "instruction": "Wash the mug and put it on the bed, then put the cup next to it.",
            "evaluation_propositions": propositions,
            "evaluation_proposition_dependencies": [],
            "evaluation_constraints": [],
            "object_states": {"is_clean": {self.objects[0]: False}},
            **more,
        }


@pytest.fixture(scope="module")
def maker(root: Path) -> Maker:
    return Maker(root)


def asks(name: str, things: list[str], places: list[str] | None = None, number: int = 1, **more: Any) -> dict[str, Any]:
    second = {"is_in_room": "room_ids"}.get(name, "receptacle_handles")
    args = {"object_handles": things, "number": number, **({second: places} if places else {}), **more}
    return {"function_name": name, "args": args}


def next_to(a: str, b: str) -> dict[str, Any]:
    return {"function_name": "is_next_to", "args": {"entity_handles_a": [a], "entity_handles_b": [b], "number": 1}}


def order(count: int, *edges: tuple[int, int]) -> dict[str, Any]:
    return {"type": "TemporalConstraint", "args": {"dag_edges": [list(e) for e in edges], "n_propositions": count}}


def terminal(*indices: int) -> dict[str, Any]:
    return {"type": "TerminalSatisfactionConstraint", "args": {"proposition_indices": list(indices)}}


def written(path: Path, episodes: list[dict[str, Any]]) -> Path:
    path.write_bytes(gzip.compress(json.dumps({"config": None, "episodes": episodes}).encode()))
    return path


def run(capsys: pytest.CaptureFixture[str], *words: object, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, words), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def whole(maker: Maker) -> list[dict[str, Any]]:
    """Episodes of all that can be played."""
    mug, cup = maker.objects
    table, bed, counter = (
        maker.furniture("dining_table"),
        maker.furniture("bed"),
        maker.furniture("kitchen_counter", inside=True),
    )
    return [
        maker.episode(
            [
                asks("is_clean", [mug]),
                asks("is_on_top", [mug], [bed]),
                next_to(cup, mug),
                asks("is_on_top", [cup], [bed]),
            ],
            evaluation_constraints=[order(4, (0, 1), (1, 2), (1, 3)), terminal(1, 2, 3)],
        ),
        maker.episode(
            [
                asks("is_on_top", [mug], [bed]),
                asks("is_inside", [mug], [counter]),
                asks("is_in_room", [cup], ["kitchen"]),
            ],
            evaluation_proposition_dependencies=[
                {
                    "proposition_indices": [1],
                    "depends_on": [0],
                    "relation_type": "after_satisfied",
                    "dependency_mode": "any",
                }
            ],
            evaluation_constraints=[terminal(1, 2)],
        ),
        maker.episode(
            [asks("is_on_top", [mug, cup], [table, bed], 2, is_same_receptacle=True), asks("is_filled", [mug, cup])],
            evaluation_constraints=[terminal(0, 1)],
        ),
        maker.episode(
            [asks("is_on_top", [mug], [table, bed]), asks("is_on_top", [cup], [table, bed])],
            evaluation_constraints=[
                {
                    "type": "DifferentArgConstraint",
                    "args": {
                        "proposition_indices": [0, 1],
                        "arg_names": ["receptacle_handles"] * 2,
                        "n_propositions": 2,
                    },
                }
            ],
        ),
        maker.episode([asks("is_on_floor", [mug]), asks("is_in_room", [mug], ["kitchen"]), next_to(cup, mug)]),
    ]


@pytest.mark.slow  # quick: those below, which do not play it
def test_orders_states_rooms_and_neighbors_are_played_by_the_expert(
    maker: Maker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(tmp_path / "val.json.gz", whole(maker))
    result = run(capsys, "generate", "language", "--episodes-file", file, "--assets", maker.root, "-o", tmp_path / "ds")
    assert (result["episodes"], result["failed"], result["left_out"]) == (5, [], [])
    for recording in h3data.open(tmp_path / "ds"):
        verdict = verdict_of(recording)
        assert verdict.percent_complete == 1, verdict.explanation
        assert recording.episode.info["instruction"].startswith("Wash the mug")
    assert verify(h3data.open(tmp_path / "ds").recording(1)).equal


@pytest.mark.slow
def test_things_on_the_floor_get_places_there(maker: Maker, place: Any) -> None:
    mug, cup = maker.objects
    table = maker.furniture("dining_table")
    low, there = asks("is_on_floor", [mug]), asks("is_in_room", [mug], ["kitchen"])
    for asked, floor in (
        ([low], [True, False]),
        ([low, there, next_to(cup, mug)], [True, True]),
        ([there, asks("is_on_floor", [cup]), asks("is_in_room", [cup], ["bathroom"])], [False, True]),
    ):
        episode = place(maker.episode(asked))
        assert evaluate_errands(episode.targets, episode.extra).percent_complete == 1
        assert [bool(t.goal[1] < 0.2) for t in episode.targets] == floor
        assert [t.destination == "" for t in episode.targets] == [True, True] if len(asked) < 2 else floor
    with pytest.raises(H3DataError) as fault:
        place(maker.episode([low, asks("is_on_top", [mug], [table])]))
    assert fault.value.code == "H3-LANGUAGE-029"


def entry_of(maker: Maker, entry: dict[str, Any]) -> Any:
    """An episode as a file has it."""
    return read_episodes(written(maker.root / "one.json.gz", [entry])).episodes[0]


def refused(maker: Maker, entry: dict[str, Any]) -> str:
    """The code with which an episode is refused, whatever its scene."""
    stored = entry_of(maker, entry)
    with pytest.raises(H3DataError) as fault:
        Language().codec.read(stored, seed=0)
    assert "\n" not in str(fault.value)
    return fault.value.code


def test_what_cannot_be_played_anywhere_is_refused_in_one_sentence(maker: Maker) -> None:
    mug = maker.objects[0]
    table = maker.furniture("dining_table")
    on = asks("is_on_top", [mug], [table])
    circle = order(2, (0, 1), (1, 0))
    for code, entry in (
        ("H3-LANGUAGE-006", maker.episode([asks("is_on_top", [mug], [table], 2)])),
        ("H3-LANGUAGE-007", maker.episode([asks("is_tasty", [mug])])),
        ("H3-LANGUAGE-009", maker.episode([on, on], evaluation_constraints=[circle])),
        ("H3-LANGUAGE-032", maker.episode([on], object_states={"is_clean": 3})),
        ("H3-LANGUAGE-022", maker.episode([])),
        ("H3-LANGUAGE-034", maker.episode([on], instruction="a" * 1_000_000)),
        ("H3-LANGUAGE-024", maker.episode([asks("is_powered_on", [table])])),
    ):
        assert refused(maker, entry) == code, entry["evaluation_propositions"]


@pytest.mark.slow
def test_what_cannot_be_played_in_its_home_is_refused_in_one_sentence(maker: Maker, place: Any) -> None:
    mug = maker.objects[0]
    table, bed = maker.furniture("dining_table"), maker.furniture("bed")
    on = asks("is_on_top", [mug], [table])
    before = {"proposition_indices": [0], "depends_on": [1], "relation_type": "before_satisfied"}
    moved_away = {
        "evaluation_proposition_dependencies": [
            {"proposition_indices": [1], "depends_on": [0], "relation_type": "after_satisfied"}
        ],
        "evaluation_constraints": [terminal(0, 1)],
    }
    both = [{**before, "relation_type": "after_satisfied"}, before]
    for code, entry in (
        ("H3-LANGUAGE-004", maker.episode([asks("is_on_top", [mug], ["moon_:0000"])])),
        ("H3-LANGUAGE-004", maker.episode([asks("is_clean", [mug]), asks("is_in_room", ["spoon_:0000"], ["kitchen"])])),
        ("H3-LANGUAGE-025", maker.episode([on, on], evaluation_proposition_dependencies=both)),
        ("H3-LANGUAGE-026", maker.episode([asks("is_inside", [mug], [bed])])),
        ("H3-LANGUAGE-027", maker.episode([asks("is_clean", [mug]), asks("is_filled", [mug])])),
        ("H3-LANGUAGE-029", maker.episode([on, asks("is_on_top", [mug], [bed])])),
        ("H3-LANGUAGE-031", maker.episode([on, asks("is_on_top", [mug], [bed])], **moved_away)),
    ):
        with pytest.raises(H3DataError) as fault:
            place(entry)
        assert fault.value.code == code, entry
        assert "\n" not in str(fault.value)


@pytest.fixture(scope="module")
def place(root: Path, maker: Maker) -> Any:
    """Makes the episode of an entry in its scene."""
    scene = h3data.load_scene(str(root / maker.scene_id))
    task = Language()
    free = FreeSpace.from_scene(scene, radius_m=task.Spec().agent_radius_m, height_m=task.Spec().agent_height_m)

    def placed(entry: dict[str, Any]) -> Any:
        stored = task.codec.read(entry_of(maker, entry), seed=3)
        assert stored is not None
        return task.codec.episode(stored, EpisodePlace(scene=scene, free=free, spec=task.codec.rules(stored)))

    return placed


def test_things_get_places_by_which_all_propositions_become_true(maker: Maker, place: Any) -> None:
    kinds = [place(entry).extra["kind"] for entry in whole(maker)]
    assert kinds == ["heterogeneous", "free", "heterogeneous", "free", "spatial"]
    episode = place(whole(maker)[0])
    assert episode.spec.max_steps == 20_000
    assert evaluate_errands(episode.targets, episode.extra).percent_complete == 1
    assert [e["after"] for e in episode.extra["errands"]] == [(2,), (0,), ()]
    same = place(whole(maker)[2])
    assert len({t.destination for t in same.targets}) == 1
    apart = place(whole(maker)[3])
    assert len({t.destination.partition("|")[0] for t in apart.targets}) == 2


def test_info_counts_what_no_task_plays(maker: Maker, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = maker.episode([asks("is_powered_on", [maker.furniture("dining_table")])])
    shown = run(capsys, "info", written(tmp_path / "val.json.gz", [*whole(maker), table, table]))["found"][0]
    assert shown["tasks"] == {"collaboration (PARTNR)": 7}
    assert list(shown["unplayable"].values()) == [2]


# --- sessions of PARTNR's tool ----------------------------------------------------------------------------------------
def session_of(maker: Maker, **episode: Any) -> dict[str, Any]:
    """A session in which a user takes the mug to the bed and washes it, while nobody moves the cup."""
    mug, cup = maker.objects
    surface = next(s for s in maker.layout.furniture[maker.furniture("bed")].surfaces if not s.inside)
    frames = []
    for k in range(6):
        held, done = 1 <= k < 4, k >= 4
        at = [surface.center[0], surface.center[1] + 0.05, surface.center[2]] if done else [3.0, 1.2, 3.0]
        events = [{"type": "place", "obj_handle": mug}] if k == 4 else []
        if k == 5:
            events = [{"type": "state_change", "obj_handle": mug, "new_value": True, "state_name": "is_clean"}]
        things = [(mug, 5, at, k == 5), (cup, 6, [1.0, 0.5, 1.0], False)]
        frames.append(
            {
                "t": 0.1 * k,
                "users": [{"events": events, "held_object": 5 if held else None}],
                "object_states": [
                    {
                        "position": place,
                        "rotation": [0, 0, 0, 1],
                        "object_handle": name,
                        "object_id": number,
                        "states": {"is_clean": clean},
                    }
                    for name, number, place, clean in things
                ],
                "agent_states": [
                    {"position": [2, 0.92, 0.04 * k], "rotation": [-0.5, -0.5, 0.5, 0.5], "grasp_mgr_snap_idx": None}
                ],
            }
        )
    told = {"episode_id": "334", "scene_id": maker.scene_id, "user_index_to_agent_index_map": {"0": 0}, **episode}
    return {"session": {}, "users": [], "frames": frames, "episode": told}


def test_sessions_are_evaluated_with_the_propositions_of_their_episodes(
    maker: Maker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mug, bed = maker.objects[0], maker.furniture("bed")
    asked = maker.episode(
        [asks("is_on_top", [mug], [bed]), asks("is_clean", [mug])],
        evaluation_constraints=[order(2, (0, 1)), terminal(0, 1)],
    )
    file = written(
        tmp_path / "val.json.gz",
        [asked, {**asked, "episode_id": "335", "evaluation_propositions": [asks("is_clean", ["?"])] * 2}],
    )
    for name, number in (("0", "334"), ("1", "335"), ("2", "336")):
        (tmp_path / "logs").mkdir(exist_ok=True)
        (tmp_path / "logs" / f"{name}.json").write_text(json.dumps(session_of(maker, episode_id=number)))
    run(capsys, "import", tmp_path / "logs", "-o", tmp_path / "rec")
    words = ("--episodes-file", file, "--assets", maker.root, "-o", tmp_path / "told")
    said = run(capsys, "language", "attach", *sorted((tmp_path / "rec").rglob("*.mcap")), *words, code=1)
    assert len(said["written"]) == 1
    assert sorted(reason[-16:-1] for reason in said["left_out"]) == ["H3-LANGUAGE-004", "H3-LANGUAGE-033"]
    for profile in ("partnr", "partnr@habitat"):
        row = run(capsys, "metrics", said["written"][0], "--profile", profile)["episodes"][0]
        assert row["values"]["PC"] == 1
        assert row["values"]["state_success"] == 1
    verdict = verdict_of(h3data.open(said["written"][0]))
    assert verdict.satisfied_at.tolist() == [4, 5]
    assert run(capsys, "metrics", said["written"][0])["episodes"][0]["values"]["offloading"] == 0
