"""Frames of links and joints, and of the collision shapes on them, from the simulator's state."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.gestures import lead_hands
from h3data.bodies.people.sitting import take_seats
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, Array, ground_pose
from h3data.scene import Box, FreeSpace, Shape
from sim_kinematic.contact import capsule_transforms, shapes_from_capsules
from sim_kinematic.motion.gait import cycle_phase
from sim_kinematic.motion.spec import PersonContact, WalkerSpec
from sim_kinematic.motion.state import AgentState, HumanState, RobotState, WorldState

Body = Robot | Humanoid
"""Body of an agent."""


def require_bodies(state: WorldState, bodies: tuple[Body, ...]) -> None:
    """Check that bodies are those of the agents of a state, robots first, then people.

    Raises:
        InputError: Their number or order differs.
    """
    kinds = [Robot] * len(state.robots) + [Humanoid] * len(state.people)
    if [type(body) for body in bodies] != kinds:
        raise InputError(
            f"Expected the bodies of {len(state.robots)} robots, then of {len(state.people)} people, as in the state, got: "
            f"{', '.join(type(body).__name__ for body in bodies) or 'none'}.",
            code="H3-SIM-029",
        )


Floor = FreeSpace | float | Array
"""Floor map of a scene, or the height of a level floor [m], as one number for all worlds or as [W]."""


def root_pose(body: Body, xz: Array, heading: ArrayLike, floor: Floor = 0.0) -> Array:
    """Return poses (pose7) [..., 7] of an agent's roots at ``xz`` [..., 2]; on stairs, only robots pitch."""
    if not isinstance(floor, FreeSpace):
        return ground_pose(xz, heading, floor)
    return floor.root_pose(xz, heading, pitch_over_m=body.climbing_length_m)


def body_frames(body: Body, state: AgentState, floor: Floor = 0.0, *, speed_mps: float | None = None) -> Array:
    """Return world frames of a robot's links [W, L, 4, 4], or of a person's joints [W, 55, 4, 4].

    A robot without joints in the state is at rest. A person plays the clip for ``speed_mps``, by default the speed of
    `WalkerSpec`.

    Raises:
        InputError: The state is not that of this kind of body.
    """
    base = root_pose(body, state.xz, state.heading, floor)
    if isinstance(body, Robot) and isinstance(state, RobotState):
        joints = state.joints if state.joints.shape[1] else np.tile(body.rest, (state.worlds, 1))
        return body.link_matrices(base, joints)
    if isinstance(body, Humanoid) and isinstance(state, HumanState):
        clip = body.clip_for_speed(WalkerSpec().speed_mps if speed_mps is None else speed_mps)
        stands = state.blend == 0  # the first clip stands: cheaper than a walk of weight 0
        phase, blend = walking_phase(body, clip, state), np.where(stands, 1.0, state.blend)
        posture = body.clip_pose(np.where(stands, 0, clip), phase, blend, arms=state.arms)
        take_seats(body, *posture, state.seat)
        if state.hands.any():
            lead_hands(body, *posture, state.hands)
        return body.joint_matrices(base, *posture)
    raise InputError(f"Expected the body of a {type(state).__name__}, got a {type(body).__name__}.", code="H3-SIM-028")


def walking_phase(body: Humanoid, clip: int, state: HumanState) -> NDArray[np.float64]:
    """Return the phase of a person in the cycle of a motion clip, 0..1, [W]."""
    return cycle_phase(body.clips[clip], state.distance, state.set_off)


def body_shapes(body: Body, person_contact: PersonContact = "body") -> tuple[Shape, ...]:
    """Return the collision shapes of a robot's links, or of a person (`PersonContact`), in frames of `shape_frames`."""
    if isinstance(body, Robot):
        return tuple(shape for link in body.links for shape in link.shapes)
    # sizes of bones do not change with the posture, so any posture gives them
    standing = body.joint_matrices(ground_pose(np.zeros((1, 2)), np.zeros(1)), *body.clip_pose([0], [0.0]))
    if person_contact == "bones":
        return tuple(Box(pose=IDENTITY_POSE, half_extents=size / 2) for size in body.bone_boxes_world(standing)[1])
    start, end, radius = body.capsules_world(standing)
    return shapes_from_capsules(start[0], end[0], radius)


def shape_frames(
    body: Body, frames: NDArray[np.floating], person_contact: PersonContact = "body"
) -> NDArray[np.floating]:
    """Return world frames of `body_shapes` [..., n, 4, 4], from those of `body_frames` [..., L or 55, 4, 4]."""
    if isinstance(body, Robot):
        return frames[..., [k for k, link in enumerate(body.links) for _ in link.shapes], :, :]
    if person_contact == "bones":
        return body.bone_boxes_world(frames)[0]
    return capsule_transforms(*body.capsules_world(frames)[:2])
