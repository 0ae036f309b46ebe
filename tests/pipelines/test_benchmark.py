"""``h3data benchmark``: results that come out again, and what is found in results that somebody has changed."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.builtin import builtin_root
from h3data.errors import FormatError, InputError, UntrustedNameError
from h3data.recording import DatasetWriter, Recording
from h3data.recording.finding import find_episodes
from h3data_pipelines.benchmark.definition import (
    EPISODES,
    benchmark_labels,
    find_benchmark,
    list_episodes,
    read_benchmark,
)
from h3data_pipelines.benchmark.leaderboard import leaderboard
from h3data_pipelines.benchmark.result import MANIFEST, result_files, run_benchmark
from h3data_pipelines.benchmark.verification import verify_result
from h3data_pipelines.cli import main
from h3data_pipelines.hub.checksums import checksums_of
from h3data_pipelines.jobs.evaluations import episode_uid

SOCIAL_NAV = """
format = 1
name = "short-nav"
version = 2
about = "Two short episodes."
task = "social_nav"
scenes = ["small"]
episodes = 2
seed = 3
rules = "natural"
overrides = { max_steps = 60 }
metrics = ["S", "F", "TD"]
rank = "TD"
"""
REARRANGE = """
format = 1
name = "short-rearrange"
version = 1
about = "One short episode with two partners."
task = "rearrange"
scenes = ["small"]
episodes = 1
seed = 3
overrides = { max_steps = 900 }
partners = ["plan_pop_3", "still"]
metrics = ["SR", "RE"]
rank = "SR"
"""

CROWD = """
format = 1
name = "short-crowd"
version = 1
about = "One short episode with four people."
task = "crowd_nav"
scenes = ["medium"]
episodes = 1
seed = 3
partners = ["orca"]
overrides = { max_steps = 60 }
metrics = ["S", "HC", "SPL", "PSC"]
rank = "S"
"""


def definition(folder: Path, text: str) -> Path:
    folder.mkdir()
    (folder / "benchmark.toml").write_text(text)
    entries = list(list_episodes(read_benchmark(folder).jobs()))
    (folder / "episodes.json").write_text(json.dumps({"format": 1, "episodes": entries}))
    return folder


@pytest.fixture(scope="module")
def short_nav(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folder of a benchmark, and of a result of two policies."""
    root = tmp_path_factory.mktemp("benchmark")
    folder = definition(root / "short-nav", SOCIAL_NAV)
    run_benchmark(read_benchmark(folder), ["heuristic_expert", "stand_still"], root / "result")
    return folder, root / "result"


@pytest.fixture
def result(short_nav: tuple[Path, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(short_nav[1], tmp_path / "result"))


def faults(result: Path, benchmark: Path) -> str:
    return "\n".join(verify_result(result, benchmark=str(benchmark)).faults)


def renew_digests(result: Path) -> None:
    """As somebody would who wants a changed file to pass."""
    manifest = json.loads((result / MANIFEST).read_text())
    manifest["files"] = checksums_of(result, result_files(result))
    (result / MANIFEST).write_text(json.dumps(manifest))


def recorded(recording: Recording) -> dict[str, Any]:
    assert isinstance(recording.episode.info, dict)
    return recording.episode.info


def rewrite(result: Path, index: int, change: Callable[[Recording], None]) -> None:
    folder = result / "recordings" / f"{index:06d}"
    recordings = [source.read() for source in find_episodes([folder])]
    change(recordings[0])
    shutil.rmtree(folder)
    with DatasetWriter(folder, like=recordings) as writer:
        for recording in recordings:
            writer.add(recording)
    renew_digests(result)


def test_shipped_benchmarks_are_whole() -> None:
    for label in benchmark_labels():
        benchmark = find_benchmark(label)
        assert benchmark.label == label == benchmark.folder.name
        assert len(set(benchmark.episode_uids())) == benchmark.file.episodes
        assert benchmark.file.rank in {metric.name for metric in benchmark.metrics()}
        first = benchmark.jobs()[0].base
        assert episode_uid(first.found_task, first.episode()) == benchmark.episode_uids()[0]
        for entry in leaderboard(
            benchmark, []
        ).entries:  # baselines were played in all episodes of this very definition
            assert entry.row.played == entry.row.expected
            assert entry.result.definition_sha256 == benchmark.sha256
    assert find_benchmark("h3-social-nav").label == "h3-social-nav@1"
    assert {"h3-social-nav@1", "h3-rearrange@1", "h3-crowd@1", "h3-language@1"} <= {
        path.name for path in (builtin_root() / "benchmarks").iterdir()
    }


def test_a_true_result_is_true_and_stands_in_the_leaderboard(
    short_nav: tuple[Path, Path], result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = short_nav[0]
    assert main(["benchmark", "verify", str(result), "--benchmark", str(folder), "--json"]) == 0
    verdict = json.loads(capsys.readouterr().out)
    assert verdict["true"]
    assert verdict["recordings"] == 4
    board = leaderboard(read_benchmark(folder), [result]).to_dict()["rows"]
    assert [row["policy"] for row in board] == sorted(
        (row["policy"] for row in board),
        key=lambda name: next(r for r in board if r["policy"] == name)["metrics"]["TD"]["mean"],
    )
    assert {row["checked"] for row in board} == {"2 of 2"}
    page = tmp_path / "board.html"
    assert main(["benchmark", "table", str(result), "--benchmark", str(folder), "-o", str(page)]) == 0
    assert "heuristic_expert" in page.read_text()
    (result / MANIFEST).write_text((result / MANIFEST).read_text() + " ")  # a verdict is of the result that was checked
    assert {row["checked"] for row in leaderboard(read_benchmark(folder), [result]).to_dict()["rows"]} == {"no"}


def test_no_text_of_a_result_becomes_markup(short_nav: tuple[Path, Path], result: Path) -> None:
    hostile = "<script>alert(1)</script>&\"'<img src=x onerror=alert(2)>"
    manifest = json.loads((result / MANIFEST).read_text())
    manifest |= {"date": hostile, "created_by": [hostile], "machine": {hostile: hostile}}
    for row in manifest["rows"]:
        row["policy"] = hostile
    (result / MANIFEST).write_text(json.dumps(manifest))
    page = leaderboard(read_benchmark(short_nav[0]), [result]).to_html()
    assert "<script" not in page
    assert "<img" not in page
    assert page.count("&lt;script&gt;alert(1)") == 3 * len(manifest["rows"]) + 4  # in rows and in the card


def test_it_goes_on_where_it_was(short_nav: tuple[Path, Path], result: Path) -> None:
    before = (result / "table.json").read_text()
    (result / "episodes" / "000001.json").unlink()
    again = run_benchmark(read_benchmark(short_nav[0]), ["heuristic_expert", "stand_still"], result, resume=True)
    assert again.result.is_complete
    assert json.loads(before)["cells"] == json.loads((result / "table.json").read_text())["cells"]


def test_a_changed_table_is_found(short_nav: tuple[Path, Path], result: Path) -> None:
    manifest = json.loads((result / MANIFEST).read_text())
    manifest["rows"][0]["metrics"]["S"]["mean"] = 0.99
    (result / MANIFEST).write_text(json.dumps(manifest))
    assert "does not follow from its episodes: S" in faults(result, short_nav[0])


def test_a_changed_metric_is_found(short_nav: tuple[Path, Path], result: Path) -> None:
    path = result / "episodes" / "000001.json"
    changed = json.loads(path.read_text())
    changed["rows"][0]["values"]["TD"] += 0.25
    path.write_text(json.dumps(changed))
    assert "the file is not the one" in faults(result, short_nav[0])
    renew_digests(result)
    assert "TD: measured again" in faults(result, short_nav[0])


def changed_column(name: str, value: float) -> Callable[[Recording], None]:
    def change(recording: Recording) -> None:
        column = np.array(recording.columns[name])
        column[10] = value
        recording.columns[name] = column  # type: ignore[index]

    return change


@pytest.mark.parametrize("name", ["agent_0.action", "agent_0.base", "agent_1.base"])
def test_a_changed_action_or_pose_is_found(short_nav: tuple[Path, Path], result: Path, name: str) -> None:
    first = next(iter(find_episodes([result / "recordings" / "000000"]))).read()
    column = (
        name
        if name in first.columns
        else next(n for n in first.columns if n.startswith(name.split(".")[0]) and "pos" in n)
    )
    rewrite(result, 0, changed_column(column, 0.125))
    assert "takes another course" in faults(result, short_nav[0])


def test_another_episode_is_found(short_nav: tuple[Path, Path], result: Path) -> None:
    def easier(recording: Recording) -> None:
        recording.episode.info["robot_start"][0] += 0.5

    rewrite(result, 0, easier)
    assert "it is another episode than the benchmark's: robot_start" in faults(result, short_nav[0])


@pytest.mark.slow
def test_people_of_other_rules_reach_more_goals(tmp_path: Path) -> None:
    text = SOCIAL_NAV.replace('"natural"', '"paper"').replace("overrides = { max_steps = 60 }\n", "")
    text = re.sub(r"scenes = .*", 'scenes = ["h3-homes/test"]', text)
    folder = definition(tmp_path / "paper-nav", re.sub(r"episodes = .*", "episodes = 1", text))
    out = tmp_path / "out"
    run_benchmark(read_benchmark(folder), ["stand_still"], out)
    assert not faults(out, folder)

    def elsewhere(recording: Recording) -> None:
        recording.episode.info["human_goals"][0][0] += 0.5

    rewrite(out, 0, elsewhere)
    assert "human_goals" in faults(out, folder)


@pytest.mark.parametrize("partner", [["plan_pop_1"], 3, {"a": 1}])
def test_what_is_no_name_is_found(short_nav: tuple[Path, Path], result: Path, partner: object) -> None:
    path = result / "episodes" / "000000.json"
    stored = json.loads(path.read_text())
    stored["rows"][0]["partner"] = partner
    path.write_text(json.dumps(stored))

    def unnamed(recording: Recording) -> None:
        recorded(recording)["partners"] = partner

    rewrite(result, 1, unnamed)
    found = faults(result, short_nav[0])
    assert "episodes/000000.json: expected the results of an episode" in found
    assert "recordings/000001" in found


def test_missing_recordings_are_found(short_nav: tuple[Path, Path], result: Path) -> None:
    shutil.rmtree(result / "recordings" / "000001")
    renew_digests(result)
    assert "recordings/000001: no recording of heuristic_expert, stand_still" in faults(result, short_nav[0])


@pytest.mark.slow
def test_people_decide_again(tmp_path: Path) -> None:
    """A result cannot show another partner's course under a partner's name."""
    folder = definition(tmp_path / "short-rearrange", REARRANGE)
    out = tmp_path / "result"
    run_benchmark(read_benchmark(folder), ["complement"], out)
    assert verify_result(out, benchmark=str(folder)).is_true
    path = out / "episodes" / "000000.json"
    changed: dict[str, Any] = json.loads(path.read_text())
    one, other = changed["rows"]
    one["partner"], other["partner"] = other["partner"], one["partner"]
    path.write_text(json.dumps(changed))

    def swapped(recording: Recording) -> None:
        names = recording.episode.info["partners"]
        names[:] = ["still" if name == "plan_pop_3" else "plan_pop_3" for name in names]

    recordings = [source.read() for source in find_episodes([out / "recordings" / "000000"])]
    for recording in recordings:
        swapped(recording)
    shutil.rmtree(out / "recordings" / "000000")
    with DatasetWriter(out / "recordings" / "000000", like=recordings) as writer:
        for recording in recordings:
            writer.add(recording)
    renew_digests(out)
    assert "takes another course" in faults(out, folder)


def test_a_crowd_decides_again(tmp_path: Path) -> None:
    folder = definition(tmp_path / "short-crowd", CROWD)
    out = tmp_path / "result"
    run_benchmark(read_benchmark(folder), ["shortest_path"], out)
    assert verify_result(out, benchmark=str(folder)).is_true
    rewrite(out, 0, changed_column("agent_4.base_pose", 0.125))
    assert "takes another course" in faults(out, folder)


def test_an_episode_that_is_another_fails_when_it_begins(short_nav: tuple[Path, Path], tmp_path: Path) -> None:
    """The first is compared before anything is played, each other one when it begins."""
    folder = Path(shutil.copytree(short_nav[0], tmp_path / "other"))
    listed = json.loads((folder / EPISODES).read_text())
    listed["episodes"][1]["uid"] = "0" * len(listed["episodes"][1]["uid"])
    (folder / EPISODES).write_text(json.dumps(listed))
    done = run_benchmark(read_benchmark(folder), ["stand_still"], tmp_path / "result")
    assert len(done.failed) == 1
    assert "makes another episode than that of the benchmark" in done.failed[0]
    assert done.failed[0].startswith("episode 1 ")
    assert [(row.played, row.expected) for row in done.result.rows] == [(1, 2)]
    assert "stand_still (1 of 2 episodes)" in done.to_text()
    listed["episodes"].reverse()
    (folder / EPISODES).write_text(json.dumps(listed))
    with pytest.raises(InputError, match="H3-JOB-052"):
        run_benchmark(read_benchmark(folder), ["stand_still"], tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_what_is_missing_in_a_definition_is_named(
    short_nav: tuple[Path, Path], result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(short_nav[0], tmp_path / "bare"))
    (folder / EPISODES).unlink()
    assert main(["benchmark", "run", str(folder), "--policy", "stand_still", "-o", str(tmp_path / "out")]) == 2
    assert "episodes.json" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(["benchmark", "verify", str(result), "--benchmark", str(folder)]) == 2
    assert "episodes.json" in capsys.readouterr().err
    (folder / "benchmark.toml").write_text(SOCIAL_NAV.replace("format = 1", "format = 9"))
    assert main(["benchmark", "run", str(folder), "--policy", "stand_still", "-o", str(tmp_path / "out")]) == 2
    assert "format 9" in capsys.readouterr().err.replace("got 9", "format 9")


def test_a_result_of_another_format_or_version_is_told(
    short_nav: tuple[Path, Path], result: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = json.loads((result / MANIFEST).read_text())
    (result / MANIFEST).write_text(json.dumps({**manifest, "format": 9}))
    for command in (["verify", str(result), "--benchmark", str(short_nav[0])], ["table", str(result)]):
        assert main(["benchmark", *command]) == 2
        assert "Expected format 1 of results, got 9" in capsys.readouterr().err
    (result / MANIFEST).write_text(json.dumps({**manifest, "benchmark": "short-nav@1"}))
    assert "expected a result of short-nav@2, got one of short-nav@1" in faults(result, short_nav[0])
    (result / MANIFEST).write_text(json.dumps({**manifest, "definition_sha256": "0" * 64}))
    assert "of another definition of short-nav@2" in faults(result, short_nav[0])


@pytest.mark.parametrize("lost", ["episodes/000001.json", "recordings/000000/meta", "recordings/000001/data"])
def test_missing_files_are_found(short_nav: tuple[Path, Path], result: Path, lost: str) -> None:
    shutil.rmtree(result / lost) if (result / lost).is_dir() else (result / lost).unlink()
    assert "missing, the first is" in faults(result, short_nav[0])
    renew_digests(result)
    assert lost.split("/")[0] in faults(result, short_nav[0])
    for folder in ("episodes", "recordings"):
        shutil.rmtree(result / folder)
    renew_digests(result)
    found = verify_result(result, benchmark=str(short_nav[0]))
    assert not found.is_true
    assert found.recordings == 0


def swap(folder: Path) -> None:
    """Exchanges the first two entries of a folder."""
    one, other = sorted(folder.iterdir())[:2]
    aside = folder / "aside"
    one.rename(aside)
    other.rename(one)
    aside.rename(other)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (["episodes"], "measured again"),
        (["recordings"], "it is another episode than the benchmark's"),
        (["episodes", "recordings"], "it is another episode than the benchmark's"),
    ],
)
def test_swapped_files_are_found(short_nav: tuple[Path, Path], result: Path, parts: list[str], words: str) -> None:
    for part in parts:
        swap(result / part)
    renew_digests(result)
    assert words in faults(result, short_nav[0])


def test_files_of_no_episode_are_found(short_nav: tuple[Path, Path], result: Path) -> None:
    shutil.copy(result / "episodes" / "000001.json", result / "episodes" / "000002.json")
    renew_digests(result)
    assert "1 file of no episode, or links, the first is episodes/000002.json" in faults(result, short_nav[0])
    (result / "episodes" / "000002.json").unlink()
    (result / "episodes" / "000001.json").rename(result / "elsewhere.json")
    (result / "episodes" / "000001.json").symlink_to(result / "elsewhere.json")
    renew_digests(result)
    assert "1 file of no episode, or links, the first is episodes/000001.json" in faults(result, short_nav[0])


def test_endless_brackets_are_no_result(short_nav: tuple[Path, Path], result: Path) -> None:
    (result / MANIFEST).write_text('{"format": 1, "x": ' + "[" * 100_000)
    with pytest.raises(FormatError, match="H3-OPTION-093"):
        verify_result(result, benchmark=str(short_nav[0]))


def test_results_of_two_benchmarks_make_no_table(
    short_nav: tuple[Path, Path], result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = Path(shutil.copytree(result, tmp_path / "other"))
    manifest = json.loads((other / MANIFEST).read_text())
    (other / MANIFEST).write_text(json.dumps({**manifest, "benchmark": "short-nav@1"}))
    page = tmp_path / "board.md"
    for folders in ([result, other], [other, result]):
        words = ["benchmark", "table", *map(str, folders), "--benchmark", str(short_nav[0]), "-o", str(page)]
        assert main(words) == 2
        assert "a leaderboard has one benchmark" in capsys.readouterr().err
    assert not page.exists()
    assert main(["benchmark", "table", str(tmp_path)]) == 2
    assert "benchmark.json" in capsys.readouterr().err


CANARY = """
from pathlib import Path
Path("ran").write_text("")
from sim_kinematic.policies.policy import Still as Mine
"""


def test_neither_a_definition_nor_a_result_runs_what_it_names(
    short_nav: tuple[Path, Path], result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "canary.py").write_text(CANARY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    path = result / "episodes" / "000000.json"
    changed = json.loads(path.read_text())
    changed["rows"][0] |= {"partner": "canary:Mine", "policy": "canary:Mine"}
    path.write_text(json.dumps(changed))

    def named(recording: Recording) -> None:
        recorded(recording).update(partner="canary:Mine", policy="canary:Mine", partners=["canary:Mine"])

    rewrite(result, 0, named)
    assert faults(result, short_nav[0])
    for line, other in (
        ('task = "social_nav"', 'task = "canary:Mine"'),
        ("overrides", 'partners = ["canary:Mine"]\noverrides'),
    ):
        (tmp_path / "theirs").mkdir(exist_ok=True)
        (tmp_path / "theirs" / "benchmark.toml").write_text(SOCIAL_NAV.replace(line, other, 1))
        with pytest.raises(UntrustedNameError):
            read_benchmark(tmp_path / "theirs")
    assert not (tmp_path / "ran").exists()


def test_what_cannot_be_is_refused(short_nav: tuple[Path, Path], result: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError):
        find_benchmark("h3-social-naw@1")
    with pytest.raises(InputError):
        verify_result(tmp_path)
    with pytest.raises(InputError):  # the result of another benchmark
        leaderboard(find_benchmark("h3-rearrange@1"), [result])
    with pytest.raises(InputError):
        run_benchmark(find_benchmark("h3-social-nav@1"), ["stand_still"], result)
    assert "expected a result of h3-social-nav@1" in "\n".join(
        verify_result(result, benchmark="h3-social-nav@1", episodes=1).faults
    )
    (result / MANIFEST).write_text("{")
    with pytest.raises(FormatError):
        verify_result(result, benchmark=str(short_nav[0]))
    broken = definition(tmp_path / "broken", SOCIAL_NAV)
    (broken / "benchmark.toml").write_text(SOCIAL_NAV.replace("version = 2", "version = 'two'"))
    with pytest.raises(FormatError):
        read_benchmark(broken)
