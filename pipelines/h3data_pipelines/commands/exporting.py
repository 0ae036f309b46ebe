"""Command ``h3data export``, which writes recordings in the file formats of other programs."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import (
    BackendOption,
    ForceFlag,
    JsonFlag,
    NameOf,
    Outcome,
    PeopleOption,
    StandInsFlag,
    claim_file,
    claim_folder,
    open_episode,
)
from h3data.commands.options import command_line, command_of
from h3data.errors import InputError, suggest_keywords
from h3data.formats import BagStorage, ExportRequest, Format, PersonDetail, export_options, load
from h3data.progress import progress
from h3data.recording import Recording
from h3data.recording.episodes import StoredEpisode, common_cameras
from h3data.recording.finding import find_episodes
from h3data.recording.storage import place
from h3data_pipelines.dataset_folders import remove_dataset
from h3data_pipelines.execution.processes import core_count
from h3data_pipelines.format_names import export_format
from h3data_pipelines.hub.provenance import read_commands, write_commands
from h3data_pipelines.outputs import check_backend

if TYPE_CHECKING:
    from typing import Literal

    from h3data.bodies.people.rigid_parts import PeopleStyle
    from h3data.commands.arguments import FilePath, Paths

log = logging.getLogger(__name__)


@suggest_keywords
def export(
    recording: FilePath,
    out: FilePath,
    *,
    to: str,
    agent: str | None = None,
    assets: Paths = (),
    person_detail: Literal["full", "low"] = "full",
    cameras: Paths = (),
    people: PeopleStyle = "skin",
    stand_ins: bool = False,
    storage: Literal["mcap", "sqlite3"] = "mcap",
    lidar: int = 0,
    backend: Literal["auto", "cpu", "gpu"] = "cpu",
    force: bool = False,
) -> Path:
    """Export recordings to file formats of other programs, with the options of ``h3data export``.

    Returns:
        The exported file or folder.

    Raises:
        InputError: the format or an option is invalid, or the output exists.
    """
    return result_of(Export, locals())


@command_of(export)
class Export:
    """Export recordings to file formats of other programs.

    h3data docs export describes what each format contains. gfx-replay: Habitat's own replay (.json, .json.gz) with GLB
    files next to it. gltf: one animated .glb for three.js and Blender. foxglove: a .foxglove.mcap of standard messages
    for Foxglove and Lichtblick. rosbag2: a bag of ROS 2 for RViz, PlotJuggler and ros2 bag play. csv: a folder of
    tables and NumPy arrays. lerobot, robomimic and minari: demonstrations for imitation learning, from one or many
    recordings. habitat-episodes: rearrangement episodes for habitat-lab, with their scenes.

    Examples:
        h3data export out/demo/episode.mcap --to gfx-replay -o episode.gfx_replay.json.gz
        h3data export out/demo/episode.mcap --to gltf -o episode.glb
        h3data export ds#3 --to foxglove --camera robot_arm -o episode.foxglove.mcap
        h3data export ds#3 --to rosbag2 --camera robot_arm -o bag/
        h3data export ds#3 --to csv -o tables/
        h3data export ds/ --to lerobot -o lerobot/ --agent robot
        h3data export ds/ --to lerobot --cameras robot_arm,human_head -o lerobot/
        h3data export ds/ --to robomimic -o demos.hdf5
        h3data export ds/ --to minari -o walks-v0
        h3data export ds/ --to habitat-episodes -o data/h3
    """

    recording: tyro.conf.Positional[Path]
    """A .mcap file or one episode of a dataset (ds#3); for lerobot, robomimic, minari and habitat-episodes also a
    dataset or a folder of recordings."""
    to: Annotated[str, NameOf(export_options)]
    """Format to write: a built-in format, the format of an installed plug-in, or module:name."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Output file (gfx-replay, gltf, foxglove, robomimic) or folder (rosbag2, csv, lerobot, minari,
    habitat-episodes).
    """
    agent: str | None
    """Agent whose actions are exported as demonstrations, for lerobot, robomimic and minari (default: the first robot
    that acts).
    """
    assets: tuple[Path, ...]
    """Folders in which the recorded asset files are searched (default: H3DATA_ASSETS)."""
    person_detail: PersonDetail
    """Detail of the meshes of people for gfx-replay and gltf: full (19,000 vertices) or low (3,000 vertices)."""
    people: PeopleOption
    stand_ins: StandInsFlag
    cameras: tuple[str, ...]
    """Cameras to add as videos (foxglove, lerobot) or images (rosbag2): names as in rerender, or .toml or .json files.
    lerobot copies the videos that a dataset has, and renders others (default: all that the dataset has)."""
    storage: BagStorage
    """For rosbag2: storage of the bag, mcap or sqlite3 (which ROS 2 Humble reads without another package)."""
    lidar: int
    """For rosbag2: number of rays of a planar lidar that is simulated in the map for each robot without recorded scans
    (0: none).
    """
    backend: BackendOption
    force: ForceFlag
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Export the recordings and return the written files."""
        form = export_format(self.to)
        if self.backend != "cpu" and "cameras" not in form.write_options:
            raise InputError(
                f"--backend is not for {form.option}, but for {_formats_with('cameras')}. Leave it out.",
                code="H3-OPTION-034",
            )
        check_backend(self.backend)
        given = {option: getattr(self, option) for option in ("agent", "assets", "people", "stand_ins", "cameras")}
        given |= {"person_detail": self.person_detail, "storage": self.storage, "lidar": self.lidar}
        for option, value in given.items():
            if value not in (None, (), "skin", "full", False, "mcap", 0) and option not in form.write_options:
                raise InputError(
                    f"--{option.replace('_', '-')} is not for {form.option}, but for {_formats_with(option)}. Leave it out.",
                    code="H3-OPTION-035",
                )
        recordings: Iterable[Recording]
        sources: list[StoredEpisode] = []
        if form.many:
            recordings = _Episodes(self.recording)
            sources = recordings.sources
        else:
            recordings = [open_episode(self.recording)]
        is_new = form.target == "folder" and not self.out.exists()
        self._claim(form)
        request = ExportRequest(
            out=self.out,
            force=self.force,
            agent=self.agent,
            assets=self.assets,
            person_detail=self.person_detail,
            people=self.people,
            stand_ins=self.stand_ins,
            cameras=self.cameras,
            storage=self.storage,
            lidar=self.lidar,
            stored_cameras=common_cameras(sources) if "cameras" in form.write_options else (),
            stored_videos=lambda number: sources[number].read_videos(),
            threads=core_count(),
            backend=self.backend,
            progress=_progress,
        )
        try:
            exported = load(form, "write")(recordings, request)
        except BaseException:
            if is_new:
                with suppress(OSError):  # not empty: what was written is kept
                    self.out.rmdir()
            raise
        if form.target == "dataset":
            roots = dict.fromkeys(source.name.rpartition("#")[0] for source in sources)
            made = [command for root in roots if root for command in read_commands(place(root))]
            write_commands(place(self.out), [*dict.fromkeys(made), command_line("export", self)])
        return Outcome(
            text=exported.text, data={"to": form.option, "out": str(self.out), **exported.data}, result=self.out
        )

    def _claim(self, form: Format) -> None:
        if form.target == "file":
            claim_file(self.out, force=self.force)
        elif form.target == "folder":
            claim_folder(self.out, force=self.force)
        elif self.force:
            source, target = Path(str(self.recording).partition("#")[0]).resolve(), self.out.resolve()
            if source == target or target in source.parents:
                raise InputError(
                    f"--force would delete what is exported. Choose another folder with -o: {self.out}",
                    code="H3-OPTION-036",
                )
            remove_dataset(self.out)


def _formats_with(option: Any) -> str:
    return " and ".join(name for name, form in export_options().items() if option in form.write_options)


def _progress(items: Iterable[Any], total: int, unit: str) -> Iterable[Any]:
    return progress(items, total=total, desc="render", unit=unit, leave=False)


class _Episodes:
    """The recordings of a path, read again on every iteration."""

    def __init__(self, path: Path) -> None:
        self.sources: list[StoredEpisode] = find_episodes([path])

    def __iter__(self) -> Iterator[Recording]:
        for source in progress(self.sources, desc="export", unit="episode"):
            yield source.read()
