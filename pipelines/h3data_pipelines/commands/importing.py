"""Command ``h3data import``, which converts recordings of other programs to MCAP recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import ForceFlag, JsonFlag, Outcome
from h3data.commands.options import command_of
from h3data.errors import suggest_keywords
from h3data.formats import ImportRequest, LengthUnit
from h3data.pseudonyms import participant_key_path
from h3data_pipelines.assets.scene_reports import text_table
from h3data_pipelines.jobs.imports import ImportResult, import_files

if TYPE_CHECKING:
    from typing import Literal

    from h3data.commands.arguments import FilePath, Paths


@suggest_keywords
def import_(
    paths: Paths,
    out: FilePath,
    *,
    assets: Paths = (),
    manifest: FilePath | None = None,
    fps: float = 30.0,
    people: str = "",
    robot: str = "",
    map: FilePath | None = None,
    goal: str = "",
    columns: tuple[str, ...] = (),
    unit: Literal["m", "cm", "mm"] | None = None,
    rate: float | None = None,
    hz: float | None = None,
    model: str = "",
    strict: bool = False,
    force: bool = False,
) -> ImportResult:
    """Convert recordings of other programs to MCAP recordings in ``out``, with the options of ``h3data import``.

    Returns:
        The outcome for every file.

    Raises:
        InputError: there is nothing to import.
        FormatError: the only file is of another kind or damaged.
    """
    return result_of(Import, locals())


@command_of(import_)
class Import:
    """Convert recordings of other programs to MCAP recordings.

    Folders are searched, and formats are detected by content.

    The command reads gfx-replay files, the logs of Habitat's human-in-the-loop tools, bags of ROS 2, tracks of people
    in files of public datasets (h3data docs ros), and formats of plug-ins (h3data docs import).

    Examples:
        h3data import my_session.gfx_replay.json -o rec/
        h3data import hitl_sessions/ -o rec/ --assets ~/habitat
        h3data import hitl_sessions/ -o rec/ --manifest sessions.csv
        h3data import my_bag/ --people /people --map map.yaml -o rec/
        h3data import tracks.csv --columns t,id,x,y --robot 7 -o rec/
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """gfx-replay files (.json, .json.gz), HITL logs (.json.gz, .pkl.gz), bags, files of tracks, or folders with such
    files.
    """
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the recordings, one .mcap each; files of a folder keep their relative paths."""
    assets: tuple[Path, ...]
    """Folders in which the recorded asset files are searched (default: H3DATA_ASSETS), so that missing files are
    reported.
    """
    manifest: Path | None
    """CSV table of a study, which assigns participants and conditions to files, user_ids or episode_ids (h3data docs
    import)."""
    fps: float
    """Steps per second of files without times: gfx-replay files and HITL logs of the first generation."""
    people: str
    """Topic of people in a bag of ROS 2, needed if the bag has several such topics, or a topic of markers."""
    robot: str
    """Robot of the recording: its frame or topic in a bag (default: base_footprint or base_link), or its id in a file
    of tracks.
    """
    map: Path | None
    """Yaml file of an occupancy map, whose walls become the scene of tracks (default: the one in the bag)."""
    goal: str
    """Goal of the robot as x,y in the frame of the map [m]."""
    columns: tuple[str, ...]
    """Columns of a table of tracks: t,id,x,y in their order, or t=NAME,id=NAME,x=NAME,y=NAME."""
    unit: LengthUnit | None
    """Unit of lengths in a table of tracks, if its format does not specify one."""
    rate: float | None
    """Number of frames per second in a file of tracks that has frame numbers instead of times."""
    hz: float | None
    """Rows per second of the recordings of tracks (default: one row for each observation)."""
    model: str
    """Body of the robot of a bag or of tracks: a built-in robot, or a URDF, robot.toml or MJCF file (default: a
    cylinder).
    """
    strict: bool
    """Refuse recordings with warnings or missing assets."""
    force: ForceFlag
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Convert the files and return the imported ones and the failures."""
        result = import_files(
            self.paths,
            self.out,
            assets=self.assets,
            manifest=self.manifest,
            fps=self.fps,
            tracks=ImportRequest(
                people=self.people,
                robot=self.robot,
                map=self.map,
                goal=self.goal,
                columns=self.columns,
                unit=self.unit,
                rate=self.rate,
                hz=self.hz,
                model=self.model,
            ),
            strict=self.strict,
            force=self.force,
        )
        return _report(result)


def _table(rows: list[dict[str, Any]]) -> str:
    """Return one line for each file: what became of it, what it is, and why it was not imported."""
    cells = [(row["status"], row["kind"], row["source"], str(row.get("steps", "")), _why(row)) for row in rows]
    return text_table(("", "kind", "file", "steps", "why"), cells)


def _why(row: dict[str, Any]) -> str:
    """Return the reason why a file was not imported, short enough for a table."""
    reason = row.get("reason", "").partition(" Hint:")[0]
    return reason.replace(row["source"], "").strip(" :")[:100]


def _report(result: ImportResult) -> Outcome:
    rows, lines = [file.to_dict() for file in result.files], []
    for row in rows:
        if row["status"] == "kept":
            lines.append(f"kept     {row['source']} -> {row['recording']}")
            continue
        if row["status"] != "imported":
            lines.append(f"{row['status']} {row['source']}: {row['reason']}")
            continue
        agents = ", ".join(f"{a['name']} ({a['kind']})" for a in row["agents"]) or "none recognised"
        lines += [
            f"imported {row['source']} -> {row['recording']}",
            f"         {row['steps']} steps, {row['bodies']} bodies ({row['moving']} moving), agents: {agents}",
        ]
        told = row["imported"]
        lines += [f"         {told[name]}" for name in ("summary", "scans") if name in told]
        if unread := told.get("not_read"):
            lines.append(f"         not read: {', '.join(unread)}")
        people = [f"{name} {row[name]}" for name in ("participant", "condition") if row[name]]
        lines += [f"         {', '.join(people)}"] if people else []
        if row["missing_assets"]:
            lines.append(
                f"         {row['missing_assets']} of {row['assets']} assets not found; they are drawn as marked "
                "placeholders. Hint: --assets DIR or H3DATA_ASSETS"
            )
        if row["synthesised"]:
            synthesised = "; ".join(f"{name}: {', '.join(what)}" for name, what in row["synthesised"].items())
            lines.append(f"         not in the file, synthesised: {synthesised}")
        lines += [f"         warning: {w}" for w in row["warnings"]]
    counts = {status: result.count(status) for status in ("imported", "kept", "skipped", "failed")}
    if len(rows) > 1:
        lines += [
            "",
            _table(rows),
            "",
            ", ".join(f"{count} {status}" for status, count in counts.items() if count or status != "kept"),
        ]
    lines += result.manifest_notes
    if any(file.summary.get("participant", "").startswith("P-") for file in result.files):
        lines.append(f"Participants are pseudonyms of user ids; the key that links them: {participant_key_path()}")
    data: dict[str, Any] = {**counts, "manifest": list(result.manifest_notes), "files": rows}
    if len(rows) == 1:
        data |= {k: v for k, v in rows[0].items() if k in ("steps", "recording", "bodies", "moving", "agents")}
    failed = counts["failed"] or not (counts["imported"] or counts["kept"])
    return Outcome(text="\n".join(lines), data=data, exit_code=1 if failed else 0)
