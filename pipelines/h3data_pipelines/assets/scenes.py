"""Command ``h3data scenes``, which lists, renders, exports and validates scenes."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import tyro

from h3data.commands.command import AssetsOption, ForceFlag, Group, JsonFlag, MissingFlag, Outcome, claim_file
from h3data.errors import InputError, SceneError
from h3data.progress import progress
from h3data.recording.task_episodes.rearrange_episode import EpisodeSet, RigidObject
from h3data.scene import FreeSpace, Scene
from h3data.scene.open import (
    NamedScene,
    collection_and_scene,
    is_collection,
    named_scenes,
    open_free_space,
    open_scene,
    preset_names,
)
from h3data.scene.scene_sets import SceneSet, find_scene_set
from h3data.scene.sources import SceneFile, scene_files
from h3data.terminal import counted
from h3data_pipelines.assets.scene_reports import (
    AGENT_HEIGHT_M,
    AGENT_RADIUS_M,
    cell,
    presets_and_sets,
    readable_os_errors,
    scene_size,
    short_name,
    text_table,
    validate_scene,
)

StrictFlag = Annotated[bool, tyro.conf.arg(help="Refuse a Habitat scene of which anything was left out or guessed.")]

_PARKED_M = 5.0
"""Depth below the floor at which the target object of a social-navigation episode lies."""

_SCENE_HELP = (
    "a built-in home such as small:3, a scene set such as h3-homes/test, or the path of a scene (.scene_instance.json, "
    ".stage_config.json, .glb, .usd)."
)


@dataclass(frozen=True)
class ScenesList:
    """List home presets and scene sets or, for given scenes, their sizes and contents.

    Examples:
        h3data scenes list
        h3data scenes list h3-homes/test
        h3data scenes list small --homes 5
        h3data scenes list medium:0 my_home.scene_instance.json --json
        h3data scenes list replicaCAD.scene_dataset_config.json
    """

    scenes: tyro.conf.Positional[tuple[str, ...]] = ()
    """A preset (small, medium, large, small2, ...), one home (small:3), a set (h3-homes/test, a .toml file), one of
    its scenes (h3-homes/test#3) or paths of scenes (default: list presets and sets)."""
    homes: int = 4
    """Number of homes to list per preset."""
    assets: AssetsOption = ()
    strict: StrictFlag = False
    allow_missing: MissingFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return a table of presets and scene sets, or of the sizes of the given scenes."""
        if self.homes < 1:
            raise InputError(f"--homes must be at least 1, got {self.homes}.", code="H3-BODY-147")
        if not self.scenes:
            return presets_and_sets()
        scenes = _all_named(self.scenes, self.homes, self.assets, self.strict, self.allow_missing)
        # Names only: a Habitat dataset may have hundreds of scenes, and measuring each takes seconds.
        if all(is_collection(text) for text in self.scenes):
            names = [named.name for named in scenes]
            return Outcome(text="\n".join(names), data={"scenes": [{"scene": name} for name in names]})
        rows = [_row(named) for named in scenes]
        columns = {
            "scene": "scene",
            "id": "id",
            "rooms": "rooms",
            "floor_m2": "floor m2",
            "free_m2": "free m2",
            "assets": "assets",
            "instances": "objects",
            "movable": "movable",
            "receptacles": "receptacles",
            "triangles": "triangles",
        }
        if not any(row["id"] for row in rows):
            del columns["id"]
        cells = [[cell(row[key]) for key in columns] for row in rows]
        return Outcome(text=text_table(list(columns.values()), cells), data={"scenes": rows})


@dataclass(frozen=True)
class ScenesShow:
    """Render a scene as a plan with rooms, free floor and receptacles, or as a view at eye level.

    Examples:
        h3data scenes show small:3 -o home.png
        h3data scenes show h3-homes/test#3 -o home.png
        h3data scenes show medium:0 --view eye --room kitchen -o kitchen.png
        h3data scenes show my_home.scene_instance.json -o home.png --pixels-per-m 60
        h3data scenes show replicaCAD.scene_dataset_config.json#apt_0 -o apt_0.png
    """

    scene: tyro.conf.Positional[str]
    """A built-in home (small:3), a scene of a set (h3-homes/test#3) or the path of a scene."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """PNG file to write."""
    view: Literal["plan", "eye"] = "plan"
    """View to render: plan (from above), or eye (from the eye level of a person in a room)."""
    room: str = ""
    """Room to stand in for --view eye (default: the largest)."""
    pixels_per_m: float = 80.0
    """Scale of the plan [pixels/m]."""
    assets: AssetsOption = ()
    strict: StrictFlag = False
    allow_missing: MissingFlag = False
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Render the scene to a PNG file."""
        from h3data.render import write_png
        from h3data.render.sheets.scene_map import plan_picture
        from h3data_pipelines.assets.scene_plan import scene_map

        named = _one(self.scene, self.assets, self.strict, self.allow_missing)
        scene = _renamed(named)
        target = _png(self.out, force=self.force)
        if not 4 <= self.pixels_per_m <= 1000:
            raise InputError(f"--pixels-per-m must be from 4 to 1000, got {self.pixels_per_m}.", code="H3-BODY-148")
        if self.room and self.view != "eye":
            raise InputError("--room applies to --view eye only: add --view eye.", code="H3-BODY-149")
        free = _free(named)
        if free is None and self.view == "eye":
            raise InputError(
                f"--view eye needs free floor to stand on, {named.name} has none. Hint: use --view plan.",
                code="H3-BODY-150",
            )
        if free is None:
            image, _ = plan_picture(scene, pixels_per_m=self.pixels_per_m)
        elif self.view == "eye":
            from h3data_pipelines.assets.eye_level import eye_level_picture

            image = eye_level_picture(scene, free, room=self.room or None)
        else:
            image = scene_map(scene, free, pixels_per_m=self.pixels_per_m)
        with readable_os_errors(target):
            write_png(target, image)
        height, width = image.shape[:2]
        data = {"file": str(target), "width": width, "height": height, **_row(named)}
        return Outcome(text=f"wrote {target} ({width}x{height})", data=data)


@dataclass(frozen=True)
class ScenesExport:
    """Export scenes as one Habitat scene dataset, which habitat-sim can load, or as one GLB or USD file each.

    The export of a scene set as a Habitat dataset includes its episodes.

    Examples:
        h3data scenes export h3-homes/test -o exports/h3-homes_test
        h3data scenes export small:0 small:1 medium:0 -o exports/homes
        h3data scenes export small:3 --split-building -o exports/semantic
        h3data scenes export small:3 --to glb -o exports/
        h3data scenes export small2-doors:3 --to usd -o home.usdz
        h3data scenes export small:3 --to glb --objects ycb/ -o exports/
    """

    scenes: tyro.conf.Positional[tuple[str, ...]]
    """A set (h3-homes/test, a .toml file), one of its scenes (h3-homes/test#3), built-in homes (small:3) or paths of
    scenes. Scenes of one Habitat dataset share their objects."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder to write to; the folder of a Habitat dataset must be new. For usd, this may also be a file: home.usda,
    home.usdc or home.usdz.
    """
    to: Literal["habitat", "glb", "usd"] = "habitat"
    """habitat: configs, stage, one GLB per object, receptacles, lights, regions. glb: one file that any viewer opens. usd: for
    Isaac, Blender and Omniverse, with materials, colliders, joints and semantic labels (in a folder: .usdc)."""
    split_building: bool = False
    """For habitat: export floors, walls, ceilings, windows, doors and trim as one static object each, so that
    habitat-sim's semantic sensor distinguishes them. The stage is then used for collisions only.
    """
    episodes: int | None = None
    """Number of episodes of a set to export for habitat (default: all; 0: none)."""
    objects: Path | None = None
    """Folder of objects (of the YCB set, or Habitat's object configs) that replace the movable things of the scenes
    where they fit.
    """
    assets: AssetsOption = ()
    strict: StrictFlag = False
    allow_missing: MissingFlag = False
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Write the scenes as a Habitat scene dataset or as GLB files."""
        if not self.scenes:
            raise InputError(f"Expected at least one scene: {_SCENE_HELP}", code="H3-BODY-151")
        if self.episodes is not None and self.episodes < 0:
            raise InputError(f"--episodes must be at least 0, got {self.episodes}.", code="H3-BODY-152")
        if self.split_building and self.to != "habitat":
            raise InputError(
                "--split-building is for --to habitat: in a GLB or USD file every part has its semantic id already.",
                code="H3-BODY-153",
            )
        sets = [s for text in self.scenes if "#" not in text and (s := find_scene_set(text)) is not None]
        for text in self.scenes:
            _refuse_preset(text)
        scenes = [_renamed(named) for named in _all_named(self.scenes, 1, self.assets, self.strict, self.allow_missing)]
        objects: dict[str, Any] = {}
        if self.objects is not None:
            scenes, objects = self._with_objects(scenes)
        if self.to == "habitat":
            files, first = self._to_habitat(scenes, sets)
        elif self.to == "glb":
            files, first = self._to_glb(scenes)
        else:
            files, first = self._to_usd(scenes)
        size = sum(f.stat().st_size for f in files)
        names = ", ".join(s.name for s in scenes[:6]) + (f", ... ({len(scenes)})" if len(scenes) > 6 else "")
        episodes = [str(f) for f in files if f.parent.name == "episodes"]
        said = (
            [f"{objects['replaced']} of {objects['movable']} movable things are objects of {self.objects}"]
            if objects
            else []
        )
        text = "\n".join(
            [f"wrote {names} as {self.to}: {counted(len(files), 'file')}, {size / 1e6:.1f} MB", *said, first, *episodes]
        )
        data = {
            "format": self.to,
            "scenes": [s.name for s in scenes],
            "path": first,
            "episodes": episodes,
            "files": len(files),
            "bytes": size,
            **({"objects": objects} if objects else {}),
        }
        return Outcome(text=text, data=data)

    def _with_objects(self, scenes: Sequence[Scene]) -> tuple[list[Scene], dict[str, Any]]:
        """Return the scenes with the objects in them; how many things they are, and their masses and grasps by name."""
        with_objects = scene_files("habitat").with_objects
        assert self.objects is not None
        assert with_objects is not None
        movable = sum(i.motion == "kinematic" for scene in scenes for i in scene.instances)
        changed, replaced, models = with_objects(scenes, self.objects, self.assets)
        if not replaced:
            raise InputError(
                f"No object of {self.objects} fits in the place of a movable thing of these scenes. Expected objects that are "
                f"at most 8 cm larger than a thing; {len(models)} objects were read, and there are {movable} things.",
                code="H3-BODY-154",
            )
        return changed, {"replaced": replaced, "movable": movable, "models": models}

    def _to_habitat(self, scenes: Sequence[Scene], sets: Sequence[SceneSet]) -> tuple[list[Path], str]:
        from h3data.recording.task_episodes.episode_files import episode_files

        habitat = scene_files("habitat")
        assert habitat.write_collection is not None
        stems = [re.sub(r"[^A-Za-z0-9_-]+", "_", s.label) for s in sets]
        name = stems[0] if sets else None
        config = f"{name}{habitat.collection}"
        sampled = {
            f"social_nav_{stem}.json.gz": _episodes(scene_set, self.episodes, self.out, config)
            for stem, scene_set in zip(stems, sets, strict=True)
        }
        dataset = habitat.write_collection(
            scenes, self.out, name=name, split_building=self.split_building, force=self.force
        )
        for file, episodes in sampled.items():
            if len(episodes):
                (self.out / "episodes").mkdir(exist_ok=True)
                episode_files().write(_with_targets(episodes, self.out), self.out / "episodes" / file)
        return sorted(p for p in self.out.rglob("*") if p.is_file()), str(dataset)

    def _to_glb(self, scenes: Sequence[Scene]) -> tuple[list[Path], str]:
        from h3data.scene import save_scene

        files = self._claimed(scenes, ".glb")
        for scene, file in zip(scenes, files, strict=True):
            save_scene(scene, file)
        return files, str(files[0])

    def _to_usd(self, scenes: Sequence[Scene]) -> tuple[list[Path], str]:
        usd = scene_files("usd")
        assert usd.write_scene is not None
        if self.out.suffix.lower() not in usd.endings:
            targets = self._claimed(scenes, ".usdc")
        elif len(scenes) == 1:
            targets = [claim_file(self.out, force=self.force)]
        else:
            raise InputError(
                f"One USD file holds one scene, {len(scenes)} are given. Hint: name a folder. -o: {self.out}",
                code="H3-BODY-177",
            )
        files = [file for scene, target in zip(scenes, targets, strict=True) for file in usd.write_scene(scene, target)]
        return files, str(targets[0])

    def _claimed(self, scenes: Sequence[Scene], ending: str) -> list[Path]:
        """Return one file in the folder per scene, which may be written."""
        files = [self.out / f"{re.sub(r'[^A-Za-z0-9_-]+', '_', s.name)}{ending}" for s in scenes]
        if len(set(files)) < len(files):
            raise InputError(
                "Two scenes have the same name: their files would overwrite each other.", code="H3-BODY-155"
            )
        return [claim_file(file, force=self.force) for file in files]


@dataclass(frozen=True)
class ScenesValidate:
    """Check scenes for problems; the exit code is 1 if there are any.

    Problems are a disconnected floor, unreachable rooms, narrow passages, overlapping, floating or sunken objects,
    receptacles out of reach, and missing assets.

    Examples:
        h3data scenes validate small:3 medium:0
        h3data scenes validate h3-homes/val h3-homes/test
        h3data scenes validate small --homes 10
        h3data scenes validate my_home.scene_instance.json -o problems.png
    """

    scenes: tyro.conf.Positional[tuple[str, ...]]
    """A preset (small, medium, large, small2, ...), one home (small:3), a set (h3-homes/test, a .toml file) or paths of
    scenes."""
    homes: int = 4
    """Number of homes to check per preset."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """PNG file for a plan with the problems marked; for several scenes, a folder of them."""
    radius: float = AGENT_RADIUS_M
    """Radius of the agent [m]."""
    assets: AssetsOption = ()
    strict: StrictFlag = False
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Check the scenes, mark their problems on plans if an output is named, and return a report."""
        if not self.scenes:
            raise InputError(f"Expected at least one scene: {_SCENE_HELP}", code="H3-BODY-151")
        if not 0.05 <= self.radius <= 2:
            raise InputError(f"--radius must be from 0.05 to 2 m, got {self.radius}.", code="H3-BODY-156")
        if self.homes < 1:
            raise InputError(f"--homes must be at least 1, got {self.homes}.", code="H3-BODY-147")
        scenes = {named.name: named for named in _all_named(self.scenes, self.homes, self.assets, self.strict)}
        targets = self._targets(list(scenes))
        reports = [
            validate_scene(named, radius_m=self.radius, picture=targets.get(name))
            for name, named in progress(scenes.items(), desc="validate", unit="scene", at_least=5)
        ]
        problems = sum(len(r["problems"]) for r in reports)
        cells = [
            [short_name(r["scene"]), p["kind"].replace("_", " "), p["subject"], p["text"]]
            for r in reports
            for p in r["problems"]
        ]
        lines = [f"{short_name(r['scene'])}: {'ok' if not r['problems'] else len(r['problems'])}" for r in reports]
        lines = [line if line.endswith("ok") else f"{line} problems" for line in lines]
        lines += ["", text_table(("scene", "problem", "where", "what"), cells)] if cells else []
        lines += [f"note: {short_name(r['scene'])}: {note}" for r in reports for note in r["notes"]]
        lines += [f"wrote {target}" for target in targets.values()]
        data = {"faults": problems, "scenes": reports}
        return Outcome(text="\n".join(lines), data=data, exit_code=1 if problems else 0)

    def _targets(self, names: Sequence[str]) -> dict[str, Path]:
        if self.out is None:
            return {}
        if len(names) == 1 and self.out.suffix.lower() == ".png":
            return {names[0]: _png(self.out, force=self.force)}
        stems = {name: re.sub(r"[^A-Za-z0-9_-]+", "_", _stem(name)) for name in names}
        if len(set(stems.values())) < len(stems):
            raise InputError(
                "Two scenes have the same name: their images would overwrite each other.", code="H3-BODY-157"
            )
        return {name: claim_file(self.out / f"{stem}.png", force=self.force) for name, stem in stems.items()}


SCENES = Group(
    "Scenes to simulate in: list, render, export and validate them.",
    {"list": ScenesList, "show": ScenesShow, "export": ScenesExport, "validate": ScenesValidate},
)


# --- scenes by name ---------------------------------------------------------------------------------------------------
def _named(
    text: str, homes: int, assets: Sequence[Path], strict: bool, allow_missing: bool = False
) -> tuple[NamedScene, ...]:
    if allow_missing and strict:
        raise InputError(
            "Choose either --strict, which refuses missing files, or --allow-missing, which skips them.",
            code="H3-BODY-142",
        )
    return named_scenes(text, homes=homes, assets=assets, strict=strict, allow_missing=allow_missing)


def _refuse_preset(text: str) -> None:
    if text in preset_names():
        raise InputError(
            f"Expected a single home, {text!r} is a preset: add a seed, e.g. {text}:0.", code="H3-BODY-143"
        )


def _one(text: str, assets: Sequence[Path], strict: bool, allow_missing: bool) -> NamedScene:
    _refuse_preset(text)
    scenes = _named(text, 1, assets, strict, allow_missing)
    if len(scenes) != 1 and is_collection(text):
        names = ", ".join(f"#{n.source.scene}" for n in scenes[:8] if isinstance(n.source, SceneFile))
        raise InputError(
            f"Expected a single scene, the dataset has {len(scenes)}: add one to its path ({names or 'none'}): {text}",
            code="H3-BODY-144",
        )
    if len(scenes) != 1:
        raise InputError(
            f"Expected a single scene, {text!r} is a set of {len(scenes)}: name one, e.g. {text}#0.", code="H3-BODY-145"
        )
    return scenes[0]


def _stem(name: str) -> str:
    """Return a name without folders and endings: ``replica#apt_0`` of ``sets/replica.scene_dataset_config.json#apt_0``."""
    file, scene = collection_and_scene(name)
    return Path(name).name.split(".")[0] if file is None else f"{file.name.split('.')[0]}#{scene}".split(".")[0]


def _all_named(texts: Sequence[str], *options: Any) -> list[NamedScene]:
    return [named for text in texts for named in _named(text, *options)]


def _renamed(named: NamedScene) -> Scene:
    """Open a scene; a scene of a set is named by its id."""
    scene = open_scene(named.source)
    return replace(scene, name=named.id) if named.id else scene


def _row(named: NamedScene) -> dict[str, Any]:
    return {**scene_size(named.name, open_scene(named.source), _free(named)), "id": named.id}


def _free(named: NamedScene) -> FreeSpace | None:
    """Return the free space of the default agent; None if there is none, as in a file that holds a single chair."""
    open_scene(named.source)  # outside the try: errors of the scene itself must reach the user
    try:
        return open_free_space(named.source, AGENT_RADIUS_M, AGENT_HEIGHT_M)
    except SceneError:
        return None


def _episodes(scenes: SceneSet, max_count: int | None, folder: Path, config: str) -> EpisodeSet:
    """Return the first episodes of a set in Habitat's format, in the order in which `h3data generate` plays them.

    Their paths lead through ``folder`` as it was given, so Habitat finds the scenes from the working directory of the export,
    as with its own ``data/...``.
    """
    from h3data.recording.task_episodes.social_nav_episodes import social_nav_episode
    from h3data_pipelines.assets.set_episodes import set_episode

    count = scenes.episodes if max_count is None else min(max_count, scenes.episodes)
    episodes = []
    for i in progress(range(count), desc=f"episodes of {scenes.label}", unit="episode", at_least=50):
        entry, index = scenes.place(i)
        episodes.append(
            social_nav_episode(
                set_episode(scenes, entry, index),
                episode_id=str(i),
                scene_id=(folder / f"scenes/{entry.id}.scene_instance.json").as_posix(),
                scene_dataset_config=(folder / config).as_posix(),
            )
        )
    return EpisodeSet(episodes=tuple(episodes))


def _with_targets(episodes: EpisodeSet, folder: Path) -> EpisodeSet:
    """Give every episode one target object, below the floor where nobody meets it.

    Habitat's social navigation keeps its starts `min_start_distance` away from some target object, and cannot reset
    without one (spec/habitat.md 1.2). The object is another piece of one that stands in the scene.
    """
    templates: dict[str, str | None] = {}
    out = []
    for episode in episodes.episodes:
        file = folder / "scenes" / Path(episode.scene_id).name
        if file.name not in templates:
            things = json.loads(file.read_text())["object_instances"]
            movable = sorted(thing["template_name"] for thing in things if thing["motion_type"] != "STATIC")
            templates[file.name] = next(iter(movable), None)
        handle = templates[file.name]
        if handle is not None:
            x, y, z = episode.start_position
            matrix = np.eye(4)
            matrix[:3, 3] = x, y - _PARKED_M, z
            thing = RigidObject(config=f"{handle}.object_config.json", matrix=matrix)
            name = f"{handle}_:0000"
            labels = {**episode.info, "object_labels": {name: "any_targets|0"}}
            episode = msgspec.structs.replace(episode, rigid_objects=(thing,), targets={name: matrix}, info=labels)
        out.append(episode)
    return EpisodeSet(episodes=tuple(out))


def _png(path: Path, *, force: bool) -> Path:
    if path.suffix.lower() != ".png":
        raise InputError(f"Expected a file name that ends in .png, got: {path}", code="H3-BODY-146")
    return claim_file(path, force=force)
