"""Profiles: which one measures a recording, tasks that no profile knows, and profiles of other packages."""

from __future__ import annotations

import dataclasses
import json
import uuid
from pathlib import Path

import numpy as np
import pytest

from h3data.errors import InputError, PluginError
from h3data.geometry import ground_pose
from h3data.metrics import Computed, Metric, Profile, find_metric, measure, measure_files, measure_many
from h3data.metrics import registry as registry_module
from h3data.metrics.registry import profile_for
from h3data.metrics.requirements import UnmeasurableError
from h3data.plugins import TRUST_VARIABLE
from h3data.recording import STEP_NS, Agent, DatasetWriter, Episode, Recording
from h3data_pipelines.cli import main
from h3data_pipelines.metric_texts import explain_episode

THIRD_PARTY = """
from h3data.metrics import Metric, Profile

def grasped(recording):
    return float((recording.columns["agent_0.grasp_body"] >= 0).any())

PROFILE = Profile(
    name="fetch",
    title="Fetching a cup",
    tasks=("fetch",),
    metrics=(
        Metric(
            id="fetch/fetch/grasped@1",
            name="grasped",
            title="Cup grasped",
            formula="1 if the robot holds something in any row, else 0",
            columns=("agent_<robot>.grasp_body",),
            binary=True,
            value=grasped,
        ),
        Metric(
            id="fetch/fetch/reward@1",
            name="reward",
            title="Total reward",
            formula="sum of metrics.reward",
            columns=("metrics.reward",),
            value=lambda recording: float(recording.columns["metrics.reward"].sum()),
        ),
    ),
)
"""


@pytest.fixture
def third_party(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with a profile as pip would leave it on sys.path, with an entry point ``fetch``."""
    (tmp_path / "fetch_metrics.py").write_text(THIRD_PARTY)
    folder = tmp_path / "fetch_metrics-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: fetch_metrics\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(TRUST_VARIABLE, "fetch_metrics")
    for cached in (registry_module.profiles_named, registry_module._profile_naming):
        cached.cache_clear()
        monkeypatch.setattr(registry_module, cached.__name__, cached.__wrapped__)
    return folder


def fetching(number: int = 0, *, rows: int = 4, drop: tuple[str, ...] = (), **info: object) -> Recording:
    """A robot alone that holds something from row 1 on."""
    columns = {
        "time_ns": np.arange(1, rows + 1) * STEP_NS,
        "agent_0.base_pose": ground_pose(np.zeros((rows, 2)), np.zeros(rows)).astype(np.float32),
        "agent_0.grasp_body": np.where(np.arange(rows) > 0, 3, -1).astype(np.int32),
        "metrics.reward": np.full(rows, 0.5, np.float32),
        "metrics.success": np.arange(rows) == rows - 1,
        "metrics.collision": np.arange(rows) % 2 == 1,
    }
    return Recording(
        episode=Episode(uid=str(uuid.uuid4()), episode_id=f"f{number}", task="fetch", scene="home", info=info),
        agents=(Agent(name="robot", kind="robot"),),
        columns={name: column for name, column in columns.items() if name not in drop},
    )


def write(folder: Path, recordings: list[Recording]) -> Path:
    with DatasetWriter(folder) as writer:
        for recording in recordings:
            writer.add(recording)
    return folder


# --- any task ---------------------------------------------------------------------------------------------------------
def test_a_task_that_no_profile_knows_is_measured_by_what_it_records():
    measured = measure(fetching(ended="success"))
    assert (measured.profile, measured.task) == ("task", "fetch")
    assert measured.values == pytest.approx(
        {"success": 1, "reward": 2, "steps": 4, "time": 4 * STEP_NS * 1e-9, "terminated": 1, "collisions": 2}
    )
    assert dict(measured.moments) == {"success": 3, "collision": 1}
    assert measure(fetching(ended="max_steps")).values["terminated"] == 0


def test_what_a_task_does_not_record_is_undefined():
    measured = measure(fetching(drop=("metrics.success", "metrics.reward", "metrics.collision")))
    assert [name for name, value in measured.values.items() if not np.isnan(value)] == ["steps", "time"]
    assert measured.notes["success"] == "needs metrics.success, which this recording does not have"
    empty = measure(fetching(rows=0))
    assert all(np.isnan(value) for value in empty.values.values())
    assert empty.notes["steps"] == "the recording has no rows"


def test_values_that_were_not_logged_are_neither_successes_nor_rewards():
    recording = fetching()
    recording.columns["metrics.success"] = np.array([np.nan, 0, np.nan, 0])  # type: ignore[index]
    recording.columns["metrics.reward"] = np.array([np.nan, 1, 2, np.nan])  # type: ignore[index]
    assert measure(recording).values["success"] == 0
    assert measure(recording).values["reward"] == 3


def test_profiles_of_other_tasks_are_refused_and_suitable_ones_listed():
    with pytest.raises(InputError, match=r"(?s)'paper'.*'fetch'.*field, social, partnr.*H3-METRIC-023"):
        measure(fetching(), "paper")
    with pytest.raises(InputError, match=r"(?s)metrics profile 'papr'\. Did you mean 'paper'\?.*H3-FILE-011"):
        measure(fetching(), "papr")
    assert measure(fetching(), "task").profile == "task"


def test_an_unknown_task_is_measured_from_a_dataset(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = write(tmp_path / "ds", [fetching(k) for k in range(3)])
    assert main(["metrics", str(folder), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert (table["profile"], table["summary"]["success"]["mean"]) == ("task", 1)
    assert main(["metrics", "explain", "collisions", f"{folder}#1"]) == 0
    assert "collision: in 2 of 4 rows: 1, 3" in capsys.readouterr().out


# --- profiles of other packages ---------------------------------------------------------------------------------------
def test_a_recording_names_its_profile(third_party: Path, tmp_path: Path):
    recordings = [fetching(k, profile="fetch_metrics:PROFILE") for k in range(3)]
    table = measure_many(recordings)
    assert (table.profile, [m.name for m in table.metrics]) == ("fetch", ["grasped", "reward"])
    assert table.summary()["grasped"].method == "wilson"
    stored = measure_files([write(tmp_path / "ds", recordings)])
    assert [e.to_dict() for e in stored.episodes] == [e.to_dict() for e in table.episodes]
    assert measure(recordings[0], "task").profile == "task", "an explicit profile wins"


def test_a_profile_of_an_installed_package_measures_its_task(third_party: Path):
    (third_party / "entry_points.txt").write_text("[h3data.profiles]\nfetch = fetch_metrics:PROFILE\n")
    assert measure(fetching()).profile == measure(fetching(), "fetch").profile == "fetch"
    assert find_metric("grasped").title == "Cup grasped"
    assert "grasped = 1  in episode 'f0'" in explain_episode(find_metric("grasped"), fetching())
    assert measure(fetching(), "task").profile == "task"


def test_metrics_that_lack_a_column_are_undefined_and_the_others_are_not(third_party: Path):
    measured = measure(fetching(drop=("metrics.reward",), profile="fetch_metrics:PROFILE"))
    assert measured.values["grasped"] == 1
    assert np.isnan(measured.values["reward"])
    with pytest.raises(InputError, match=r"(?s)grasped needs agent_<robot>\.grasp_body; reward needs.*H3-METRIC-026"):
        measure(fetching(drop=("metrics.reward", "agent_0.grasp_body")), "fetch_metrics:PROFILE")


def test_a_declared_profile_that_cannot_be_used_says_what_to_do(third_party: Path):
    with pytest.raises(InputError, match=r"(?s)'fetch'.*'gone:P'.*H3-FILE-0"):
        measure(fetching(profile="gone:P"))
    with pytest.raises(InputError, match=r"(?s)'paper'.*'fetch'.*H3-METRIC-023"):
        measure(fetching(profile="paper"))
    assert profile_for("fetch", {"profile": "gone:P"}, "task").name == "task"


def test_objects_that_are_not_profiles_are_refused(third_party: Path):
    with pytest.raises(PluginError, match=r"(?s)expected an h3data\.metrics\.Profile or a tuple of them.*H3-FILE-016"):
        measure(fetching(), "fetch_metrics:grasped")


def metric(**changes: object) -> Metric:
    facts = {"id": "p/t/a@1", "name": "a", "title": "A", "formula": "1", "value": lambda _: 1.0, **changes}
    return Metric(**facts)  # type: ignore[arg-type]


def test_profiles_are_checked_when_they_are_made():
    with pytest.raises(InputError, match="H3-METRIC-019"):
        Profile(name="p", title="", metrics=())
    with pytest.raises(InputError, match=r"(?s)q/.*'q'.*'p/t/a@1'.*H3-METRIC-020"):
        Profile(name="q", title="", metrics=(metric(),))
    with pytest.raises(InputError, match=r"(?s)value=.*H3-METRIC-021"):
        Profile(name="p", title="", metrics=(metric(value=None),))


def test_a_profile_may_compute_everything_together():
    profile = Profile(
        name="p",
        title="",
        metrics=(metric(value=None), metric(id="p/t/b@1", name="b", value=None)),
        compute=lambda recording, notes: Computed(values={"b": len(recording)}),
    )
    assert profile.measure(fetching()).values == pytest.approx({"a": np.nan, "b": 4}, nan_ok=True)


def test_a_profile_may_compute_several_recordings_together():
    def lengths(recordings, notes):
        if any(not recording.agents for recording in recordings):
            raise UnmeasurableError("nobody", "nobody")
        for note in notes:
            note.add(["a"], "counted")
        return [Computed(values={"a": len(recording) + len(recordings)}) for recording in recordings]

    profile = Profile(name="p", title="", metrics=(metric(value=None),), compute_many=lengths)
    together = profile.measure_many([fetching(), fetching()])
    assert [each.values["a"] for each in together] == [6, 6]
    assert profile.measure(fetching()).values["a"] == 5
    nobody = dataclasses.replace(fetching(), agents=())
    first, left_out, last = profile.measure_many([fetching(), nobody, fetching()])
    assert isinstance(left_out, UnmeasurableError)
    assert [(each.values["a"], dict(each.notes)) for each in (first, last)] == [(5, {"a": "counted"})] * 2


def test_only_the_first_profiles_are_loaded_for_a_task_that_they_name(monkeypatch):
    asked = []
    found = registry_module.PROFILES.get
    monkeypatch.setattr(registry_module.PROFILES, "get", lambda name: asked.append(name) or found(name))
    monkeypatch.setattr(registry_module.PROFILES, "load_all", lambda: pytest.fail("all profiles were loaded"))
    registry_module.profiles_named.cache_clear()
    registry_module._profile_naming.cache_clear()
    assert profile_for("social_nav", {}).name == "paper"
    assert set(asked) <= {"paper", registry_module.ANY_TASK}
    registry_module._profile_naming.cache_clear()
