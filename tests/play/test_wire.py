"""States as bytes: the golden file that the TypeScript decoder is tested with, rounding, what is left out."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import Humanoid
from h3data.geometry import IDENTITY_POSE
from h3data.recording.records import Columns
from h3data.replay import Replay
from h3data_homes import HomeSpec, build_home
from h3data_play.messages import Leave, Move, Pick, decode
from h3data_play.wire import _OTHERS, StatePacker, pack_rotations
from tests.play import golden
from tests.simulated import simulate_wander


def unpack_rotations(data: bytes) -> np.ndarray:
    """As `web/src/link/wire.ts` does it."""
    bits = np.frombuffer(data, "<u4")
    largest = bits >> 30
    levels = (bits[:, None] >> np.array([20, 10, 0], np.uint32)) & 1023
    small = (levels / 511.5 - 1) / np.sqrt(2)
    quats = np.zeros((len(bits), 4))
    rows = np.arange(len(bits))
    quats[rows[:, None], _OTHERS[largest]] = small
    quats[rows, largest] = np.sqrt(np.maximum(1 - (small**2).sum(1), 0))
    return quats


def test_states_are_the_golden_ones_to_the_byte():
    stored = json.loads(golden.FILE.read_text(encoding="utf-8"))
    assert golden.golden() == stored
    first, second, third, fourth, fifth = (bytes.fromhex(state["bytes"]) for state in stored["states"])
    assert [data[3] for data in (first, second, third)] == [3, 0, 1], "after the first, objects that moved"
    assert len(first) == 16 + (12 + 2 * 20) + (12 + 28 + 84) + 3 * 32
    assert struct.unpack_from("<Ii", second, 4) == (2, 0)
    assert len(fourth) == len(first) + 3 * 6, "all doors and drawers"
    assert fifth[len(second) :] == struct.pack("<Hf", 1, 0.25), "the one that has moved"


def test_drawn_in_arms_are_where_a_replay_has_them():
    recording = simulate_wander(build_home(HomeSpec(preset="small", seed=5)), "human", seed=3, steps=2)
    arms = np.ones((len(recording), 2), np.float32)
    recording = replace(recording, columns={**recording.columns, "agent_0.motion_arms": arms})
    replay = Replay(recording)
    body = replay.model(0)
    assert isinstance(body, Humanoid)
    first = {name: column[:1] for name, column in recording.columns.items()}
    base = first["agent_0.base_pose"][0].astype(np.float64)
    live = StatePacker(recording, (body,), replay.scene)._pose(0, body, base, Columns(first))
    pelvis, quats = live[0], np.concatenate([live[0][None, 3:], live[1]])
    ours = body.joint_matrices(IDENTITY_POSE[None], quats[None], pelvis[None, :3])
    np.testing.assert_allclose(ours[0], replay.joint_matrices(0, np.array([0]))[0], atol=1e-6)


def test_rotations_lose_less_than_a_quarter_of_a_degree():
    quats = np.random.default_rng(0).normal(size=(10_000, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    back = unpack_rotations(pack_rotations(quats))
    degrees = np.degrees(2 * np.arccos(np.minimum(np.abs((quats * back).sum(1)), 1)))
    assert degrees.max() < 0.25


def test_what_players_may_say():
    assert decode('{"k":"move","f":1,"t":-0.5,"seq":3,"step":9,"ct":1.5,"rtt":20}') == Move(
        f=1.0, t=-0.5, seq=3, step=9, ct=1.5, rtt=20.0
    )
    assert decode('{"k":"pick","o":1,"more":"is ignored"}') == Pick(o=1)
    assert decode('{"k":"leave"}') == Leave()


NO_MESSAGES = [
    "",
    "x",
    "[]",
    "null",
    "{}",
    '{"k":"cheat"}',
    '{"k":"move","f":NaN}',
    '{"k":"move","f":1e400}',
    '{"k":"move","f":1.5}',
    '{"k":"move","f":"1"}',
    '{"k":"move","seq":-1}',
    '{"k":"move","seq":2147483648}',
    '{"k":"pick"}',
    '{"k":"pick","o":-1}',
    '{"k":"pick","o":1.5}',
    '{"k":"open"}',
    '{"k":"close","j":-1}',
    '{"k":"open","j":"fridge"}',
    '{"k":"place","p":[0,0]}',
    '{"k":"place","p":[0,1e200,0]}',
    '{"k":"hand","side":"middle","p":[0,0,0]}',
    '{"k":"hand","side":"left","p":[0,1e200,0]}',
    '{"k":"head","yaw":1e9,"pitch":0}',
    '{"k":"ping"}',
    '{"k":' * 500,
]


@pytest.mark.parametrize("text", NO_MESSAGES)
def test_what_is_no_message(text: str):
    import msgspec

    with pytest.raises(msgspec.MsgspecError):
        decode(text)


@settings(max_examples=300, deadline=None)
@given(
    st.text(max_size=60)
    | st.dictionaries(
        st.sampled_from(["k", "f", "t", "p", "o", "seq"]),
        st.none()
        | st.floats()
        | st.integers()
        | st.sampled_from(["move", "pick", "goto", "hand"])
        | st.lists(st.floats(), max_size=4),
    ).map(json.dumps)
)
def test_anything_else_is_refused_cleanly(text: str):
    import contextlib

    import msgspec

    with contextlib.suppress(msgspec.MsgspecError, UnicodeEncodeError):
        message = decode(text)
        assert all(abs(v) <= 1000 for v in (getattr(message, "f", 0), getattr(message, "t", 0)))
