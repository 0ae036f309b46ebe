"""Rearrangement episodes in Habitat's files: positions and goals of objects, and starts of the agents.

Habitat's own files hold objects and goals (spec/habitat.md 6.5) but no starts; h3data's files hold all of these under
``info["h3data"]`` (`h3data.recording.task_episodes.stored_episodes`). Both are read as one record.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from h3data.errors import InputError
from h3data.geometry import pose_from_matrix
from h3data.recording.task_episodes.partnr_goals import Placement, placements_of
from h3data.recording.task_episodes.rearrange_episode import (
    Matrix,
    RearrangeEpisode,
    RigidObject,
    instance_handles,
    is_rigid,
)
from h3data.recording.task_episodes.stored_episodes import (
    Start,
    info_block,
    plain,
    read_info_block,
    start_fields,
    task_of,
)

TASK = "rearrange"


class StoredGoal(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Object and its goal, as in a recording's ``info["goals"]``."""

    object: str
    """Name of the instance in the scene."""
    start: list[float]
    """Pose (pose7) in the world at the start."""
    position: list[float]
    """Goal position of the object's origin in the world, shape [3] [m]."""
    source: str = msgspec.field(name="from")
    """Receptacle on which the object lies, ``instance|receptacle``; empty if unknown."""
    destination: str = msgspec.field(name="to")
    rotation: list[float] | None = None
    """Quaternion ``[x y z w]`` at the goal; only needed to convert between frames."""


class EpisodeObject(msgspec.Struct, frozen=True, kw_only=True):
    """Object that the episode adds to the scene."""

    name: str
    """Name of the object's instance, Habitat's handle: ``024_bowl_:0000``."""
    config: str
    """File name of the object's template."""
    pose: tuple[float, ...]
    """Pose (pose7) of the object's center of mass in the world."""


class StoredRearrangement(msgspec.Struct, frozen=True, kw_only=True):
    """Rearrangement episode in a file, with all data that a simulator needs besides the scene."""

    goals: tuple[StoredGoal, ...]
    placements: tuple[Placement, ...] = ()
    """Further objects and the furniture on which their goals are sampled from the seed."""
    robot_start: Start | None = None
    """Start of the robot; None, as in Habitat's files, means that it is sampled from the seed."""
    human_start: Start | None = None
    objects: tuple[EpisodeObject, ...] = ()
    """Objects that are not in the scene itself."""
    object_paths: tuple[str, ...] = ()
    """Folders with the templates of ``objects``."""
    com_frames: bool = False
    """True if ``goals`` are poses of the centers of mass, as in Habitat, instead of the assets' origins."""
    floor_y: float = 0.0
    """Height of the floor [m]."""
    seed: int = 0
    robot: str = ""
    """Model of the robot, such as ``robot/quad_arm``; empty for the default robot."""
    human: str = ""
    scene_sha256: str = ""
    scene_source: Mapping[str, Any] = msgspec.field(default_factory=dict)
    rules: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Rules of the episode by the field names of ``RearrangeSpec``; missing rules have their defaults."""
    recording: str = ""
    """Identity (uid) of the recording from which the episode was taken."""
    sampled_sha256: str = ""
    """`content_digest` of an episode that follows from its seed alone; it shows whether the episode has been edited."""
    instruction: str = ""
    """Instruction to the agents; empty if the file has none."""


def content_digest(record: StoredRearrangement) -> str:
    """Return the digest of starts, objects, goals, seed and rules."""
    # what only describes (recording, instruction) stays out: it does not change what is played
    content = (
        record.robot_start,
        record.human_start,
        record.goals,
        record.objects,
        record.seed,
        record.robot,
        record.human,
        record.scene_sha256,
        plain(record.rules),
    )
    return hashlib.sha256(msgspec.json.encode(content)).hexdigest()


def rearrangement_entry(
    record: StoredRearrangement,
    *,
    episode_id: str,
    scene_id: str,
    scene_dataset_config: str = "default",
    rigid_objects: Sequence[RigidObject] = (),
    targets: Mapping[str, Matrix] | None = None,
    goal_receptacles: Sequence[str] = (),
    name_to_receptacle: Mapping[str, str] | None = None,
    object_paths: Sequence[str] = (),
) -> RearrangeEpisode:
    """Return a Habitat episode that contains a record, for `write_episodes`; `read_rearrangement` reads the record.

    Habitat itself uses ``rigid_objects`` (in the order of their configs) and ``targets``, which
    `h3data_habitat.exporters.episodes` fills in; h3data needs neither.
    """
    require_finite(record)
    names = targets or {}
    on = name_to_receptacle or {}
    info: dict[str, Any] = {"object_labels": {name: f"any_targets|{k}" for k, name in enumerate(names)}}
    return RearrangeEpisode(
        episode_id=episode_id,
        scene_id=scene_id,
        scene_dataset_config=scene_dataset_config,
        additional_obj_config_paths=tuple(object_paths),
        # this heading is no rotation in Habitat, its default
        **start_fields(record.robot_start or (0.0, 0.0, math.pi / 2), record.floor_y),
        rigid_objects=tuple(rigid_objects),
        targets=names,
        target_receptacles=tuple((on.get(name, "").partition("|")[0], None) for name in names),
        goal_receptacles=tuple((name.partition("|")[0], None) for name in goal_receptacles),
        name_to_receptacle=on,
        info={**info, **info_block(TASK, record)},
    )


def read_rearrangement(episode: RearrangeEpisode) -> StoredRearrangement | None:
    """Return the rearrangement that an episode of any file describes; None if there is nothing to rearrange.

    Raises:
        FormatError: an episode of h3data is damaged or from a newer version.
        InputError: in an episode of Habitat a target is not one of its objects or a pose is invalid, or an episode of PARTNR
            asks for something that is not supported.
    """
    if task_of(episode) == TASK:
        record = read_info_block(episode, TASK, StoredRearrangement)
        assert record is not None
        require_finite(record)
        if not record.goals and not record.placements:
            raise InputError(
                f"Episode {episode.episode_id!r} has no objects to rearrange: goals is empty.", code="H3-HABITAT-053"
            )
        return record
    if task_of(episode) is not None:
        return None
    placements = placements_of(episode)
    return rearrangement_of(episode, placements or ()) if placements is not None or episode.targets else None


def rearrangement_of(episode: RearrangeEpisode, placements: tuple[Placement, ...]) -> StoredRearrangement:
    """Return the objects, targets and instruction of an episode of Habitat's files.

    Targets count only in an episode without placements.

    Raises:
        InputError: a target is not an object of the episode, or a pose is not a valid one.
    """
    where = f"Episode {episode.episode_id!r}"
    handles = instance_handles(episode)
    asked = {} if placements else episode.targets
    strangers = asked.keys() - set(handles)
    if strangers:
        listed = ", ".join(handles[:6]) + (", ..." if len(handles) > 6 else "") if handles else "it has none"
        raise InputError(
            f"{where}: its target {min(strangers)!r} is none of its objects ({listed}).", code="H3-HABITAT-048"
        )
    matrices = [*(thing.matrix for thing in episode.rigid_objects), *asked.values()]
    what = [*(f"the pose of {name!r}" for name in handles), *(f"the goal of {name!r}" for name in asked)]
    poses: list[list[float]] = []
    if matrices:
        stacked = np.stack(matrices).astype(np.float64)
        rigid = is_rigid(stacked)
        if not rigid.all():
            raise InputError(
                f"{where}: {what[int(np.argmin(rigid))]} is no rotation and translation.", code="H3-HABITAT-051"
            )
        poses = pose_from_matrix(stacked).astype(np.float64).tolist()
    # not strict: the poses of the goals follow those of the objects
    starts = dict(zip(handles, poses, strict=False))
    objects = tuple(
        EpisodeObject(name=name, config=thing.config, pose=tuple(starts[name]))
        for name, thing in zip(handles, episode.rigid_objects, strict=True)
    )
    goals = [
        StoredGoal(
            object=name,
            start=starts[name],
            position=goal[:3],
            rotation=goal[3:],
            source=episode.name_to_receptacle.get(name) or _at(episode.target_receptacles, k),
            destination=_at(episode.goal_receptacles, k),
        )
        for k, (name, goal) in enumerate(zip(asked, poses[len(handles) :], strict=True))
    ]
    return StoredRearrangement(
        goals=tuple(goals),
        placements=placements,
        objects=objects,
        object_paths=episode.additional_obj_config_paths,
        com_frames=True,
        instruction=str(episode.extra.get("instruction") or episode.extra.get("language_instruction") or ""),
    )


def _at(receptacles: Sequence[tuple[str, int | None]], index: int) -> str:
    return receptacles[index][0] if index < len(receptacles) else ""


def require_finite(record: StoredRearrangement) -> None:
    """Raise an InputError where a start or goal is NaN or infinite."""
    for start in (record.robot_start, record.human_start):
        if start is not None and not all(map(math.isfinite, start)):
            raise InputError(f"Expected finite starts, got {start}.", code="H3-HABITAT-054")
    for goal in record.goals:
        numbers = [*goal.start, *goal.position]
        if len(goal.start) != 7 or len(goal.position) != 3 or not all(map(math.isfinite, numbers)):
            raise InputError(
                f"Expected a pose7 and a position [3] of finite numbers for {goal.object!r}, got {goal.start} and "
                f"{goal.position}.",
                code="H3-HABITAT-055",
            )
    if not math.isfinite(record.floor_y):
        raise InputError(f"Expected a finite height of the floor, got {record.floor_y}.", code="H3-HABITAT-052")
