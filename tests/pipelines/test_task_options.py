"""Help of options that take policies: it lists the names that there are."""

from __future__ import annotations

import pytest

from h3data_pipelines.cli import main
from h3data_pipelines.task_options import REMARKS, in_ranges
from sim_kinematic.policies.assignment import policy_names
from sim_kinematic.tasks.registry import find_task


@pytest.mark.parametrize(
    ("command", "task"), [("generate", "social_nav"), ("generate", "wander"), ("evaluate", "rearrange")]
)
def test_help_lists_every_policy_of_a_task(command: str, task: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, task, "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for kind in ("robot", "human") if command == "generate" else ("robot",):
        for name in in_ranges(policy_names(find_task(task), kind)):
            assert name in shown


def test_remarks_are_of_policies_that_exist() -> None:
    there = {name for task in ("social_nav", "rearrange") for name in policy_names(find_task(task), "robot")}
    assert set(REMARKS) <= there


def test_numbered_names_are_ranges() -> None:
    assert in_ranges(["a_1", "a_2", "a_3", "both", "object_1", "object_2", "b_0", "c_1"]) == [
        "a_1 to a_3",
        "both",
        "object_1",
        "object_2",
        "b_0",
        "c_1",
    ]
