"""``h3data language templates`` and ``h3data language verify``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from h3data.commands import Group, JsonFlag, Outcome
from h3data.errors import InputError
from h3data.progress import progress
from h3data.terminal import aligned


@dataclass(frozen=True, kw_only=True)
class LanguageTemplates:
    """List the templates of tasks in words, with their types and their first wordings.

    Examples:
        h3data language templates
    """

    json: JsonFlag = False

    def run(self) -> Outcome:
        """A line per template."""
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
    """Sample tasks in words and play each: a person alone, then a robot and a person. Lists what could not be done.

    Tasks are sampled as by `h3data.session("language", scenes, seed=seed)`: episode 0, 1, ... of the run with this seed.

    Examples:
        h3data language verify --scenes h3-homes/val --episodes 20
    """

    scenes: tuple[str, ...] = ("h3-homes/val",)
    """Homes, as in generate."""
    episodes: int = 20
    """Number of tasks."""
    seed: int = 0
    """Seed of everything random."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """A table by type of task; exit code 1 if a task could not be done."""
        from h3data_language.task import Language
        from h3data_language.verification import rows_of_kinds, verify_task
        from sim_kinematic.tasks.sources import EpisodeSource

        if self.episodes < 1:
            raise InputError(f"Expected --episodes of at least 1, got {self.episodes}.", code="H3-LANGUAGE-016")
        task = Language()
        source = EpisodeSource(task, list(self.scenes))
        played, failed = [], []
        for k in progress(range(self.episodes), desc="verify", unit="task"):
            episode = source.sample(self.seed, k)
            alone, pair = verify_task(task, episode)
            played.append((str(episode.extra["kind"]), alone, pair))
            for who, result in (("a person alone", alone), ("robot and person", pair)):
                if not result.success:
                    words = task.codec.instruction(episode)
                    failed.append(f"{k} ({who}, {result.complete:.0%} in {result.steps} steps): {words}")
        return Outcome(
            text="\n".join([aligned(rows_of_kinds(played)), *failed]),
            data={
                "tasks": [{"type": t, "alone": a._asdict(), "pair": b._asdict()} for t, a, b in played],
                "failed": failed,
            },
            exit_code=int(bool(failed)),
        )


LANGUAGE = Group(
    "Tasks in words: their templates, and whether tasks can be done.",
    {"templates": LanguageTemplates, "verify": LanguageVerify},
)
