"""Messages with the views of privileged policies, such as planners that know the map and all positions.

The episode is sent once, as a recording of one step without motion, followed by the plain fields of each view. Data
that a view requests from the simulator, such as pictures, are not sent.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from h3data.plugins import names_from_data
from h3data.recording import read_mcap, write_mcap
from h3data.scene import FreeSpace, Scene
from h3data_remote.wire import PolicyServerError
from sim_kinematic.agents.roster import kinds_of
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.policies.policy import Still
from sim_kinematic.policies.views import AgentView, SocialNavView
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.recorder import Recorder, run
from sim_kinematic.tasks.resimulation import scene_and_map
from sim_kinematic.tasks.task import Task

VIEWS = {view.__name__: view for view in (SocialNavView, AgentView)}


def packed_episode(task: Task, episode: Episode) -> bytes:
    """Return an episode as the bytes of a recording with its scene, rules, agents and starts."""
    policies = [AssignedPolicy(Still(), "still", member.kind) for member in episode.roster]
    play = WorldRollout.of(task, episode, policies, measure=False)
    recorder = Recorder.of(play)
    run(play, recorder, steps=1)  # recordings have columns, so that there is a first step, in which nobody decides
    recording = recorder.finish({})
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "episode.mcap")
        write_mcap(recording, file)
        return file.read_bytes()


def unpacked_episode(task: Task, packed: Any) -> Episode:
    """Return the episode from the bytes that `packed_episode` returns.

    Raises:
        PolicyServerError: the episode belongs to another task.
        H3DataError: the bytes are malformed.
    """
    if not isinstance(packed, bytes):
        raise PolicyServerError(
            f"Expected an episode of {task.name} with the first request, got none.", code="H3-REMOTE-038"
        )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "episode.mcap")
        file.write_bytes(packed)
        recording = read_mcap(file)
    name = str(recording.episode.info.get("task") or recording.episode.task)
    if name != task.name:
        raise PolicyServerError(f"This server plays {task.name}, the episode is of {name}.", code="H3-REMOTE-039")
    glb = recording.attachments["scene.glb"]
    with names_from_data():
        return task.codec.restore(recording, lambda radius, height: _map(glb, radius, height))


@lru_cache(maxsize=8)
def _map(glb: bytes, radius_m: float, height_m: float) -> tuple[Scene, FreeSpace]:
    return scene_and_map(glb, radius_m, height_m)


def view_to_wire(view: NamedTuple) -> dict[str, Any]:
    """Return the plain fields of a view, by name."""
    fields = {name: value for name, value in view._asdict().items() if _is_plain(value)}
    return {"view": type(view).__name__, **fields}


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value)) and not hasattr(value, "_fields")
    return value is None or isinstance(value, str | bool | int | float | np.ndarray | np.generic)


def view_from_wire(fields: Any, episode: Episode, number: int) -> Any:
    """Return a view from its plain fields, with the map and the rules of the episode.

    Raises:
        PolicyServerError: the server does not know a view with these fields.
    """
    kind = VIEWS.get(str(fields.get("view"))) if isinstance(fields, dict) else None
    if kind is None or not 0 <= number < len(episode.roster):
        raise PolicyServerError(f"Expected a view, one of: {', '.join(VIEWS)}.", code="H3-REMOTE-040")
    told: Mapping[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in fields.items()
        if name in kind._fields
    }
    rules = {
        "free": episode.floor(number),
        "bases": episode.bases[: kinds_of(episode.roster).count("robot")],
        "walker": episode.spec.human,
        "extra": episode.extra,
        # these reach into the world of the caller, which this process does not have
        "traffic": _no_traffic,
        "crowds": _no_traffic,
    }
    known = {name: value for name, value in rules.items() if name in kind._fields}
    try:
        return kind(**{**told, **known})
    except TypeError as fault:
        raise PolicyServerError(f"The view is malformed: {fault}", code="H3-REMOTE-041") from None


def _no_traffic() -> Any:
    raise PolicyServerError(
        "This policy gives way to everybody in the world that it plays in, and cannot decide behind a server.",
        code="H3-REMOTE-037",
    )
