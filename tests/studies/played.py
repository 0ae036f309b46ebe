"""A study that has been played, without server or browser: by people who let the simulator lead."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from h3data_play.live import EpisodeFactory, LiveGame
from h3data_play.messages import Act, Pick, Place
from h3data_studies.commands.running import keep_design
from h3data_studies.design import StudyPlan
from h3data_studies.files import make_plan, read_design, study_folder
from h3data_studies.orders import game_key, order_of, row_of
from h3data_studies.pseudonyms import read_key, recruit_ids
from h3data_studies.store import Participant, StudyStore
from tests.studies.test_flow import DEVICE
from tests.studies.tiny import write_tiny

NOTHING = {"text": 'It said "no", twice', "number": 30}


def pid(number: int) -> str:
    """The id of somebody at the recruiting platform."""
    return f"5f00000000000000000000{number:02x}"


def play_study(root: Path, people: int = 2, *, unfinished: int = 0, **changes: Any) -> Path:
    """Plays the tiny study: ``people`` to the end, ``unfinished`` more up to their first episode; returns the study file."""
    path = write_tiny(root, tutorial={"skip": True}, **changes)
    design = read_design(path)
    folder = study_folder(path, design)
    folder.mkdir()
    plan = make_plan(design, folder)
    keep_design(folder, design)
    key, store = read_key(Path(plan.key_file)), StudyStore(plan.design, plan.places, folder)
    tables: dict[int, EpisodeFactory] = {}
    for number in range(people + unfinished):
        ids = recruit_ids({"PROLIFIC_PID": pid(number), "SESSION_ID": f"session{number}"}, key)
        place = store.free_place()
        assert place is not None
        consent = {"version": "1", "sha256": "0" * 64}
        person = store.join(ids["PROLIFIC_PID"], place, language="en", consent=consent, ids=ids)
        store.move(person, f"token{number}")
        store.save(person, person.progress.device({**DEVICE, "browser": "bot"}))
        while person.progress.stage.kind != "end" and not (number >= people and person.progress.done > 1):
            do_next(store, plan, person, tables, answer=number)
    store.close(done=False)
    return path


def do_next(
    store: StudyStore, plan: StudyPlan, person: Participant, tables: dict[int, EpisodeFactory], answer: int
) -> None:
    """Does what comes next for a participant."""
    progress = person.progress
    if progress.stage.kind == "form":
        answers = {
            i.id: NOTHING.get(i.kind, i.min + i.step * min(answer, 2) if i.kind == "scale" else 0)
            for i in progress.form.items
        }
        store.save(person, progress.answer(progress.stage.form, answers))
        return
    key = game_key(person, progress.stage)
    order = order_of(plan, person, key)
    game, journal = (
        tables.setdefault(order.plan, EpisodeFactory(plan.plans[order.plan])).begin(order),
        store.begin_episode(person, key),
    )
    store.assign(store.seats[next(iter(s.sid for s in store.seats.values() if s.place == person.number))], journal)
    finish(game)
    result = {"ended": game.ended or "closed", "steps": len(game.session.recorder), "slipped": 0, "step_ms": 1.0}
    game.close()
    store.end(journal, result["ended"])
    store.save(person, progress.over(row_of(key), result))


def finish(game: LiveGame) -> None:
    """Brings all things to their places, or waits for the end."""
    (number,) = game.drivers
    for k, goal in enumerate(game.app.goals()):
        for message in (Pick(o=k, lead=True), Place(p=goal.position, lead=True)):
            act(game, number, message)
    while not game.ended:
        game.step()


def act(game: LiveGame, number: int, message: Act) -> None:
    """Does one thing to its end."""
    if game.ended:
        return
    game.take(number, message, msgspec.json.encode(message).decode(), 0.0)
    game.step()
    while not game.ended and game.drivers[number].busy:
        game.step()
