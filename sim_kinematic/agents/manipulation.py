"""Arms and grips: joints that move by small steps, and objects that a hand takes, carries and releases.

Manipulation is kinematic, as in Habitat: a held object moves rigidly with the hand, and a released object stays where
it is, even in the air (spec/habitat.md 2.4). The kernels are scalar definitions, looped over worlds, as in
`sim_kinematic.motion.step`. In a step the base moves first, then the arm, then the grip; `carry_objects` follows with
the new frame of the hand.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Robot
from h3data.bodies.people.kernels.tuple_math import from_axes, inverse, multiply, plus, turned
from h3data.errors import InputError
from h3data.kernels import kernel
from sim_kinematic.contact.frames import Floor, root_pose
from sim_kinematic.motion.spec import ArmSpec
from sim_kinematic.motion.state import NOBODY, ROBOT, RobotState, WorldState
from sim_kinematic.motion.step import first_not_finite


# --- the robot's arm ----------------------------------------------------------------------------------------------------
@kernel(error_model="numpy")
def step_joint(position, command, most, lower, upper):
    """Return a joint position [rad or m] after one step, within its limits.

    The joint moves by ``command``, clipped to -1..1, times ``most``.
    """
    return min(max(position + min(max(command, -1.0), 1.0) * most, lower), upper)


@kernel(error_model="numpy")
def _step_arms(joints, columns, action, most, lower, upper):
    # all of them before anything moves, so that a step is made in every world or in none
    broken = first_not_finite(action)
    if broken >= 0:
        return broken
    for w in range(len(joints)):
        for k, j in enumerate(columns):
            joints[w, j] = step_joint(joints[w, j], action[w, k], most, lower[j], upper[j])
    return -1


def move_arms(state: RobotState, robot: Robot, action: ArrayLike, spec: ArmSpec) -> None:
    """Move the arm of a robot in all worlds, in place.

    Args:
        state: state of the robot.
        robot: body of the robot.
        action: -1..1 of ``spec.joint_step`` for each of ``robot.arm_columns``, [W, n].
        spec: limits of the arm.

    Raises:
        InputError: the actions or the state's joints have another shape, or an action is not finite; then nothing moves.
    """
    columns = np.array(robot.require_arm())
    joints = _checked_joints(state, robot)
    rows = _rows(action, (len(joints), len(columns)), "One number per world and arm joint")
    broken = _step_arms(joints, columns, rows, spec.joint_step, robot.lower, robot.upper)
    if broken >= 0:
        raise InputError(f"Actions must be finite. That of world {broken} is {rows[broken]}.", code="H3-SIM-007")


def robot_hands(state: RobotState, robot: Robot, floor: Floor = 0.0) -> NDArray[np.float64]:
    """Return the frames in which a robot holds objects, hand to world, [W, 4, 4]; their origin is ``hand_position``."""
    base = root_pose(robot, state.xz, state.heading, floor)
    hands = robot.link_matrices(base, _checked_joints(state, robot))[:, robot.hand_link]
    hands[:, :3, 3] += hands[:, :3, :3] @ robot.hand_position
    return np.ascontiguousarray(hands)


def _checked_joints(state: RobotState, robot: Robot) -> NDArray[np.float64]:
    expected = len(state.heading), len(robot.joint_names)
    if state.joints.shape != expected:
        raise InputError(
            f"Expected the joints of {robot.name} in the state, shape {list(expected)}, got "
            f"{list(state.joints.shape)}. Hint: WorldState.zeros(worlds, joints={expected[1]}).",
            code="H3-SIM-008",
        )
    return state.joints


# --- objects in a hand --------------------------------------------------------------------------------------------------
@kernel(error_model="numpy")
def nearest_free(hand, object_pose, held_by, nobody):
    """Return ``(index, distance [m])`` of the free object nearest to a hand [4, 4], -1 if there is none."""
    best, distance = -1, math.inf
    for o in range(len(held_by)):
        if held_by[o] == nobody:
            d = math.hypot(
                math.hypot(object_pose[o, 0] - hand[0, 3], object_pose[o, 1] - hand[1, 3]),
                object_pose[o, 2] - hand[2, 3],
            )
            if d < distance:
                best, distance = o, d
    return best, distance


@kernel(error_model="numpy")
def _quaternion(frame):
    a = (frame[0, 0], frame[1, 0], frame[2, 0])
    b = (frame[0, 1], frame[1, 1], frame[2, 1])
    c = (frame[0, 2], frame[1, 2], frame[2, 2])
    return from_axes(a, b, c)


@kernel(error_model="numpy")
def _grip_worlds(hand, object_pose, held_by, grip_pose, action, agent, nobody, reach):
    # a loop of its own, so that nothing is taken anywhere if one of them is refused
    for w in range(len(action)):
        if not math.isfinite(action[w]):
            return w
    for w in range(len(action)):
        holds = False
        for o in range(held_by.shape[1]):
            if held_by[w, o] == agent:
                holds = True
                if action[w] < 0.0:
                    held_by[w, o] = nobody
        # a hand that has just let go takes nothing in the same step
        if holds or action[w] <= 0.0:
            continue
        o, distance = nearest_free(hand[w], object_pose[w], held_by[w], nobody)
        if o >= 0 and distance < reach:
            held_by[w, o] = agent
            q = object_pose[w, o]
            grip = multiply(inverse(_quaternion(hand[w])), (q[3], q[4], q[5], q[6]))
            # the object snaps to the hand and keeps its rotation, so that only this is relative to the hand
            grip_pose[w, o, :3] = 0.0
            for k in range(4):
                grip_pose[w, o, 3 + k] = grip[k]
    return -1


@kernel(error_model="numpy")
def _carry_worlds(hand, object_pose, held_by, grip_pose, agent):
    for w in range(held_by.shape[0]):
        for o in range(held_by.shape[1]):
            if held_by[w, o] == agent:
                q = _quaternion(hand[w])
                g = grip_pose[w, o]
                at = plus((hand[w, 0, 3], hand[w, 1, 3], hand[w, 2, 3]), turned(q, (g[0], g[1], g[2])), 1.0)
                turn = multiply(q, (g[3], g[4], g[5], g[6]))
                for k in range(3):
                    object_pose[w, o, k] = at[k]
                for k in range(4):
                    object_pose[w, o, 3 + k] = turn[k]


def grip_objects(
    state: WorldState, hands: NDArray[np.float64], action: ArrayLike, spec: ArmSpec, *, agent: int = ROBOT
) -> None:
    """Close or open the hands of one agent in all worlds by ``action`` [W], in place.

    With an action above 0, an empty hand takes the nearest object that no agent holds, if its origin is within
    ``spec.grasp_m``. The object snaps to the hand and keeps its orientation; in Habitat it takes that of the hand, and
    an action of 0 grasps too. With an action below 0, the hand releases its object. ``hands`` [W, 4, 4] are the frames
    from `robot_hands`, or any frames for a person.

    Raises:
        InputError: an array has the wrong shape, or an action or a hand is not finite; then nothing is taken.
    """
    frames = _hands(hands, state)
    rows = _rows(action, (len(frames),), "One number per world")
    broken = _grip_worlds(frames, state.object_pose, state.held_by, state.grip_pose, rows, agent, NOBODY, spec.grasp_m)
    if broken >= 0:
        raise InputError(f"Actions must be finite. That of world {broken} is {rows[broken]}.", code="H3-SIM-007")
    carry_objects(state, frames, agent=agent)


def carry_objects(state: WorldState, hands: NDArray[np.float64], *, agent: int = ROBOT) -> None:
    """Move the objects that an agent holds along with its hands, in place; ``hands`` [W, 4, 4] are the new frames."""
    _carry_worlds(_hands(hands, state), state.object_pose, state.held_by, state.grip_pose, agent)


def _hands(hands: ArrayLike, state: WorldState) -> NDArray[np.float64]:
    frames = _rows(hands, (len(state.held_by), 4, 4), "One hand per world, hand to world")
    if not np.isfinite(frames).all():
        raise InputError("Frames of hands must be finite.", code="H3-SIM-009")
    return frames


def _rows(values: ArrayLike, shape: tuple[int, ...], what: str) -> NDArray[np.float64]:
    rows = np.ascontiguousarray(values, np.float64)
    if rows.shape != shape:
        raise InputError(
            f"Expected shape {list(shape)}: {what[0].lower()}{what[1:]}, got {list(rows.shape)}.", code="H3-SIM-010"
        )
    return rows
