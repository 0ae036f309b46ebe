"""Conversion of recordings to training data: the observations, actions and rewards of an agent.

Row k of a recording is the state *after* action k. Training pairs an observation with the action that follows it, so
frame t has row t and the action of row t + 1. An episode of T rows gives T - 1 frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.recording.records import Agent, Recording

SUCCESS_EVENTS = ("success", "found")
"""Kinds of events that mean success in rearrangement, and in finding the person in social navigation. An episode
without such an event whose info states ``success`` succeeds with its last action."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Transitions:
    """Transitions of one agent in one episode."""

    agent: int
    state: dict[str, NDArray[np.float32]]
    """State of the agent's body before each action and after the last one (`base_pose`, `joint_pos`, ...), each [T,
    width]."""
    state_names: tuple[str, ...]
    """Names of all values of ``state``, in order."""
    action: NDArray[np.float32]
    """Actions, shape [T - 1, A]."""
    action_names: tuple[str, ...]
    reward: NDArray[np.float32]
    """Reward: 1 for the action that first led to success (`SUCCESS_EVENTS`), else 0, shape [T - 1]."""

    def __len__(self) -> int:
        return len(self.action)

    @property
    def flat_state(self) -> NDArray[np.float32]:
        """Values of ``state``, concatenated, shape [T, S]."""
        return np.concatenate(list(self.state.values()), axis=1)


def transitions_of(recording: Recording, *, agent: str | None = None) -> Transitions:
    """Return the transitions of a named agent, or of the first robot or else agent that has actions.

    Raises:
        InputError: there are no actions, no agent has the name, there are fewer than two steps, or an earlier export
            omitted the last step.
    """
    if recording.episode.is_lerobot_export:
        raise InputError(
            "Demonstrations exported to LeRobot lack the last row of each episode; exported again they would lose another one. "
            "Hint: export the dataset that they were exported from.",
            code="H3-EXPORT-034",
        )
    index = _acting(recording, agent)
    if len(recording) < 2:
        raise InputError(
            f"Transitions need at least two steps, the recording has {len(recording)}.", code="H3-EXPORT-035"
        )
    who, columns = recording.agents[index], recording.columns
    state = {
        name: columns[f"agent_{index}.{name}"].reshape(len(recording), -1).astype(np.float32)
        for name in ("base_pose", "joint_pos", "root_pose", "joint_quat")
        if f"agent_{index}.{name}" in columns
    }
    # the action of row t + 1 is the one that was taken in the state of row t
    action = columns[f"agent_{index}.action"][1:].astype(np.float32)
    return Transitions(
        agent=index,
        state=state,
        state_names=tuple(n for name, values in state.items() for n in _names(name, values.shape[1], who)),
        action=action.reshape(len(action), -1),
        action_names=who.action_names or tuple(f"action.{k}" for k in range(int(np.prod(action.shape[1:])))),
        reward=_reward(recording),
    )


def observations_of(recording: Recording, found: Transitions) -> dict[str, NDArray[np.float32]]:
    """Return all observations of an agent in its transitions, each [T, width].

    They are its own state (``base_pose``, ``joint_pos``, ...), ``object_pose`` (zeros for absent bodies), and the pose
    ``agent_<i>.base_pose`` of every other agent.
    """
    observed: dict[str, NDArray[np.float32]] = dict(found.state)
    for index in range(len(recording.agents)):
        if index != found.agent:
            observed[f"agent_{index}.base_pose"] = recording.agent_column(index, "base_pose")
    if "object_pose" in recording.columns:
        poses = recording.columns["object_pose"]
        observed["object_pose"] = poses.reshape(len(poses), -1)
    # absent bodies have NaN, with which nothing can be learned
    return {name: np.nan_to_num(values).astype(np.float32) for name, values in observed.items()}


def check_alike(
    shapes: dict[str, tuple[int, ...]], arrays: Mapping[str, NDArray[np.float32]], recording: Recording
) -> None:
    """Check that all demonstrations have equal arrays; the first call fills in their ``shapes``.

    Raises:
        InputError: names or widths of the arrays differ from those of the first one.
    """
    own = {name: values.shape[1:] for name, values in arrays.items()}
    # the first episode fills them in, for all others this changes nothing
    shapes.update(shapes or own)
    different = sorted(name for name in shapes.keys() | own.keys() if shapes.get(name) != own.get(name))
    if different:
        raise InputError(
            f"Episode {recording.episode.episode_id!r} differs from the first one in {', '.join(different[:4])}, but all "
            "demonstrations of a file must have the same observations. Export such episodes to files of their own.",
            code="H3-EXPORT-032",
        )


def _reward(recording: Recording) -> NDArray[np.float32]:
    reward = np.zeros(len(recording) - 1, np.float32)
    steps = [event.step for event in recording.events if event.kind in SUCCESS_EVENTS]
    if steps:
        # the event is at the row after its action; one at row 0 counts for the first action
        reward[np.clip(min(steps) - 1, 0, len(reward) - 1)] = 1
    elif recording.episode.info.get("success"):
        reward[-1] = 1
    return reward


def _acting(recording: Recording, name: str | None) -> int:
    acting = [i for i in range(len(recording.agents)) if recording.columns.get(f"agent_{i}.action") is not None]
    names = [agent.name for agent in recording.agents]
    if name is not None and name not in names:
        raise InputError(
            f"There is no agent {name!r}. The recording has: {', '.join(names) or 'none'}.", code="H3-EXPORT-036"
        )
    if name is not None:
        acting = [i for i in acting if names[i] == name]
    if not acting:
        whose = f"of {name!r} " if name is not None else ""
        raise InputError(
            f"The recording holds no actions {whose}(columns agent_<i>.action), which a learner needs. Recordings made "
            "from visual logs, as gfx-replay, have none.",
            code="H3-EXPORT-037",
        )
    # robots first: in most tasks people act too, and a policy of the robot is what is wanted
    return next((i for i in acting if recording.agents[i].kind == "robot"), acting[0])


def _names(name: str, width: int, agent: Agent) -> Sequence[str]:
    if name in ("base_pose", "root_pose"):
        return [f"{name}.{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    if name == "joint_pos" and len(agent.joint_names) == width:
        return agent.joint_names
    return [f"{name}.{k}" for k in range(width)]
