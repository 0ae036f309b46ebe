"""Measurements and validation of scenes as JSON data, for ``h3data scenes``."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from h3data.commands.command import Outcome
from h3data.errors import InputError, MissingAssetError, SceneError
from h3data.scene import FreeSpace, Scene
from h3data.scene.open import NamedScene, open_scene
from h3data.scene.scene_sets import builtin_sets, find_scene_set
from h3data.scene.sources import SceneFile, SceneSource, scene_generators

if TYPE_CHECKING:
    from h3data_pipelines.validation.scenes import Problem

AGENT_RADIUS_M, AGENT_HEIGHT_M = 0.25, 1.41


def scene_size(name: str, scene: Scene, free: FreeSpace | None) -> dict[str, Any]:
    """Return counts and areas [m2] of a scene as JSON data; ``free`` is None for a scene without free floor."""
    rectangles = [np.asarray(r.rectangles, np.float64) for r in scene.rooms]
    floor = sum(float(np.sum((r[:, 2] - r[:, 0]) * (r[:, 3] - r[:, 1]))) for r in rectangles)
    return {
        "scene": name,
        "rooms": len(scene.rooms),
        "room_names": [r.name for r in scene.rooms],
        "floor_m2": round(floor, 2),
        "free_m2": 0.0 if free is None else round(float(free.polygon.area), 2),
        "islands": 0 if free is None else len(free.island_areas),
        "assets": len(scene.assets),
        "instances": len(scene.instances),
        "movable": sum(i.motion == "kinematic" for i in scene.instances),
        "receptacles": sum(1 for _ in scene.receptacles()),
        "triangles": sum(len(scene.assets[i.asset].mesh.faces) for i in scene.instances),
    }


def presets_and_sets() -> Outcome:
    """Return tables of the presets for which the installed generators make scenes, and of the built-in scene sets."""
    generators = scene_generators().values()
    presets = [
        {"preset": name, **asdict(size), "seeds": "0, 1, 2, ..."}
        for generator in generators
        for name, size in generator.listed.items()
    ]
    scene_sets = [find_scene_set(f"{name}/{split}") for name, splits in builtin_sets().items() for split in splits]
    sets = [
        {
            "set": s.label,
            "scenes": len(s.scenes),
            "episodes_per_scene": s.social_nav.episodes_per_scene,
            "episodes": s.episodes,
            "spawn_distance_m": s.social_nav.spawn_distance_m,
            "about": s.about,
        }
        for s in scene_sets
        if s is not None
    ]
    parts = [
        text_table(
            ("preset", "floor m2", "bedrooms", "bathrooms", "seeds"), [[cell(v) for v in r.values()] for r in presets]
        ),
        *(generator.about for generator in generators if generator.about),
        text_table(
            ("set", "scenes", "episodes each", "episodes", "spawn distance m", "about"),
            [[cell(v) for v in r.values()] for r in sets],
        ),
        "Name a scene of a set as set#number, e.g. h3-homes/test#3. Define your own sets in .toml files "
        "(h3data docs scene-sets).",
    ]
    return Outcome(text="\n\n".join(parts), data={"presets": presets, "sets": sets})


def _load_without_missing(source: SceneSource) -> tuple[Scene, str]:
    """Load a scene without assets whose files are missing, and a text that names them (empty if none are)."""
    try:
        return open_scene(source), ""
    except (MissingAssetError, SceneError) as error:
        if not isinstance(source, SceneFile) or source.strict or not Path(source.path).exists():
            raise
        try:
            return open_scene(replace(source, allow_missing=True)), str(error)
        except SceneError:
            raise error from None


def validate_scene(
    named: NamedScene, *, radius_m: float = AGENT_RADIUS_M, picture: Path | None = None
) -> dict[str, Any]:
    """Find the problems of a scene, as JSON data; with ``picture``, also mark them on a floor plan (PNG)."""
    from h3data.render import write_png
    from h3data_pipelines.assets.scene_plan import scene_map
    from h3data_pipelines.validation.scenes import Problem, find_problems, free_space_for_validation

    scene, missing = _load_without_missing(named.source)
    problems = [Problem(kind="missing_asset", subject=scene.name, text=missing)] if missing else []
    notes = [str(w) for w in scene.source.get("warnings", ())]
    try:
        wide = free_space_for_validation(scene, radius_m=radius_m, height_m=AGENT_HEIGHT_M)
    except SceneError as error:
        problems.append(Problem(kind="no_floor", subject=scene.name, text=str(error)))
        wide = picture = None
    if wide is not None:
        problems += find_problems(scene, wide, radius_m=radius_m)
    overlaps, hull_overlaps = _overlaps(scene)
    problems += overlaps
    if hull_overlaps:
        notes.append(
            f"{hull_overlaps} pairs overlap only as convex hulls, which fill hollows such as shelves: not counted"
        )
    if picture is not None:
        free = FreeSpace.from_scene(scene, radius_m=radius_m, height_m=AGENT_HEIGHT_M)
        image = scene_map(scene, free, problems=problems)
        with readable_os_errors(picture):
            write_png(picture, image)
    rows = [
        {
            "kind": p.kind,
            "subject": p.subject,
            "text": p.text,
            "position": None if p.position is None else np.round(p.position, 4).tolist(),
        }
        for p in problems
    ]
    free_m2 = 0.0 if wide is None else float(wide.polygon.buffer(wide.radius_m - radius_m).area)
    return {"scene": named.name, "problems": rows, "notes": notes, "free_m2": round(free_m2, 3)}


def _same_object(first: str, second: str) -> bool:
    """Return whether two instances are links of one articulated object, which may touch: a door and its cabinet, say."""
    return "/" in first and first.split("/")[0] == second.split("/")[0]


def _overlaps(scene: Scene) -> tuple[list[Problem], int]:
    """Return overlapping objects, and the number of further pairs that may overlap only by a filled hull."""
    from h3data_pipelines.validation.overlaps import overlapping_instances
    from h3data_pipelines.validation.scenes import Problem, hull_fills_hollows

    hollow = {name for name, asset in scene.assets.items() if hull_fills_hollows(asset)}
    asset_of = {i.name: i.asset for i in scene.instances}
    overlaps = [o for o in overlapping_instances(scene) if not _same_object(o.first, o.second)]
    certain = [o for o in overlaps if not {asset_of[o.first], asset_of[o.second]} & hollow]
    problems = [
        Problem(
            kind="overlap",
            subject=f"{o.first} / {o.second}",
            text=f"overlap by {100 * o.depth_m:.1f} cm",
            position=o.point,
        )
        for o in certain
    ]
    return problems, len(overlaps) - len(certain)


def short_name(name: str) -> str:
    """Return the name of a scene for tables, which is the last part of its path."""
    return Path(name).name if "/" in name else name


# --- tables and files -------------------------------------------------------------------------------------------------
def cell(value: Any) -> str:
    """Return the value as text for a table; numbers that are not integers have two decimals, and None is empty."""
    return "" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)


def text_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table with aligned columns, in which numbers are aligned to the right."""
    widths = [max(len(h), *(len(r[k]) for r in rows)) if rows else len(h) for k, h in enumerate(heads)]

    def line(cells: Sequence[str]) -> str:
        parts = [c.rjust(w) if re.fullmatch(r"[\d.]+", c) else c.ljust(w) for c, w in zip(cells, widths, strict=True)]
        return "  ".join(parts).rstrip()

    return "\n".join(line(row) for row in (heads, *rows))


@contextmanager
def readable_os_errors(path: Path) -> Iterator[None]:
    """Turn an `OSError` while writing ``path`` into an `InputError`."""
    try:
        yield
    except OSError as error:
        raise InputError(f"Cannot write the image ({error.strerror or error}): {path}", code="H3-BODY-141") from None
