"""Planning of a study with people: balanced orders of conditions, and a session manifest per participant."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from h3data.errors import FormatError, InputError
from h3data.files import part_file


@dataclass(frozen=True, kw_only=True)
class Block:
    """Consecutive episodes of a participant under one condition in one scene."""

    condition: str
    scene: str
    episodes: tuple[str, ...]
    """Ids of the episodes, in order."""


@dataclass(frozen=True, kw_only=True)
class Session:
    """Plan of one participant's session, which is stored as a manifest: training episodes, then the blocks."""

    study: str
    participant: str
    """Anonymous id of the participant."""
    training: tuple[str, ...]
    """Ids of uncounted episodes in the first block's scene; no later episode repeats them."""
    blocks: tuple[Block, ...]
    format: Literal["h3data/session@1"] = "h3data/session@1"


def latin_square(conditions: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Return N orders of ``conditions`` (2 N if N is odd), balanced for position and for the preceding condition.

    Each condition occurs equally often at each position, and follows each other condition equally often (J. V. Bradley
    1958, "Complete Counterbalancing of Immediate Sequential Effects in a Latin Square Design").
    """
    count = len(conditions)
    if count < 2 or len(set(conditions)) != count:
        raise InputError(f"Expected two or more different conditions, got {list(conditions)}.", code="H3-METRIC-033")
    zigzag = [(k + 1) // 2 if k % 2 else (count - k // 2) % count for k in range(count)]  # 0 1 n-1 2 n-2 ...
    rows = [[(k + shift) % count for k in zigzag] for shift in range(count)]
    if count % 2:
        rows += [row[::-1] for row in rows]
    return tuple(tuple(conditions[k] for k in row) for row in rows)


def plan_sessions(
    participants: int | Sequence[str],
    conditions: Sequence[str],
    episodes: Mapping[str, Sequence[str]],
    *,
    episodes_per_condition: int = 10,
    training_episodes: int = 1,
    study: str = "study",
    seed: int = 0,
) -> tuple[Session, ...]:
    """Return one session per participant, with every condition once in one scene and without repeated episodes.

    Orders come from `latin_square` in turn, so they balance whenever the number of participants is a multiple of
    theirs. Scenes rotate over participants and conditions: participant and scene are crossed, not nested. The
    assignment of orders and episodes to participants is random with ``seed``.

    Args:
        participants: Ids (see `h3data.pseudonyms.anonymous_id`), or a number of participants (ids P01, P02, ...).
        conditions: Names of conditions, such as solo, learn_single, plan_pop3.
        episodes: Episode ids by scene.
        episodes_per_condition: Episodes of each block.
        training_episodes: Episodes before the first block, in its scene.
        study: Name of the study in the manifests.
        seed: The same seed gives the same plan.

    Raises:
        InputError: an id occurs twice, or a scene has too few episodes.
    """
    if isinstance(participants, int):
        width = max(2, len(str(participants)))
        people = [f"P{k:0{width}d}" for k in range(1, participants + 1)]
    else:
        people = list(participants)
    if not people or len(set(people)) != len(people):
        raise InputError(f"Expected different participants, one or more, got {people}.", code="H3-METRIC-034")
    if not episodes or episodes_per_condition < 1 or training_episodes < 0:
        raise InputError(
            "Expected at least one scene, one episode per condition, and no negative number of training episodes.",
            code="H3-METRIC-035",
        )
    for scene, ids in episodes.items():
        if len(set(ids)) != len(ids):
            raise InputError(f"Scene {scene!r} holds the same episode id twice.", code="H3-METRIC-038")
    # a single condition has one order, which is no Latin square
    orders = latin_square(conditions) if len(conditions) != 1 else (tuple(conditions),)
    scenes = list(episodes)
    cycle = math.lcm(len(orders), len(scenes))
    random = np.random.default_rng(seed)
    dealt = random.permutation(len(people)).tolist()
    sessions: dict[str, Session] = {}
    for turn, who in enumerate(dealt):
        left: dict[str, list[str]] = {
            scene: [str(e) for e in random.permutation(list(ids))] for scene, ids in episodes.items()
        }
        order = orders[turn % len(orders)]
        # Shifting by one after each cycle combines every order with every scene.
        offset = turn + turn // cycle
        places = [scenes[(offset + conditions.index(c)) % len(scenes)] for c in order]
        training = _take(left, places[0], training_episodes)
        blocks = tuple(
            Block(condition=c, scene=scene, episodes=_take(left, scene, episodes_per_condition))
            for c, scene in zip(order, places, strict=True)
        )
        name = people[who]
        sessions[name] = Session(study=study, participant=name, training=training, blocks=blocks)
    return tuple(sessions[name] for name in people)


def study_rows(sessions: Sequence[Session]) -> dict[str, list[str] | list[int]]:
    """Return columns with one row per planned episode: participant, condition, scene, episode, block and trial."""
    rows = [
        (s.participant, b.condition, b.scene, e, k + 1, sum(len(x.episodes) for x in s.blocks[:k]) + j + 1)
        for s in sessions
        for k, b in enumerate(s.blocks)
        for j, e in enumerate(b.episodes)
    ]
    names = ("participant", "condition", "scene", "episode", "block", "trial")
    return {name: list(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}  # type: ignore[misc]


def write_sessions(sessions: Sequence[Session], folder: str | os.PathLike[str]) -> list[Path]:
    """Write a manifest ``<participant>.json`` per session to a folder, which is created, and return the paths."""
    import msgspec

    paths = [Path(folder) / f"{s.participant}.json" for s in sessions]
    bad = [s.participant for s in sessions if Path(s.participant).name != s.participant]
    if bad:
        raise InputError(
            f"A participant's id becomes a file name, which {bad[0]!r} cannot. Hint: use anonymous_id.",
            code="H3-METRIC-036",
        )
    Path(folder).mkdir(parents=True, exist_ok=True)
    for session, path in zip(sessions, paths, strict=True):
        with part_file(path) as part:
            part.write_bytes(msgspec.json.format(msgspec.json.encode(session), indent=2) + b"\n")
    return paths


def read_session(path: str | os.PathLike[str]) -> Session:
    """Read the session manifest at ``path``."""
    import msgspec

    try:
        return msgspec.json.decode(Path(path).read_bytes(), type=Session)
    except OSError as error:
        raise InputError(
            f"Cannot read the session manifest: {error.strerror}. File: {path}", code="H3-METRIC-039"
        ) from error
    except msgspec.DecodeError as error:
        raise FormatError(
            f"Expected a session manifest (h3data/session@1): {error}. File: {path}", code="H3-METRIC-040"
        ) from error


def _take(left: dict[str, list[str]], scene: str, count: int) -> tuple[str, ...]:
    if len(left[scene]) < count:
        raise InputError(
            f"Scene {scene!r} has too few episodes: nobody may get one twice. Hint: add episodes or scenes, or use fewer "
            "episodes per condition or for training.",
            code="H3-METRIC-037",
        )
    taken, left[scene] = left[scene][:count], left[scene][count:]
    return tuple(taken)
