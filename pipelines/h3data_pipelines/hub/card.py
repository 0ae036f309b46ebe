"""Command ``h3data card``, which writes a README.md for a dataset, as the Hugging Face Hub displays it."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro
from numpy.typing import NDArray

from h3data.commands.arguments import result_of
from h3data.commands.command import DryRunFlag, ForceFlag, JsonFlag, Outcome, write_text
from h3data.commands.options import command_of
from h3data.errors import H3DataError, InputError, suggest_keywords
from h3data.progress import progress
from h3data.recording.storage import local
from h3data_pipelines.hub.provenance import read_commands

if TYPE_CHECKING:
    from h3data.commands.arguments import FilePath
    from h3data.metrics import MetricsTable
    from h3data.recording import Dataset, Recording

log = logging.getLogger(__name__)

CARD, PICTURE = "README.md", "card.jpg"
SHOWN = 4
"""Number of episodes in the picture of a card."""
CANDIDATES, CANDIDATE_WIDTH = 16, 96
"""Number of moments of an episode from which the moment with the most visible things is chosen, and the width of the
pictures for this choice [pixels]."""
SEEN_SHARE, AGENT_COUNTS = 0.01, 20
"""Smallest share of a picture that a visible thing covers, and the number of things that one visible agent counts
as.
"""
_HEIGHT, _WIDTH = 180, 320
_LISTED = 12


@suggest_keywords
def card(
    dataset: FilePath,
    *,
    title: str = "",
    license: str = "unknown",
    repo: str = "user/name",
    force: bool = False,
) -> Path:
    """Write README.md for a dataset, with the options of ``h3data card``.

    Returns:
        The path of README.md.

    Raises:
        InputError: the dataset already has a README.md.
    """
    return result_of(Card, locals())


@command_of(card)
class Card:
    """Write a card for a dataset: README.md and a picture.

    README.md describes the contents of the dataset, the quality of its episodes, how they were made and how to load
    them, with the front matter that the Hugging Face Hub reads. The picture is card.jpg. h3data push writes a card if
    the dataset has none.

    Examples:
        h3data card ds/ --license cc-by-4.0
        h3data card ds/ --title "Following people at home" --force
        h3data card ds/ --dry-run
    """

    dataset: tyro.conf.Positional[Path]
    """Folder of the dataset."""
    title: str
    """Heading (default: the name of the folder)."""
    license: str
    """License of the data, by its name on the Hub: cc-by-4.0, mit, ..."""
    repo: str
    """Name of the dataset on the Hub, for the example code that loads it."""
    dry_run: DryRunFlag = False
    force: ForceFlag
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Write the card, or return its text with ``--dry-run``."""
        from h3data.recording import Dataset

        dataset = Dataset(local(self.dataset))
        root, path = Path(str(dataset.root)), self.dataset / CARD
        if self.dry_run:
            text = card_text(dataset, title=self.title or root.resolve().name, license=self.license, repo=self.repo)
            return Outcome(text=text, data={"card": text})
        if path.exists() and not self.force:
            raise InputError(f"The dataset has a card. Use --force to overwrite it: {path}", code="H3-HUB-001")
        write_card(dataset, title=self.title, license=self.license, repo=self.repo)
        return Outcome(text=f"wrote {path} and {PICTURE}", data={"card": str(path)}, result=path)


def write_card(dataset: Dataset, *, title: str = "", license: str = "unknown", repo: str = "user/name") -> None:
    """Write ``README.md`` and ``card.jpg`` into a local dataset."""
    from h3data.render.image_files import write_jpg

    root = Path(str(dataset.root))
    picture = card_picture(dataset)
    if picture is not None:
        write_jpg(root / PICTURE, picture, quality=85)
    text = card_text(
        dataset, title=title or root.resolve().name, license=license, repo=repo, picture=picture is not None
    )
    write_text(root / CARD, text)


# --- the text ---------------------------------------------------------------------------------------------------------
def card_text(dataset: Dataset, *, title: str, license: str, repo: str, picture: bool = True) -> str:
    """Return the card in Markdown."""
    rows = dataset.rows
    steps, fps = sum(row["length"] for row in rows), dataset.schema.fps
    empty = sum(not row["length"] for row in rows)
    tasks, scenes = (Counter(str(row[name]) for row in rows) for name in ("task", "scene"))
    instructions = Counter(told for row in rows for told in row["tasks"])
    facts = {
        "episodes": f"{len(rows):,}" + (f", of which {empty} without steps" if empty else ""),
        "steps": f"{steps:,} at {fps} per second ({steps / fps / 3600:.2f} h)",
        "tasks": _listed(tasks),
        "instructions": _listed(instructions),
        "homes": _listed(scenes),
        "robots": _listed(_agents(dataset, "robot")),
        "people": _listed(_agents(dataset, "human")),
        "cameras": ", ".join(f"`{v.key}` ({v.width}x{v.height})" for v in dataset.schema.videos) or "none",
        "seeds": _seeds([row["seed"] for row in rows]),
    }
    made = read_commands(dataset.root)
    by = ", ".join(sorted({row["created_by"] for row in rows if row["created_by"]})) or "h3data"
    columns = [f"| `{c.name}` | {c.dtype} | {['T', *c.shape]} |".replace("'T'", "T") for c in dataset.schema.columns]
    return "\n".join(
        [
            *_front_matter(title, license, steps, sorted(tasks)),
            f"# {title}",
            "",
            "Episodes of people and robots sharing a home, simulated and recorded with h3data.",
            "",
            *([f"![Moments of episodes: the scene, and below it what a camera saw]({PICTURE})", ""] if picture else []),
            "## Contents",
            "",
            "| | |",
            "|---|---|",
            *(f"| {name} | {value} |" for name, value in facts.items()),
            "",
            *_figures(dataset),
            "## How it was made",
            "",
            *(["```bash", *made, "```"] if made else ["The commands were not kept."]),
            f"Written by {by}; schema {dataset.schema.version}, LeRobot v3.0 layout.",
            "",
            "## Loading",
            "",
            *_loading(repo, dataset),
            "## Columns",
            "",
            "| column | type | shape |",
            "|---|---|---|",
            *columns,
            "",
        ]
    )


def _front_matter(title: str, license: str, steps: int, tasks: Sequence[str]) -> list[str]:
    bounds = ((1e3, "n<1K"), (1e4, "1K<n<10K"), (1e5, "10K<n<100K"), (1e6, "100K<n<1M"), (1e7, "1M<n<10M"))
    size = next((name for bound, name in bounds if steps < bound), "10M<n<100M")
    tags = ["LeRobot", "h3data", "human-robot-interaction", *(task.replace("_", "-") for task in tasks)]
    return [
        "---",
        f"pretty_name: {json.dumps(title, ensure_ascii=False)}",
        f"license: {json.dumps(license)}",
        "task_categories:",
        "- robotics",
        "tags:",
        *(f"- {json.dumps(tag, ensure_ascii=False)}" for tag in tags),
        "size_categories:",
        f"- {size}",
        "configs:",
        "- config_name: default",
        "  data_files: data/*/*.parquet",
        "---",
        "",
    ]


def _figures(dataset: Dataset) -> list[str]:
    """Return metrics of the episodes, a table for each task; nothing where none of them has any, as in exports to LeRobot."""
    from h3data.metrics.batch import measure_tables
    from h3data.metrics.requirements import UnmeasurableError

    try:
        tables = measure_tables([Path(str(dataset.root))])
    except UnmeasurableError:
        return []
    except H3DataError as error:
        log.warning("The card has no metrics: %s", error)
        return []
    lines = []
    for table in tables:
        if all(np.isnan(summary.mean) for summary in table.summary().values()):
            continue
        lines += [f"## Metrics: {table.episodes[0].task}", "", *_markdown(table), ""]
    return lines


def _markdown(table: MetricsTable) -> list[str]:
    records = {m.name: m for m in table.metrics}
    lines = ["| metric | | mean | 95% interval | unit | episodes |", "|---|---|---|---|---|---|"]
    for name, summary in table.summary().items():
        unit = "" if records[name].unit == "1" else records[name].unit
        mean = "undefined" if np.isnan(summary.mean) else f"{summary.mean:.3f}"
        interval = "" if np.isnan(summary.low) else f"{summary.low:.3f} to {summary.high:.3f}"
        lines.append(f"| {name} | {records[name].title} | {mean} | {interval} | {unit} | {summary.count} |")
    return lines


def _loading(repo: str, dataset: Dataset) -> list[str]:
    shows = (
        f'\nfor picture in ds.video(0, "{dataset.cameras[0]}").frames():  # uint8 [H, W, 3]\n    ...'
        if dataset.cameras
        else ""
    )
    return [
        "```bash",
        f"h3data pull {repo} -o ds/",
        "```",
        "```python",
        "import h3data",
        "",
        'ds = h3data.open("ds/")  # a sequence of recordings',
        f"print(ds[0]){shows}",
        "```",
        "```python",
        "from lerobot.datasets.lerobot_dataset import LeRobotDataset",
        "",
        f'ds = LeRobotDataset("{repo}")',
        "```",
        "",
    ]


def _agents(dataset: Dataset, kind: str) -> Counter[str]:
    """Return the models of the agents of a kind, with the number of episodes of each."""
    counts: Counter[str] = Counter()
    for shard in dict.fromkeys(map(dataset.shard_of, dataset.rows)):
        table = dataset.sidecar("agents", shard)
        named = zip(table["kind"].to_pylist(), table["model"].to_pylist(), strict=True)
        counts.update((model.partition("/")[2] or model) for of, model in named if of == kind and model)
    return counts


def _listed(counts: Mapping[str, int]) -> str:
    shown = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    text = ", ".join(f"{name} ({count})" for name, count in shown[:_LISTED])
    return (text + (f" and {len(shown) - _LISTED} more" if len(shown) > _LISTED else "")).replace("|", "\\|") or "none"


def _seeds(seeds: Iterable[int]) -> str:
    distinct = sorted(set(seeds))
    if len(distinct) <= 3:
        return ", ".join(map(str, distinct)) or "none"
    return f"{len(distinct)} different ones, derived from the seed of the command; in the column `seed` of the episode table"


# --- the picture ------------------------------------------------------------------------------------------------------
def card_picture(dataset: Dataset) -> NDArray[np.uint8] | None:
    """Render moments of some episodes side by side, above the first camera's views; return None without steps."""
    played = [row["episode_index"] for row in dataset.rows if row["length"]]
    if not played:
        return None
    chosen = [played[int(k)] for k in np.unique(np.linspace(0, len(played) - 1, SHOWN).astype(int))]
    columns = [_column(dataset, index) for index in progress(chosen, desc="picture", unit="episode", leave=False)]
    return np.concatenate(columns, axis=1)


def _column(dataset: Dataset, index: int) -> NDArray[np.uint8]:
    from h3data.api import render_frame

    recording = dataset.recording(index)
    camera = "third_person" if recording.agents else "top_down"
    step = _step_that_shows_most(recording, [camera, *dataset.cameras[:1]])
    pictures = [render_frame(recording, camera=camera, step=step)["rgb"]]
    if dataset.cameras:
        frames = dataset.video(index, dataset.cameras[0]).frames()
        pictures.append(next(frame for k, frame in enumerate(frames) if k == step))
    return np.concatenate([_fitted(picture) for picture in pictures])


def _step_that_shows_most(recording: Recording, cameras: Sequence[str]) -> int:
    """Return the step at which most different things, agents above all, are in the pictures of some cameras."""
    from h3data.replay import Replay, camera_track
    from h3data.replay.cameras import camera_names

    replay = Replay(recording)
    known = camera_names(replay)
    tracks = [camera_track(replay, name) for name in cameras if name in known or "/" in name]
    tracks = [
        track.resized(CANDIDATE_WIDTH, max(round(CANDIDATE_WIDTH * track.camera.height / track.camera.width), 1))
        for track in tracks
    ]
    steps = np.unique(np.linspace(0, len(recording) - 1, CANDIDATES).astype(int)).tolist()
    agents = np.array([drawable.agent for drawable in replay.drawables], np.int64)
    shown = [
        sum(_things_in(image["instance"], agents) for image in images)
        for _, images in replay.frames(tracks, steps, outputs=("instance",))
    ]
    return steps[int(np.argmax(shown))]


def _things_in(instances: NDArray[np.integer], agents: NDArray[np.int64]) -> int:
    """Count the things that a picture of ids [H, W] shows; ``agents`` has the agent of each id, -1 for things."""
    ids, pixels = np.unique(instances[instances >= 0], return_counts=True)
    of = agents[ids]
    things = (pixels[of < 0] >= SEEN_SHARE * instances.size).sum()
    people = (np.bincount(of[of >= 0], pixels[of >= 0]) >= SEEN_SHARE * instances.size).sum()
    return int(things + AGENT_COUNTS * people)


def _fitted(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture in the size of a cell, cut at the edges where its shape differs."""
    import cv2

    height, width = picture.shape[:2]
    scale = max(_HEIGHT / height, _WIDTH / width)
    size = (max(round(width * scale), _WIDTH), max(round(height * scale), _HEIGHT))
    scaled = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    top, left = (scaled.shape[0] - _HEIGHT) // 2, (scaled.shape[1] - _WIDTH) // 2
    return np.asarray(scaled[top : top + _HEIGHT, left : left + _WIDTH], np.uint8)
