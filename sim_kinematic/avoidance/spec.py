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
"""A person, as agents that plan around them see them."""


@dataclass(frozen=True, kw_only=True)
class AvoidanceSpec:
    """Distances, times and costs of avoidance. Lengths are on the floor, between centres unless said otherwise.

    Tuned together on rearrangement by three to five agents (``benchmarks/sim_many.py``): of 40 episodes none ends in a
    contact and 92% succeed; without right of way it was 7% and 46%. Distances that concern robots are those of ``quad_arm``;
    for another robot its own size replaces the size of ``quad_arm`` (`sim_kinematic.avoidance.robot_base`).
    """

    # --- sizes ---------------------------------------------------------------------------------------------------------
    person: Footprint = PERSON
    robot: Footprint = field(default=Footprint((-0.3, 0.0, 0.4), 0.3))
    """``quad_arm`` from hind legs to stowed hand, as other agents see it. Its base discs alone (0 and 0.225 m) would let others
    plan paths through its hind legs."""
    robot_margin_m: float = 0.05
    """Width that is added to those discs beyond the base discs, for legs and an arm that sway."""

    # --- a robot's base chooses its next velocity ------------------------------------------------------------------------
    accel_mps2: float = 5.0
    """Robots set off, and brake before their goal, at this rate: full speed takes half a second. Where they have to keep clear
    of somebody, they do so at once."""
    brake_mps2: float = 12.0
    """Deceleration of people where a path turns sharply."""
    turn_accel_rad_s2: float = 12.0
    """Angular acceleration with which people begin and end a turn."""
    corner_mps: float = 1.2
    """Speed to which they have braked at a corner of their path."""
    dots_m: float = 0.2
    """Largest distance between the points on a path from which distances to another path are measured [m]."""
    range_m: float = 4.0
    """Agents farther away are ignored: at 2.5 m/s each, two need 0.8 s to meet."""
    horizon_steps: int = 24
    """Number of steps that each trial command is rolled out."""
    stride_steps: int = 3
    """Number of steps between the moments of a roll-out in which gaps are measured."""
    doubt_mps: float = 0.25
    """Gaps in the future count as wider by this speed: an agent's motion is known best now."""
    person_radius_m: float = 0.35
    """Radius of a person; wider than ``person`` because their arms swing."""
    margin_m: float = 0.35
    """Gap [m] to be kept between robot and agent."""
    standing_margin_m: float = 0.15
    """Distance that is kept from agents that stand and will step aside if asked to."""
    still_margin_m: float = 0.0
    """Distance that is kept from agents that have stood for long, small enough for a robot to get past."""
    still_steps: int = 75
    """An agent that has stood for this long has settled; picking and placing take less."""
    still_m: float = 0.01
    """An agent that moved less than this along x and z in ``still_steps`` stood."""
    gap_weight: float = 8.0
    """Metres of path that a metre of missing gap is worth."""
    heading_weight_m: float = 0.1
    """Metres of path that a radian of heading error is worth."""
    turn_weight_m: float = 0.02
    """Cost of a full turn command: of equal commands the calmest wins."""
    change_weight_m: float = 0.15
    """Cost of a change of either command by its limit, so that a robot does not waver between two paths around a person."""
    wall_tolerance_m: float = 2e-3
    """Distance by which a base disc may be nearer to an obstacle than its radius in trials, so that a base that touches a wall
    can leave it."""
    wall_m: float = 0.03
    """A person walking straight on is taken to stop this much closer to an obstacle than their radius."""
    velocity_steps: int = 3
    """Number of steps over which an agent's velocity is measured."""
    contact_gate_m: float = 2.0
    """Agents farther apart cannot touch, arms stretched out."""
    contact_span_m: float = 1.4
    """Span of a robot (`sim_kinematic.contact.clearance.robot_span`) that this allows for; 1.38 m is that of ``quad_arm``."""

    # --- people on their path, and agents that wait ----------------------------------------------------------------------
    ahead_m: float = 1.2
    """An agent is in a person's way if it is within this distance along their path and both would touch."""
    beside_nearer_m: float = 0.03
    """Change of distance below which a person who passes counts as beside an agent and not in its path."""
    moving_m: float = 0.1
    """Additional gap [m] within which an agent that moves is in the way."""
    passing_m: tuple[float, ...] = (0.1, 0.0)
    """Gaps that a person leaves to standing agents on a detour; the first with which there is a path is taken."""
    apart_m: float = 0.75
    """People do not choose places to stand closer to each other than this."""
    stands_mps: float = 0.05
    """Agents slower than this stand."""
    patience_steps: int = 90
    """Number of steps after which a person gives up waiting for others to clear the path."""
    detour_after_steps: tuple[int, int] = (10, 40)
    """Stalled steps after which a robot looks for a path around the agents that stand."""
    detours: int = 3
    """Largest number of detours to one destination."""
    via_m: float = 0.25
    """A point of a detour counts as reached within this distance."""
    robot_passing_m: tuple[float, ...] = (0.4, 0.1)
    """Gaps that a robot leaves to standing agents on a detour; the first with which there is a path is taken."""
    maneuver_after_steps: int = 12
    """Number of stalled steps after which a robot looks for a maneuver (`sim_kinematic.avoidance.maneuvers`)."""
    maneuvers: int = 8
    """Largest number of maneuvers on the path to one destination."""
    retreat_m: float = 2.0
    """A robot that waits retreats to this distance from a person, measured along the person's path."""
    retreat_room_m: float = 0.45
    """Distance to the nearest obstacle at such a place [m]."""
    retreat_rings_m: tuple[float, ...] = (0.75, 1.5, 2.5, 3.5)
    """Distances from an agent at which it looks for places to step aside to [m]."""

    # --- right of way: agents ask each other to step aside ---------------------------------------------------------------
    aside_m: tuple[float, float, float] = (0.8, 1.1, 1.3)
    """Distance to the other's path that counts as aside: two people, a person and a robot, two robots."""
    aside_share: float = 0.8
    """Share of the distance to a path that is accepted for stepping aside where there is no more room."""
    beside_m: tuple[float, float] = (0.65, 0.9)
    """An agent is on the path of a person, or of a robot, if the centre of one of its discs is this close to it."""
    asks_idle_m: float = 2.5
    """Distance ahead within which an agent asks idle agents to step aside."""
    asks_moving_m: float = 1.6
    """Distance ahead within which it asks agents that are going somewhere themselves."""
    keeps_free_m: float = 5.0
    """Length of the other's path that is kept free by stepping aside."""
    returns_m: float = 1.5
    """Length of an agent's own path that must not lead onto the other's before it continues [m]."""
    skips_m: float = 0.3
    """Length of the first part of a path, on which no agent counts as in the way, because it is beside [m]."""
    held_up_steps: int = 10
    """Number of stalled steps after which moving agents are asked to yield too."""
    gives_up_steps: int = 45
    """Number of stalled steps after which an agent stops stepping aside."""
    progress_m: float = 0.15
    """An agent that moved, or turned by ``progress_rad``, more than this is not stalled."""
    progress_rad: float = 0.6
    lasts_steps: int = 150
    """Largest number of steps for which an agent stands aside."""
    room_m: tuple[float, float] = (0.3, 0.5)
    """Distance to the nearest obstacle wanted where a person, or a robot, steps aside."""
    step_aside_m: tuple[float, float] = (0.3, 10.0)
    """Least and greatest length of a path aside [m]."""
    reached_m: tuple[float, float] = (0.02, 0.2)
    """A point of a path counts as reached by a person, or by a robot, within this distance. A person steps onto it exactly."""
    squeeze_share: float = 0.75
    """Share of ``aside_m`` that agents stepping aside keep from others on their path."""

    # --- stand-offs: near each other, and neither gets on --------------------------------------------------------------
    stand_off_m: float = 2.5
    """Agents nearer than this are near each other."""
    gets_on_m: float = 1.0
    """Reduction of the distance to go since they met that counts as progress, as completing something does [m]."""
    looks_steps: int = 10
    """Interval of this check [steps]."""
    stand_off_steps: tuple[int, int] = (90, 180)
    """Number of steps without progress of either agent after which one of them is sent away; the second number holds where one
    is driven from outside, as somebody who turns or goes a short way beside the other blocks nobody."""
    held_off_steps: int = 45
    """Number of steps without movement after which an agent near somebody driven from outside, who keeps it from going on, is
    sent away at once. The same holds for one whose path is blocked by somebody who has stood for ``held_up_steps``."""
    waits_steps: int = 40
    """Number of steps for which an agent first waits where it is, because whoever drives the other one sees it wait and may go
    on."""
    refuge_m: float = 3.5
    """Least distance of a refuge from the other agent, if there is such a place [m]."""
    refuge_steps: int = 240
    """Largest number of steps in a refuge, in which the agent waits until the other has got past; where the other is driven
    from outside, until there is a path around it."""

    # --- floor routes around standing agents -----------------------------------------------------------------------------
    cell_m: float = 0.1
    """Side of a grid cell."""
    spare_m: float = 0.01
    """Distance to obstacles beyond the agent's radius in every cell of a path."""
    near_m: float = 0.15
    """A path ends where its last cell is this close to the goal."""
    leaves_m: float = 0.05
    """An agent that is inside a disc may move away from its centre, down to a radius this much smaller than its distance."""


AVOIDANCE = AvoidanceSpec()
