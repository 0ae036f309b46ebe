"""``h3data scenes``: which homes there are, what they look like, their files in other formats, what is wrong with them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

import numpy as np
import tyro

from h3data.errors import InputError, MissingAssetError, SceneError
from h3data.scene import HOME_PRESETS, FreeSpace, Scene
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_file
from h3data_pipelines.generate import load_scene_by_name, scene_names

if TYPE_CHECKING:
    from h3data.scene.validation import Problem

_SCENE_HELP = (
    "small:3 (built-in home), or the path of a Habitat scene (.scene_instance.json, .stage_config.json, .glb)."
)
AGENT_RADIUS_M, AGENT_HEIGHT_M = 0.25, 1.41


@dataclass(frozen=True)
class ScenesList:
    """List what can be simulated in: presets of built-in homes, or the sizes of given scenes.

    Examples:
        h3data scenes list
        h3data scenes list small --homes 5
        h3data scenes list medium:0 my_home.scene_instance.json --json
    """

    scenes: tyro.conf.Positional[tuple[str, ...]] = ()
    """A preset (small, medium, large), one home (small:3) or paths of Habitat scenes; nothing lists the presets."""
    homes: int = 4
    """How many homes of a preset."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        if self.homes < 1:
            raise InputError(f"--homes must be at least 1, got {self.homes}.")
        if not self.scenes:
            return _presets()
        rows = []
        for text in self.scenes:
            rows += [_size(name, _load(name)) for name in scene_names(text, self.homes)]
        heads = ("scene", "rooms", "floor m2", "free m2", "assets", "things", "movable", "receptacles", "triangles")
        keys = ("scene", "rooms", "floor_m2", "free_m2", "assets", "instances", "movable", "receptacles", "triangles")
        cells = [[_cell(row[k]) for k in keys] for row in rows]
        return Outcome(text=_table(heads, cells), data={"scenes": rows})


@dataclass(frozen=True)
class ScenesShow:
    """Draw one scene: a plan with rooms, free floor and receptacles, or a view at eye level.

    Examples:
        h3data scenes show small:3 -o home.png
        h3data scenes show medium:0 --view eye --room kitchen -o kitchen.png
        h3data scenes show my_home.scene_instance.json -o home.png --pixels-per-m 60
    """

    scene: tyro.conf.Positional[str]
    """small:3 (built-in home), or the path of a Habitat scene."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """PNG file to write."""
    view: Literal["plan", "eye"] = "plan"
    """From above, or as somebody sees it who stands in a room."""
    room: str = ""
    """Which room, for --view eye (default: the largest)."""
    pixels_per_m: float = 80.0
    """Size of the plan."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        from h3data.render import write_png
        from h3data.render.scene_map import eye_level_picture, scene_map

        scene = _load(_one(self.scene))
        target = _png(self.out, force=self.force)
        if not 4 <= self.pixels_per_m <= 1000:
            raise InputError(f"--pixels-per-m must be from 4 to 1000, got {self.pixels_per_m}.")
        if self.room and self.view != "eye":
            raise InputError("--room chooses where to stand: add --view eye.")
        free = FreeSpace.from_scene(scene, radius_m=AGENT_RADIUS_M, height_m=AGENT_HEIGHT_M)
        if self.view == "eye":
            image = eye_level_picture(scene, free, room=self.room or None)
        else:
            image = scene_map(scene, free, pixels_per_m=self.pixels_per_m)
        _written(target, lambda: write_png(target, image))
        height, width = image.shape[:2]
        data = {"file": str(target), "width": width, "height": height, **_size(self.scene, scene, free)}
        return Outcome(text=f"wrote {target} ({width}x{height})", data=data)


@dataclass(frozen=True)
class ScenesExport:
    """Write scenes for other programs: a Habitat scene dataset that habitat-sim loads, or one GLB each.

    Examples:
        h3data scenes export small:3 --to habitat -o exports/small_3
        h3data scenes export small:0 small:1 medium:0 --to habitat -o exports/homes
        h3data scenes export small:3 --to glb -o exports/
    """

    scenes: tyro.conf.Positional[tuple[str, ...]]
    """small:3 (built-in homes), or paths of Habitat scenes. Several share the objects of one Habitat dataset."""
    to: Literal["habitat", "glb"]
    """Format: habitat (configs, stage, one GLB per object, receptacles, lights, regions) or glb (opens in any viewer)."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder: of the dataset, which must be new, or for the .glb files."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        from h3data.interop.habitat_export import export_habitat_dataset
        from h3data.scene import save_scene

        if not self.scenes:
            raise InputError(f"Expected at least one scene: {_SCENE_HELP}")
        scenes = [_load(_one(name)) for name in self.scenes]
        if self.to == "habitat":
            config = export_habitat_dataset(scenes, self.out, force=self.force)
            files = sorted(p for p in self.out.rglob("*") if p.is_file())
            first = str(config)
        else:
            files = [self.out / f"{re.sub(r'[^A-Za-z0-9_-]+', '_', s.name)}.glb" for s in scenes]
            if len(set(files)) < len(files):
                raise InputError("Two of the scenes have the same name, so their files would overwrite each other.")
            for file in files:
                claim_file(file, force=self.force)
            for scene, file in zip(scenes, files, strict=True):
                save_scene(scene, file)
            first = str(files[0])
        size = sum(f.stat().st_size for f in files)
        names = ", ".join(s.name for s in scenes)
        text = f"wrote {names} as {self.to}: {len(files)} files, {size / 1e6:.1f} MB\n{first}"
        data = {
            "format": self.to,
            "scenes": [s.name for s in scenes],
            "path": first,
            "files": len(files),
            "bytes": size,
        }
        return Outcome(text=text, data=data)


@dataclass(frozen=True)
class ScenesValidate:
    """Look for faults: cut-off floor, unreachable rooms, passages of nearly an agent's width, things inside each other,
    things that float or are sunk, receptacles out of reach, missing assets. Exit code 1 when there are any.

    Examples:
        h3data scenes validate small:3 medium:0
        h3data scenes validate small --homes 10
        h3data scenes validate my_home.scene_instance.json -o problems.png
    """

    scenes: tyro.conf.Positional[tuple[str, ...]]
    """A preset (small, medium, large), one home (small:3) or paths of Habitat scenes."""
    homes: int = 4
    """How many homes of a preset."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """PNG with the problems drawn into the plan; for several scenes a folder, one PNG each."""
    radius: float = AGENT_RADIUS_M
    """Radius of the agent [m]."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        if not self.scenes:
            raise InputError(f"Expected at least one scene: {_SCENE_HELP}")
        if not 0.05 <= self.radius <= 2:
            raise InputError(f"--radius must be from 0.05 to 2 m, got {self.radius}.")
        if self.homes < 1:
            raise InputError(f"--homes must be at least 1, got {self.homes}.")
        names = list(dict.fromkeys(name for text in self.scenes for name in scene_names(text, self.homes)))
        targets = self._targets(names)
        reports = [validate_scene(name, radius_m=self.radius, picture=targets.get(name)) for name in names]
        faults = sum(len(r["problems"]) for r in reports)
        cells = [
            [_short(r["scene"]), p["kind"].replace("_", " "), p["subject"], p["text"]]
            for r in reports
            for p in r["problems"]
        ]
        lines = [f"{_short(r['scene'])}: {'ok' if not r['problems'] else len(r['problems'])}" for r in reports]
        lines = [line if line.endswith("ok") else f"{line} problems" for line in lines]
        lines += ["", _table(("scene", "problem", "where", "what"), cells)] if cells else []
        lines += [f"note: {_short(r['scene'])}: {note}" for r in reports for note in r["notes"]]
        lines += [f"wrote {target}" for target in targets.values()]
        data = {"faults": faults, "scenes": reports}
        return Outcome(text="\n".join(lines), data=data, exit_code=1 if faults else 0)

    def _targets(self, names: Sequence[str]) -> dict[str, Path]:
        if self.out is None:
            return {}
        if len(names) == 1 and self.out.suffix.lower() == ".png":
            return {names[0]: _png(self.out, force=self.force)}
        stems = {name: re.sub(r"[^A-Za-z0-9_-]+", "_", Path(name).name.split(".")[0]) for name in names}
        if len(set(stems.values())) < len(stems):
            raise InputError("Two of the scenes have the same name, so their pictures would overwrite each other.")
        return {name: claim_file(self.out / f"{stem}.png", force=self.force) for name, stem in stems.items()}


def _subcommand(name: str, of: type) -> Any:
    """The help of each shows its docstring with the examples, unabridged."""
    return tyro.conf.subcommand(name, description=inspect.getdoc(of))


@dataclass(frozen=True)
class Scenes:
    """Homes to simulate in: list them, draw them, export them to other formats, look for faults.

    Each has its own --help, and prints one JSON object with --json.

    Examples:
        h3data scenes list small --homes 3
        h3data scenes show small:3 -o home.png
        h3data scenes export small:3 --to habitat -o exports/small_3
        h3data scenes validate small --homes 10
    """

    do: Annotated[
        Union[  # noqa: UP007 - made of parts with a help text each
            Annotated[ScenesList, _subcommand("list", ScenesList)],
            Annotated[ScenesShow, _subcommand("show", ScenesShow)],
            Annotated[ScenesExport, _subcommand("export", ScenesExport)],
            Annotated[ScenesValidate, _subcommand("validate", ScenesValidate)],
        ],
        tyro.conf.arg(name=""),
    ]

    @property
    def json(self) -> bool:
        return self.do.json

    def run(self) -> Outcome:
        return self.do.run()


# --- scenes by name ---------------------------------------------------------------------------------------------------
def _one(name: str) -> str:
    if name in HOME_PRESETS:
        raise InputError(f"Which home? {name!r} is a preset: give a seed as well, e.g. {name}:0.")
    return scene_names(name, 1)[0]


def _load(name: str) -> Scene:
    return load_scene_by_name(name)


def load_as_far_as_possible(name: str) -> tuple[Scene, str]:
    """The scene, without what is missing, and what that is (empty: nothing)."""
    from h3data.interop import load_habitat_scene

    try:
        return _load(name), ""
    except (MissingAssetError, SceneError) as fault:
        if not Path(name).exists():
            raise
        try:
            return load_habitat_scene(name, allow_missing=True), str(fault)
        except SceneError:
            raise fault from None


def validate_scene(name: str, *, radius_m: float = AGENT_RADIUS_M, picture: Path | None = None) -> dict[str, Any]:
    """Everything that is wrong with a scene, as plain JSON; drawn to ``picture`` if that is given."""
    from h3data.render import write_png
    from h3data.render.scene_map import scene_map
    from h3data.scene.validation import Problem, find_problems, free_space_for_validation

    scene, missing = load_as_far_as_possible(name)
    problems = [Problem(kind="missing_asset", subject=scene.name, text=missing)] if missing else []
    notes = [str(w) for w in scene.source.get("warnings", ())]
    try:
        loose = free_space_for_validation(scene, radius_m=radius_m, height_m=AGENT_HEIGHT_M)
    except SceneError as fault:
        problems.append(Problem(kind="no_floor", subject=scene.name, text=str(fault)))
        loose = picture = None
    if loose is not None:
        problems += find_problems(scene, loose, radius_m=radius_m)
    overlaps, doubtful = _overlaps(scene)
    problems += overlaps
    if doubtful:
        notes.append(
            f"{doubtful} pairs overlap only as convex hulls, which fill the hollows of shelves and chairs: not counted"
        )
    if picture is not None:
        free = FreeSpace.from_scene(scene, radius_m=radius_m, height_m=AGENT_HEIGHT_M)
        image = scene_map(scene, free, problems=problems)
        _written(picture, lambda: write_png(picture, image))
    rows = [
        {
            "kind": p.kind,
            "subject": p.subject,
            "text": p.text,
            "position": None if p.position is None else np.round(p.position, 4).tolist(),
        }
        for p in problems
    ]
    free_m2 = 0.0 if loose is None else float(loose.polygon.buffer(loose.radius_m - radius_m).area)
    return {"scene": name, "problems": rows, "notes": notes, "free_m2": round(free_m2, 3)}


def _overlaps(scene: Scene) -> tuple[list[Problem], int]:
    """Things inside each other, and the number of pairs that may be so only because one is a hull of a hollow thing."""
    from h3data.scene.validation import Problem, stands_for_hollow
    from sim_kinematic.collision import overlapping_instances

    hollow = {name for name, asset in scene.assets.items() if stands_for_hollow(asset)}
    asset_of = {i.name: i.asset for i in scene.instances}
    found = overlapping_instances(scene)
    sure = [o for o in found if not {asset_of[o.first], asset_of[o.second]} & hollow]
    problems = [
        Problem(
            kind="overlap",
            subject=f"{o.first} / {o.second}",
            text=f"{100 * o.depth_m:.1f} cm inside each other",
            position=o.point,
        )
        for o in sure
    ]
    return problems, len(found) - len(sure)


def _short(name: str) -> str:
    """How tables name a scene: a path by its last part."""
    return Path(name).name if "/" in name else name


# --- tables and files -------------------------------------------------------------------------------------------------
def _presets() -> Outcome:
    rows = [
        {
            "preset": name,
            "area_m2": p.area_m2,
            "bedrooms": p.bedrooms,
            "bathrooms": p.bathrooms,
            "seeds": "0, 1, 2, ...",
        }
        for name, p in HOME_PRESETS.items()
    ]
    heads = ("preset", "floor m2", "bedrooms", "bathrooms", "seeds")
    text = _table(heads, [[_cell(v) for v in row.values()] for row in rows])
    return Outcome(
        text=f"{text}\n\nA home is preset:seed, e.g. small:3. Any seed from 0 gives one.", data={"presets": rows}
    )


def _size(name: str, scene: Scene, free: FreeSpace | None = None) -> dict[str, Any]:
    """What a scene holds, in numbers."""
    free = free or FreeSpace.from_scene(scene, radius_m=AGENT_RADIUS_M, height_m=AGENT_HEIGHT_M)
    rectangles = [np.asarray(r.rectangles, np.float64) for r in scene.rooms]
    floor = sum(float(np.sum((r[:, 2] - r[:, 0]) * (r[:, 3] - r[:, 1]))) for r in rectangles)
    return {
        "scene": name,
        "rooms": len(scene.rooms),
        "room_names": [r.name for r in scene.rooms],
        "floor_m2": round(floor, 2),
        "free_m2": round(float(free.polygon.area), 2),
        "islands": len(free.island_areas),
        "assets": len(scene.assets),
        "instances": len(scene.instances),
        "movable": sum(i.motion == "kinematic" for i in scene.instances),
        "receptacles": sum(1 for _ in scene.receptacles()),
        "triangles": sum(len(scene.assets[i.asset].mesh.faces) for i in scene.instances),
    }


def _cell(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Aligned columns, numbers to the right."""
    widths = [max(len(h), *(len(r[k]) for r in rows)) if rows else len(h) for k, h in enumerate(heads)]

    def line(cells: Sequence[str]) -> str:
        parts = [c.rjust(w) if re.fullmatch(r"[\d.]+", c) else c.ljust(w) for c, w in zip(cells, widths, strict=True)]
        return "  ".join(parts).rstrip()

    return "\n".join(line(row) for row in (heads, *rows))


def _png(path: Path, *, force: bool) -> Path:
    if path.suffix.lower() != ".png":
        raise InputError(f"Expected a file name that ends in .png, got: {path}")
    return claim_file(path, force=force)


def _written(path: Path, write: Any) -> None:
    try:
        write()
    except OSError as error:
        raise InputError(f"Cannot write the picture ({error.strerror or error}): {path}") from None
