"""Propositions for imported sessions of PARTNR's tool, whose logs name an episode of a file and hold no propositions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.recording import Recording
from h3data.recording.task_episodes.episode_files import episode_files
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode as FileEntry
from h3data.recording.task_episodes.stored_rearrangements import rearrangement_of
from h3data.scene.open import open_free_space, open_scene
from h3data_language.evaluation.engine import STATE_COLUMNS
from h3data_language.evaluation.layout import LAYOUT, Layout, ThingBox
from h3data_language.evaluation.predicates import check_names
from h3data_language.evaluation.records import CONSTRAINTS, DEPENDENCIES, PROPOSITIONS, THEIR_STATES, Evaluation
from h3data_language.partnr import states_of

_RADIUS_M, _HEIGHT_M = 0.25, 1.4
"""Radius and height [m] of the agent for which the free floor is computed."""


def entry_of(recording: Recording, entries: Sequence[FileEntry]) -> FileEntry:
    """Find the episode that an imported session played, by the episode's id and scene.

    Raises:
        InputError: no episode matches, or the episode has no propositions.
    """
    told = recording.episode.info.get("episode")
    told = told if isinstance(told, Mapping) else {}
    number, scene = str(told.get("episode_id", "")), Path(str(told.get("scene_id") or "")).name.partition(".")[0]
    found = [
        e for e in entries if str(e.episode_id) == number and scene in ("", Path(e.scene_id).name.partition(".")[0])
    ]
    if len(found) != 1 or PROPOSITIONS not in found[0].extra:
        what = "no propositions" if len(found) == 1 else f"{len(found)} episodes {number!r} in the scene {scene!r}"
        raise InputError(
            f"Expected the episode of {recording.episode.episode_id!r} with its propositions, got a file with {what}.",
            code="H3-LANGUAGE-033",
        )
    return found[0]


def with_propositions(
    recording: Recording, entry: FileEntry, folder: Path, *, assets: Sequence[str | Path] = ()
) -> Recording:
    """Return an imported session with the propositions of its episode, so that the profile ``partnr`` evaluates it.

    Things count as held if an agent has grasped them or a user holds them. States that the log lacks are those at the
    start of the episode.

    Args:
        recording: The session.
        entry: Episode of the session, as `entry_of` returns it.
        folder: Folder of the episode file.
        assets: Folders below which the scene and the objects are searched.

    Raises:
        InputError: propositions are malformed, or name things that do not exist.
        SceneError: the scene is not found.
    """
    evaluation, files = Evaluation.of(entry.extra), episode_files()
    record = rearrangement_of(msgspec.structs.replace(entry, targets={}), ())
    source = files.scene_of(entry, None, folder, assets=assets, allow_missing=True)
    scene, origins = files.add_objects(
        open_scene(source), record.objects, record.object_paths, [str(place) for place in assets]
    )
    moving = sorted((body.moving, k) for k, body in enumerate(recording.bodies) if body.moving >= 0)
    names = [recording.bodies[k].name for _, k in moving]
    known = [name for name in names if name in origins]
    of_home = Layout.of_scene(scene, known, open_free_space(source, _RADIUS_M, _HEIGHT_M).floor_y)
    boxes = {}
    for name, (_, body) in zip(names, moving, strict=True):
        box = of_home.things.get(name, ThingBox(body, (0, 0, 0), (0, 0, 0)))
        # logs have the pose of the center of mass
        x, y, z = np.round(np.array(box.center) - origins.get(name, 0.0), 4).tolist()
        boxes[name] = ThingBox(body, (x, y, z), box.half)
    layout = msgspec.structs.replace(of_home, things=boxes)
    check_names(evaluation.propositions, layout)
    stored = {key: entry.extra.get(key) or [] for key in (PROPOSITIONS, DEPENDENCIES, CONSTRAINTS)}
    told = {"instruction": str(entry.extra.get("instruction") or ""), "profile": "partnr"}
    info = {**recording.episode.info, **told, **stored, LAYOUT: msgspec.to_builtins(layout)}
    columns = {**recording.columns, **_states(recording, entry, names), **_hands(recording, boxes)}
    return replace(recording, episode=replace(recording.episode, info=info), columns=columns)


def _states(recording: Recording, entry: FileEntry, names: Sequence[str]) -> dict[str, NDArray[np.bool_]]:
    """Return columns of states: as logged (1, 0, -1 = unknown), else as at the start of the episode."""
    found = {}
    for state, flags in states_of(entry, names).items():
        logged = recording.columns.get(f"object_state.{THEIR_STATES[state]}")
        start = np.tile(np.array(flags, np.bool_), (len(recording), 1))
        found[STATE_COLUMNS[state]] = start if logged is None else np.where(logged < 0, start, logged == 1)
    return found


def _hands(recording: Recording, boxes: Mapping[str, ThingBox]) -> dict[str, NDArray[np.int32]]:
    """Return the bodies that agents hold, where their users hold one and the agents themselves have grasped nothing."""
    info = recording.episode.info
    owners = info["episode"].get("user_index_to_agent_index_map")
    bodies = {info.get("object_ids", {}).get(name): box.body for name, box in boxes.items()}
    found: dict[str, NDArray[np.int32]] = {}
    for user, agent in owners.items() if isinstance(owners, Mapping) else ():
        column, held = f"agent_{agent}.grasp_body", recording.columns.get(f"input.user_{user}.held_object")
        if held is not None and column in recording.columns:
            by_user = np.array([bodies.get(number, -1) for number in held.tolist()], np.int32)
            grasped = recording.columns[column]
            found[column] = np.where(grasped < 0, by_user, grasped).astype(np.int32)
    return found
