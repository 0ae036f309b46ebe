"""Formats of installed packages: detected, imported, exported to, listed; broken ones are named and the rest goes on
working."""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.errors import FormatError, InputError, PluginError
from h3data.formats import FORMATS, Format, SourceFile, detect, export_options, load
from h3data.formats.builtin_formats import BUILT_IN
from h3data.plugins import PluginWarning, load_reference
from h3data.recording import Episode, Recording, write_mcap
from h3data_pipelines.cli import main

SOURCE = """
import re
from pathlib import Path
import numpy as np
from h3data.formats import Exported, Format
from h3data.recording import Episode, Recording

def read(file, *, fps):
    steps = len(Path(file).read_text().splitlines()) - 1
    times = (np.arange(steps) * 1e9 / fps).astype(np.int64)
    return Recording(episode=Episode(uid="u", episode_id="x", task="t", scene=""), columns={"time_ns": times})

def write(recordings, request):
    lines = [str(len(recording)) for recording in recordings]
    request.out.write_text("TRACK\\n" + "\\n".join(lines))
    return Exported(text="written", data={"recordings": len(lines)})

TRACK = Format(name="acme_track", title="an ACME track", begins=re.compile(rb"TRACK\\n"), suffixes=(".track",),
               read=read, read_options=("fps",), write="acme:write", many=True)
"""


@pytest.fixture
def install(install_package: Callable[..., None]) -> Callable[..., None]:
    def installed(package: str, entries: Mapping[str, str], source: str) -> None:
        install_package(package, "h3data.formats", entries, source)

    return installed


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def test_the_built_in_table_is_sound() -> None:
    assert len({one.name for one in BUILT_IN}) == len(BUILT_IN)
    assert list(export_options()) == [
        "gfx-replay",
        "rosbag2",
        "habitat-episodes",
        "csv",
        "foxglove",
        "gltf",
        "lerobot",
        "minari",
        "robomimic",
    ]
    for one in FORMATS.load_all().values():
        for field in ("read", "write"):
            if getattr(one, field) is not None:
                assert callable(load(one, field))  # its module exists
        for reference in re.findall(r"h3data_habitat\.[\w.]+", one.hint):
            module, _, name = reference.rpartition(".")
            assert callable(load_reference(f"{module}:{name}"))


def test_a_plug_in_is_detected_imported_and_exported_to(
    install: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    install("acme", {"acme_track": "acme:TRACK"}, SOURCE)
    (tmp_path / "in").mkdir()
    file = tmp_path / "in" / "walk.track"
    file.write_text("TRACK\n1\n2\n3\n")
    assert detect(file).title == "an ACME track"
    with pytest.raises(FormatError, match=r"(?s)ACME track\. Hint: `h3data import.*H3-RECORDING-048"):
        h3data.open(file)
    data = run_json(capsys, "import", tmp_path / "in", "-o", tmp_path / "rec", "--fps", "10")
    assert [(row["kind"], row["steps"]) for row in data["files"]] == [("acme_track", 3)]
    recording = h3data.open(data["files"][0]["recording"])
    assert recording.columns["time_ns"].tolist() == [0, 100_000_000, 200_000_000]
    out = tmp_path / "again.track"
    assert run_json(capsys, "export", tmp_path / "rec", "--to", "acme-track", "-o", out)["recordings"] == 1
    assert out.read_text() == "TRACK\n3"
    run_json(capsys, "export", tmp_path / "rec", "--to", "acme:TRACK", "-o", out, "--force")
    assert "acme-track" in run_json(capsys, "export", "a", "--to", "acme-trak", "-o", "b", code=2)["error"]
    with pytest.raises(SystemExit):
        main(["export", "--help"])
    assert "acme-track" in capsys.readouterr().out


BROKEN = {
    "not importable": ("1 / 0", "cannot be imported: ZeroDivisionError"),
    "another type": ("BAD = 3", r"expected an h3data.formats.Format, got int"),
    "unknown field": (
        "from h3data.formats import Format\nBAD = Format(name='bad', title='a bad file', reads=print)",
        "unexpected keyword argument 'reads'",
    ),
    "neither reads nor writes": (
        "from h3data.formats import Format\nBAD = Format(name='bad', title='a bad file')",
        "one of the fields 'read' and 'write' must be given",
    ),
    "no title": ("from h3data.formats import Format\nBAD = Format(name='bad', title='', read=print)", "field 'title'"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_plug_in_is_named_and_the_others_go_on_working(
    install: Callable[..., None], tmp_path: Path, case: str
) -> None:
    source, reason = BROKEN[case]
    install("broken", {"bad": "broken:BAD"}, source)
    install("acme", {"acme_track": "acme:TRACK"}, SOURCE)
    file = tmp_path / "walk.track"
    file.write_text("TRACK\n1\n")
    named = r"'bad' \(entry point broken:BAD of the group h3data.formats, installed by broken 1.2\).*" + reason
    with pytest.warns(PluginWarning, match=named):
        assert detect(file).name == "acme_track"
    with pytest.raises(PluginError, match=f"(?s){named}.*H3-FILE-01[56]"):
        FORMATS.get("bad")


def test_a_reader_that_cannot_be_imported_is_named_with_its_field(install: Callable[..., None], tmp_path: Path) -> None:
    install("acme", {"acme_track": "acme:TRACK"}, SOURCE.replace("read=read", "read='acme.nowhere:read'"))
    named = r"(?s)'read'.*'acme_track' \(entry point.*acme 1\.2\).*acme\.nowhere.*H3-FORMAT-007"
    with pytest.raises(PluginError, match=named):
        load(FORMATS.get("acme_track"), "read")


def test_a_check_that_fails_is_named_and_skipped(install: Callable[..., None], tmp_path: Path) -> None:
    source = SOURCE.replace("begins=", "members=lambda members, name: members['nothing'], begins=")
    install("acme", {"acme_track": "acme:TRACK"}, source)
    (tmp_path / "x.json").write_text('{"a": 1}')
    with pytest.warns(PluginWarning, match=r"installed by acme 1\.2.*'members' fails with KeyError"):
        assert detect(tmp_path / "x.json").name == "json"


def test_built_in_formats_keep_their_files(install: Callable[..., None], tmp_path: Path) -> None:
    greedy = SOURCE.replace('begins=re.compile(rb"TRACK\\n")', "members=lambda members, name: True")
    assert "lambda" in greedy
    install("acme", {"acme_track": "acme:TRACK"}, greedy)
    (tmp_path / "a.json").write_text('{"keyframes": []}')
    (tmp_path / "b.json").write_text('{"mine": 1}')
    assert [detect(tmp_path / name).name for name in ("a.json", "b.json")] == ["gfx_replay", "acme_track"]


def test_options_that_a_format_does_not_take_name_those_that_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = {"time_ns": np.arange(3, dtype=np.int64)}
    write_mcap(
        Recording(episode=Episode(uid="u", episode_id="x", task="t", scene=""), columns=times), tmp_path / "a.mcap"
    )
    options = ("export", tmp_path / "a.mcap", "--to", "csv", "-o", tmp_path / "t", "--agent", "robot")
    assert "not for csv, but for lerobot and minari and robomimic" in run_json(capsys, *options, code=2)["error"]


def test_a_file_is_read_from_disk_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "x.gfx_replay.json"
    file.write_text('{"keyframes":[{"loads":[]},' + ",".join(["{}"] * 2000) + "]}")
    opened: list[Path] = []
    path_open = Path.open
    monkeypatch.setattr(Path, "open", lambda path, *a, **o: opened.append(path) or path_open(path, *a, **o))
    for chunk_bytes in (100, 1 << 20):
        opened.clear()
        source = SourceFile(file, chunk_bytes=chunk_bytes)
        assert len(load(detect(source), "read")(source)) == 2001
        assert opened == [file]
        assert b"".join(source.chunks()) == source.data == file.read_bytes()


def test_the_name_of_a_format_is_its_option() -> None:
    assert Format(name="my_log", title="a log").option == "my-log"
    with pytest.raises(InputError, match=r"(?s)file format 'nothing'.*H3-FILE-011"):
        FORMATS.get("nothing")
