"""Export of recorded rearrangement as Habitat's ``RearrangeEpisode``, with a scene dataset and an episode file.

The scenes hold the building and the furniture; everything that moves is an object of the episode (``rigid_objs``), as in
Habitat's own datasets, so that no object exists twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from h3data.errors import InputError
from h3data.formats import Exported, ExportRequest
from h3data.geometry import pose_to_matrix
from h3data.recording.records import Recording
from h3data.recording.task_episodes.rearrange_episode import EpisodeSet, RearrangeEpisode, RigidObject, handles_of
from h3data.recording.task_episodes.stored_rearrangements import (
    EpisodeObject,
    StoredRearrangement,
    rearrangement_entry,
)
from h3data.scene import load_scene, scene_digest
from h3data.scene.records import Instance, Scene
from h3data_habitat.episodes.files import write_episodes
from h3data_habitat.episodes.recorded_episodes import rearrangement_of
from h3data_habitat.exporters.scenes import DatasetExport

EPISODES = "episodes/rearrange.json.gz"


def export_habitat_episodes(recordings: Iterable[Recording], request: ExportRequest) -> Exported:
    """Export recordings for ``h3data export --to habitat-episodes``."""
    folder = write_habitat_episodes(recordings, request.out, force=request.force)
    return Exported(
        text=f"{folder.episodes} episodes in {folder.scenes} scenes: {folder.file}\n{folder.config}",
        data={
            "episodes": folder.episodes,
            "scenes": folder.scenes,
            "file": str(folder.file),
            "config": str(folder.config),
            "left_out": list(folder.left_out),
        },
    )


@dataclass(frozen=True, kw_only=True)
class WrittenEpisodes:
    """Result of writing an episode file."""

    config: Path
    """Path of the scene dataset's config."""
    file: Path
    """File of the episodes."""
    episodes: int
    scenes: int
    left_out: tuple[str, ...]
    """Names of recordings without steps."""


def write_habitat_episodes(
    recordings: Iterable[Recording], folder: str | Path, *, force: bool = False
) -> WrittenEpisodes:
    """Write a folder with a scene dataset and ``episodes/rearrange.json.gz``.

    Paths in the file start with ``folder`` as it is given, so that Habitat finds the scenes from the working directory
    of the export.

    Args:
        recordings: Recordings of rearrangement; those without steps are left out.
        folder: Output folder, which must not exist or be empty.
        force: True replaces a folder that an earlier export made.

    Raises:
        InputError: there are no recordings, or one is of another task or lacks its scene or goals.
    """
    dataset = DatasetExport(folder, Path(folder).name, force=force)
    scenes: dict[str, tuple[Path, Mapping[str, str]]] = {}
    names: set[str] = set()
    entries: list[RearrangeEpisode] = []
    left_out = []
    for recording in recordings:
        if not len(recording):
            left_out.append(recording.episode.episode_id)
            continue
        record = rearrangement_of(recording)
        if "scene.glb" not in recording.attachments:
            raise InputError(
                f"The recording {recording.episode.episode_id!r} does not hold its scene (scene.glb).",
                code="H3-EXPORT-016",
            )
        scene = load_scene(recording.attachments["scene.glb"])
        # episodes of one home share its scene, whatever lies about in it
        furniture = _furniture(scene)
        digest = scene_digest(furniture)
        if digest not in scenes:
            named = replace(furniture, name=_unused(furniture.name, names))
            scenes[digest] = dataset.add_scene(named)
        entries.append(_entry(record, scene, dataset, *scenes[digest], number=len(entries)))
    if not entries:
        raise InputError("There is no recording with steps to export.", code="H3-EXPORT-014")
    config = dataset.write()
    file = Path(folder) / EPISODES
    file.parent.mkdir(exist_ok=True)
    write_episodes(EpisodeSet(episodes=tuple(entries)), file)
    return WrittenEpisodes(
        config=config, file=file, episodes=len(entries), scenes=len(scenes), left_out=tuple(left_out)
    )


def _entry(
    record: StoredRearrangement,
    scene: Scene,
    dataset: DatasetExport,
    file: Path,
    receptacles: Mapping[str, str],
    *,
    number: int,
) -> RearrangeEpisode:
    """Return one episode: everything that moves, where it begins and where the goals are."""
    starts = {goal.object: np.array(goal.start, np.float64) for goal in record.goals}
    movable = [(dataset.add_object(scene, thing), thing) for thing in _movable(scene)]
    # by template: Habitat adds objects in this order and numbers them so
    movable.sort(key=lambda pair: pair[0])
    handles = dict(
        zip((thing.name for _, thing in movable), handles_of([config for config, _ in movable]), strict=True)
    )
    lost = sorted(starts.keys() - handles.keys())
    if lost:
        raise InputError(
            f"The recorded scene has no movable thing {lost[0]!r}, which is a goal of its episode.",
            code="H3-EXPORT-015",
        )
    poses = {thing.name: starts.get(thing.name, thing.pose) for _, thing in movable}
    objects = tuple(
        EpisodeObject(name=thing.name, config=config, pose=tuple(thing.pose.tolist())) for config, thing in movable
    )
    targets = {}
    for goal in record.goals:
        # goals of ours are places only; the object keeps the rotation that it starts with
        at_goal = np.concatenate([goal.position, goal.start[3:]])
        targets[handles[goal.object]] = pose_to_matrix(at_goal).astype(np.float64)
    return rearrangement_entry(
        msgspec.structs.replace(record, objects=objects),
        episode_id=str(number),
        scene_id=file.as_posix(),
        scene_dataset_config=dataset.config.as_posix(),
        rigid_objects=[
            RigidObject(config=config, matrix=pose_to_matrix(poses[thing.name]).astype(np.float64))
            for config, thing in movable
        ],
        targets=targets,
        goal_receptacles=[receptacles.get(goal.destination, goal.destination) for goal in record.goals],
        name_to_receptacle={
            handles[goal.object]: receptacles.get(goal.source, goal.source) for goal in record.goals if goal.source
        },
    )


def _furniture(scene: Scene) -> Scene:
    """Return the scene without what moves."""
    instances = tuple(i for i in scene.instances if i.motion == "static")
    return replace(scene, instances=instances, assets={i.asset: scene.assets[i.asset] for i in instances})


def _movable(scene: Scene) -> Sequence[Instance]:
    # what cannot be seen has no mesh to write
    return [i for i in scene.instances if i.motion != "static" and len(scene.assets[i.asset].mesh.faces)]


def _unused(name: str, taken: set[str]) -> str:
    """Return the name, numbered if it is taken; it is taken from then on."""
    unused, number = name, 1
    while unused in taken:
        unused, number = f"{name}-{number}", number + 1
    taken.add(unused)
    return unused
