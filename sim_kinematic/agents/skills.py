"""Skills of a task's agents: oracle skills of robots and people (paper section 4.2; spec/habitat.md 2.3, 2.4).

A skill is a generator: each ``next`` is one step of 1/30 s, and the return value is its result. Its preconditions are
checked before it starts; an infeasible skill does nothing and is reported.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, suggest
from h3data.scene import Scene
from sim_kinematic.motion.state import NOBODY, WorldState

SKILLS = (
    "nav_to_object",
    "nav_to_goal",
    "pick",
    "place",
    "wait",
    "move_forward",
    "move_backward",
    "turn_left",
    "turn_right",
    "control",
)
"""Names of all skills, in the order in which recordings number them."""
PRIMITIVES = {
    "move_forward": (1.0, 0.0, 4),
    "move_backward": (-1.0, 0.0, 4),
    "turn_left": (0.0, 1.0, 2),
    "turn_right": (0.0, -1.0, 2),
}
"""Command and number of steps of each primitive motion of robots: 0.333 m and 9.55 degrees as in Habitat, at h3data's
speed limits."""
CONTROL = "control"
"""Skill of one low-level step of a robot: its base, arm and hand follow `Action.command`."""
OPENING_SKILLS = ("nav_to_handle", "open", "close")
"""Skills in homes with doors and drawers that open; their target is the number of a joint."""
SIT = "sit"
"""Skill of a person who is driven from outside: walk to the nearest seat and sit there until another command."""
CHORE = "chore"
"""Skill of a person who is driven from outside: handle a thing that they brought along; its target is a number of
`CHORES`."""
CHORES = ("take", "lift", "put", "phone", "perform")
"""Chores: take a thing out of a fridge, take up a thing from furniture, put it down, take out or put away a phone, and
perform a captured motion of the body, whose number among them is the command."""
SEARCH = "nav_to_place"
"""Skill of agents that only know the objects that they have seen; its target is the number of a surface
(`Scene.receptacles`)."""
ALL_SKILLS = (*SKILLS, "drop", "hand_over", *OPENING_SKILLS, SIT, SEARCH, CHORE)
"""Skills in the order in which recordings of homes with doors and drawers, and of people driven from outside, number them."""
CHOICE_WAIT_STEPS = 5
"""Duration of ``wait`` in `choices` [steps]."""
REASONS = {
    "already_closed": "It is closed already.",
    "already_held": "It is in this agent's hand already.",
    "already_open": "It is open already.",
    "blocked": "Another agent is in the way.",
    "closed": "It is in something that is closed.",
    "dropped": "It was let go elsewhere.",
    "hand_full": "The hand already holds something.",
    "held_by_other": "Somebody else holds it.",
    "invalid_posture": "It is out of reach from here.",
    "missed": "The hand did not get there.",
    "no_chore": "There is nothing near by for it.",
    "no_joint": "There is no such door or drawer.",
    "no_room": "Something is in the way of the arm or the body.",
    "no_seat": "There is no free seat near by that fits.",
    "no_space": "There is no space for it: something else is there.",
    "no_support": "There is nothing there to put it on.",
    "no_way": "No path leads to where it can be reached.",
    "not_a_robot": "Things can only be handed over to a robot.",
    "obstructed": "Something stands before it, or in its way.",
    "not_seen": "It has not seen where it is.",
    "not_held": "The hand holds no such thing.",
    "not_of_a_person": "People cannot do this.",
    "out_of_reach": "It is too far away to reach from here.",
    "outside_box": "It is too far away to reach from here.",
    "robot_busy": "The robot's hand is not free.",
    "robot_moved": "The robot moved away.",
    "stuck": "There is no getting on.",
    "timed_out": "It took too long.",
    "too_near": "It would hit whoever opens it: they stand in its way.",
    "too_far": "It is too far away to reach from here.",
    "wrong_object": "The hand took something else.",
}
"""Sentences for the short words in recordings about skills that were refused or failed."""


def sentence(reason: str) -> str:
    """Return the sentence for a recorded reason; an unknown reason is returned unchanged."""
    return REASONS.get(reason, f"It was not possible ({reason}).")


class Action(NamedTuple):
    """Choice of a high-level policy: a skill and its target."""

    skill: str
    target: int = -1
    """Index of the object that the skill handles or whose goal it leads to; for `OPENING_SKILLS`, index of the
    joint."""
    steps: int = 30
    """Duration of ``wait`` [steps]."""
    command: Any = ()
    """Command of the skill, if it has one. For ``control`` of a robot: forward and left turn of the base, each arm
    joint, and grip, -1..1 of the limits of a step. For ``control`` of a person: a
    `sim_kinematic.agents.driven.commands.PersonCommand`. For ``place`` of a driven person: the point in the world [3]
    [m]; for ``hand_over``: the robot's number."""


INSIDE = "inside "
"""Prefix of the names of places behind doors and in drawers."""


class Destination(NamedTuple):
    """Command (`Action.command`) of a ``wait`` of 0 steps that gives its object another goal, if the task allows it."""

    place: str
    """Name of a piece of furniture or a room; ``inside NAME`` for a drawer or a cupboard of the furniture."""
    next_to: str = ""
    """Name of the object next to which the object has to be put; empty: anywhere."""

    def __str__(self) -> str:
        return f"{self.place} next to {self.next_to}" if self.next_to else self.place

    @classmethod
    def of(cls, text: str) -> Destination:
        """Return the destination that a text written by ``str(destination)`` describes."""
        place, _, next_to = text.partition(" next to ")
        return cls(place, next_to)


LONGEST_MESSAGE = 500
"""Largest number of characters of a message."""


class Message(NamedTuple):
    """Command (`Action.command`) of a ``wait`` of 0 steps that sends a message to other agents."""

    text: str
    to: str = ""
    """Name of the agent that receives the message; empty: all agents."""

    @property
    def action(self) -> Action:
        """Action by which an agent sends this message, which takes no time."""
        return Action("wait", -1, 0, self)

    def check(self, names: Sequence[str]) -> None:
        """Check that a message can be sent in a home with agents of these names.

        Raises:
            InputError: the message is empty, too long or not a text, or there is no such agent.
        """
        if not isinstance(self.text, str) or not 0 < len(self.text) <= LONGEST_MESSAGE:
            raise InputError(
                f"Expected a message of 1 to {LONGEST_MESSAGE} characters, got {len(str(self.text)):,}.",
                code="H3-SIM-067",
            )
        if self.to not in ("", *names):
            raise InputError(
                f"Nobody is called {str(self.to)[:50]!r} here.{suggest(str(self.to)[:50], names)}", code="H3-SIM-068"
            )


class SkillResult(NamedTuple):
    """Result of a skill."""

    outcome: Literal["done", "failed", "aborted"]
    reason: str = ""


Skill = Generator[None, None, SkillResult]


@lru_cache(maxsize=64)
def choices(objects: int, *, robot: bool = True, parts: tuple[int, ...] = ()) -> tuple[Action, ...]:
    """Return all actions that an agent can choose from, in the order in which learned policies number them.

    The actions are each of the four skills with each of the K objects, ``wait`` and, for robots, the four primitives: 4
    K + 5 actions, or 4 K + 1 for a person. The `OPENING_SKILLS` with each of the joints ``parts`` of the task follow.
    """
    with_target = [Action(skill, k) for skill in SKILLS[:4] for k in range(objects)]
    primitives = [Action(skill) for skill in PRIMITIVES] if robot else []
    opening = [Action(skill, joint) for skill in OPENING_SKILLS for joint in parts]
    return (*with_target, Action("wait", steps=CHOICE_WAIT_STEPS), *primitives, *opening)


class LearnedSkill(Protocol):
    """Skill that a network carries out instead of the scripted skill, which knows the whole state."""

    def infeasible(self, actor: Any, action: Action) -> str:
        """Return the reason, besides those of `Objects.why_not`, why the skill cannot start now; empty if it can."""
        ...

    def start(self, actor: Any, action: Action) -> Skill:
        """Start an action; the returned skill advances by one step at each iteration."""
        ...


@dataclass(eq=False)
class Objects:
    """Objects of the task, shared by all actors."""

    names: tuple[str, ...]
    goals: NDArray[np.float64]
    """Goal positions of the objects in the world, shape [K, 3] [m]."""
    state: WorldState
    """State of the objects: ``object_pose`` [1, K, 7], ``held_by`` [1, K], ``grip_pose`` [1, K, 7], ``joint_pos`` [1,
    J]."""
    joints: tuple[str, ...] = ()
    """Names of the home's doors and drawers."""
    scene: Scene | None = None
    """Home with its doors and drawers where they last stood still."""
    openables: Any = None
    """Doors and drawers of the home, `sim_kinematic.agents.opening.openables.ArticulatedParts`; None if nothing opens."""
    sight: Any = None
    """Memory of everything that each agent has seen, `sim_kinematic.sensing.sight.Sight`; None if all agents know
    everything."""

    def destination(self, agent: int, action: Action) -> NDArray[np.float64]:
        """Return the world point [3] to which ``nav_to_object``, ``nav_to_goal`` or `SEARCH` leads, as the agent knows it."""
        k = action.target
        if action.skill == SEARCH:
            return self.sight.points[k]
        if action.skill == "nav_to_goal":
            return self.goals[k]
        return self.poses[k, :3] if self.sight is None else self.sight.where[agent, k]

    def __post_init__(self) -> None:
        self.poses: NDArray[np.float64] = self.state.object_pose[0]
        """Pose (pose7) of each object in the world [K, 7]; a view."""
        self.held_by: NDArray[np.int64] = self.state.held_by[0]
        """Number of the agent that holds each object, [K]; a view."""

    def held(self, agent: int) -> int:
        """Return the index of the object that an agent holds, or -1."""
        holders = self.held_by.tolist()
        return holders.index(agent) if agent in holders else -1

    def why_not(self, agent: int, action: Action) -> str:
        """Return the reason why an agent cannot start an action, by rules shared by all agents; empty if it can.

        Raises:
            InputError: There is no such skill, object, joint or surface.
        """
        skill, k = action.skill, action.target
        is_known = skill in SKILLS or (self.joints and skill in OPENING_SKILLS)
        if not is_known and not (skill == SEARCH and self.sight is not None):
            known = (*SKILLS, *(OPENING_SKILLS if self.joints else ()), *(() if self.sight is None else (SEARCH,)))
            # an error and no recorded reason: this is a mistake of the caller, not a state of the world
            raise InputError(f"Unknown skill {skill!r}. Expected one of: {', '.join(known)}.", code="H3-SIM-022")
        if skill not in (*SKILLS[:4], *OPENING_SKILLS, SEARCH):
            return ""
        if skill in OPENING_SKILLS:
            if not 0 <= k < len(self.joints):
                raise InputError(
                    f"{skill} needs one of the joints 0 to {len(self.joints) - 1}, got {k}.", code="H3-SIM-024"
                )
            # the hand is needed at the handle, not on the way there
            return "hand_full" if skill != "nav_to_handle" and self.held(agent) >= 0 else ""
        if skill == SEARCH:
            if not 0 <= k < len(self.sight.points):
                raise InputError(
                    f"{skill} needs one of the surfaces 0 to {len(self.sight.points) - 1}, got {k}.", code="H3-SIM-066"
                )
            return ""
        if not 0 <= k < len(self.names):
            raise InputError(
                f"{skill} needs one of the objects 0 to {len(self.names) - 1}, got {k}.", code="H3-SIM-023"
            )
        holders = self.held_by.tolist()
        if skill in ("nav_to_object", "pick") and holders[k] not in (NOBODY, agent):
            return "held_by_other"
        if skill in ("nav_to_object", "pick") and self.sight is not None and not self.sight.known[agent, k]:
            return "not_seen"
        if skill == "nav_to_object" and holders[k] == agent:
            return "already_held"
        if skill == "pick" and agent in holders:
            return "hand_full"
        if skill == "place" and holders[k] != agent:
            return "not_held"
        return ""
