"""``h3data sync``: copies are equal, complete at any time, and never made over something else."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import h3data
from h3data.errors import FormatError, InputError
from h3data.recording import Dataset
from h3data.recording.storage import place
from h3data_pipelines.cli import main
from h3data_pipelines.hub import syncing
from tests.object_store import bucket


def made(root: Path, episodes: int, seed: int = 0) -> Path:
    options = {"episodes": episodes, "seed": seed, "max_steps": 5, "homes": 1, "agents": "robot"}
    return Path(str(h3data.generate("wander", root, **options).dataset.root))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five episodes in two shards: the second is committed by resuming."""
    root = made(tmp_path_factory.mktemp("sync") / "ds", 3)
    options: dict[str, Any] = {"episodes": 5, "max_steps": 5, "homes": 1, "agents": "robot", "resume": True}
    h3data.generate("wander", root, **options)
    return root


def contents(root: Any) -> dict[str, bytes]:
    at = place(root)
    return {name: (at / name).read_bytes() for name in syncing.sizes_below(at)}


def said(capsys: pytest.CaptureFixture[str], *words: Any, code: int = 0) -> Any:
    assert main(["sync", *map(str, words), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def test_a_copy_is_equal_and_the_next_one_is_nothing(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "deep" / "copy"
    assert said(capsys, dataset, copy)["copied"]
    assert contents(copy) == contents(dataset)
    assert said(capsys, dataset, copy)["copied"] == []
    assert said(capsys, dataset, copy, "--quick")["copied"] == []


@pytest.mark.slow  # quick: recording/test_storage.py
def test_there_and_back_by_an_object_store(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with bucket() as uri:
        said(capsys, dataset, f"{uri}/ds")
        assert contents(f"{uri}/ds") == contents(dataset)
        assert said(capsys, dataset, f"{uri}/ds")["copied"] == []
        said(capsys, f"{uri}/ds", tmp_path / "back")
        assert said(capsys, f"{uri}/ds", f"{uri}/twin")["files"] == len(contents(dataset))
        assert "bucket" in said(capsys, dataset, "s3://nobody/ds", code=2)["error"]
    assert contents(tmp_path / "back") == contents(dataset)


def test_damaged_and_missing_files_are_copied_again(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = h3data.sync(dataset, tmp_path / "copy")
    assert isinstance(copy, Path)
    data = next(copy.glob("data/*/*.parquet"))
    data.write_bytes(bytes(reversed(data.read_bytes())))
    (copy / "meta/info.json").unlink()
    names = [data.relative_to(copy).as_posix(), "meta/info.json"]
    assert said(capsys, dataset, copy, "--dry-run")["copied"] == names
    assert contents(copy) != contents(dataset)
    assert said(capsys, dataset, copy, "--quick")["copied"] == ["meta/info.json"]
    assert said(capsys, dataset, copy)["copied"] == names[:1]
    assert contents(copy) == contents(dataset)


@pytest.mark.parametrize("after", [1, 8, -8, -5, -4, -3, -2, -1])
def test_interrupted_copies_hold_whole_episodes(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    done: list[str] = []
    after %= len(contents(dataset))
    copy_file = syncing._copy_file

    def until(source: Any, target: Any, name: str, info: bytes | None) -> None:
        if len(done) >= after:
            raise KeyboardInterrupt
        copy_file(source, target, name, info)
        done.append(name)

    monkeypatch.setattr(syncing, "_THREADS", 1)
    monkeypatch.setattr(syncing, "_copy_file", until)
    with pytest.raises(KeyboardInterrupt, match="the same call goes on"):
        h3data.sync(dataset, tmp_path)
    if (tmp_path / "h3/schema.json").is_file():
        partly = Dataset(tmp_path)
        assert [row["uid"] for row in partly.rows] == [row["uid"] for row in Dataset(dataset).rows][: len(partly)]
        assert all(len(recording) for recording in partly)
    monkeypatch.undo()
    h3data.sync(dataset, tmp_path)
    assert contents(tmp_path) == contents(dataset)


def test_what_a_writer_has_not_finished_stays_behind(dataset: Path, tmp_path: Path) -> None:
    growing = tmp_path / "growing"
    shutil.copytree(dataset, growing)
    for name in ("data/chunk-000/_file-002.parquet.part", "h3/writer"):
        (growing / name).write_bytes(b"x")
    h3data.sync(growing, tmp_path / "copy")
    assert contents(tmp_path / "copy") == contents(dataset)


def test_only_a_copy_is_written_over(dataset: Path, tmp_path: Path) -> None:
    other = made(tmp_path / "other", 3, seed=7)
    before = contents(other)
    with pytest.raises(InputError, match="H3-HUB-012"):
        h3data.sync(dataset, other)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes/mine.txt").write_text("mine")
    with pytest.raises(InputError, match=r"(?s)1 file.*mine\.txt.*H3-HUB-011"):
        h3data.sync(dataset, tmp_path / "notes")
    assert contents(other) == before
    h3data.sync(dataset, other, force=True)
    assert contents(other) == contents(dataset)


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [("nothing", "copy", "H3-HUB-013"), ("ds", "ds", "H3-HUB-014"), ("ds", "file", "H3-HUB-015")],
)
def test_what_cannot_be_copied(dataset: Path, tmp_path: Path, source: str, target: str, message: str) -> None:
    shutil.copytree(dataset, tmp_path / "ds")
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=message):
        h3data.sync(tmp_path / source, tmp_path / target)


def test_a_copy_that_arrives_otherwise_is_an_error(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(syncing.shutil, "copyfileobj", lambda read, write, size: write.write(b"other"))
    with pytest.raises(FormatError, match="H3-HUB-010"):
        h3data.sync(dataset, tmp_path / "copy")
