"""Progress of long work: a bar on a terminal, lines off it, nothing when quiet."""

from __future__ import annotations

import io
from contextlib import redirect_stderr

import pytest

from h3data import progress as progress_module
from h3data.progress import QUIET, progress


class Stream(io.StringIO):
    """Stands in for stderr."""

    terminal = False

    def isatty(self) -> bool:
        return self.terminal


def test_off_a_terminal_long_work_prints_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress_module, "LINE_EVERY_S", 0.0)
    with redirect_stderr(Stream()) as log:
        assert list(progress([1, 2, 3], desc="simulate", unit="episode")) == [1, 2, 3]
    lines = log.getvalue().splitlines()
    assert [line.partition(",")[0] for line in lines] == [f"simulate: {n} of 3 episodes" for n in (0, 1, 2, 3)]
    assert [line.endswith(" left") for line in lines] == [False, False, True, True]  # nothing is foretold from one unit


def test_off_a_terminal_short_work_prints_nothing() -> None:
    with redirect_stderr(Stream()) as log:
        assert list(progress(range(100), desc="simulate", unit="episode")) == list(range(100))
    assert log.getvalue() == ""


def test_quiet_prints_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress_module, "LINE_EVERY_S", 0.0)
    monkeypatch.setenv(QUIET, "1")
    with redirect_stderr(Stream()) as log, progress(desc="simulate", unit="step", total=2) as bar:
        bar.update()
        bar.update()
    assert log.getvalue() == ""


def test_a_bar_on_a_terminal() -> None:
    stream = Stream()
    stream.terminal = True
    with redirect_stderr(stream):
        assert list(progress([1, 2], desc="a\x1b[2J", unit="step")) == [1, 2]
    assert "100%" in stream.getvalue()
    assert "\x1b[2J" not in stream.getvalue()


def test_no_line_is_written_again() -> None:
    # pitfall: from 2 skipped units on, a thread of tqdm writes the last line again every ten seconds, estimate and all
    with redirect_stderr(Stream()), progress(range(100), desc="render", unit="frame") as bar:
        assert bar.miniters == 1
        assert not bar.dynamic_miniters


def test_kernels_are_not_announced_between_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    from h3data.kernels import decorators

    monkeypatch.delenv(QUIET, raising=False)
    for begun in (False, True):
        progress_module.BEGUN.clear()
        said: list[str] = []
        monkeypatch.setattr(decorators._log, "info", said.append)
        monkeypatch.setattr(decorators._log, "hasHandlers", lambda: True)
        monkeypatch.setattr(decorators.socket.socket, "bind", lambda *_: None)
        if begun:
            with redirect_stderr(Stream()):
                progress(range(3), desc="render", unit="frame").display()
        decorators._announce.__wrapped__()
        assert said == ([] if begun else [decorators.ANNOUNCEMENT])
