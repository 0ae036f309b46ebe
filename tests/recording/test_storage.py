"""Datasets and recordings by URI: an object store (a local server of S3) and memory behave like a folder."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest

from h3data.errors import FormatError, InputError
from h3data.recording import (
    Dataset,
    DatasetWriter,
    Recording,
    RecordingWriter,
    open_recording,
    read_mcap,
    rebuild_meta,
    recordings_equal,
    storage,
    write_mcap,
)
from h3data.recording.storage import RemotePath, masked, place
from h3data_pipelines.cli import main
from h3data_training.samples import WindowDataset
from tests.object_store import bucket, read_only
from tests.recording.strategies import simple_recording


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """URI of an empty bucket on a server of this process, found by the standard environment variables."""
    with bucket() as uri:
        yield uri


@pytest.fixture(params=["mock", pytest.param("s3", marks=pytest.mark.slow)])
def store(request: pytest.FixtureRequest) -> str:
    """A fresh folder in memory or in the bucket."""
    name = request.node.name.replace("[", "_").strip("]")
    return f"mock://memory/{name}" if request.param == "mock" else f"{request.getfixturevalue('s3')}/{name}"


EPISODES = [simple_recording(steps=steps, seed=seed) for seed, steps in enumerate((7, 0, 12))]


def test_uris_and_paths() -> None:
    assert place("s3://bucket/a/b/") == place(Path("s3://bucket/a/b")) == RemotePath("s3", "bucket/a/b")
    assert place("S3://bucket/a") == place(Path("S3://bucket/a")) == RemotePath("s3", "bucket/a")
    assert str(place(Path("s3://bucket/a?region=eu"))) == "s3://bucket/a?region=eu"
    assert place("file:///tmp/x") == place(Path("file:///tmp/x")) == Path("/tmp/x")
    for path in ("a/b", "/a:b/c", "C:/x", "run:1/ds", "weird:/x"):
        assert place(path) == Path(path)
    for uri, said in (("ftp://host/x", r"(?s)s3.*H3-RECORDING-118"), ("s3://", "H3-RECORDING-119")):
        with pytest.raises(InputError, match=said):
            place(uri)
    remote = place("s3://bucket/a/b.mcap")
    assert isinstance(remote, RemotePath)
    assert (remote.name, remote.stem, remote.suffix, remote.parent) == ("b.mcap", "b", ".mcap", place("s3://bucket/a"))
    assert pickle.loads(pickle.dumps(remote)) == remote


def test_a_remote_folder_is_listed_like_a_local_one(tmp_path: Path, store: str) -> None:
    files = ["a.txt", "meta/x/file-1.bin", "meta/y/file-2.bin", "meta/file-3.bin", "deep/er/a.txt"]
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(name.encode())
        remote = place(store) / name
        assert isinstance(remote, RemotePath)
        remote.put(name.encode())
        assert remote.read_bytes() == name.encode()
    root = place(store)
    for list_of in (
        lambda at: at.iterdir(),
        lambda at: at.glob("meta/*/file-*.bin"),
        lambda at: at.glob("*.txt"),
        lambda at: at.rglob("*.txt"),
        lambda at: at.rglob("x/file-*.bin"),
        lambda at: (at / "nowhere").rglob("*"),
    ):
        names = {str(p.relative_to(tmp_path)) for p in list_of(tmp_path) if p.exists()}
        assert {str(p.relative_to(root)) for p in list_of(root)} == names
    for name in ("a.txt", "meta", "nowhere"):
        for question in ("exists", "is_dir", "is_file"):
            assert getattr(root / name, question)() == getattr(tmp_path / name, question)()
    storage.remove_tree(root / "meta")
    assert not (root / "meta" / "file-3.bin").exists()
    assert (root / "a.txt").exists()


def test_a_dataset_is_what_it_is_in_a_folder(store: str) -> None:
    with DatasetWriter(f"{store}/ds", episodes_per_file=2) as writer:
        for episode in EPISODES:
            writer.add(episode)
    for dataset in (
        Dataset(f"{store}/ds"),
        open_recording(Path(f"{store}/ds")),
        pickle.loads(pickle.dumps(Dataset(f"{store}/ds"))),
    ):
        assert isinstance(dataset, Dataset)
        assert [recordings_equal(a, b) for a, b in zip(EPISODES, dataset, strict=True)] == [[]] * 3
    assert f"{store}/ds" in repr(dataset)
    assert dataset.to_arrow(["frame_index"])["frame_index"].to_pylist() == [*range(7), *range(12)]
    assert len(list(WindowDataset(dataset, ["agent_0.action"], history=3))) == 15
    (place(store) / "ds" / "meta" / "info.json").unlink()
    assert rebuild_meta(f"{store}/ds") == 3


def test_a_shard_is_visible_from_its_commit_on(store: str) -> None:
    writer = DatasetWriter(f"{store}/ds")
    writer.add(EPISODES[0])
    assert not any((place(store) / "ds").rglob("*.parquet"))
    writer.commit()
    writer.add(EPISODES[2])
    assert len(Dataset(f"{store}/ds")) == 1
    assert writer._shard is not None
    writer._shard.discard()  # as if the process had died
    with DatasetWriter(f"{store}/ds", resume=True) as again:
        assert len(again) == 1
        again.add(EPISODES[2])
    assert recordings_equal(Dataset(f"{store}/ds")[1], EPISODES[2]) == []
    with pytest.raises(InputError, match="H3-RECORDING-096"):
        DatasetWriter(f"{store}/ds")
    with DatasetWriter(f"{store}/ds", overwrite=True) as anew:
        anew.add(EPISODES[2])
    assert len(Dataset(f"{store}/ds")) == 1


def test_of_two_writers_the_first_is_told(store: str) -> None:
    first = DatasetWriter(f"{store}/ds")
    first.add(EPISODES[0])
    first.commit()
    with DatasetWriter(f"{store}/ds", resume=True) as second:
        second.add(EPISODES[2])
        first.add(EPISODES[0])
        with pytest.raises(InputError, match="H3-RECORDING-097"):
            first.commit()
    assert [
        recordings_equal(a, b) for a, b in zip((EPISODES[0], EPISODES[2]), Dataset(f"{store}/ds"), strict=True)
    ] == [[], []]
    assert not (place(store) / "ds" / "h3" / "writer").exists()


@pytest.mark.parametrize("fails_at", range(7))
def test_an_upload_that_fails_commits_nothing(fails_at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    uri = f"mock://failing/{fails_at}"
    with DatasetWriter(uri) as writer:
        writer.add(EPISODES[0])
    put, count = RemotePath.put, iter(range(100))

    def failing(self: RemotePath, source) -> None:
        if next(count) == fails_at:
            raise OSError("the network is gone")
        put(self, source)

    writer = DatasetWriter(uri, resume=True)
    writer.add(EPISODES[2])
    monkeypatch.setattr(RemotePath, "put", failing)
    with pytest.raises(InputError, match=r"(?s)network is gone.*H3-RECORDING-103"):
        writer.commit()
    monkeypatch.undo()
    assert len(Dataset(uri)) == 1, "the episode table is the last of the seven files"
    with DatasetWriter(uri, resume=True) as again:
        again.add(EPISODES[2])
    assert [recordings_equal(a, b) for a, b in zip((EPISODES[0], EPISODES[2]), Dataset(uri), strict=True)] == [[], []]


def test_logs_go_whole(store: str) -> None:
    uri = f"{store}/logs/e.mcap"
    assert str(write_mcap(EPISODES[2], uri)) == uri
    assert recordings_equal(read_mcap(uri), EPISODES[2]) == []
    opened = open_recording(Path(uri))
    assert isinstance(opened, Recording)
    assert recordings_equal(opened, EPISODES[2]) == []
    with pytest.raises(InputError, match="H3-RECORDING-047"):
        write_mcap(EPISODES[0], uri)
    write_mcap(EPISODES[0], uri, overwrite=True)
    assert len(read_mcap(uri)) == 7
    with pytest.raises(InputError, match="H3-RECORDING-120"):
        RecordingWriter(uri, EPISODES[0])


def test_what_is_not_there_or_something_else(store: str) -> None:
    with pytest.raises(InputError, match="H3-RECORDING-049"):
        open_recording(f"{store}/nothing")
    with pytest.raises(InputError, match="H3-RECORDING-061"):
        Dataset(f"{store}/nothing")
    picture = place(f"{store}/p.png")
    assert isinstance(picture, RemotePath)
    picture.put(b"\x89PNG....")
    with pytest.raises(FormatError, match=r"(?s)PNG picture.*H3-RECORDING-048"):
        open_recording(picture)


OPTIONS = ("--scenes", "small:1", "--max-steps", 6, "--seed", 3)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict:
    assert main([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow  # a bucket takes seconds to start; quick: the same in memory
def test_commands_take_uris(s3: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generate = ("generate", "social_nav", *OPTIONS, "--episodes", 1, "--mcap", "-o")
    local, uri = run(capsys, *generate, tmp_path / "ds"), f"{s3}/made"
    made = run(capsys, *generate, uri)
    assert made["dataset"] == uri
    assert made["state_hashes"] == local["state_hashes"]
    assert main([*map(str, generate), uri]) == 2
    assert "--force" in capsys.readouterr().err
    assert run(capsys, *generate, uri, "--resume")["new"] == 0
    assert run(capsys, "metrics", uri)["metrics"] == run(capsys, "metrics", tmp_path / "ds")["metrics"]
    assert run(capsys, "metrics", f"{uri}/mcap/000000.mcap")["metrics"]
    assert run(
        capsys,
        "sql",
        "select dataset, count(*), avg(S) is not null from steps "
        "join episodes using (dataset, episode_index) group by 1",
        uri,
    )["rows"] == [[uri, 6, True]]
    assert run(capsys, "convert", f"{uri}#0", f"{s3}/one.mcap", "--check")["converted"] == 1
    run(capsys, "validate", uri, f"{s3}/one.mcap")
    for command in (["rerender", f"{uri}#0", "-o", f"{s3}/pictures"], ["metrics", uri, "-o", f"{s3}/t.csv"]):
        assert main(command) == 2
        assert "only be written locally" in capsys.readouterr().err
    assert not Path("s3:").exists()


@pytest.mark.slow
def test_recordings_at_a_uri_are_shown_simulated_again_and_replaced(
    s3: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    uri, generate = f"{s3}/shown", ("generate", "social_nav", *OPTIONS, "--episodes", 2, "-o")
    run(capsys, *generate, uri)
    assert run(capsys, "convert", uri, f"{s3}/logs", "--check")["converted"] == 2
    assert run(capsys, "convert", f"{s3}/logs", tmp_path / "back", "--check")["converted"] == 2
    run(capsys, "view", f"{uri}#0", "-o", tmp_path / "e.rrd")
    run(capsys, "replay", f"{uri}#0", "--verify")
    assert run(capsys, *generate, uri, "--force")["new"] == 2
    made = run(capsys, "rerender", f"{uri}#1", "--steps", "0:2", "--format", "png", "-o", tmp_path / "pictures")
    assert (Path(made["recordings"][0]["files"][0]) / "000001.png").is_file()


@pytest.mark.slow
def test_a_bucket_without_the_right_to_write(s3: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with DatasetWriter(f"{s3}/others") as out:
        out.add(EPISODES[0])
    with DatasetWriter(tmp_path / "ds") as out:
        out.add(EPISODES[0])
    generate = ("generate", "social_nav", "--episodes", "1", "--max-steps", "5", "--scenes", "small:1", "-o")
    with read_only():
        assert len(Dataset(f"{s3}/others")) == 1
        for command in (
            (*generate, f"{s3}/denied"),
            (*generate, f"{s3}/others", "--force"),
            ("sync", str(tmp_path / "ds"), f"{s3}/denied"),
            ("convert", f"{tmp_path}/ds#0", f"{s3}/denied.mcap"),
            ("convert", str(tmp_path / "ds"), f"{s3}/denied"),
        ):
            assert main([*command]) == 2, command
            (line,) = capsys.readouterr().err.splitlines()
            assert line.startswith("error: Access denied: no right to "), line
            assert f"{s3}/" in line
            assert "check them (AWS_PROFILE" in line
        assert not recordings_equal(Dataset(f"{s3}/others")[0], EPISODES[0]), "it is still there"


def test_no_such_bucket(s3: str) -> None:
    with pytest.raises(InputError, match=r"(?s)s3://elsewhere.*H3-RECORDING-123"):
        place("s3://elsewhere/x").put(b"x")  # type: ignore[union-attr] - a URI


@pytest.mark.slow  # pyarrow tries for 6 seconds
def test_nobody_there(s3: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    storage._filesystem.cache_clear()
    assert main(["metrics", f"{s3}/ds"]) == 2
    assert "The store does not answer. Check the network and the endpoint" in capsys.readouterr().err
    storage._filesystem.cache_clear()


# --- credentials ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("s3://me:hush@bucket/ds#3", "s3://me:***@bucket/ds#3"),
        ("no s3:/me:hush@bucket/ds, which pathlib shortened", "no s3:/me:***@bucket/ds, which pathlib shortened"),
        ("abfs://:hush@account/ds and s3://a:hush@b", "abfs://:***@account/ds and s3://a:***@b"),
        ("s3://b/ds?region=x&secret_key=hush&y=1", "s3://b/ds?region=x&secret_key=***&y=1"),
        ("s3://bucket/a@b:c", "s3://bucket/a@b:c"),
        ("s3://bucket/12:30@home", "s3://bucket/12:30@home"),
        ("C:/me and you@home", "C:/me and you@home"),
    ],
)
def test_credentials_are_not_shown(text: str, shown: str) -> None:
    assert masked(text) == shown


def test_errors_about_uris_do_not_show_their_credentials(capsys: pytest.CaptureFixture[str]) -> None:
    path = place("s3://me:hush@bucket/ds?secret_key=hush")
    assert isinstance(path, RemotePath)
    assert "hush" in path.uri
    assert "hush" not in f"{path} {path!r} {path / 'meta'}"
    for uri in ("ftp://me:hush@host/ds", "mock://me:hush@host/nowhere", "mock://me:hush@host/nowhere#3"):
        for command in (
            ["metrics", uri],
            ["view", uri, "-o", "x.rrd"],
            ["generate", "wander", "--scenes", uri, "-o", uri],
        ):
            assert main([*command, "--json"]) == 2
            out, error = capsys.readouterr()
            assert "hush" not in out + error
            assert "***" in error
    assert place(path.uri) == path
