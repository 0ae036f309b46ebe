"""Two participants who play together: their places, their game, and what happens when one of them is gone."""

from __future__ import annotations

import asyncio
import csv
import json
import zipfile
from pathlib import Path
from typing import Any

import msgspec
import pytest

from h3data.errors import InputError
from h3data.recording import read_mcap
from h3data_pipelines.cli import main
from h3data_studies.design import Condition, Design
from h3data_studies.files import deal, make_plan, open_store, read_design
from h3data_studies.flow import COMPLETE, SCREENED_OUT, WITHDRAWN
from h3data_studies.orders import order_of
from h3data_studies.store import Participant as Person
from h3data_studies.store import StudyStore
from sim_kinematic.tasks.resume import verify
from tests.llm.scripted_endpoint import Served, call, chat_server
from tests.play.server import Server
from tests.studies.participant import Participant
from tests.studies.test_flow import DEVICE
from tests.studies.test_words import MODEL, documented
from tests.studies.tiny import as_toml, tiny, write_tiny

TOGETHER: dict[str, Any] = {
    "conditions": [
        {"name": "solo", "partner": "solo"},
        {"name": "together", "partner": "solo", "play_as": ["person", "person"]},
    ],
    "tutorial": {"skip": True},
    "forms": [],
}


def pairs(**changes: Any) -> Design:
    return tiny(**{**TOGETHER, **changes})


def open_pairs(folder: Path, **changes: Any) -> StudyStore:
    folder.mkdir(exist_ok=True)
    design = pairs(**changes)
    return StudyStore(design, deal(design), folder)


def join(store: StudyStore, number: int) -> Person:
    place = store.free_place()
    assert place is not None
    person = store.join(f"P-{number:010d}", place, language="en", consent={}, ids={})
    store.save(person, person.progress.device(DEVICE))
    return person


def play(store: StudyStore, *people: Person) -> None:
    pair = {"pair": [p.id for p in people]} if len(people) > 1 else {}
    for person in people:
        store.save(person, person.progress.over(person.progress.stage.key, {"ended": "success", "steps": 3, **pair}))


def come_together(store: StudyStore, *people: Person) -> None:
    """Plays alone what comes before the first episode that a pair plays."""
    for person in people:
        while not person.progress.is_shared(person.progress.stage.key):
            play(store, person)


def test_two_neighbours_are_dealt_the_same_and_an_odd_number_is_refused(tmp_path: Path) -> None:
    places = deal(pairs(participants=6, episodes=2))
    assert places[0::2] == places[1::2]
    assert len({place.blocks for place in places}) > 1
    with pytest.raises(InputError, match=r"(?s)even number of participants.*got 5.*H3-STUDY-051"):
        read_design(write_tiny(tmp_path, **{**TOGETHER, "participants": 5}))
    conditions = [{"name": "crowd", "play_as": ["person"] * 3}]
    with pytest.raises(InputError, match="H3-STUDY-032"):
        read_design(write_tiny(tmp_path / "crowd", **{**TOGETHER, "conditions": conditions}))
    study = write_tiny(tmp_path / "bots", **TOGETHER)
    assert main(["study", "bots", str(study), "--participants", "1"]) == 2


def test_people_among_themselves_are_not_asked_about_a_robot() -> None:
    assert Condition(name="a", play_as=["person", "person"]).is_solo
    assert not Condition(name="a", play_as=["person", "robot"]).is_solo
    assert not Condition(name="a", play_as=["person", "person"], partner="still").is_solo


def test_a_place_is_free_beside_somebody_who_has_not_played_with_anybody_yet(tmp_path: Path) -> None:
    store = open_pairs(tmp_path, participants=4, episodes=2)
    first, second = join(store, 1), join(store, 2)
    assert store.company(first) is second
    assert store.company(second) is first
    second.progress.end(WITHDRAWN, "asked")
    third = join(store, 3)
    assert (third.place, store.company(first)) == (1, third)
    come_together(store, first, third)
    game = store.begin_episode(first, f"{first.id}/{first.progress.stage.key}")
    assert store.players(game) == (first, third)
    assert store.shared_game(third) is game
    store.end(game, "success")
    play(store, first, third)
    assert first.progress.has_met
    third.progress.end(WITHDRAWN, "asked")
    assert join(store, 4).place == 2, "beside the first nobody can take up where the third has left"
    first.progress.end(SCREENED_OUT, "partner_left")
    assert join(store, 5).place == 0


def test_a_game_that_ended_as_the_server_was_killed_counts_for_both(tmp_path: Path) -> None:
    store = open_pairs(tmp_path)
    first, second = join(store, 1), join(store, 2)
    come_together(store, first, second)
    key = first.progress.stage.key
    store.end(store.begin_episode(first, f"{first.id}/{key}"), "limit")
    store.close(done=False)
    again = open_pairs(tmp_path)
    for person in again.participants.values():
        assert person.progress.rows[key] == {"ended": "limit", "pair": [first.id, second.id]}


def test_the_recording_of_two_names_both_and_goes_with_either(tmp_path: Path) -> None:
    store = open_pairs(tmp_path)
    first, second = join(store, 1), join(store, 2)
    come_together(store, first, second)
    plan = make_plan(pairs(), tmp_path)
    order = order_of(plan, first, f"{first.id}/{first.progress.stage.key}", second)
    block = first.progress.stage.block
    assert order.name == f"recordings/{first.id}_{second.id}_{block}-01"
    assert order.info["participant"] == f"{first.id}+{second.id}"
    assert order.info["participants"] == [first.id, second.id]
    play(store, first, second)
    key = f"episode/{block}/1"
    store.forget(second)
    assert first.progress.rows[key]["pair"] == [first.id, ""]
    store.close(done=False)
    assert second.id.encode() not in b"".join(path.read_bytes() for path in tmp_path.iterdir() if path.is_file())


async def one_leaves(link: str) -> list[Participant]:
    async with Participant(link) as first, Participant(link) as second:
        await first.join(PROLIFIC_PID="5f0000000000000000000aaa")
        if first.stage["block"] == 1 and first.stage["trial"] == 1 and await first.sit() == 200:
            await first.play()  # the condition solo came first
        assert await first.sit() == 503
        assert "not here yet" in str(first.told[-1])
        await second.join(PROLIFIC_PID="5f0000000000000000000bbb")
        while second.stage["block"] < first.stage["block"]:
            await second.play()
        await asyncio.gather(first.begin(), second.begin())
        assert {first.manifest["me"], second.manifest["me"]} == {0, 1}
        await first.until(lambda: first.states[-1][4] > 5)
        await second.send(k="leave")
        for person in (first, second):
            await person.until(lambda person=person: person.heard("over"))
            await person.ask("api/study")
        return [first, second]


@pytest.mark.slow
def test_who_stays_is_told_that_the_other_has_left(tmp_path: Path) -> None:
    folder = tmp_path / "tiny-1"
    plan = make_plan(pairs(recruiting={"screen_out_code": "S1"}), folder, speed=8.0)
    with Server(folder, {"study": msgspec.to_builtins(plan), "stays": True}) as server:
        first, second = asyncio.run(one_leaves(server.links[0]))
        assert server.stop() == 0
    assert (first.stage["status"], first.stage["reason"], first.stage["code"]) == (SCREENED_OUT, "partner_left", "S1")
    assert "has left the study" in first.stage["text"]
    assert second.stage["status"] == WITHDRAWN
    assert open_store(folder, pairs()).free_place() == 0


async def nobody_comes(link: str) -> Participant:
    async with Participant(link) as person:
        await person.join(PROLIFIC_PID="5f0000000000000000000aaa")
        while (status := await person.sit()) == 503:
            await asyncio.sleep(0.2)
        assert status == 410
        await person.ask("api/study")
        return person


@pytest.mark.slow
def test_nobody_waits_for_ever(tmp_path: Path) -> None:
    conditions = [{**TOGETHER["conditions"][1], "name": name} for name in ("a", "b")]
    changes: dict[str, Any] = {"conditions": conditions, "dropout": {"wait_minutes": 0.02}}
    folder = tmp_path / "tiny-1"
    with Server(folder, {"study": msgspec.to_builtins(make_plan(pairs(**changes), folder)), "stays": True}) as server:
        person = asyncio.run(nobody_comes(server.links[0]))
        assert server.stop() == 0
    assert (person.stage["status"], person.stage["reason"]) == (SCREENED_OUT, "no_partner")


def words_together(folder: Path, served: Served) -> Path:
    """The study in words of the page, with the conditions of two people, by one pair in a home of few things."""
    data = documented()
    conditions = [{**c, "partner": (c["partner"]).replace(MODEL, served.policy(plans=3))} for c in data["conditions"]]
    conditions = [c for c in conditions if c["name"] in ("solo", "together", "expert", "model")]
    for one in conditions:
        one["rules"] = {"template": "wash_and_put", "max_steps": 5000}
    changes = {"participants": 2, "episodes": 1, "scenes": ["h3-homes/val#3"], "conditions": conditions}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "study.toml"
    path.write_text(as_toml({**data, **changes, "tutorial": {"skip": True}, "retention": "2030-01-31"}))
    return path


def test_the_study_of_the_page_has_all_four_kinds_of_company(tmp_path: Path) -> None:
    design = msgspec.convert({**documented(), "retention": "2030-01-31"}, Design)
    assert {c.seats for c in design.conditions} == {("person",), ("person", "person")}
    assert {"solo", "language_expert"} <= {c.partner for c in design.conditions}
    assert any((c.partner or "").startswith("llm:") for c in design.conditions)


@pytest.mark.slow
def test_a_pair_of_bots_plays_a_study_alone_together_beside_an_expert_and_a_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with chat_server(lambda _: call("done")) as served:
        path = words_together(tmp_path, served)
        assert main(["study", "bots", str(path), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["statuses"] == {COMPLETE: 2}
    folder = tmp_path / "words-1-bots"
    files = sorted((folder / "recordings").glob("*.mcap"))
    assert len(files) == 3 * 2 + 1
    (shared,) = (file for file in files if file.name.count("P-") == 2)
    recording = read_mcap(shared)
    info = recording.episode.info
    assert info["condition"] == "together"
    assert info["ended"] == "success"
    assert [agent.kind for agent in recording.agents] == ["human", "human"]
    assert {event.user for event in recording.inputs if event.kind == "client"} == {0, 1}
    assert sorted(remark["agent"] for remark in info["hitl"]["remarks"]) == [0, 1]
    assert verify(recording).difference is None
    assert main(["study", "report", str(folder), "--pictures", "0"]) == 0
    rows = list(csv.DictReader((folder / "report" / "trials.csv").read_text().splitlines()))
    together = [row for row in rows if row["condition"] == "together"]
    assert len(together) == 2
    assert {row["recording"] for row in together} == {f"recordings/{shared.name}"}
    assert {row["PC"] for row in together} == {"1.0"}
    one, other = (row["participant"] for row in together)
    assert main(["study", "data", str(folder), other, "-o", str(tmp_path / "own.zip")]) == 0
    with zipfile.ZipFile(tmp_path / "own.zip") as archive:
        assert f"recordings/{shared.name}" in archive.namelist()
    assert main(["study", "forget", str(folder), other]) == 0
    left = list((folder / "recordings").iterdir())
    assert len(left) == 3
    assert all(file.name.startswith(f"{one}_") for file in left)
