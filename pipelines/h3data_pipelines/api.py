"""Jobs from Python, with the options of the commands: ``h3data.generate``, ``h3data.evaluate``, and others.

Each function runs the command of its name, so both do the same; results come back as objects instead of text.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from h3data.bodies.people.rigid_parts import PeopleStyle
from h3data.commands.command import WalkOption
from h3data.commands.options import run_from_python
from h3data.recording.storage import RemotePath
from h3data.render.light.sources import LightMode

if TYPE_CHECKING:
    from h3data_pipelines.jobs.evaluation_runs import EvaluationResult
    from h3data_pipelines.jobs.generated import Generated
    from h3data_pipelines.jobs.imports import ImportResult
    from h3data_pipelines.jobs.skill_evaluations import SkillEvaluationResult
    from h3data_pipelines.pictures.rerender import Rendered

AnyPath = str | os.PathLike[str]


def generate(
    task: str,
    out: AnyPath,
    *,
    episodes: int | None = None,
    seed: int = 0,
    scenes: str = "small",
    episodes_file: AnyPath | None = None,
    save_episodes: AnyPath | None = None,
    assets: Sequence[AnyPath] = (),
    allow_missing: bool = False,
    homes: int = 4,
    policy: str | None = None,
    partner: str | None = None,
    skills: str | None = None,
    agents: str | None = None,
    robot: str | None = None,
    human: str | None = None,
    motion: AnyPath | None = None,
    human_walk: WalkOption | None = None,
    human_speed: float | None = None,
    max_steps: int | None = None,
    spawn_distance: float | None = None,
    rule: Sequence[str] = (),
    camera: Sequence[str] = (),
    people: PeopleStyle = "skin",
    light: LightMode = "baked",
    backend: Literal["auto", "cpu", "gpu"] = "cpu",
    workers: int = 1,
    executor: str = "local",
    mcap: bool = False,
    share_scenes: bool = False,
    resume: bool = False,
    force: bool = False,
) -> Generated:
    """Simulates episodes of a task into a dataset; options as of ``h3data generate``.

    With ``workers`` above 1 call it under ``if __name__ == "__main__":``, as Python's own `multiprocessing` asks for.

    Returns:
        The dataset, the episodes that failed and the metrics.

    Raises:
        InputError: an option is wrong, or the folder holds something.
    """
    from h3data_pipelines.commands.generate import Generate

    return run_from_python(Generate, locals())


def evaluate(
    task: str,
    out: AnyPath,
    *,
    policies: str = "all",
    partners: str = "all",
    skills: str = "",
    zsc: Sequence[str] = (),
    scenes: str = "h3-homes/test",
    episodes_file: AnyPath | None = None,
    assets: Sequence[AnyPath] = (),
    allow_missing: bool = False,
    episodes: int | None = None,
    homes: int = 4,
    seed: int = 0,
    robot: str | None = None,
    human: str | None = None,
    motion: AnyPath | None = None,
    human_walk: WalkOption | None = None,
    human_speed: float | None = None,
    max_steps: int | None = None,
    light: LightMode | None = None,
    workers: int = 1,
    executor: str = "local",
    keep: bool = False,
    resume: bool = False,
    force: bool = False,
) -> EvaluationResult | SkillEvaluationResult:
    """Plays policies in the same episodes and measures them; options as of ``h3data evaluate``.

    Returns:
        The table of policies (and partners) with 95% intervals, and the episodes that failed; of the task ``skill`` that of
        the skills.

    Raises:
        InputError: an option is wrong, or the folder holds results with other options.
    """
    from h3data_pipelines.commands.evaluating import Evaluate

    return run_from_python(Evaluate, locals())


def import_(
    paths: AnyPath | Sequence[AnyPath],
    out: AnyPath,
    *,
    assets: Sequence[AnyPath] = (),
    manifest: AnyPath | None = None,
    fps: float = 30.0,
    strict: bool = False,
    force: bool = False,
) -> ImportResult:
    """Turns recordings of other programs into MCAP recordings in the folder ``out``; options as of ``h3data import``.

    Returns:
        What became of every file.

    Raises:
        InputError: there is nothing to import.
        FormatError: the only file is of another kind or damaged.
    """
    from h3data_pipelines.commands.importing import Import

    return run_from_python(Import, locals(), several=("paths",))


def export(
    recording: AnyPath,
    out: AnyPath,
    *,
    to: str,
    agent: str | None = None,
    assets: Sequence[AnyPath] = (),
    person_detail: Literal["full", "low"] = "full",
    light: bool = False,
    camera: Sequence[str] = (),
    people: PeopleStyle = "skin",
    stand_ins: bool = False,
    backend: Literal["auto", "cpu", "gpu"] = "cpu",
    force: bool = False,
) -> Path:
    """Writes recordings as files of other programs; options as of ``h3data export``.

    Returns:
        The file or folder.

    Raises:
        InputError: the format or an option is wrong, or the output exists.
    """
    from h3data_pipelines.commands.exporting import Export

    return run_from_python(Export, locals())


def rerender(
    recordings: AnyPath | Sequence[AnyPath],
    out: AnyPath,
    *,
    camera: Sequence[str] = (),
    people: PeopleStyle = "skin",
    light: LightMode = "baked",
    backend: Literal["auto", "cpu", "gpu"] = "cpu",
    outputs: str = "rgb",
    assets: Sequence[AnyPath] = (),
    stand_ins: bool = False,
    steps: str = "",
    format: Literal["mp4", "av1", "png", "data"] = "mp4",
    size: str = "",
    samples: Literal[1, 4] | None = None,
    workers: int | None = None,
    executor: str = "local",
    force: bool = False,
) -> Rendered:
    """Renders recordings from any number of cameras into the folder ``out``; options as of ``h3data rerender``.

    Returns:
        The video files and folders of images, and which recordings failed.

    Raises:
        InputError: an option is wrong, a file exists, or no recording can be rendered.
    """
    from h3data_pipelines.pictures.rerender import Rerender

    return run_from_python(Rerender, locals(), several=("recordings",))


def card(
    dataset: AnyPath,
    *,
    title: str = "",
    license: str = "unknown",
    repo: str = "user/name",
    force: bool = False,
) -> Path:
    """Writes README.md for a dataset; options as of ``h3data card``.

    Returns:
        The file.

    Raises:
        InputError: the dataset has one.
    """
    from h3data_pipelines.hub.card import Card

    return run_from_python(Card, locals())


def push(dataset: AnyPath, repo: str, *, private: bool = False, message: str = "") -> str:
    """Uploads a dataset to the Hugging Face Hub; options as of ``h3data push``.

    Returns:
        Its address.

    Raises:
        MissingExtraError: the extra ``hub`` is not installed.
        InputError: there is no token, it has no right to write, or the Hub cannot be reached.
    """
    from h3data_pipelines.hub.pushing import Push

    return run_from_python(Push, locals())


def pull(repo: str, out: AnyPath, *, revision: str = "main", force: bool = False) -> Path:
    """Downloads a dataset from the Hugging Face Hub; options as of ``h3data pull``.

    Returns:
        The dataset's folder.

    Raises:
        MissingExtraError: the extra ``hub`` is not installed.
        InputError: there is no such dataset, or the Hub cannot be reached.
        FormatError: what came is not what was pushed.
    """
    from h3data_pipelines.hub.pulling import Pull

    return run_from_python(Pull, locals())


def sync(source: AnyPath, target: AnyPath, *, quick: bool = False, force: bool = False) -> Path | RemotePath:
    """Copies a dataset to another folder or object store, or what is new in it; options as of ``h3data sync``.

    Returns:
        Where the copy is.

    Raises:
        InputError: the source is no dataset, or the target holds anything but a copy of it.
        FormatError: a file arrived otherwise than it was sent.
    """
    from h3data_pipelines.hub.syncing import Sync

    return run_from_python(Sync, locals())
