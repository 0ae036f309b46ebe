"""Number of steps that one person alone takes, as the reference for the efficiency of several agents."""

from __future__ import annotations

from typing import Any

from sim_kinematic.agents.roster import kinds_of
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.policies.rearrange import planner
from sim_kinematic.policies.searching import Seeking
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from sim_kinematic.tasks.recorder import run

_SOLO_STEPS = "_solo_steps"


def solo_steps_of(task: Any, episode: RearrangeEpisode) -> int:
    """Return the number of steps in which one person alone brings all objects to their goals (paper: ``L_human``).

    The number is at most ``max_steps``. It is computed by simulating the first person, or the first robot if there are
    no people. ``task`` is the `sim_kinematic.tasks.task.Task` of the episode, which caches the number.
    """
    # beside the fields of the frozen episode: replace() leaves it out, so other agents count anew
    if _SOLO_STEPS not in vars(episode):
        vars(episode)[_SOLO_STEPS] = _simulated_solo_steps(task, episode)
    return vars(episode)[_SOLO_STEPS]


def _simulated_solo_steps(task: Any, episode: RearrangeEpisode) -> int:
    kinds = kinds_of(episode.roster)
    first = kinds.index("human") if "human" in kinds else 0
    alone = episode.only(first)
    policy: Any = planner("both", episode.seed, len(episode.targets))
    # the reference has to search as well, or it would know more than those compared with it
    policy = Seeking(policy) if episode.spec.observe == "seen" else policy
    play = WorldRollout.of(task, alone, [AssignedPolicy(policy, "both", kinds[first], "both")])
    run(play)
    return play.step


def keep_solo_steps(episode: RearrangeEpisode, steps: int) -> None:
    """Store a known number of steps for `solo_steps_of` to return."""
    vars(episode)[_SOLO_STEPS] = steps
