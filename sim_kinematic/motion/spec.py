"""Constants of the simulator, in SI units, which kernels receive as arguments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Literal, get_args

from h3data.errors import InputError

STEP_S = 1 / 30
"""Duration of a step [s]. Habitat runs 30 steps/s and integrates 1/120 s of its velocity "units" in each, so its 10 is
2.5 m/s (spec/habitat.md 0)."""


Slide = Literal["strict", "habitat"]
PersonContact = Literal["body", "bones"]
"""Collision shapes of people: ``body``, 18 capsules as thick as the body; or ``bones``, a box of 2 x 2 cm along each
bone, as for Habitat's published people (spec/habitat.md 1.6)."""


@dataclass(frozen=True, kw_only=True)
class HabitatSlideSpec:
    """Settings of Habitat's base action; the defaults reproduce the paper (spec/habitat.md 1.1, 1.3)."""

    root_height_m: float = 0.48
    """Height of Spot's root above the floor, from which its discs are projected onto the navigation mesh [m]."""
    slides: bool = True
    """True if a base that touches a wall slides along it (``allow_dyn_slide``); False if it stays where it was."""
    slides_while_turning: bool = True
    """True if the base also slides while it turns; False corresponds to Habitat's
    ``enable_rotation_check_for_dyn_slide``."""
    navmesh_slides: bool = True
    """True if a disc's own step on the navigation mesh slides too (``sim_cfg.allow_sliding``); False if it ends at the
    first wall."""


@dataclass(frozen=True, kw_only=True)
class BaseSpec:
    """Motion of a robot's base: discs that must stay clear of obstacles, and speed limits."""

    max_speed_mps: float = 2.5
    max_turn_rad_s: float = 2.5
    max_lateral_mps: float = 0.0
    """Limit of the speed to the side [m/s]; if it is above 0, an action has a third number for that speed, positive to
    the left."""
    allow_back: bool = True
    """True if the base can drive backwards."""
    slide: Slide = "strict"
    """Behaviour of the base at a wall. With ``strict``, no disc ever enters an obstacle. With ``habitat``, the base
    moves as Habitat's base action, step for step: as far as its most obstructed disc allows, so that other discs may
    enter walls (research: navigation-and-stepping 3.2)."""
    habitat: HabitatSlideSpec = HabitatSlideSpec()
    """Parameters of the base action that are used with ``slide="habitat"``."""
    disc_offsets_m: tuple[float, ...] = (0.0, 0.225)
    """Positions of the discs along the robot's x axis [m]: centre and front, the paper's two cylinders (appendix,
    social navigation), which make up the profile ``habitat`` of every robot. These discs do not cover the hind legs and
    the hand, which were more than 2 cm inside walls or furniture in 13% of the steps; those of `HOME_BASE` do."""
    disc_radius_m: float = 0.25
    slide_iterations: int = 6
    """Largest number of attempts to push the discs out of obstacles before the move is given up."""
    clearance_tolerance_m: float = 7e-4
    """Distance by which a disc may be nearer to an obstacle on the grid than its radius [m]. The error of the grid is
    up to cell^2 / (8 radius), 1.25 mm at corners, so the disc enters no obstacle by more than 2 mm."""
    contact_tolerance_m: float = 1e-5
    """Displacement of a disc above which it counts as having touched an obstacle [m]."""
    keeps_speed: bool = field(default=False, repr=False)
    """True if sliding counts towards the speed limit; otherwise obstacles may push a base beyond it (2.76 m/s were
    measured at a limit of 2.5 m/s). The field is left out of ``repr``, from which the identity of episodes is derived,
    so that episodes with the paper's base keep theirs."""
    maneuvers: bool = field(default=False, repr=False)
    """True if scripts drive the base as in h3data's own episodes: it accelerates and brakes gradually, and searches for
    a maneuver when it is stuck (`sim_kinematic.avoidance.maneuvers`)."""

    def farthest_m(self, dt: float) -> float:
        """Return the largest movement of the base in one step of ``dt`` [s], including pushes by obstacles [m]."""
        return math.hypot(self.max_speed_mps, self.max_lateral_mps) * dt if self.keeps_speed else math.inf


HOME_BASE = BaseSpec(disc_offsets_m=(-0.4, 0.02, 0.33), keeps_speed=True, maneuvers=True)
"""Base of h3data's own episodes, whose discs cover a robot from hind legs to hand. Robots other than ``quad_arm`` have
their own base (`sim_kinematic.avoidance.robot_base.base_of`)."""


@dataclass(frozen=True, kw_only=True)
class ArmRoomSpec:
    """Rules by which people fold in their arms where there is little room (`sim_kinematic.agents.arm_tuck`).

    Distances are measured from the half width of a person with both arms folded in, which is 0.21 to 0.27 m; swinging
    arms are 3 to 6 cm wider.
    """

    free_m: float = 0.08
    """Room at the side, beyond the arm's own, above which an arm swings freely [m]."""
    tight_m: float = 0.02
    """Room at the side below which an arm is fully tucked [m]."""
    aside_m: float = 0.12
    """Distance from the middle of the body to the line along which room is measured [m]."""
    within_m: float = 0.3
    """Distance ahead and behind within which obstacles count in full [m]."""
    fade_m: float = 0.5
    """Distance beyond ``within_m`` over which obstacles count less and less [m]."""
    step_m: float = 0.1
    """Length of the steps in which the line is checked [m]."""
    rate: float = 0.12
    """Largest change of an arm's fold in one step, where 0 is fully out and 1 fully in."""


@dataclass(frozen=True, kw_only=True)
class StrideSpec:
    """Rules for walking along a path without stopping to turn (`sim_kinematic.motion.stride`)."""

    accel_mps2: float = 1.1
    """Acceleration of people [m/s2], who reach their walking speed in two to three steps (Breniere and Do 1986: 1.3 m/s
    in 1.2 s)."""
    decel_mps2: float = 1.1
    turn_rad_s: float = 1.8
    turn_accel_rad_s2: float = 7.0
    steer_per_s: float = 2.6
    """Turn rate per radian between a person's heading and the direction to the point that they walk to [1/s]."""
    look_m: float = 0.7
    """Largest distance of the point that the person walks towards [m]; it is nearer where there is little room."""
    sidestep_rad: float = 0.35
    """Largest angle between the direction of walking and the heading [rad]."""
    sidestep_rad_s: float = 2.5
    """Largest rate of change of that angle [rad/s]."""
    arrive_m: float = 0.12
    """Half of the distance from the end of a path within which people no longer turn but step to it, sideways if
    necessary [m]."""
    patience_s: float = 4.0
    """Time without progress after which people follow the path itself, with all its corners [s]."""

    @property
    def limits(self) -> tuple[float, ...]:
        """Constants of the spec in the order in which the kernel takes them."""
        return (
            self.accel_mps2,
            self.decel_mps2,
            self.turn_rad_s,
            self.turn_accel_rad_s2,
            self.steer_per_s,
            self.look_m,
            self.sidestep_rad,
            self.sidestep_rad_s,
            self.arrive_m,
        )


@dataclass(frozen=True, kw_only=True)
class WalkerSpec:
    """Motion of a waypoint humanoid: it turns on the spot towards the next waypoint, then walks (paper section 3.1)."""

    speed_mps: float = 2.5
    turn_rad_s: float = 2.5
    turn_before_walk_rad: float = 0.0873
    """Heading error above which a person turns without walking (5 degrees, spec/habitat.md 3.4) [rad]."""
    arrive_m: float = 1e-3
    """Distance within which a waypoint counts as reached [m]. People stop exactly on it; a larger distance would make
    them cut the next corner."""
    blend_s: float = 0.2
    """Duration of the transition between standing and walking [s]."""
    clearance_m: float = 0.0
    """Distance of waypoints from walls and furniture where there is room [m]; with 0, paths are shortest, as in
    Habitat."""
    arms: ArmRoomSpec | None = None
    """Rules for folding in the arms beside walls and furniture; None: they swing regardless of obstacles."""
    stride: StrideSpec | None = None
    """Rules for curves, starts and stops; None: people turn on the spot and always walk at full speed, as in the
    paper."""

    def __repr__(self) -> str:
        # uids of episodes are made of it: those of walkers without a stride stay as they were
        shown = [f for f in fields(self) if f.name != "stride" or self.stride is not None]
        return f"WalkerSpec({', '.join(f'{f.name}={getattr(self, f.name)!r}' for f in shown)})"


NATURAL_WALKER = WalkerSpec(speed_mps=1.3, clearance_m=0.4, arms=ArmRoomSpec(), stride=StrideSpec())
"""Gait of a person who walks along curves at a natural walking speed, the default of new episodes."""

HOME_WALKER = WalkerSpec(clearance_m=0.4, arms=ArmRoomSpec())
"""Gait of the paper's person, who keeps a distance from walls and furniture where there is room."""


WALKERS = {"paper": HOME_WALKER, "natural": NATURAL_WALKER}
"""Gaits by name: ``paper`` walks at 2.5 m/s and turns on the spot; ``natural`` walks along curves at a natural
speed."""

RULE_SETS: Mapping[str, Mapping[str, Any]] = {name: {"human": walker} for name, walker in WALKERS.items()}
"""Fields of a spec by the name of a set of rules. ``paper`` reproduces the published numbers as far as the included
assets allow (`h3data.metrics.paper.protocol`), and ``natural`` is the default of new episodes."""


@dataclass(frozen=True, kw_only=True)
class SocialNavSpec:
    """Rules of social navigation: find the person, then follow them at 1-2 m, facing them.

    The rules follow the paper (section 4.1 and appendix).
    """

    max_steps: int = 1500
    spawn_distance_m: float = 5.0
    """Least distance between robot and human at the start [m]: 3 m for training, 5 m for evaluation."""
    near_m: float = 1.0
    far_m: float = 2.0
    facing_dot: float = 0.5
    """Cosine between the robot's forward axis and the direction to the human, above which it faces them."""
    end_on_collision: bool = True
    agent_radius_m: float = 0.25
    agent_height_m: float = 1.41
    """Height of the agent for Habitat's navigation mesh of Spot, which both agents use [m] (spec/habitat.md 1.2)."""
    robot: BaseSpec = HOME_BASE
    human: WalkerSpec = NATURAL_WALKER
    rule_sets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "natural": {"human": NATURAL_WALKER, "robot": HOME_BASE, "person_contact": "body"},
        "paper": {"human": WalkerSpec(), "robot": BaseSpec(), "person_contact": "bones"},
    }
    solid_agents: bool = field(default=False, repr=False)
    """True if a person under commands slides along the discs of others as along walls, which is the rule where people
    play live. The field is left out of ``repr``, from which the identity of episodes is derived."""
    person_contact: PersonContact = field(default="body", repr=False)
    """Shapes of people for collisions with robots."""

    def __repr__(self) -> str:
        # uids of episodes are made of it: those from before there was a choice of shapes stay as they were
        shown = [f for f in fields(self) if f.repr or (f.name == "person_contact" and self.person_contact != "body")]
        return f"SocialNavSpec({', '.join(f'{f.name}={getattr(self, f.name)!r}' for f in shown)})"

    def __post_init__(self) -> None:
        if self.person_contact not in (kinds := get_args(PersonContact)):
            raise InputError(
                f"Unknown person_contact {self.person_contact!r}. Expected one of: {', '.join(kinds)}.",
                code="H3-SIM-057",
            )


@dataclass(frozen=True, kw_only=True)
class ArmSpec:
    """Motion and grasping of a robot's arm (paper appendix, low-level skills; spec/habitat.md 2.8)."""

    joint_step: float = 0.05
    """Largest movement of a joint in one step [rad or m]."""
    grasp_m: float = 0.15
    """Distance within which the hand takes the nearest object, measured to its origin [m]."""


@dataclass(frozen=True, kw_only=True)
class SkillSpec:
    """Rules of a robot's learned skills: conditions of success, time limits, and rewards.

    They follow the paper's appendix (low-level skill training).
    """

    nav_steps: int = 1500
    """Longest duration of ``nav`` in steps."""
    arm_steps: int = 1250
    """Longest duration of ``pick`` and ``place`` in steps."""
    nav_start_m: float = 4.0
    """Least length of the path to the stand at the start of ``nav`` [m]."""
    arm_start_m: float = 3.0
    """Least length of the path to the stand at the start of ``pick`` and ``place`` [m]."""
    arm_most_m: float = 5.0
    """Largest length of that path at the start of ``pick`` and ``place`` [m]; a robot that is farther away has to drive
    there first."""
    near_m: float = 1.5
    """Distance to the target, and length of the path to the stand, below which ``nav`` ends [m]."""
    facing_dot: float = 0.5
    """Least cosine between the forward axis and the direction to the target at which ``nav`` ends."""
    rest_m: float = 0.15
    """Distance of the hand from its resting place below which ``pick`` and ``place`` end [m]."""
    place_m: float = 0.15
    """Distance from its goal within which an object counts as placed [m]."""
    slack: float = 0.005
    """Cost of each step; ``nav`` costs twice that."""
    contact: float = 0.005
    """Cost of each step of ``nav`` in which the base touches something."""
    facing: float = 0.05
    """Cost of each step of ``nav``, multiplied by one minus the cosine to the target."""
    facing_within_m: float = 3.0
    """Length of the path within which a step costs ``facing`` [m]. If it were a reward, waiting in front of the target
    would be worth more than success."""
    nav_success: float = 10.0
    pick_success: float = 2.0
    place_success: float = 10.0
    placed: float = 5.0
    """Reward for putting the object at its goal, once."""
    lost: float = 0.5
    """Cost of taking another object or dropping the right one, which ends ``pick``."""


@dataclass(frozen=True, kw_only=True)
class OracleSpec:
    """Rules of oracle skills like Habitat's, which a device can repeat step by step (h3data docs rearrangement).

    Agents do not give way to each other. An agent takes an object if it stands where it can reach the object and faces
    it. The object is in the hand after some steps, and at its goal in the step in which it is put down. Arms stay at
    rest.
    """

    robot_steps: tuple[int, int] = (12, 14)
    """Number of steps of a robot's pick or place until the object changes hands, and until the skill ends; averages of
    the full skills."""
    person_steps: tuple[int, int] = (46, 73)
    """Number of steps of a person's pick or place until the object changes hands, and until the skill ends."""
    reach_m: float = 0.2
    """Distance within which an agent counts as being at a place [m]."""
    reach_rad: float = 0.1
    """Angle within which an agent counts as facing the object that it reaches for [rad]."""
    person_radius_m: float = 0.2
    """Radius of a person's disc [m]; agents touch if their discs overlap."""

    def __post_init__(self) -> None:
        for changes, ends in (self.robot_steps, self.person_steps):
            if not 1 <= changes <= ends:
                raise InputError(
                    f"Expected picks of 1 <= hand-over <= end steps, got {changes} and {ends}.", code="H3-SIM-032"
                )
