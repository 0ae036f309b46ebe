"""Marks on the floor of a Rerun view: free space, goals of objects and people, and points of laser scans."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from h3data.recording.records import Recording, agent_numbers
from h3data.recording.scans import clouds_of, scans_of
from h3data.scene import FreeSpace, Scene
from h3data.scene.freespace.build import choose_method
from h3data_viewers.rerun.sink import Sink

GOAL_COLOR = (236, 64, 122)
ABOVE_FLOOR_M = 0.015
LABEL_APART_M = 0.8
"""Distance of points below which their labels would overlap when the whole home is in view [m]."""
SCAN_EVERY = 3
"""Number of steps between logged scans; a scan of 360 points takes 4 kB."""


# --- free space -------------------------------------------------------------------------------------------------------
def log_free_space(sink: Sink, recording: Recording, scene: Scene | None) -> bool:
    """Log the border of the free space of an agent's centre as ``world/free_space``; return whether there is any.

    Scenes without rooms and primitive shapes are skipped: extracting the floor from triangles takes longer than writing
    the rest of the file.
    """
    import rerun as rr

    if scene is None or choose_method(scene, "auto") != "shapes":
        return False
    spec = recording.episode.info.get("spec")
    radius = spec.get("agent_radius_m") if isinstance(spec, Mapping) else None
    # info is whatever the writer of the file put there
    if isinstance(radius, int | float) and 0 < radius < 2:
        space = FreeSpace.from_scene(scene, radius_m=float(radius))
    else:
        space = FreeSpace.from_scene(scene)
    borders = [r for p in space.polygon.geoms for r in (p.exterior, *p.interiors)]
    if len(space.heights):
        # points every 25 cm, so that the border follows the stairs up
        borders = [shapely.segmentize(r, 0.25) for r in borders]
    rings = [np.asarray(r.coords) for r in borders]
    if not rings:
        return False
    levels = [space.height_at(r) + ABOVE_FLOOR_M for r in rings]
    strips = [np.column_stack([r[:, 0], y, r[:, 1]]).astype(np.float32) for r, y in zip(rings, levels, strict=True)]
    sink.static("world/free_space", rr.LineStrips3D(strips, colors=[(102, 187, 106, 160)], radii=[0.01]))
    return True


# --- scans ------------------------------------------------------------------------------------------------------------
def log_scans(sink: Sink, recording: Recording) -> None:
    """Log the points of laser scans below ``world/scans``, every `SCAN_EVERY` steps."""
    import rerun as rr

    rows = np.arange(0, len(recording), SCAN_EVERY)
    colors = ((255, 64, 200), (150, 110, 255), (255, 171, 64)) * 9
    for scan, color in zip([*scans_of(recording), *clouds_of(recording)], colors, strict=False):
        points = scan.points(recording, rows)
        met = np.isfinite(points).all(-1)
        name = rr.escape_entity_path_part(f"{recording.agents[scan.agent].name}_{scan.sensor}")
        sink.static(f"world/scans/{name}", rr.Points3D.from_fields(colors=[color], radii=[0.035]))
        columns = rr.Points3D.columns(positions=points[met]).partition(met.sum(1))
        sink.columns(f"world/scans/{name}", rows, columns)


# --- goals ------------------------------------------------------------------------------------------------------------
def log_goals(sink: Sink, recording: Recording) -> None:
    """Log the goal positions of objects and the person's current goal below ``world/goals``.

    Goals come from ``episode.info`` as written by `social_nav`, `rearrange` and HITL sessions. Malformed ones are
    skipped with a warning.
    """
    import rerun as rr

    positions, labels = object_goals(recording)
    if len(positions):
        texts = stacked_labels(positions, labels)
        points = rr.Points3D(positions, radii=[0.07], colors=[GOAL_COLOR], labels=texts, show_labels=True)
        sink.static("world/goals/objects", points)
    for index, rows, points in walking_goals(recording):
        agent = rr.escape_entity_path_part(recording.agents[index].name or "unnamed")
        static = rr.Points3D.from_fields(colors=[GOAL_COLOR], radii=[0.09])
        sink.static(f"world/goals/{agent}", static)
        sink.columns(f"world/goals/{agent}", rows, rr.Points3D.columns(positions=points))


def stacked_labels(positions: NDArray[np.floating], labels: Sequence[str]) -> list[str]:
    """Return one label per point [N, 3]; points within `LABEL_APART_M` of an earlier point are listed in its label."""
    heads: list[int] = []
    texts = [""] * len(labels)
    for k, label in enumerate(labels):
        near = [h for h in heads if np.linalg.norm((positions[h] - positions[k])[[0, 2]]) < LABEL_APART_M]
        if near:
            texts[near[0]] += f"\n{label}"
        else:
            heads.append(k)
            texts[k] = label
    return texts


def object_goals(recording: Recording) -> tuple[NDArray[np.float64], list[str]]:
    """Return the goal positions of objects [N, 3] [m] and their labels, from ``episode.info``."""
    info = recording.episode.info
    goals = info.get("goals")
    if isinstance(goals, Sequence) and not isinstance(goals, str) and goals:
        placed = [g for g in goals if isinstance(g, Mapping) and "position" in g]
        labels = [" to ".join(str(g[key]) for key in ("object", "to") if g.get(key)) for g in placed]
        positions = _points([g["position"] for g in placed], 3, "goals")
        return positions, labels[: len(positions)]
    positions = _points(info.get("goal_positions"), 3, "goal_positions")
    return positions, [f"goal {k + 1}" for k in range(len(positions))]


def walking_goals(recording: Recording) -> list[tuple[int, NDArray[np.int64], NDArray[np.float64]]]:
    """Return the first person's index, the rows [N] in which their walking goal changes, and these goals [N, 3] [m]."""
    goals = _points(recording.episode.info.get("human_goals"), 2, "human_goals")
    column = recording.columns.get("sim.human_goal")
    people = agent_numbers(recording.agents, "human")
    if not len(goals) or column is None or column.ndim != 1 or not len(column) or not people:
        return []
    index = np.clip(column.astype(np.int64), 0, len(goals) - 1)
    rows = np.flatnonzero(np.concatenate([[True], np.diff(index) != 0]))
    # goals of people have x and z alone; they stand on the floor that the person walks on
    height = np.nan_to_num(recording.agent_column(people[0], "base_pose")[rows, 1].astype(np.float64))
    x, z = goals[index[rows]].T
    return [(people[0], rows, np.column_stack([x, height + ABOVE_FLOOR_M, z]))]


def _points(value: Any, width: int, key: str) -> NDArray[np.float64]:
    """Parse ``episode.info[key]`` as finite points [N, width]; anything else gives no points and a warning."""
    none = np.zeros((0, width))
    if value is None:
        return none
    try:
        points = np.asarray(value, np.float64)
        if points.size == 0:
            return none
        if points.ndim == 2 and points.shape[1] == width and np.isfinite(points).all():
            return points
    except (TypeError, ValueError):
        pass
    message = "Goals are not shown: expected episode.info[%r] to hold points of %d finite numbers."
    logging.getLogger(__name__).warning(message, key, width)
    return none
