"""``h3data scenes``: which homes there are, what they look like, their files in other formats, what is wrong with them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tqdm import tqdm

from h3data.errors import InputError, SceneError
from h3data.habitat.episodes.rearrange_episode import EpisodeSet
from h3data.habitat.scene_names import NamedScene, named_scenes, open_free_space, open_scene
from h3data.habitat.scenes.scene_dataset import DATASET_ENDING
from h3data.scene import HOME_PRESETS, FreeSpace, Scene
from h3data.scene.scene_sets import SceneFile, SceneSet, find_scene_set
from h3data_pipelines.assets.scene_reports import (
    AGENT_HEIGHT_M,
    AGENT_RADIUS_M,
    cell,
    presets_and_sets,
    scene_size,
    short_name,
    text_table,
    validate_scene,
    written,
)
from h3data_pipelines.command import (
    AssetsOption,
    ForceFlag,
    Group,
    JsonFlag,
    MissingFlag,
    Outcome,
    StrictFlag,
    claim_file,
)

_SCENE_HELP = (
    "small:3 (built-in home), h3-homes/test (a set) or the path of a scene (.scene_instance.json, .stage_config.json, "
    ".glb)."
)


@dataclass(frozen=True)
class ScenesList:
    """List what can be simulated in: presets of built-in homes and sets of scenes, or the sizes of given scenes.

    Examples:
        h3data scenes list
        h3data scenes list h3-homes/test
        h3data scenes list small --homes 5
        h3data scenes list medium:0 my_home.scene_instance.json --json
        h3data scenes list replicaCAD.scene_dataset_config.json
    """

    scenes: tyro.conf.Positional[tuple[str, ...]] = ()
    """A preset (small, medium, large), one home (small:3), a set (h3-homes/test, a .toml file), one of its scenes
    (h3-homes/test#3) or paths of scenes; nothing lists presets and sets."""
    homes: int = 4
    """How many homes of a preset."""
    assets: AssetsOption = ()
    strict: StrictFlag = False
    allow_missing: MissingFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        if self.homes < 1:
            raise InputError(f"--homes must be at least 1, got {self.homes}.")
        if not self.scenes:
            return presets_and_sets()
        if all(text.endswith(DATASET_ENDING) for text in self.scenes):  # names only: a dataset may have hundreds
            names = [
                named.name
                for named in _all_named(self.scenes, self.homes, self.assets, self.strict, self.allow_missing)
            ]
            return Outcome(text="\n".join(names), data={"scenes": [{"scene": name} for name in names]})
        rows = [
            _row(named) for named in _all_named(self.scenes, self.homes, self.assets, self.strict, self.allow_missing)
        ]
        columns = {
            "scene": "scene", "id": "id", "rooms": "rooms", "floor_m2": "floor m2", "free_m2": "free m2",
            "assets": "assets", "instances": "things", "movable": "movable", "receptacles": "receptacles",
            "triangles": "triangles",
        }  # fmt: skip
        if not any(row["id"] for row in rows):
            del columns["id"]
        cells = [[cell(row[key]) for key in columns] for row in rows]
        return Outcome(text=text_table(list(columns.values()), cells), data={"scenes": rows})


@dataclass(frozen=True)
class ScenesShow:
    """Draw one scene: a plan with rooms, free floor and receptacles, or a view at eye level.

    Examples:
        h3data scenes show small:3 -o home.png
        h3data scenes show h3-homes/test#3 -o home.png
        h3data scenes show medium:0 --view eye --room kitchen -o kitchen.png
        h3data scenes show my_home.scene_instance.json -o home.png --pixels-per-m 60
        h3data scenes show replicaCAD.scene_dataset_config.json#apt_0 -o apt_0.png
    """

    scene: tyro.conf.Positional[str]
    """small:3 (built-in home), h3-homes/test#3 (one of a set), or the path of a scene."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """PNG file to write."""
    view: Literal["plan", "eye"] = "plan"
    """From above, or as somebody sees it who stands in a room."""
    room: str = ""
    """Which room, for --view eye (default: the largest)."""
    pixels_per_m: float = 80.0
    """Size of the plan."""
    assets: AssetsOption = ()
    strict: StrictFlag = False
    allow_missing: MissingFlag = False
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        from h3data.render import write_png
        from h3data.render.sheets.scene_map import eye_level_picture, plan_picture, scene_map

        named = _one(self.scene, self.assets, self.strict, self.allow_missing)
        scene = _renamed(named)
        target = _png(self.out, force=self.force)
        if not 4 <= self.pixels_per_m <= 1000:
            raise InputError(f"--pixels-per-m must be from 4 to 1000, got {self.pixels_per_m}.")
        if self.room and self.view != "eye":
            raise InputError("--room chooses where to stand: add --view eye.")
        free = _free(named)
        if free is None and self.view == "eye":
            raise InputError(f"Nobody can stand in {named.name}, so there is no view --view eye.")
        if free is None:
            image, _ = plan_picture(scene, pixels_per_m=self.pixels_per_m)
        elif self.view == "eye":
            image = eye_level_picture(scene, free, room=self.room or None)
        else:
            image = scene_map(scene, free, pixels_per_m=self.pixels_per_m)
        written(target, lambda: write_png(target, image))
        height, width = image.shape[:2]
        data = {"file": str(target), "width": width, "height": height, **_row(named)}
        return Outcome(text=f"wrote {target} ({width}x{height})", data=data)


@dataclass(frozen=True)
class ScenesExport:
    """Write scenes for other programs: a Habitat scene dataset that habitat-sim loads, or one GLB each. With a set, its
    episodes come too, as a Habitat episode file.

    Examples:
        h3data scenes export h3-homes/test -o exports/h3-homes_test
        h3data scenes export small:0 small:1 medium:0 -o exports/homes
        h3data scenes export small:3 --to glb -o exports/
    """

    scenes: tyro.conf.Positional[tuple[str, ...]]
    """A set (h3-homes/test, a .toml file), small:3 (built-in homes), h3-homes/test#3 or paths of scenes. Several share the
    objects of one Habitat dataset."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder: of the dataset, which must be new, or for the .glb files."""
    to: Literal["habitat", "glb"] = "habitat"
    """Format: habitat (configs, stage, one GLB per object, receptacles, lights, regions) or glb (opens in any viewer)."""
    episodes: int | None = None
    """How many episodes of a set to write, for habitat (default: all; 0: none)."""
    assets: AssetsOption = ()
    strict: StrictFlag = False
    allow_missing: MissingFlag = False
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        if not self.scenes:
            raise InputError(f"Expected at least one scene: {_SCENE_HELP}")
        if self.episodes is not None and self.episodes < 0:
            raise InputError(f"--episodes must be at least 0, got {self.episodes}.")
        sets = [found for text in self.scenes if "#" not in text and (found := find_scene_set(text)) is not None]
        whole = [text for text in self.scenes if text in HOME_PRESETS]
        if whole:
            raise InputError(f"Which home? {whole[0]!r} is a preset: give a seed as well, e.g. {whole[0]}:0.")
        scenes = [_renamed(named) for named in _all_named(self.scenes, 1, self.assets, self.strict, self.allow_missing)]
        if self.to == "habitat":
            files, first = self._to_habitat(scenes, sets)
        else:
            files, first = self._to_glb(scenes)
        size = sum(f.stat().st_size for f in files)
        names = ", ".join(s.name for s in scenes[:6]) + (f", ... ({len(scenes)})" if len(scenes) > 6 else "")
        episodes = [str(f) for f in files if f.parent.name == "episodes"]
        text = "\n".join([f"wrote {names} as {self.to}: {len(files)} files, {size / 1e6:.1f} MB", first, *episodes])
        data = {
            "format": self.to, "scenes": [s.name for s in scenes], "path": first, "episodes": episodes,
            "files": len(files), "bytes": size,
        }  # fmt: skip
        return Outcome(text=text, data=data)

    def _to_habitat(self, scenes: Sequence[Scene], sets: Sequence[SceneSet]) -> tuple[list[Path], str]:
        from h3data.export.habitat_scenes import export_habitat_dataset
        from h3data.habitat.episodes.episode_files import write_episodes

        stems = [re.sub(r"[^A-Za-z0-9_-]+", "_", s.label) for s in sets]
        name = stems[0] if sets else None
        config = f"{name}{DATASET_ENDING}"
        drawn = {
            f"social_nav_{stem}.json.gz": _episodes(of, self.episodes, config)
            for stem, of in zip(stems, sets, strict=True)
        }
        dataset = export_habitat_dataset(scenes, self.out, name=name, force=self.force)
        for file, episodes in drawn.items():
            if len(episodes):
                (self.out / "episodes").mkdir(exist_ok=True)
                write_episodes(episodes, self.out / "episodes" / file)
        return sorted(p for p in self.out.rglob("*") if p.is_file()), str(dataset)

    def _to_glb(self, scenes: Sequence[Scene]) -> tuple[list[Path], str]:
        from h3data.scene import save_scene

        files = [self.out / f"{re.sub(r'[^A-Za-z0-9_-]+', '_', s.name)}.glb" for s in scenes]
        if len(set(files)) < len(files):
            raise InputError("Two of the scenes have the same name, so their files would overwrite each other.")
        for file in files:
            claim_file(file, force=self.force)
        for scene, file in zip(scenes, files, strict=True):
            save_scene(scene, file)
        return files, str(files[0])


@dataclass(frozen=True)
class ScenesValidate:
    """Look for faults: cut-off floor, unreachable rooms, passages of nearly an agent's width, things inside each other,
    things that float or are sunk, receptacles out of reach, missing assets. Exit code 1 when there are any.

    Examples:
        h3data scenes validate small:3 medium:0
        h3data scenes validate h3-homes/val h3-homes/test
        h3data scenes validate small --homes 10
        h3data scenes validate my_home.scene_instance.json -o problems.png
    """

    scenes: tyro.conf.Positional[tuple[str, ...]]
    """A preset (small, medium, large), one home (small:3), a set (h3-homes/test, a .toml file) or paths of scenes."""
    homes: int = 4
    """How many homes of a preset."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """PNG with the problems drawn into the plan; for several scenes a folder, one PNG each."""
    radius: float = AGENT_RADIUS_M
    """Radius of the agent [m]."""
    assets: AssetsOption = ()
    strict: StrictFlag = False
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        if not self.scenes:
            raise InputError(f"Expected at least one scene: {_SCENE_HELP}")
        if not 0.05 <= self.radius <= 2:
            raise InputError(f"--radius must be from 0.05 to 2 m, got {self.radius}.")
        if self.homes < 1:
            raise InputError(f"--homes must be at least 1, got {self.homes}.")
        every = list(
            {named.name: named for named in _all_named(self.scenes, self.homes, self.assets, self.strict)}.values()
        )
        targets = self._targets([named.name for named in every])
        reports = [
            validate_scene(named, radius_m=self.radius, picture=targets.get(named.name))
            for named in tqdm(every, desc="validate", unit="scene", disable=True if len(every) < 5 else None)
        ]
        faults = sum(len(r["problems"]) for r in reports)
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
        data = {"faults": faults, "scenes": reports}
        return Outcome(text="\n".join(lines), data=data, exit_code=1 if faults else 0)

    def _targets(self, names: Sequence[str]) -> dict[str, Path]:
        if self.out is None:
            return {}
        if len(names) == 1 and self.out.suffix.lower() == ".png":
            return {names[0]: _png(self.out, force=self.force)}
        stems = {
            name: re.sub(r"[^A-Za-z0-9_-]+", "_", Path(name).name.replace(DATASET_ENDING, "").split(".")[0])
            for name in names
        }
        if len(set(stems.values())) < len(stems):
            raise InputError("Two of the scenes have the same name, so their pictures would overwrite each other.")
        return {name: claim_file(self.out / f"{stem}.png", force=self.force) for name, stem in stems.items()}


SCENES = Group(
    "Homes to simulate in: list them, draw them, export them to other formats, look for faults.",
    {"list": ScenesList, "show": ScenesShow, "export": ScenesExport, "validate": ScenesValidate},
)


# --- scenes by name ---------------------------------------------------------------------------------------------------
def _named(
    text: str, homes: int, assets: Sequence[Path], strict: bool, allow_missing: bool = False
) -> tuple[NamedScene, ...]:
    if allow_missing and strict:
        raise InputError("Choose one: --strict refuses what is missing, --allow-missing leaves it out.")
    return named_scenes(text, homes=homes, assets=assets, strict=strict, allow_missing=allow_missing)


def _one(text: str, assets: Sequence[Path], strict: bool, allow_missing: bool) -> NamedScene:
    if text in HOME_PRESETS:
        raise InputError(f"Which home? {text!r} is a preset: give a seed as well, e.g. {text}:0.")
    found = _named(text, 1, assets, strict, allow_missing)
    if len(found) != 1 and text.endswith(DATASET_ENDING):
        names = ", ".join(f"#{n.source.scene}" for n in found[:8] if isinstance(n.source, SceneFile))
        raise InputError(f"Which scene? The dataset has {len(found)}, add one to its path ({names or 'none'}): {text}")
    if len(found) != 1:
        raise InputError(f"Which scene? {text!r} is a set of {len(found)}: name one as {text}#0.")
    return found[0]


def _all_named(texts: Sequence[str], *options: Any) -> list[NamedScene]:
    return [named for text in texts for named in _named(text, *options)]


def _renamed(named: NamedScene) -> Scene:
    """The scene; one of a set by its id."""
    scene = open_scene(named.source)
    return replace(scene, name=named.id) if named.id else scene


def _row(named: NamedScene) -> dict[str, Any]:
    return {**scene_size(named.name, open_scene(named.source), _free(named)), "id": named.id}


def _free(named: NamedScene) -> FreeSpace | None:
    """The free floor; None if there is none, as for a single chair."""
    open_scene(named.source)  # tells what is wrong with the scene itself
    try:
        return open_free_space(named.source, AGENT_RADIUS_M, AGENT_HEIGHT_M)
    except SceneError:
        return None


def _episodes(scenes: SceneSet, wanted: int | None, config: str) -> EpisodeSet:
    """The first episodes of a set for a Habitat dataset, in the order in which `h3data generate` plays them."""
    from h3data.habitat.episodes.social_nav_episodes import social_nav_episode
    from sim_kinematic.tasks.social_nav_episodes import set_episode

    count = scenes.episodes if wanted is None else min(wanted, scenes.episodes)
    made = []
    for i in tqdm(range(count), desc=f"episodes of {scenes.label}", disable=True if count < 50 else None):
        entry, index = scenes.place(i)
        made.append(
            social_nav_episode(
                set_episode(scenes, entry, index), episode_id=str(i),
                scene_id=f"scenes/{entry.id}.scene_instance.json", scene_dataset_config=config,
            )
        )  # fmt: skip
    return EpisodeSet(episodes=tuple(made))


def _png(path: Path, *, force: bool) -> Path:
    if path.suffix.lower() != ".png":
        raise InputError(f"Expected a file name that ends in .png, got: {path}")
    return claim_file(path, force=force)
