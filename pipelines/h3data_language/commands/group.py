"""Commands ``h3data language templates``, ``h3data language verify`` and ``h3data language attach``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro

from h3data.commands import Group, JsonFlag, Outcome
from h3data.commands.command import AssetsOption, ForceFlag
from h3data.errors import H3DataError, InputError, SceneError
from h3data.progress import progress
from h3data.terminal import aligned, counted


@dataclass(frozen=True, kw_only=True)
class LanguageTemplates:
    """List the templates of tasks in words, with the type and first wording of each.

    Examples:
        h3data language templates
    """

    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return a table with a row for each template."""
        from h3data_language.templates import TEMPLATES

        rows = [[t.name, t.kind, t.wordings[0]] for t in TEMPLATES]
        counts = Counter(t.kind for t in TEMPLATES)
        text = f"{len(TEMPLATES)} templates: {', '.join(f'{n} {kind}' for kind, n in counts.items())}"
        return Outcome(
            text=f"{aligned([['template', 'type', 'wording'], *rows])}\n{text}",
            data={"templates": [{**t._asdict(), "wordings": list(t.wordings)} for t in TEMPLATES]},
        )


@dataclass(frozen=True, kw_only=True)
class LanguageVerify:
    """Sample tasks in words, and play each by a person alone, then by a robot and a person.

    Tasks are those of `h3data generate language` with the same scenes and seed. An episode that cannot be sampled, or that the
    expert does not complete, is skipped, and the next of its home takes its place; the lines `[skipped.language]` make a scene
    set skip it too (h3data docs scene-sets). The table has a digest of the identities of all tasks. With -o, results
    are saved as they come, and the same command continues after an interruption. The second example has the tasks of
    the benchmark h3-language@1.

    Examples:
        h3data language verify --scenes h3-homes/val --episodes 20
        h3data language verify --scenes h3-homes-open/test --episodes 200 --workers 2 -o out/verified
    """

    scenes: str = "h3-homes/val"
    """Homes, named as for h3data generate."""
    episodes: int = 20
    """Number of tasks."""
    seed: int = 0
    """Seed of everything random."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for the results: a file for each episode as soon as it has been played, and the table (default: nothing is
    written)."""
    workers: int = 1
    """Number of processes."""
    resume: bool = False
    """Continue a verification that was started with the same options, and fail if there is none. Without this option, an
    existing one is continued too."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Verify the tasks and return a table by type of task.

        The exit code is 1 if a home has too few tasks, or an episode raised an error.
        """
        from h3data_language.verification import digest_of, rows_of_kinds, skip_table, tasks_in, verify_homes
        from h3data_pipelines.jobs.result_files import write_table

        if self.episodes < 1:
            raise InputError(f"Expected --episodes of at least 1, got {self.episodes}.", code="H3-LANGUAGE-016")
        if self.out is None and (self.resume or self.force):
            raise InputError(
                "Expected -o DIR, whose results --resume continues and --force replaces.", code="H3-LANGUAGE-037"
            )
        homes = tasks_in(self.scenes, episodes=self.episodes, seed=self.seed)
        with TemporaryDirectory() as scratch:
            done = verify_homes(
                homes,
                self.out or Path(scratch) / "results",
                resume=self.resume,
                force=self.force,
                workers=self.workers,
                progress=progress,
            )
        if not done.tasks:
            raise SceneError(
                f"None of the episodes of {self.scenes} is a task: {[*(s.reason for s in done.skipped), *done.failed][0]}.",
                code="H3-LANGUAGE-020",
            )
        tasks = sorted(done.tasks)
        reasons = Counter(each.reason for each in done.skipped)
        lines = [aligned(rows_of_kinds(tasks))]
        lines += [f"skipped {counted(count, 'episode')}: {reason}" for reason, count in reasons.items()]
        lines += [f"failed {line}" for line in done.failed]
        digest, table = digest_of(tasks), skip_table(homes, done.skipped)
        text = "\n".join([*lines, *done.short, *([table] if table else []), f"sha256 {digest}"])
        data = {
            "tasks": [{**t._asdict(), "alone": t.alone._asdict(), "pair": t.pair._asdict()} for t in tasks],
            "skipped": [each._asdict() for each in done.skipped],
            "failed": done.failed,
            "new": done.new,
            "sha256": digest,
        }
        if self.out is not None:
            write_table(self.out, text, data)
        return Outcome(text=text, data=data, exit_code=int(bool(done.short or done.failed)))


@dataclass(frozen=True, kw_only=True)
class LanguageAttach:
    """Give imported sessions of PARTNR's tool the propositions of their episodes, so that h3data metrics evaluates them.

    A session names its episode, and the file of episodes has the rest; scenes and objects are searched for as for
    h3data generate --episodes-file. The recordings are written again, with the profile `partnr`. A session without an
    episode in the file, or with a missing scene, is listed with the reason.

    Examples:
        h3data import hitl_data/ -o rec/
        h3data language attach rec/*.mcap --episodes-file val_mini.json.gz --assets data/ -o told/
        h3data metrics told/*.mcap
        h3data metrics told/*.mcap --profile partnr@habitat
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Imported recordings: .mcap files, datasets, single episodes (ds#3)."""
    episodes_file: Path
    """PARTNR's file of episodes (.json.gz or .json)."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the recordings, one .mcap each."""
    assets: AssetsOption = ()
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Attach the tasks and return a row for each reason why recordings were left out.

        The exit code is 1 if some recordings are left out, and 2 if all are.
        """
        from h3data.commands.command import claim_file
        from h3data.recording import write_mcap
        from h3data.recording.finding import find_episodes
        from h3data.recording.task_episodes.episode_files import episode_files
        from h3data_language.trajectories import entry_of, with_propositions

        entries = episode_files().read(self.episodes_file).episodes
        written: list[Path] = []
        left_out: dict[str, list[str]] = {}
        for stored in find_episodes(self.paths):
            recording = stored.read()
            target = self.out / f"{Path(recording.episode.info.get('source', {}).get('file') or 'session').name}.mcap"
            target = target.with_name(target.name.replace(".json", "").replace(".gz", ""))
            try:
                entry = entry_of(recording, entries)
                told = with_propositions(recording, entry, self.episodes_file.parent, assets=self.assets)
            except H3DataError as fault:
                left_out.setdefault(f"{fault} [{fault.code}]", []).append(recording.episode.episode_id)
                continue
            while target in written:
                target = target.with_stem(f"{target.stem}_")
            claim_file(target, force=self.force)
            write_mcap(told, target, overwrite=self.force)
            written.append(target)
        lines = [f"{counted(len(written), 'recording')} with propositions in {self.out}"]
        lines += [f"left out {counted(len(names), 'recording')}: {reason}" for reason, names in left_out.items()]
        return Outcome(
            text="\n".join(lines),
            data={"written": [str(path) for path in written], "left_out": left_out},
            exit_code=0 if not left_out else 1 if written else 2,
        )


LANGUAGE = Group(
    "Tasks in words: list templates, verify tasks, attach propositions.",
    {"templates": LanguageTemplates, "verify": LanguageVerify, "attach": LanguageAttach},
)
