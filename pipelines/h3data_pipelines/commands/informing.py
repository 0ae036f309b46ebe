"""Command ``h3data info``, which shows the contents of recordings, datasets and episode files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from h3data.commands.command import JsonFlag, Outcome
from h3data.errors import H3DataError, InputError
from h3data.recording.finding import find_episodes
from h3data.recording.records import JOINTS
from h3data.recording.storage import AnyPath, place
from h3data.terminal import counted

if TYPE_CHECKING:
    from h3data.recording import Dataset, Recording


EPISODE_ENDINGS = (".json.gz", ".json", ".pickle")


@dataclass(frozen=True)
class Info:
    """Show the contents of recordings, datasets and episode files.

    For recordings and datasets, it shows the task, scene, agents, steps and columns. For episode files, it shows the
    tasks, scenes, objects, receptacles and distances.

    Examples:
        h3data info out/demo/episode.mcap
        h3data info ds/
        h3data info ds#3 --json
        h3data info recordings/
        h3data info social_rearrange.json.gz
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """.mcap files, datasets, single episodes (ds#3), folders of these, or their URIs; episode files (.json.gz, .json,
    .pickle) of Habitat, PARTNR and h3data."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return a description of each path."""
        if not self.paths:
            raise InputError("Expected at least one recording (.mcap), dataset or episode file.", code="H3-OPTION-043")
        described = [part for path in map(place, self.paths) for part in _described(path)]
        faults = sum("error" in data for _, data in described)
        if faults == len(described) == 1:
            raise InputError(described[0][1]["error"], code=described[0][1]["code"])
        return Outcome(
            text="\n\n".join(text for text, _ in described),
            data={"found": [data for _, data in described]},
            exit_code=int(faults > 0),
        )


def _described(path: AnyPath) -> list[tuple[str, dict[str, Any]]]:
    """Return the text and JSON values for a dataset, or for each recording at or below a path."""
    from h3data.recording import Dataset
    from h3data.recording.parquet.files import is_dataset

    if path.is_dir() and is_dataset(path):
        return [_of_dataset(Dataset(path))]
    if isinstance(path, Path) and path.name.endswith(EPISODE_ENDINGS) and path.is_file():
        return [_of_episode_file(path)]
    described = []
    for source in find_episodes([path]):
        try:
            recording = source.read()
        except H3DataError as error:
            described.append(
                (f"{source.name}: {error}", {"path": source.name, "error": str(error), "code": error.code})
            )
        else:
            text = "\n".join([f"{source.name}\n{recording!r}", *_outcome(recording)])
            described.append((text, {"path": source.name, **_of_recording(recording)}))
    return described


def _of_dataset(dataset: Dataset) -> tuple[str, dict[str, Any]]:
    rows = dataset.rows
    tasks, scenes = (Counter(str(row[key]) for row in rows) for key in ("task", "scene"))
    failed = sum(1 for row in rows if not row["length"])
    text = f"{dataset!r}\n  scenes   " + ", ".join(f"{name} ({count})" for name, count in scenes.most_common(8))
    text += f", ... ({len(scenes)} in all)" if len(scenes) > 8 else ""
    text += f"\n  without steps: {failed} episodes (h3data info {dataset.root}#K says why)" if failed else ""
    return text, {
        "path": str(dataset.root),
        "kind": "dataset",
        "episodes": len(dataset),
        "steps": sum(r["length"] for r in rows),
        "tasks": dict(tasks),
        "scenes": dict(scenes),
        "instructions": dict(Counter(told for row in rows for told in row["tasks"])),
        "cameras": list(dataset.cameras),
        "without_steps": failed,
        "columns": {c.name: {"dtype": c.dtype, "shape": list(c.shape)} for c in dataset.schema.columns},
    }


def _of_episode_file(path: Path) -> tuple[str, dict[str, Any]]:
    from h3data.recording.task_episodes.episode_files import episode_files
    from h3data_pipelines.commands.episode_summary import summary_of

    files = episode_files()
    try:
        summary = summary_of(files.read(path))
    except H3DataError as error:
        return f"{path}: {error}", {"path": str(path), "error": str(error), "code": error.code}
    text = f"{path}: {counted(summary.episodes, 'episode')}\n{summary.to_text()}"
    return text, {"path": str(path), "kind": "episodes", **summary.to_dict()}


def _outcome(recording: Recording) -> list[str]:
    """Return the lines about how the episode and its skills ended, as far as they are recorded."""
    ended, skills = recording.episode.info.get("ended"), Counter(span.outcome for span in recording.skills)
    told = recording.episode.info.get("instruction")
    lines = [f"  told     {told}"] if told else []
    lines += [f"  ended    {ended}"] if ended else []
    lines += [f"  skills   {', '.join(f'{count} {name}' for name, count in skills.items())}"] if skills else []
    return lines + _joints(recording) + _walks(recording) + _players(recording)


def _joints(recording: Recording) -> list[str]:
    """Return a line about doors and drawers, and which of them were moved."""
    moved = _moved_joints(recording)
    if moved is None:
        return []
    count = recording.columns[JOINTS].shape[1]
    return [f"  joints   {count} of doors and drawers; {', '.join(moved) if moved else 'none'} moved"]


def _moved_joints(recording: Recording) -> list[str] | None:
    """Return names of the joints of the home that moved; None: none were recorded."""
    positions = recording.columns.get(JOINTS)
    if positions is None or positions.ndim != 2:
        return None
    names: Sequence[str] = ()
    if "scene.glb" in recording.attachments:
        from h3data.scene import joint_names, load_scene

        names = joint_names(load_scene(recording.attachments["scene.glb"]))
    moved = np.flatnonzero((positions != positions[:1]).any(0)).tolist()
    return [names[k] if k < len(names) else str(k) for k in moved]


def _walks(recording: Recording) -> list[str]:
    """Return the lines about motion files by which people walk, or which they play as activities."""
    motions = recording.episode.info.get("motions")
    facts = motions.items() if isinstance(motions, dict) else ()
    known = [(file, fact) for file, fact in facts if isinstance(fact, dict)]
    # a model names activities by ``+dance=motion:`` and the digits of the file
    models = " ".join(agent.model for agent in recording.agents)
    acts = {file for file, _ in known if f"=motion:{file.removeprefix('motion_').removesuffix('.npz')}" in models}
    return [
        f"  {'activity' if file in acts else 'walk':<8} of {fact.get('name')} ({file}) {fact.get('source', '')}".rstrip()
        for file, fact in known
    ]


def _players(recording: Recording) -> list[str]:
    """Return the lines about people who played live: messages, round trips, steps that were not played in time."""
    from h3data.recording.live_input import live_inputs, remark_lines

    lines = []
    for player in live_inputs(recording):
        name = recording.agents[player.user].name if player.user < len(recording.agents) else f"user {player.user}"
        shares = player.rtt_shares_ms
        trip = "" if shares is None else f", round trip {shares[0]:.0f} ms (95%: {shares[1]:.0f} ms)"
        lines.append(
            f"  {'played' if not lines else '':<8} {name}{_by_bot(recording)}: {counted(player.messages, 'message')}{trip}"
        )
    if lines:
        lines[-1] += f"; {counted(slipped_steps(recording), 'step')} slipped"
    return lines + [f"  {'remark':<8} {line}" for line in remark_lines(recording)]


def _by_bot(recording: Recording) -> str:
    """Return whether the player was a script, and the clock another than real time."""
    hitl = recording.episode.info.get("hitl")
    hitl = hitl if isinstance(hitl, dict) else {}
    client, speed = hitl.get("client"), hitl.get("speed", 1)
    marks = ["a bot"] if isinstance(client, dict) and client.get("browser") == "bot" else []
    if speed != 1:
        marks.append("clock as fast as the machine" if not speed else f"clock {speed} times as fast")
    return f" ({', '.join(marks)})" if marks else ""


def slipped_steps(recording: Recording) -> int:
    """Return the steps of a live session that the server did not simulate in time."""
    from h3data.recording.live_input import SLIP, payload_of

    slips = (payload_of(event).get("steps") for event in recording.inputs if event.kind == SLIP)
    return sum(steps for steps in slips if isinstance(steps, int))


def _of_recording(recording: Recording) -> dict[str, Any]:
    from h3data.recording.live_input import live_inputs

    return {
        "kind": "recording",
        "steps": len(recording),
        "duration_s": recording.duration_s,
        **asdict(recording.episode),
        "agents": [asdict(agent) for agent in recording.agents],
        "bodies": len(recording.bodies),
        "moving_bodies": len(recording.moving_bodies),
        "events": len(recording.events),
        "skills": len(recording.skills),
        "played": [
            {"agent": player.user, "messages": player.messages, "rtt_ms": player.rtt_shares_ms}
            for player in live_inputs(recording)
        ],
        "slipped": slipped_steps(recording),
        "skill_outcomes": dict(Counter(span.outcome for span in recording.skills)),
        "ended": recording.episode.info.get("ended"),
        **({} if (moved := _moved_joints(recording)) is None else {"moved_joints": moved}),
        "columns": {name: {"dtype": str(a.dtype), "shape": list(a.shape)} for name, a in recording.columns.items()},
        "attachments": {name: len(data) for name, data in recording.attachments.items()},
    }
