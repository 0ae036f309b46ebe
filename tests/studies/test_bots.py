"""Scripted participants play a whole study from the command line, and are labelled as what they are."""

from __future__ import annotations

import asyncio
import json
import sqlite3
import struct
from collections.abc import AsyncIterator
from contextlib import closing
from pathlib import Path

import aiohttp
import pytest

from h3data.recording import read_mcap
from h3data_pipelines.cli import main
from h3data_studies.bots.client import HEAD, STATE, Client, Thing
from h3data_studies.bots.participant import SAID
from sim_kinematic.tasks.resume import verify
from tests.studies.tiny import TINY, write_tiny


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, object]:
    assert main(["study", "bots", *arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_bots_play_a_whole_study_and_go_on_where_they_were(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    study = write_tiny(
        tmp_path,
        forms=[
            *TINY["forms"],
            {
                "id": "more",
                "after": "end",
                "items": [
                    {"id": "words", "text": "Anything else?", "kind": "text"},
                    {"id": "games", "text": "Games?", "kind": "choice", "options": ["Never", "Often"]},
                ],
            },
        ],
    )
    first = said(capsys, str(study), "--participants", "1")
    folder = tmp_path / "tiny-1-bots"
    assert first["statuses"] == {"complete": 1}
    assert first["folder"] == str(folder)
    assert not (tmp_path / "tiny-1").exists(), "no place of the study is taken"
    files = sorted((folder / "recordings").glob("*.mcap"))
    assert len(files) == 2
    for file in files:
        recording = read_mcap(file)
        hitl = recording.episode.info["hitl"]
        assert hitl["client"]["browser"] == "bot"
        assert hitl["speed"] == 0
        assert recording.episode.info["ended"] == "success"
        assert verify(recording).difference is None
    assert main(["info", str(files[0])]) == 0
    assert "human (a bot, clock as fast as the machine): " in capsys.readouterr().out
    assert main(["study", "report", str(folder)]) == 0
    assert "1 of 1 participant" in capsys.readouterr().out
    second = said(capsys, str(study), "--participants", "2", "--workers", "2")
    assert second["statuses"] == {"complete": 2}
    assert second["episodes"]["success"] == 2, "the first one has nothing left to play"  # type: ignore[index]
    with closing(sqlite3.connect(folder / "study.sqlite")) as database:
        rows = database.execute("select data from rows where stage like 'form/%more'").fetchall()
    assert [json.loads(row[0])["answers"]["words"] for row in rows] == [SAID] * 2


def test_there_are_no_more_bots_than_places(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["study", "bots", str(write_tiny(tmp_path)), "--participants", "5"]) == 2
    assert "--participants from 1 to 4" in capsys.readouterr().err
    assert not (tmp_path / "tiny-1-bots").exists()


def test_states_with_things_of_chores_are_read() -> None:
    bot = Client("http://127.0.0.1:1/")
    bot.manifest, bot.things = {"agents": []}, [Thing(), Thing()]
    objects = [struct.pack("<Hh7f", k, 0, *[1.0] * 7) for k in (1, 2)]  # the second comes after the objects
    bot._state(HEAD.pack(STATE, 0, 0, len(objects), 7, -1, 0.0) + b"".join(objects))
    assert [thing.held for thing in bot.things] == [-1, 0]
    assert bot.step == 7


def test_what_a_bot_cannot_read_is_raised_and_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    async def waits() -> None:
        async with Client("http://127.0.0.1:1/") as bot:
            monkeypatch.setattr(bot.http, "ws_connect", connects)
            bot.manifest = {"objects": [], "joints": []}
            await bot.connect()
            await bot.until(lambda: False)

    class Damaged:
        """A socket whose only message is no JSON."""

        async def __aiter__(self) -> AsyncIterator[aiohttp.WSMessage]:
            yield aiohttp.WSMessage(aiohttp.WSMsgType.TEXT, "{", None)

        async def close(self) -> None: ...

    async def connects(*_: object, **__: object) -> Damaged:
        return Damaged()

    with pytest.raises(json.JSONDecodeError):
        asyncio.run(waits())
