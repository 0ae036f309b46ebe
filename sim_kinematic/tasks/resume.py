"""Recordings simulated again: compared step by step, continued from any step, or with another robot beside the same people.

A recording holds its scene, its rules, its starts, its seed and what every agent was told to do, so the simulator's state
after any step follows from it: no hidden numbers are stored. "Resume from step K" plays the K recorded steps, and is refused
if that does not give the recorded states bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from h3data.errors import InputError
from h3data.recording import Recording
from sim_kinematic.tasks import resume_rearrange, resume_social_nav, resume_wander
from sim_kinematic.tasks.resimulation import Difference, Verification, first_difference

if TYPE_CHECKING:
    from sim_kinematic.policies.rearrange import HighLevelPolicy
    from sim_kinematic.policies.social_nav import Policy

__all__ = ["TASKS", "Difference", "Verification", "counterfactual", "first_difference", "resume", "verify"]

TASKS = ("social_nav", "rearrange", "wander")
"""Whose recordings can be simulated again."""


def verify(recording: Recording) -> Verification:
    """Simulate what was recorded and compare every stored column, and the hash of the state, step by step.

    Bit for bit on one architecture; elsewhere the last bits of sines and square roots may differ.

    Raises:
        H3DataError: it cannot be simulated again: it is of another task, or lacks something.
    """
    task = _task(recording)
    if task == "rearrange":
        return resume_rearrange.verify(recording)
    return resume_wander.verify(recording) if task == "wander" else resume_social_nav.verify(recording)


def resume(
    recording: Recording, step: int, *, policy: str | Policy | HighLevelPolicy | Sequence[str | HighLevelPolicy] | None = None,
    partner: str | HighLevelPolicy | Sequence[str | HighLevelPolicy] | None = None,
) -> Recording:  # fmt: skip
    """The episode anew: its first ``step`` steps as they are, then simulated on, by default as it was.

    ``policy`` moves the robots from then on; ``partner`` the people, of rearrangement only. Who wanders has no policy.

    Raises:
        InputError: there is no such step or policy, or the recorded states before it do not come out again.
    """
    task = _task(recording)
    if task == "rearrange":
        return resume_rearrange.resume(recording, step, policy=policy, partner=partner)  # type: ignore[arg-type]
    if partner is not None or (task == "wander" and policy is not None):
        what = "partner" if partner is not None else "policy"
        raise InputError(f"Nobody in recordings of {task} follows a {what}. Hint: leave it out.")
    if task == "wander":
        return resume_wander.resume(recording, step)
    return resume_social_nav.resume(recording, step, policy=policy)  # type: ignore[arg-type]


def counterfactual(
    recording: Recording,
    policy: str | Policy | HighLevelPolicy | Sequence[str | HighLevelPolicy] | None,
    *,
    step: int = 0,
) -> Recording:
    """The same people on their recorded tracks beside robots that follow ``policy`` from ``step`` on.

    They do not react: ``info["human_reactive"]`` is False. It ends with their tracks, or as the rules say.

    Raises:
        InputError: as `resume`; or it has no robot or no person, or her body was not recorded.
    """
    task = _task(recording)
    if task == "wander":
        raise InputError("Robots that wander follow no policy. Expected a recording of social_nav or rearrange.")
    if task == "rearrange":
        return resume_rearrange.counterfactual(recording, policy, step=step)  # type: ignore[arg-type]
    return resume_social_nav.counterfactual(recording, policy, step=step)  # type: ignore[arg-type]


def _task(recording: Recording) -> str:
    task = recording.episode.task
    if task not in TASKS:
        raise InputError(
            f"Only recordings of {', '.join(TASKS)} can be simulated again, this one is of the task {task!r}. "
            "Hint: h3data validate checks any recording."
        )
    return task
