"""Reactions of people to visible robots: the six reactions of HuNavSim with their published parameters.

A reaction has a distance, a duration, and a behaviour of the person. It applies while the robot is in sight within that
distance, until the duration since the first sight is over (Perez-Higueras et al. 2023, behaviour trees of hunav_sim).
Otherwise the person walks on.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from h3data.kernels import kernel
from h3data.scene.freespace.free_space import sample_sdf
from sim_kinematic.motion.step import wrap_angle


class Reaction(NamedTuple):
    """Parameters of one reaction."""

    within_m: float
    """Distance within which a robot is noticed [m]; with 0, people avoid robots only as they avoid anything else."""
    lasts_s: float = 0.0
    """Time from the first sight after which the reaction is over [s]."""
    again: float = 0.0
    """Flag: 1 if the reaction starts again at the next sight of the robot after its end."""
    speed_mps: float = 0.0
    """Walking speed during the reaction [m/s]."""
    by_distance: float = 0.0
    """Flag: 1 if ``speed_mps`` is multiplied by the distance to the robot divided by ``within_m``."""
    approach: float = 0.0
    """Flag: 1 if the person walks up to the robot."""
    before_m: float = 0.0
    """Distance in front of the robot to which the person walks up [m]."""
    stand_m: float = 0.0
    """Distance at which the person stands and looks at the robot [m]."""
    repulsion_m2_s2: float = 0.0
    """Repulsion by the robot [m2/s2]; divided by the distance to the robot's outline [m], it is an acceleration
    [m/s2]."""


REACTIONS: dict[str, Reaction] = {
    "regular": Reaction(0.0),
    "impassive": Reaction(0.0),
    "surprised": Reaction(4.0, 30.0, stand_m=4.0),
    "curious": Reaction(10.0, 30.0, speed_mps=1.8, by_distance=1.0, approach=1.0, stand_m=1.5),
    "scared": Reaction(3.0, 40.0, 1.0, speed_mps=0.6, repulsion_m2_s2=20.0 * 0.2),
    "threatening": Reaction(4.0, 40.0, speed_mps=2.0, approach=1.0, before_m=1.1, stand_m=1.2),
}
"""Reactions by name. ``regular`` treats the robot as another person, ``impassive`` as furniture."""
IMPASSIVE = list(REACTIONS).index("impassive")
"""Number of the reaction ``impassive``."""
TABLE = np.array(list(REACTIONS.values()))
"""Parameters of the reactions for the kernels, [6, 9], by number of the reaction."""
VIEW_RAD = math.radians(100.0)
"""Angle from the direction of their gaze up to which people see robots [rad]."""


@kernel(error_model="numpy")
def sees(sdf, origin, cell, ax, az, bx, bz):
    """Return whether the straight line between two places is free of walls and furniture."""
    length = math.hypot(bx - ax, bz - az)
    at = 0.0
    while at < length:
        share = at / length
        clear = sample_sdf(sdf, origin, cell, ax + share * (bx - ax), az + share * (bz - az))
        # 0.05: distance from an obstacle to the line between two places below which it hides them from each
        # other [m]
        if clear < 0.05:
            return False
        # sphere tracing: nothing is nearer than ``clear``, so the line is free for as long
        at += max(clear, 0.05)
    return True


@kernel(error_model="numpy")
def notice(reaction, mood, x, z, heading, robot, in_sight, step, dt):
    """Return whether a person reacts to a robot in this step, and update their ``mood`` [2].

    Args:
        reaction: Row of `TABLE`.
        mood: Step of the first sight, -1 before it; 1 while the person reacts. Changed in place.
        x: Position of the person along x [m].
        z: Position of the person along z [m].
        heading: Heading of the person [rad].
        robot: Place and heading of the robot (x, z, heading).
        in_sight: True if nothing hides the robot.
        step: Number of the step.
        dt: Duration of a step [s].
    """
    px, pz = robot[0] - x, robot[1] - z
    angle = wrap_angle(math.atan2(-pz, px) - heading)
    mood[1] = 0.0
    if not in_sight or math.hypot(px, pz) > reaction[0] or abs(angle) > VIEW_RAD:
        return False
    if mood[0] < 0.0:
        mood[0] = step
    # over since the first sight, even if the robot was out of sight in between
    if (step - mood[0]) * dt >= reaction[1]:
        if reaction[2] > 0.0:
            mood[0] = -1.0
        return False
    mood[1] = 1.0
    return True


@kernel(error_model="numpy")
def reacting_velocity(reaction, x, z, robot, radius, wx, wz, tau):
    """Return the velocity (x, z) [m/s] that a reacting person wants, instead of ``(wx, wz)``.

    Args:
        reaction: Row of `TABLE`.
        x: Position of the person along x [m].
        z: Position of the person along z [m].
        robot: Place and heading of the robot (x, z, heading).
        radius: Radius of the robot [m].
        wx: Velocity along x that the person wants without the reaction [m/s].
        wz: Velocity along z that the person wants without the reaction [m/s].
        tau: Time in which a repulsion becomes a velocity [s].
    """
    px, pz = robot[0] - x, robot[1] - z
    distance = max(math.hypot(px, pz), 1e-6)
    if distance <= reaction[7]:
        return 0.0, 0.0
    speed = reaction[3]
    if reaction[5] > 0.0:
        gx = px + reaction[6] * math.cos(robot[2])
        gz = pz - reaction[6] * math.sin(robot[2])
        left = max(math.hypot(gx, gz), 1e-6)
        if reaction[4] > 0.0:
            speed *= distance / reaction[0]
        speed = min(speed, left / tau)
        return gx / left * speed, gz / left * speed
    wanted = math.hypot(wx, wz)
    if wanted > speed:
        wx, wz = wx / wanted * speed, wz / wanted * speed
    # at the outline the repulsion would be infinite
    push = tau * reaction[8] / max(distance - radius, 0.05)
    wx, wz = wx - px / distance * push, wz - pz / distance * push
    wanted = max(math.hypot(wx, wz), 1e-9)
    return wx / wanted * min(wanted, speed), wz / wanted * min(wanted, speed)
