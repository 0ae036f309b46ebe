"""Cards, push and pull, against a stand-in for the Hugging Face Hub."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.commands.options import command_line
from h3data.errors import FormatError, InputError
from h3data.recording import Dataset, DatasetWriter, recordings_equal
from h3data_pipelines.cli import main
from h3data_pipelines.commands.generate import Generate
from h3data_pipelines.hub.card import AGENT_COUNTS, _things_in, card_picture
from h3data_pipelines.hub.checksums import require_checksums
from h3data_pipelines.hub.provenance import read_commands
from tests.hub_server import READER, WRITER, Hub, served
from tests.recording.strategies import simple_recording

REPO = "somebody/homes"
pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")  # huggingface_hub's own


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("hub") / "following"
    return h3data.generate(
        "social_nav", root, episodes=2, seed=5, max_steps=20, spawn_distance=2.0, cameras=["robot_arm"], workers=1
    ).dataset


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """A server that huggingface_hub takes for the Hub, with a token that may write."""
    pytest.importorskip("huggingface_hub", reason='needs the extra: pip install "h3data[hub]"')
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)  # another protocol, with servers of its own
    with served() as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        monkeypatch.setenv("HF_TOKEN", WRITER)
        yield server


def copied(dataset: Dataset, root: Path) -> Path:
    """A dataset of its own to change."""
    dataset.all().save(root)
    return root


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.mark.slow
# --- the card ---------------------------------------------------------------------------------------------------------
def test_a_card_says_what_is_inside(dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import yaml

    root = Path(str(dataset.root))
    text = run_json(capsys, "card", root, "--license", "mit", "--title", "A: b", "--dry-run")["card"]
    assert not (root / "README.md").exists()
    front = yaml.safe_load(text.split("---\n")[1])
    assert (front["pretty_name"], front["license"], front["size_categories"]) == ("A: b", "mit", ["n<1K"])
    assert front["task_categories"] == ["robotics"]
    assert {"LeRobot", "social-nav"} <= set(front["tags"])
    assert list(root.glob(front["configs"][0]["data_files"]))
    steps = sum(row["length"] for row in dataset.rows)
    for words in (
        f"| steps | {steps:,} at 30 per second",
        "| instructions | follow the person (2) |",
        "| robots | quad_arm (2) |",
        "`observation.images.robot_arm` (224x172)",
        "## Metrics: social_nav",
        "| CR |",
        "h3data generate social_nav --episodes 2 --seed 5",
        "LeRobotDataset",
        "| `agent_0.action` | float32 | [T, 2] |",
    ):
        assert words in text, words
    picture = card_picture(dataset)
    assert picture is not None
    assert picture.shape == (360, 640, 3)
    assert picture[:180].std() > 10
    assert picture[180:].std() > 10


@pytest.mark.slow
def test_a_card_is_kept_unless_forced(dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = copied(dataset, tmp_path / "ds")
    run_json(capsys, "card", root)
    assert (root / "card.jpg").stat().st_size > 5000
    (root / "README.md").write_text("mine")
    assert "--force" in run_json(capsys, "card", root, code=2)["error"]
    assert (root / "README.md").read_text() == "mine"
    assert h3data.card(root, force=True) == root / "README.md"
    assert len(Dataset(root)) == 2, "a card beside it changes nothing"
    run_json(capsys, "convert", dataset.root, root, "--to", "dataset", "--force")
    assert not (root / "README.md").exists()


def test_a_dataset_without_steps_or_cameras_has_a_card_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(simple_recording(steps=0))
    text = run_json(capsys, "card", tmp_path / "ds", "--dry-run")["card"]
    assert "1, of which 1 without steps" in text
    assert "Metrics" not in text
    assert "The commands were not kept." in text


def test_the_card_of_an_export_has_no_metrics_and_shows_people(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exports lack the last row of each episode, so that their metrics would be wrong."""
    root = Path(str(dataset.root))
    run_json(capsys, "export", root, "--to", "lerobot", "-o", tmp_path / "export")
    text = run_json(capsys, "card", tmp_path / "export", "--dry-run")["card"]
    assert "| episodes | 2 |" in text
    assert "Metrics" not in text
    assert "measured" not in text
    assert "## Metrics: social_nav" in run_json(capsys, "card", root, "--dry-run")["card"]


def test_the_picture_of_a_card_shows_the_moment_at_which_most_is_seen() -> None:
    """Eight ids: a wall, three things and four links of two agents; a wall alone, things, and an agent."""
    agents = np.array([-1, -1, -1, -1, 0, 0, 1, 1])
    wall = np.zeros((10, 10), np.int32)
    things, person = wall.copy(), wall.copy()
    things[:5, :5], things[5:, 5:] = 1, 2
    person[2:4, :], person[4:6, :], person[9, 9] = 4, 5, -1
    assert [_things_in(picture, agents) for picture in (wall, things, person)] == [1, 3, 1 + AGENT_COUNTS]


def test_commands_are_kept_without_folders_and_without_what_changes_nothing(dataset: Dataset) -> None:
    (made,) = read_commands(dataset.root)
    assert made == (
        "h3data generate social_nav --episodes 2 --seed 5 --max-steps 20 --spawn-distance 2.0 --camera robot_arm"
    )
    told = Generate(
        task="wander",
        out=Path("/home/me/out"),
        policies=("weights:/home/me/net.npz",),
        assets=(Path("/data/habitat"),),
        workers=7,
    )
    assert command_line("generate", told) == "h3data generate wander --asset habitat --policy weights:net.npz"


# --- push and pull ----------------------------------------------------------------------------------------------------
def test_what_is_pushed_is_pulled(
    dataset: Dataset, hub: Hub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = copied(dataset, tmp_path / "ds")
    done = run_json(capsys, "push", root, REPO, "--private")
    repo = hub.repos[REPO]
    assert repo.private
    assert len(repo.commits) == 1, "everything at once"
    assert repo.tags == {"v3.0": repo.sha}, "where LeRobot looks"
    assert {"README.md", "card.jpg", "h3/checksums.json", "meta/info.json"} <= set(repo.files)
    assert any(name.endswith(".mp4") for name in repo.large)
    assert done["files"] == len(repo.files) - 1

    pulled = run_json(capsys, "pull", REPO, "-o", tmp_path / "back")
    assert pulled["episodes"] == 2
    assert pulled["checksums"] == len(repo.files) - 3, "all but card, picture and the checksums themselves"
    back = contents(tmp_path / "back")
    assert back.pop("h3/checksums.json")
    assert back == contents(root)
    copy = Dataset(tmp_path / "back")
    assert recordings_equal(dataset[1], copy[1]) == []
    assert np.array_equal(list(copy.video(1, "robot_arm").frames()), list(dataset.video(1, "robot_arm").frames()))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["back", "ds"]


@pytest.mark.slow
def test_a_smaller_version_replaces_the_larger_one(dataset: Dataset, hub: Hub, tmp_path: Path) -> None:
    root = tmp_path / "large"
    with DatasetWriter(root, episodes_per_file=1) as writer:
        for k in range(2):
            writer.add(dataset[k], videos=dataset.videos(k))
    assert h3data.push(root, REPO) == f"{hub.url}/datasets/{REPO}"
    assert "data/chunk-000/file-001.parquet" in hub.repos[REPO].files
    h3data.push(copied(dataset, tmp_path / "small"), REPO)
    assert "data/chunk-000/file-001.parquet" not in hub.repos[REPO].files
    assert hub.repos[REPO].tags == {"v3.0": hub.repos[REPO].sha}
    assert len(Dataset(h3data.pull(REPO, tmp_path / "back"))) == 2
    uploads = hub.asked["uploads"]
    h3data.push(tmp_path / "small", REPO)
    assert hub.asked["uploads"] == uploads, "what is there is not sent again"


@pytest.mark.slow
def test_an_interrupted_push_goes_on(dataset: Dataset, hub: Hub, tmp_path: Path) -> None:
    root = copied(dataset, tmp_path / "ds")
    hub.fail_after = 3
    with pytest.raises(InputError, match=f"(?s){REPO}.*H3-HUB-006"):
        h3data.push(root, REPO)
    assert not hub.repos[REPO].files, "nothing is seen of a half"
    hub.fail_after = None
    h3data.push(root, REPO)
    assert hub.asked["uploads"] == len(hub.blobs), "each content once"
    assert hub.repos[REPO].files


@pytest.mark.slow
def test_an_interrupted_pull_goes_on(dataset: Dataset, hub: Hub, tmp_path: Path) -> None:
    h3data.push(copied(dataset, tmp_path / "ds"), REPO)
    out, files = tmp_path / "back", len(hub.repos[REPO].files)
    hub.fail_after = 5
    with pytest.raises(InputError):
        h3data.pull(REPO, out)
    assert not list(out.rglob("*")), "half of it does not look whole"
    before, hub.fail_after = hub.asked["downloads"], None
    assert before == 5
    h3data.pull(REPO, out)
    assert hub.asked["downloads"] == files, "each file once"
    assert len(Dataset(out)) == 2


@pytest.mark.slow
def test_damage_on_the_way_is_noticed(dataset: Dataset, hub: Hub, tmp_path: Path) -> None:
    h3data.push(copied(dataset, tmp_path / "ds"), REPO)
    repo = hub.repos[REPO]
    video = next(name for name in repo.files if name.endswith(".mp4"))
    repo.files[video] = b"\0" * len(repo.files[video])
    with pytest.raises(FormatError, match="H3-HUB-002"):
        h3data.pull(REPO, tmp_path / "back")
    del repo.files[video]
    with pytest.raises(FormatError, match="H3-HUB-002"):
        h3data.pull(REPO, tmp_path / "back")
    assert not (tmp_path / "back.part").exists()
    assert not list((tmp_path / "back").rglob("*"))
    del repo.files["h3/checksums.json"]  # uploaded by another program: every episode is read
    h3data.pull(REPO, tmp_path / "back")
    assert require_checksums(tmp_path / "back") == 0


@pytest.mark.slow
def test_what_stands_in_the_way_is_said(
    dataset: Dataset, hub: Hub, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = copied(dataset, tmp_path / "ds")
    run_json(capsys, "push", root, REPO, "--private")

    def push_error(repo: str = REPO) -> str:
        return run_json(capsys, "push", root, repo, code=2)["error"]

    def pull_error(*more: str | Path) -> str:
        return run_json(capsys, "pull", *(more or (REPO,)), "-o", tmp_path / "back", code=2)["error"]

    assert "user/name, got 'homes'" in push_error("homes")
    assert "There is no such dataset" in pull_error("somebody/nothing")
    assert "no such revision" in pull_error(REPO, "--revision", "v9")
    monkeypatch.setenv("HF_TOKEN", READER)
    assert "may not write" in push_error()
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    assert "does not know this token" in push_error()
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setenv("HF_HUB_DISABLE_IMPLICIT_TOKEN", "1")
    assert "hf auth login" in push_error()
    assert "hf auth login" in pull_error()
    hub.repos[REPO].private = False
    hub.repos[REPO].files.pop("h3/schema.json")
    assert "no h3/schema.json" in pull_error()
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    assert "cannot be reached" in push_error()
    assert "cannot be reached" in pull_error()
    assert "not empty" in run_json(capsys, "pull", REPO, "-o", root, code=2)["error"]
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert 'pip install "h3data[hub]"' in push_error()
    assert 'pip install "h3data[hub]"' in pull_error()


@pytest.mark.slow
def test_addresses_name_datasets_too(dataset: Dataset, hub: Hub, tmp_path: Path) -> None:
    h3data.push(copied(dataset, tmp_path / "ds"), f"https://huggingface.co/datasets/{REPO}")
    assert len(Dataset(h3data.pull(f"hf://datasets/{REPO}", tmp_path / "back"))) == 2
