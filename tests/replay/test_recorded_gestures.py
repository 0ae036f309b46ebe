"""Gestures in replay: they follow the recorded activities and change nothing that is recorded."""

from dataclasses import replace

import numpy as np
import pytest

import h3data
from h3data.bodies import JOINT_INDEX
from h3data.bodies.people.gestures import NAMES
from h3data.recording import Event
from h3data.replay import Replay
from h3data.replay.posed_recording import RAMP_S, recorded_gestures

HANDS = [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]]


@pytest.fixture(scope="module")
def recording() -> h3data.Recording:
    """A person who stands for four seconds."""
    return h3data.simulate("wander", "small:1", agents={"human": "still", "robot": "still"}, seed=1, max_steps=120)


def with_events(recording: h3data.Recording, *events: tuple[int, str, str]) -> h3data.Recording:
    return replace(
        recording, events=tuple(Event(step=step, agent=1, kind=kind, target=target) for step, kind, target in events)
    )


def test_hands_move_during_an_activity_and_rest_before_and_after(recording: h3data.Recording) -> None:
    cooks = with_events(recording, (30, "activity", "cook"), (90, "walks_to", "fridge_0"))
    gestures = recorded_gestures(cooks, 1)
    assert gestures is not None
    assert set(gestures[30:90, 0]) == {NAMES.index("cook")}
    assert not gestures[:31, 2].any()
    assert not gestures[90:, 2].any()
    assert gestures[30 + round(RAMP_S * 30) + 1 : 64, 2].min() == 1
    steps = np.arange(len(recording))
    apart = Replay(cooks).joint_matrices(1, steps)[:, HANDS] - Replay(recording).joint_matrices(1, steps)[:, HANDS]
    moved = np.abs(apart).max((1, 2, 3))
    assert not moved[:30].any()
    assert moved[60] > 0.2
    assert not moved[91:].any()
    assert not np.array_equal(
        Replay(cooks).joint_matrices(1, steps), Replay(cooks, stepping=False).joint_matrices(1, steps)
    )


def test_other_events_and_other_agents_have_no_gesture(recording: h3data.Recording) -> None:
    assert recorded_gestures(with_events(recording, (30, "activity", "look_out"), (31, "picks", "cook")), 1) is None
    assert recorded_gestures(with_events(recording, (30, "activity", "cook")), 0) is None
    last = recorded_gestures(with_events(recording, (119, "activity", "cook"), (119, "activity", "wash")), 1)
    assert last is not None
    assert not last[:, 2].any()


def test_who_sits_for_it_begins_on_the_seat(recording: h3data.Recording) -> None:
    share = np.clip(np.arange(len(recording)) / 60 - 0.5, 0, 1)
    columns = {
        **recording.columns,
        "agent_1.motion_seat": np.column_stack([np.full(len(share), 0.45), share]).astype("f4"),
    }
    reads = with_events(replace(recording, columns=columns), (10, "activity", "read"))
    gestures = recorded_gestures(reads, 1)
    assert gestures is not None
    assert not gestures[: np.argmax(share >= 1) + 1, 2].any()
    assert gestures[-1, 2] > 0.9
    columns["agent_1.motion_seat"][:, 1] *= 0.9
    waits = recorded_gestures(with_events(replace(recording, columns=columns), (10, "activity", "read")), 1)
    assert waits is not None
    assert not waits[:, 2].any()
