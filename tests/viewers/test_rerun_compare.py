"""Two recordings in one Rerun file, and goals on the floor, read back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.geometry import pose_to_matrix
from h3data.recording.records import STEP_NS, Recording
from h3data_viewers import ViewedRecording, write_comparison_rrd, write_rrd
from h3data_viewers.rerun.rrd_file import _timeline
from tests.viewers.rerun_file import STEPS, File, Stage, example

pytest.importorskip("rerun")


# --- two recordings ---------------------------------------------------------------------------------------------------
def shortened(recording: Recording, steps: int) -> Recording:
    columns = {name: column[:steps] for name, column in recording.columns.items()}
    episode = replace(recording.episode, uid="short", episode_id="e-2", info={"ended": "collision"})
    spans = tuple(replace(s, end_step=min(s.end_step, steps - 1)) for s in recording.skills if s.start_step < steps)
    return replace(recording, episode=episode, columns=columns, skills=spans, events=())


class ShortStage(Stage):
    """Another scene: what `Stage` holds but for the lamp."""

    def __init__(self, recording: Recording) -> None:
        super().__init__(recording)
        self.drawables = self.drawables[:2] + self.drawables[3:4]

    def matrices(self, index: int, steps: np.ndarray) -> np.ndarray:
        return np.tile(pose_to_matrix([5.0, 1.0, 0.0, 0, 0, 0, 1]), (len(steps), 1, 1))


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> tuple[Recording, Recording, File]:
    first, second = example(), shortened(example(), 25)
    one = ViewedRecording(recording=first, replay=Stage(first), name="one")
    two = ViewedRecording(recording=second, replay=ShortStage(second), name="two")
    return first, second, File(write_comparison_rrd(one, two, tmp_path_factory.mktemp("rrd") / "two.rrd"))


def test_each_of_two_recordings_has_its_own_root(compared):
    first, second, file = compared
    assert {e.split("/")[1] for e in file.batches} == {"a", "b", "__properties"}
    for label, recording, step in (("a", first, 45), ("b", second, 24)):
        root = pose_to_matrix(recording.agent_column(0, "base_pose")[step])
        assert np.allclose(file.matrix(f"/{label}/world/spot", step), root, atol=1e-5)
        assert file.at(f"/__properties/episode_{label}", "uid", 0) == [recording.episode.uid]
    assert np.allclose(file.matrix("/b/world/objects/cup", 24)[:3, 3], [5, 1, 0])
    assert "/a/world/scene/lamp\\/left\\ hand" in file.batches
    assert "/b/world/scene/lamp\\/left\\ hand" not in file.batches
    assert [r.recording_id for r in file.recordings] == ["7a1e short"]


def test_the_shorter_one_says_that_it_has_ended(compared):
    first, second, file = compared
    assert file.at("/b/actions/spot_skill", "StateChange:state", 24) == ["follow"]
    assert file.at("/b/actions/spot_skill", "StateChange:state", 40) == ["ended"]
    assert file.at("/a/actions/spot_skill", "StateChange:state", 40) == ["follow"]
    assert file.at("/b/log/events", "TextLog:text", 25) == ["the recording ends (collision)"]
    assert file.column("/b/log/events", "TextLog:text")[0].tolist() == [25]
    batch = next(b for static, b in file.batches["/b/log/events"] if not static)
    assert batch.column("sim_time").cast("int64").to_pylist() == [25 * STEP_NS]
    for label, recording in (("a", first), ("b", second)):
        _, curve = file.column(f"/{label}/metrics/geodesic_agents", "Scalars:scalars")
        assert len(curve) == len(recording)
        assert file.at(f"/{label}/metrics/geodesic_agents", "SeriesLines:names", 0) == [f"{label} geodesic_agents"]
    assert "/b/metrics/follow_to_2m" not in file.batches, "the bounds are drawn once"


def test_curves_of_two_recordings_differ_in_colour(compared):
    _, _, file = compared
    curves = [f"/{label}/metrics/{name}" for label in "ab" for name in ("geodesic_agents", "distance_l2")]
    assert len({file.at(entity, "SeriesLines:colors", 0)[0] for entity in curves}) == 4


def test_the_timeline_is_one_on_which_both_keep_their_pace():
    first, second = (ViewedRecording(recording=r) for r in (example(), shortened(example(), 25)))
    assert _timeline([first, second]) == "step"
    columns = {**second.recording.columns, "time_ns": second.recording.columns["time_ns"] * 2}
    slow = ViewedRecording(recording=replace(second.recording, columns=columns))
    assert _timeline([first, slow]) == "sim_time"


def test_nothing_to_compare_is_refused(tmp_path):
    empty = example(agents=(), columns={"time_ns": np.zeros(0, np.int64)}, skills=(), events=())
    with pytest.raises(InputError, match=r"(?s)b, 'nothing'.*H3-VIEW-021"):
        write_comparison_rrd(
            ViewedRecording(recording=example()), ViewedRecording(recording=empty, name="nothing"), tmp_path / "e.rrd"
        )
    assert not list(tmp_path.iterdir())


# --- goals ------------------------------------------------------------------------------------------------------------
def with_info(**info) -> Recording:
    recording = example()
    return replace(recording, episode=replace(recording.episode, info=info))


def test_goals_are_where_the_recording_says(tmp_path):
    info = {
        "human_goals": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]],
        "goals": [{"object": "mug", "position": [1, 0.8, 2], "from": "sofa", "to": "table"}],
    }
    recording = with_info(**info)
    number = (np.arange(STEPS) >= 20).astype(np.int32) + (np.arange(STEPS) >= 50)
    recording = replace(recording, columns={**recording.columns, "sim.human_goal": number})
    file = File(write_rrd(recording, tmp_path / "e.rrd"))
    steps, points = file.column("/world/goals/alex", "Points3D:positions")
    assert steps.tolist() == [0, 20, 50]
    assert np.allclose(np.array(points)[:, 0, [0, 2]], info["human_goals"])
    assert file.at("/world/goals/objects", "Points3D:positions", 0) == [[1.0, pytest.approx(0.8), 2.0]]
    assert file.at("/world/goals/objects", "Points3D:labels", 0) == ["mug to table"]


@pytest.mark.parametrize(
    "info",
    [
        {"human_goals": "everywhere"},
        {"human_goals": [[1, 2, 3]]},
        {"human_goals": [[float("nan"), 1.0]]},
        {"human_goals": [[1, 2], [3]]},
        {"goals": [{"position": "here"}]},
        {"goals": {"a": 1}},
        {"goals": ["a"]},
        {"goal_positions": [[0, None, 1]]},
        {"goals": [{"position": {}}]},
        {"spec": {"agent_radius_m": "wide"}},
    ],
)
def test_goals_of_another_form_are_left_out(tmp_path, info):
    recording = with_info(**info)
    recording = replace(recording, columns={**recording.columns, "sim.human_goal": np.full(STEPS, -7)})
    file = File(write_rrd(recording, tmp_path / "e.rrd"))
    assert not [entity for entity in file.batches if entity.startswith("/world/goals")]
    assert "/world/spot" in file.batches
