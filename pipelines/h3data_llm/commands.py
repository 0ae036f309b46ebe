"""Commands ``h3data llm show`` and ``h3data llm again``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from h3data.commands import Group, JsonFlag, Outcome
from h3data.terminal import aligned, counted

if TYPE_CHECKING:
    from h3data_llm.policy import Decision
    from h3data_llm.use import ModelUse


@dataclass(frozen=True)
class LlmShow:
    """Show each answer of language models in recordings, with step, call or text, and the reason if it was invalid.

    The last lines are the totals of answers, tokens and time. h3data metrics ds --profile llm gives them for each
    episode, with means.

    Examples:
        h3data llm show ds#0
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings to read: .mcap files, datasets or single episodes (ds#3)."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return a table with a row for each answer of a language model."""
        from h3data.recording.finding import find_episodes
        from h3data_llm.replies import models_in
        from h3data_llm.use import ModelUse

        lines, data = [], []
        every: list[Decision] = []
        for recording in (stored.read() for stored in find_episodes(self.paths)):
            for model in models_in(recording):
                rows = [["step", "answer", "seconds", "tokens", ""]]
                for d in model.decisions:
                    calls = d.reply.get("tool_calls")
                    said = f"{calls[0]['function']['name']} {calls[0]['function']['arguments']}" if calls else ""
                    text = " ".join((said or str(d.reply.get("content", ""))).split())[:100]
                    rows.append([str(d.step), text, f"{d.ms / 1e3:.1f}", str(sum(d.tokens)), d.result[:60]])
                name = f"episode {recording.episode.episode_id}, {recording.agents[model.agent].name}, {model.policy}"
                use = ModelUse.of(model.decisions)
                lines += [name, aligned(rows), _told(use)]
                data.append({"episode": recording.episode.episode_id, **model._asdict(), "use": use._asdict()})
                every += model.decisions
        total = ModelUse.of(every)
        if len(data) > 1:
            lines.append(f"all {len(data)}: {_told(total)}")
        return Outcome(text="\n".join(lines), data={"models": data, "use": total._asdict()})


def _told(use: ModelUse) -> str:
    return f"{counted(use.calls, 'answer')}, {use.tokens:,} tokens ({use.tokens_out:,} of answers), {use.seconds:.1f} s"


@dataclass(frozen=True)
class LlmAgain:
    """Carry out the recorded answers of language models again with the current prompts and parser, without an endpoint.

    The table shows whether the requests would be the same today, whether the answers have the same meaning, and the
    first step at which the episode differs. The exit code is 1 if anything differs.

    Examples:
        h3data llm again ds#0
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings to read: .mcap files, datasets or single episodes (ds#3)."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Compare the answers and return a table with a row for each language model."""
        from h3data.recording.finding import find_episodes
        from h3data_llm.replies import played_again

        rows, differs = [["episode", "agent", "answers", "requests", "meaning", "steps"]], False
        for recording in (stored.read() for stored in find_episodes(self.paths)):
            for found in played_again(recording):
                differs = differs or bool(found.fault) or max(found.request, found.meaning, found.step) >= 0
                rows.append(
                    [
                        recording.episode.episode_id,
                        recording.agents[found.model.agent].name,
                        str(len(found.model.decisions)),
                        "the same" if found.request < 0 else f"another from {found.request} on",
                        "the same" if found.meaning < 0 else f"another from {found.meaning} on",
                        found.fault or ("the same" if found.step < 0 else f"differ from {found.step} on"),
                    ]
                )
        columns = rows[0]
        data = {"models": [dict(zip(columns, row, strict=True)) for row in rows[1:]]}
        return Outcome(text=aligned(rows), data=data, exit_code=int(differs))


LLM = Group(
    "Show recorded answers of language models, or replay them.",
    {"show": LlmShow, "again": LlmAgain},
)
