"""Evaluation of one skill of a robot that is alone in a rearrangement episode, with its outcome and number of steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from h3data.geometry import IDENTITY_POSE
from sim_kinematic.agents.skills import Action, LearnedSkill
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.policies.policy import External
from sim_kinematic.tasks.play import DecisionLoop, WorldRollout
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.skills.skill_starts import SkillStart


class SkillScore(NamedTuple):
    """Outcome of a skill."""

    outcome: str
    """Outcome of the skill: ``done`` or ``failed``."""
    reason: str
    steps: int
    path_m: float
    """Length of the shortest path at the start to the place from which the target can be reached [m]."""
    contact: int
    """Number of steps in which the base touched the home."""


def action_of(start: SkillStart) -> Action:
    """Return the high-level action that starts a skill at a given start."""
    name = {"nav": "nav_to_goal" if start.holds else "nav_to_object"}.get(start.skill, start.skill)
    return Action(name, start.target)


def judge(
    episode: RearrangeEpisode,
    start: SkillStart,
    learned: Mapping[str, LearnedSkill],
    watch: Callable[[WorldRollout], object] | None = None,
) -> SkillScore:
    """Play one skill to its end and return its outcome.

    Args:
        episode: Episode, of whose agents only the first robot is present.
        start: State in which the skill starts.
        learned: Learned skills by name; a skill without an entry knows the whole state.
        watch: Function that is called after every step.
    """
    play = play_of(episode, start, learned)
    robot = play.team.robots[0]
    turns = DecisionLoop(play)
    turns.answer(action_of(start))
    steps = contact = 0
    while not turns.over and turns.asked is None:
        steps, contact = steps + 1, contact + bool(robot.state.contact[0])
        if watch is not None:
            watch(play)
        turns.go_on()
    ending = play.team.controllers[robot.number].ending
    outcome, reason = (ending.outcome, ending.reason) if ending is not None else ("failed", "timed_out")
    if play.ended == "success":  # all objects were at their goals before the hand was back
        outcome, reason = "done", ""
    path = float(robot.free.geodesic(start.xz, start.stand_xz))
    return SkillScore(outcome, reason, steps, path, contact)


def play_of(episode: RearrangeEpisode, start: SkillStart, learned: Mapping[str, LearnedSkill]) -> WorldRollout:
    """Return the play of an episode with its first robot alone, in the state in which a skill starts."""
    play = WorldRollout.of(Rearrange(), episode.only(0), [AssignedPolicy(External(), "skill", "robot")])
    home = play.team
    robot = home.robots[0]
    robot.learned = learned
    robot.state.xz[0], robot.state.heading[0] = start.xz, start.heading
    home.company.end_turn(robot.number)
    home.note_places()
    home.note_places()  # as it is now, and as it was a step ago
    home.objects.poses[:, :3] = start.objects
    if start.holds:
        home.objects.held_by[start.target] = robot.number
        home.objects.poses[start.target] = robot.hand_pose
        home.objects.state.grip_pose[0, start.target] = IDENTITY_POSE
    return play
