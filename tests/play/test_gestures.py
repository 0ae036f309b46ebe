"""Players who wave and look at a phone: the hand goes where the gesture has it, and free again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import h3data
from h3data.bodies.people.reach import hand_points
from h3data_play.drivers import OFFER_STEPS, WAVES, PersonDriver
from h3data_play.messages import Gesture, Sit, decode
from h3data_play.wire import GESTURES, LIES, SEATED, SITS
from sim_kinematic.agents.driven.commands import Sit as Seat
from sim_kinematic.agents.skills import sentence
from sim_kinematic.crowd.seating import Seats
from sim_kinematic.policies.policy import External
from sim_kinematic.tasks.resume import verify


@pytest.fixture
def driver() -> PersonDriver:
    session = h3data.session("rearrange", "small:1", agents={"person": External(), "robot": "still"}, seed=2)
    number = next(k for k, agent in enumerate(session.episode.roster) if agent.kind == "human")
    return PersonDriver(session, number)


def played(driver: PersonDriver, steps: int) -> np.ndarray:
    """Heights of the right palm above the floor [T]."""
    heights = []
    for _ in range(steps):
        command = driver.command()
        if command is not None:
            driver.session.act("person", command)
        driver.session.step()
        columns = driver.session.recorder.latest_columns()
        prefix = f"agent_{driver.number}."
        body: Any = driver.body.person.body
        frames = body.joint_matrices_free(columns[prefix + "root_pose"][-1:], columns[prefix + "joint_quat"][-1:])
        heights.append(hand_points(frames, body)[0, 1])
    return np.array(heights)


def test_a_wave_raises_the_hand_and_ends(driver: PersonDriver) -> None:
    assert driver.follow(Gesture(name="wave")) == ""
    heights = played(driver, round(30 * (0.9 * WAVES + 1.5)))
    assert heights.max() - heights[0] > 0.5
    assert driver.gesture == ""
    assert abs(heights[-1] - heights[0]) < 0.1
    assert verify(driver.session.close()).difference is None


def test_a_phone_stays_until_the_same_key_or_full_hands(driver: PersonDriver, monkeypatch: pytest.MonkeyPatch) -> None:
    driver.follow(Gesture(name="phone"))
    heights = played(driver, 90)
    assert heights[60:].min() > heights[0] + 0.2
    driver.follow(Gesture(name="phone"))
    assert played(driver, 40)[-1] < heights[0] + 0.1
    monkeypatch.setattr(type(driver.objects), "held", lambda *_: 0)
    assert driver.follow(Gesture(name="wave")) == sentence("hand_full")
    assert driver.gesture == ""


def test_only_postures_that_are_possible_are_offered(driver: PersonDriver, monkeypatch: pytest.MonkeyPatch) -> None:
    played(driver, 2)
    assert driver.offers == SITS | LIES | GESTURES, "small:1 has a bed near its start"
    driver.follow(Sit(lies=True))
    assert driver.session.refusal("person", Seat(lies=True)) is None
    played(driver, 3)
    assert driver.offers == 0, "a body that is led has no buttons"
    while driver.body.seat is None:
        played(driver, 1)
    assert driver.offers == SEATED
    driver.follow(Sit())
    while driver.busy:
        played(driver, 1)
    monkeypatch.setattr(driver.body.seats, "nearest", lambda *_args, **options: None if options["lies"] else ...)
    played(driver, OFFER_STEPS)
    assert driver.offers == SITS | GESTURES
    monkeypatch.setattr(type(driver.objects), "held", lambda *_: 0)
    assert driver.offers == 0


def test_messages_name_what_they_want() -> None:
    assert decode('{"k": "sit", "lies": true}') == Sit(lies=True)
    assert decode('{"k": "gesture", "name": "phone"}') == Gesture(name="phone")
    with pytest.raises(Exception, match="name"):
        decode('{"k": "gesture", "name": "juggle"}')


def test_seats_that_were_searched_before_give_the_same_answers(driver: PersonDriver) -> None:
    known, rng = driver.body.seats, np.random.default_rng(5)
    assert known is not None
    low, high = 0.0, 8.0
    for _ in range(12):
        xz, lies = rng.uniform(low, high, 2), bool(rng.integers(2))
        other = np.array([*rng.uniform(low, high, 2), 0.0, 1.0])
        taken = [other] if rng.random() < 0.5 else []
        new = Seats(driver.session.episode.scene, driver.session.episode.free, driver.body.person.body)
        found, again = (seats.nearest(xz, taken, lies=lies) for seats in (new, known))
        assert (found is None) == (again is None)
        if found is not None and again is not None:
            assert found.seat.name == again.seat.name
            for was, now in ((found.before, again.before), (found.stand, again.stand), (found.lie, again.lie)):
                np.testing.assert_array_equal(was, now)
