"""Files appear whole or not at all."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from h3data.errors import InputError
from h3data.files import part_file, spreadsheet_cell


@pytest.mark.parametrize("shared", [False, True])
def test_a_file_appears_when_it_is_complete(tmp_path: Path, shared: bool):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with part_file(path, shared=shared) as part:
        part.write_bytes(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_leaves_what_was_there(tmp_path: Path, shared: bool, error: type[BaseException]):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(error), part_file(path, shared=shared) as part:  # noqa: PT012
        part.write_bytes(b"half")
        raise error
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a.bin", b"old")]


def test_two_writers_of_a_shared_file_do_not_meet(tmp_path: Path):
    path = tmp_path / "cache"
    with part_file(path, shared=True) as first:
        with part_file(path, shared=True) as second:
            assert first != second
            second.write_text("second")
        first.write_text("first")
    assert path.read_text() == "first"


@pytest.mark.parametrize("names_it", [True, False])
def test_the_operating_system_names_the_file_that_was_asked_for(tmp_path: Path, names_it: bool):
    with pytest.raises(OSError, match="No space left") as caught, part_file(tmp_path / "a.rrd") as part:
        raise OSError(errno.ENOSPC, "No space left on device", *([str(part)] if names_it else []))
    assert caught.value.filename == str(tmp_path / "a.rrd")
    with pytest.raises(FileNotFoundError) as other, part_file(tmp_path / "a.rrd"):
        (tmp_path / "source").read_bytes()
    assert other.value.filename == str(tmp_path / "source")


def test_a_missing_folder_is_named(tmp_path: Path):
    with pytest.raises(InputError, match=r"(?s)nowhere.*H3-FILE-009"), part_file(tmp_path / "nowhere" / "a"):
        pass


@pytest.mark.parametrize(
    "text", ["=1+1", "+1+1", "-2+3", "@SUM(A1)", "\tx", "\rx", "  =A1", "\uff1dA1", "-", "-1-1", "+49 30 1234", "\n=1"]
)
def test_no_spreadsheet_runs_a_cell(text: str):
    assert spreadsheet_cell(text) == f"'{text}"


@pytest.mark.parametrize(
    "value", ["-1", "+2.5", "-1e-05", " -3 ", "-.5", "-inf", "a=b", "", "5", "Wir = eins", -3.5, 0, None, True]
)
def test_numbers_and_other_words_stay_as_they_are(value: object):
    assert spreadsheet_cell(value) is value
