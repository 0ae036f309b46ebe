"""``h3data export``: recordings of ours become files of other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tqdm import tqdm

from h3data.errors import InputError
from h3data.recording import Recording
from h3data_pipelines.command import (
    ForceFlag,
    JsonFlag,
    Outcome,
    claim_file,
    claim_folder,
    open_episode,
    remove_dataset,
)
from h3data_pipelines.jobs.episode_sources import EpisodeSource, find_episodes
from h3data_pipelines.pictures.drawing import core_count

Format = Literal["gfx-replay", "gltf", "foxglove", "lerobot", "robomimic", "csv"]


@dataclass(frozen=True)
class Export:
    """Write recordings as files of other programs; docs/export.md says what each of them keeps.

    gfx-replay: Habitat's own replay (.json, .json.gz) with GLB files beside it. gltf: one animated .glb for three.js and
    Blender. foxglove: a .foxglove.mcap of standard messages for Foxglove and Lichtblick. csv: a folder of tables and NumPy
    arrays. lerobot and robomimic: demonstrations to learn from, of one or many recordings.

    Examples:
        h3data export out/demo/episode.mcap --to gfx-replay -o episode.gfx_replay.json.gz
        h3data export out/demo/episode.mcap --to gltf -o episode.glb
        h3data export ds#3 --to foxglove --camera robot_arm -o episode.foxglove.mcap
        h3data export ds#3 --to csv -o tables/
        h3data export ds/ --to lerobot -o lerobot/ --agent robot
        h3data export ds/ --to robomimic -o demos.hdf5
    """

    recording: tyro.conf.Positional[Path]
    """A .mcap file or one episode of a dataset (ds#3); for lerobot and robomimic also a dataset or a folder of recordings."""
    to: Format
    """What to write."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The file (gfx-replay, gltf, foxglove, robomimic) or folder (csv, lerobot)."""
    agent: str | None = None
    """Whose actions are learned, for lerobot and robomimic (default: the first robot that acts)."""
    assets: tuple[Path, ...] = ()
    """Folders below which the recorded asset files are searched (default: H3DATA_ASSETS)."""
    light: bool = False
    """Take the light meshes of people (3,000 vertices instead of 19,000), for gfx-replay and gltf."""
    camera: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Draw what this camera sees at every step, for foxglove: a name as in rerender, or a .toml or .json file; may be given
    several times."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        if self.agent is not None and self.to not in ("lerobot", "robomimic"):
            raise InputError(f"--agent is for lerobot and robomimic; {self.to} holds everybody. Leave it out.")
        if self.light and self.to not in ("gfx-replay", "gltf"):
            raise InputError(f"--light is for gfx-replay and gltf, not for {self.to}. Leave it out.")
        if self.assets and self.to not in ("gfx-replay", "gltf", "foxglove"):
            raise InputError(f"--assets is for gfx-replay, gltf and foxglove; {self.to} holds no meshes.")
        if self.camera and self.to != "foxglove":
            raise InputError(f"--camera is for foxglove, not for {self.to}. Hint: h3data rerender draws pictures.")
        text, data = _WRITERS[self.to](self)
        return Outcome(text=text, data={"to": self.to, "out": str(self.out), **data})


def _gfx_replay(options: Export) -> tuple[str, dict[str, Any]]:
    from h3data.export.gfx_replay_write import assets_folder, write_gfx_replay

    recording = open_episode(options.recording)
    if options.out.name.endswith((".json", ".json.gz")):
        claim_file(options.out, force=options.force)
        if any(asset.uri.startswith("scene:") for asset in recording.assets) or any(a.model for a in recording.agents):
            claim_folder(assets_folder(options.out), force=options.force)
    parts, cameras, missing = _posed(options, recording)
    made = write_gfx_replay(recording, parts, options.out, cameras=cameras)
    size = made.path.stat().st_size
    text = f"{made.path}: {made.keyframes} keyframes, {made.instances} instances, {_size(size)}"
    if made.assets:
        text += f"\n{assets_folder(made.path)}: {len(made.assets)} GLB files. Start habitat-sim in the folder of both."
    data = {"keyframes": made.keyframes, "instances": made.instances, "bytes": size, "assets": len(made.assets)}
    return text + _missing_note(missing, "are named as they were recorded"), {**data, "missing": missing}


def _gltf(options: Export) -> tuple[str, dict[str, Any]]:
    from h3data.export.gltf_animation import write_gltf_animation

    recording = open_episode(options.recording)
    claim_file(options.out, force=options.force)
    parts, cameras, missing = _posed(options, recording)
    made = write_gltf_animation(recording, parts, options.out, cameras=cameras)
    size = made.path.stat().st_size
    text = (
        f"{made.path}: {made.seconds:.1f} s, {made.nodes} nodes, {made.meshes} meshes, {made.joints} joints, "
        f"{len(cameras)} cameras, {_size(size)}"
    )
    data = {
        "seconds": made.seconds, "nodes": made.nodes, "meshes": made.meshes, "joints": made.joints,
        "channels": made.channels, "cameras": len(cameras), "bytes": size, "missing": missing,
    }  # fmt: skip
    return text + _missing_note(missing, "are marked placeholders"), data


def _posed(options: Export, recording: Recording) -> tuple[list[Any], list[Any], list[str]]:
    from h3data.export.posing import posed_cameras, posed_parts
    from h3data.replay import Replay

    replay = Replay(recording, assets=options.assets, detail=not options.light)
    return posed_parts(replay), posed_cameras(replay), sorted(replay.missing)


def _foxglove(options: Export) -> tuple[str, dict[str, Any]]:
    from h3data.export.foxglove.write import FoxgloveCamera, write_foxglove
    from h3data.export.posing import posed_parts
    from h3data.replay import Replay, camera_track

    recording = open_episode(options.recording)
    claim_file(options.out, force=options.force)
    replay = Replay(recording, assets=options.assets, detail=False)
    tracks = [camera_track(replay, name) for name in options.camera]
    frames = replay.frames(tracks, range(len(recording) if tracks else 0), threads=core_count())
    shown = tqdm(frames, total=len(recording), desc="render", unit="frame", disable=None if tracks else True)
    made = write_foxglove(
        recording,
        lambda steps: posed_parts(replay, steps),
        options.out,
        cameras=[FoxgloveCamera(camera=track.camera, poses=track.poses) for track in tracks],
        pictures=((step, [image["rgb"] for image in images]) for step, images in shown),
    )
    size = made.path.stat().st_size
    text = f"{made.path}: {made.messages} messages on {len(made.topics)} topics, {made.frames} frames, {_size(size)}"
    data = {"messages": made.messages, "topics": list(made.topics), "frames": made.frames, "bytes": size}
    missing = sorted(replay.missing)
    return text + _missing_note(missing, "are marked placeholders"), {**data, "missing": missing}


def _csv(options: Export) -> tuple[str, dict[str, Any]]:
    from h3data.export.csv_tables import write_csv_tables

    recording = open_episode(options.recording)
    files = write_csv_tables(recording, claim_folder(options.out, force=options.force))
    lines = [f"{file}: {_size(file.stat().st_size)}" for file in files]
    return "\n".join(lines), {"steps": len(recording), "files": [str(file) for file in files]}


def _lerobot(options: Export) -> tuple[str, dict[str, Any]]:
    from h3data.export.lerobot_export import write_lerobot

    episodes = _Episodes(options.recording)
    if options.force:
        _keep_apart(options)
        remove_dataset(options.out)
    count = write_lerobot(episodes, options.out, agent=options.agent, overwrite=options.force)
    return f"{options.out}: {count} episode{'s' * (count != 1)} as a LeRobot v3.0 dataset", {"episodes": count}


def _robomimic(options: Export) -> tuple[str, dict[str, Any]]:
    from h3data.export.robomimic import write_robomimic

    claim_file(options.out, force=options.force)
    count = write_robomimic(_Episodes(options.recording), options.out, agent=options.agent)
    size = options.out.stat().st_size
    return f"{options.out}: {count} demonstration{'s' * (count != 1)}, {_size(size)}", {
        "demonstrations": count,
        "bytes": size,
    }


_WRITERS: dict[Format, Callable[[Export], tuple[str, dict[str, Any]]]] = {
    "gfx-replay": _gfx_replay,
    "gltf": _gltf,
    "foxglove": _foxglove,
    "csv": _csv,
    "lerobot": _lerobot,
    "robomimic": _robomimic,
}


class _Episodes:
    """The recordings of a path, read anew each time that they are gone through."""

    def __init__(self, path: Path) -> None:
        self._sources: list[EpisodeSource] = find_episodes([path])

    def __iter__(self) -> Iterator[Recording]:
        for source in tqdm(self._sources, desc="export", unit="episode", disable=None):
            yield source.read()


def _keep_apart(options: Export) -> None:
    """Refuse to replace the dataset that is read."""
    source = Path(str(options.recording).partition("#")[0]).resolve()
    target = options.out.resolve()
    if source == target or target in source.parents:
        raise InputError(f"--force would delete what is exported. Choose another folder with -o: {options.out}")


def _missing_note(missing: list[str], what: str) -> str:
    return f"\n{len(missing)} asset files were not found and {what}. Hint: --assets DIR" if missing else ""


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.1f} kB"
