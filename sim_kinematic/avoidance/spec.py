"""Constants of avoidance between agents."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple


class Footprint(NamedTuple):
    """Discs along the x axis of an agent that cover its outline on the floor."""

    offsets_m: tuple[float, ...]
    """Offsets of the discs' centres along the heading [m]."""
    radius_m: float

    @property
    def extent_m(self) -> float:
        """Farthest distance of the footprint from the agent's origin [m]."""
        return max(map(abs, self.offsets_m)) + self.radius_m


PERSON = Footprint((0.0,), 0.3)
"""Footprint of a person that other agents use in planning."""


@dataclass(frozen=True, kw_only=True)
class AvoidanceSpec:
    """Distances, times and costs of avoidance; lengths are on the floor and between centres unless stated otherwise.

    The constants were tuned together on rearrangement by three to five agents (``benchmarks/sim_many.py``). Of 40
    episodes, none ends in a contact and 92% succeed; without right of way, 7% end in a contact and 46% succeed.
    Distances that concern robots are those of ``quad_arm``; for another robot its own size replaces the size of
    ``quad_arm`` (`sim_kinematic.avoidance.robot_base`).
    """

    # --- sizes ---------------------------------------------------------------------------------------------------------
    person: Footprint = PERSON
    robot: Footprint = field(default=Footprint((-0.3, 0.0, 0.4), 0.3))
    """Footprint of ``quad_arm`` from hind legs to stowed hand, as other agents use it. Its base discs alone (0 and
    0.225 m) would let others plan paths through its hind legs."""
    robot_margin_m: float = 0.05
    """Margin that is added around the discs of ``robot`` beyond the base discs, for legs and an arm that sway [m]."""

    # --- a robot's base chooses its next velocity ------------------------------------------------------------------------
    accel_mps2: float = 5.0
    """Acceleration and deceleration of robots at their start and goal [m/s2]: full speed takes half a second. To keep
    clear of another agent, robots brake at once."""
    brake_mps2: float = 12.0
    """Deceleration of people where a path turns sharply [m/s2]."""
    turn_accel_rad_s2: float = 12.0
    """Angular acceleration with which people start and end a turn [rad/s2]."""
    corner_mps: float = 1.2
    """Speed of people at a sharp corner of their path [m/s]."""
    dots_m: float = 0.2
    """Largest distance between the points on a path from which distances to another path are measured [m]."""
    range_m: float = 4.0
    """Distance beyond which agents are ignored [m]: at 2.5 m/s each, two need 0.8 s to meet."""
    horizon_steps: int = 24
    """Number of steps for which each trial command is simulated."""
    stride_steps: int = 3
    """Number of steps between the moments of a roll-out at which gaps are measured."""
    doubt_mps: float = 0.25
    """Speed by which gaps in the future count as wider [m/s], because predictions of an agent's motion become less
    certain."""
    person_radius_m: float = 0.35
    """Radius of a person [m]; larger than that of `PERSON` because arms swing."""
    margin_m: float = 0.35
    """Gap to be kept between a robot and another agent [m]."""
    standing_margin_m: float = 0.15
    """Distance to keep from agents that stand and step aside when asked [m]."""
    still_margin_m: float = 0.0
    """Distance to keep from agents that have stood still for a long time [m], small enough for a robot to get past."""
    still_steps: int = 75
    """Number of steps of standing after which an agent has settled; picking and placing take fewer."""
    still_m: float = 0.01
    """Movement along x and z in ``still_steps`` below which an agent has stood [m]."""
    gap_weight: float = 8.0
    """Length of path that a metre of missing gap costs [m]."""
    heading_weight_m: float = 0.1
    """Length of path that a radian of heading error costs [m]."""
    turn_weight_m: float = 0.02
    """Cost of a full turn command [m], so that of otherwise equal commands the one with the least turn is chosen."""
    change_weight_m: float = 0.15
    """Cost of a change of either component of the command by its limit [m], so that a robot does not waver between two
    paths around a person."""
    wall_tolerance_m: float = 2e-3
    """Distance by which a base disc may be nearer to an obstacle than its radius in trials, so that a base that touches a wall
    can leave it."""
    wall_m: float = 0.03
    """Distance beyond their radius at which people who walk straight on are assumed to stop before an obstacle [m]."""
    velocity_steps: int = 3
    """Number of steps over which an agent's velocity is measured."""
    contact_gate_m: float = 2.0
    """Distance beyond which agents cannot touch, with arms stretched out [m]."""
    contact_span_m: float = 1.4
    """Span of a robot (`sim_kinematic.contact.clearance.robot_span`) that `contact_gate_m` allows for [m]; 1.38 m is
    that of ``quad_arm``."""

    # --- people on their path, and agents that wait ----------------------------------------------------------------------
    ahead_m: float = 1.2
    """Distance along a person's path within which an agent blocks it, if both would touch [m]."""
    beside_nearer_m: float = 0.03
    """Change of distance below which a person who passes counts as beside an agent and not in its path [m]."""
    moving_m: float = 0.1
    """Additional gap within which a moving agent blocks a path [m]."""
    passing_m: tuple[float, ...] = (0.1, 0.0)
    """Gaps that a person leaves to standing agents on a detour [m]; the first gap for which there is a path is used."""
    apart_m: float = 0.75
    """Least distance between places that people choose to stand at [m]."""
    stands_mps: float = 0.05
    """Speed below which an agent counts as standing [m/s]."""
    patience_steps: int = 90
    """Number of steps after which a person gives up waiting for others to clear the path."""
    detour_after_steps: tuple[int, int] = (10, 40)
    """Numbers of stalled steps at which a robot plans a path around the agents that stand."""
    detours: int = 3
    """Largest number of detours to one destination."""
    via_m: float = 0.25
    """Distance within which a point of a detour counts as reached [m]."""
    robot_passing_m: tuple[float, ...] = (0.4, 0.1)
    """Gaps that a robot leaves to standing agents on a detour [m]; the first gap for which there is a path is used."""
    maneuver_after_steps: int = 12
    """Number of stalled steps after which a robot looks for a maneuver (`sim_kinematic.avoidance.maneuvers`)."""
    maneuvers: int = 8
    """Largest number of maneuvers on the path to one destination."""
    retreat_m: float = 2.0
    """Distance from a person, along the person's path, to which a waiting robot retreats [m]."""
    retreat_room_m: float = 0.45
    """Smallest distance of a place of retreat from the nearest obstacle [m]."""
    retreat_rings_m: tuple[float, ...] = (0.75, 1.5, 2.5, 3.5)
    """Distances from a robot at which it searches for places to retreat to [m]."""

    # --- right of way: agents ask each other to step aside ---------------------------------------------------------------
    aside_m: tuple[float, float, float] = (0.8, 1.1, 1.3)
    """Distance to the other's path at which an agent is aside: two people, a person and a robot, two robots [m]."""
    aside_share: float = 0.8
    """Share of the distance to a path that is accepted for stepping aside where there is no more room."""
    beside_m: tuple[float, float] = (0.65, 0.9)
    """Distance of the centre of a disc below which an agent is on the path of a person, or of a robot [m]."""
    asks_idle_m: float = 2.5
    """Distance ahead within which an agent asks idle agents to step aside [m]."""
    asks_moving_m: float = 1.6
    """Distance ahead within which an agent asks agents that move to their own goals to step aside [m]."""
    keeps_free_m: float = 5.0
    """Length of the other agent's path that agents that step aside keep free [m]."""
    returns_m: float = 1.5
    """Length of an agent's own path that must be clear of the other agent's path before it continues [m]."""
    skips_m: float = 0.3
    """Length of the first part of a path, beside the agent, on which no other agent counts as blocking it [m]."""
    held_up_steps: int = 10
    """Number of stalled steps after which moving agents are asked to yield too."""
    gives_up_steps: int = 45
    """Number of stalled steps after which an agent stops stepping aside."""
    progress_m: float = 0.15
    """Movement above which, or turn above ``progress_rad``, an agent is not stalled [m]."""
    progress_rad: float = 0.6
    lasts_steps: int = 150
    """Largest number of steps for which an agent stands aside."""
    room_m: tuple[float, float] = (0.3, 0.5)
    """Distance to the nearest obstacle that a person, or a robot, prefers when stepping aside [m]."""
    step_aside_m: tuple[float, float] = (0.3, 10.0)
    """Least and greatest length of a path aside [m]."""
    reached_m: tuple[float, float] = (0.02, 0.2)
    """Distance within which a point of a path counts as reached by a person, or by a robot [m]. A person steps onto it
    exactly."""
    squeeze_share: float = 0.75
    """Share of ``aside_m`` that agents stepping aside keep from others on their path."""

    # --- stand-offs: near each other, and neither gets on --------------------------------------------------------------
    stand_off_m: float = 2.5
    """Distance below which agents are near each other [m]."""
    gets_on_m: float = 1.0
    """Reduction of the remaining distance since two agents met that counts as progress; completing a task also counts
    [m]."""
    looks_steps: int = 10
    """Interval of the checks for agents that block each other [steps]."""
    stand_off_steps: tuple[int, int] = (90, 180)
    """Number of steps without progress of either agent after which one of them is sent away. The second number applies
    if one of them is driven from outside, because a person who turns or moves a short distance beside the other agent
    blocks nobody."""
    held_off_steps: int = 45
    """Number of steps without movement after which an agent is sent away at once because an agent driven from outside
    blocks it. The same applies to an agent whose path is blocked by one that has stood for ``held_up_steps``."""
    waits_steps: int = 40
    """Number of steps for which an agent first waits where it is, because the person who drives the other agent sees it
    wait and may move on."""
    refuge_m: float = 3.5
    """Least distance of a refuge from the other agent, if there is such a place [m]."""
    refuge_steps: int = 240
    """Largest number of steps that an agent waits in a refuge for the other agent to get past, or, if the other is
    driven from outside, for a path around it."""

    # --- floor routes around standing agents -----------------------------------------------------------------------------
    cell_m: float = 0.1
    """Side of a grid cell [m]."""
    spare_m: float = 0.01
    """Distance to obstacles beyond the agent's radius in every cell of a path [m]."""
    near_m: float = 0.15
    """Distance between the last cell of a path and the goal at which the path ends [m]."""
    leaves_m: float = 0.05
    """Tolerance for leaving a disc [m]: an agent inside it may move if its distance from the centre shrinks by no more
    than this."""


AVOIDANCE = AvoidanceSpec()
