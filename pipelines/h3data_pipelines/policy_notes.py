"""Notes of options that take policies: the names of each task, from its tables, when a help text is shown."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from h3data.commands.options import TaskNotes

REMARKS: Mapping[str, str] = {
    "future_oracle": "knows their walk",
    "end_to_end": "sees by cameras",
    "end_to_end_paper": "sees by cameras",
}
"""Words in brackets after a name."""
_NUMBERED = re.compile(r"(.*_)(\d+)")


@dataclass(frozen=True, eq=False)
class _Names(Mapping[str, str]):
    """Text by task: the names, the default first, and what else an option takes. Tasks are imported when they are asked for."""

    kind: str
    tasks: tuple[str, ...]
    more: Mapping[str, str]
    shows_default: bool

    def __getitem__(self, task: str) -> str:
        if task not in self.tasks:
            raise KeyError(task)
        from sim_kinematic.policies.assignment import policy_names
        from sim_kinematic.tasks.registry import find_task

        found = find_task(task)
        names, default = policy_names(found, self.kind), found.defaults[self.kind]
        if self.shows_default:
            names.sort(key=lambda name: name != default)
        remarks = {**REMARKS, **({default: "default"} if self.shows_default else {})}
        listed = [f"{name} ({remarks[name]})" if name in remarks else name for name in in_ranges(names)]
        return ", ".join(filter(None, [*listed, self.more.get(task, "")])) + "."

    def __iter__(self) -> Iterator[str]:
        return iter(self.tasks)

    def __len__(self) -> int:
        return len(self.tasks)


@dataclass(frozen=True, eq=False)
class PolicyNotes(TaskNotes):
    """Marks an option that takes policies of one kind of agent: the help of each task lists their names."""

    notes: Mapping[str, str] = field(init=False)
    kind: str
    """``robot`` or ``human``."""
    tasks: tuple[str, ...]
    more: Mapping[str, str] = field(default_factory=dict)
    """Other values that the option takes, by task."""
    shows_default: bool = True

    __hash__ = object.__hash__

    def __post_init__(self) -> None:
        """Makes the texts, which are not written before they are asked for."""
        object.__setattr__(self, "notes", _Names(self.kind, self.tasks, self.more, self.shows_default))


def in_ranges(names: Sequence[str]) -> list[str]:
    """The names, with ``a_1 to a_3`` for three and more that are numbered one after the other."""
    runs: list[list[str]] = []
    for name in names:
        before, this = _NUMBERED.fullmatch(runs[-1][-1]) if runs else None, _NUMBERED.fullmatch(name)
        follows = before and this and before[1] == this[1] and int(this[2]) == int(before[2]) + 1
        if follows:
            runs[-1].append(name)
        else:
            runs.append([name])
    return [text for run in runs for text in ([f"{run[0]} to {run[-1]}"] if len(run) > 2 else run)]
