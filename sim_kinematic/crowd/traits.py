"""Traits of individual people of a crowd, and the constants that all of them share."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from typing import NamedTuple

import numpy as np

from h3data.geometry import Array
from sim_kinematic.motion.randomness import generator


@dataclass(frozen=True, kw_only=True)
class CrowdSpec:
    """Constants of avoidance that all people of a crowd share, in SI units."""

    horizon_s: float = 2.0
    """Time within which `orca` avoids a collision with a person who keeps their velocity [s]."""
    wall_horizon_s: float = 0.5
    """Time within which `orca` avoids a collision with walls and furniture [s]."""
    guard_s: float = 0.6
    """Time within which people of `social_force` avoid a collision, as its forces alone let people touch [s]."""
    neighbour_m: float = 6.0
    """Distance beyond which people and robots are ignored [m]."""
    comfort_m: float = 0.08
    """Distance between outlines that avoidance adds to both radii [m]."""
    narrow_m: float = 0.55
    """Distance to the nearest wall below which a place counts as narrow: two people cannot pass each other there
    [m]."""
    wait_m: float = 1.2
    """Distance before a narrow place at which people decide who goes first [m]."""
    aside_m: float = 0.9
    """Distance that people who wait keep from the path of people who come through [m]."""
    approach_m: float = 6.0
    """Distance from which people who meet head-on move to their preferred side [m]."""
    approach_rad: float = 0.6
    """Angle by which people who meet head-on move to their preferred side [rad]."""
    desired_gain: float = 2.0
    """Social force (Moussaid et al. 2009, with the weights of HuNavSim's library lightsfm): weight of the desired velocity."""
    social_gain: float = 2.1
    """Social force: weight of other people."""
    wall_gain: float = 10.0
    """Social force: weight of walls."""
    wall_range_m: float = 0.2
    """Distance over which the force of walls falls by e [m]."""
    lambda_: float = 2.0
    """Social force: weight of the relative velocity in the direction of an interaction."""
    gamma: float = 0.35
    """Social force: range of an interaction for each m/s."""
    n: float = 2.0
    """Social force: angular range of an interaction for slowing down."""
    n_prime: float = 3.0
    """Social force: angular range of an interaction for turning aside."""
    version: int = 4
    """Version of the rules (`sim_kinematic.crowd.crowd.VERSION`). From 2 on, people of a walking group keep together
    only with members whom they see, and keep walking at least slowly. From 4 on, people who should go back walk on if
    they are at the start of their path, and members of a walking group do not pull at each other while another person
    is between them. From 5 on, a place beside a wall is narrow only if there is no more room beside it either
    (`sim_kinematic.crowd.step.is_narrow`). From 6 on, people give way to nobody who has passed them, and take any
    velocity that avoids others who keep theirs."""
    way_horizon_s: float = 2.0
    """Time within which `orca` avoids a collision with a person who gives way [s]."""
    aside_mps: float = 0.6
    """Speed of people who step aside for others [m/s]."""
    back_mps: float = 0.8
    """Speed of people who go back for others [m/s]."""
    way_share: float = 0.5
    """Share of the change of velocity that `orca` expects of people to whom another person gives way; that person makes
    the rest."""
    company_m: float = 0.08
    """Distance between outlines that avoidance adds between members of one walking group [m]."""
    company_gain: float = 2.1
    """Social force: weight of members of one's own walking group."""
    frees: bool = False
    """True if people of `social_force`, some of whom walk in groups, are not held up before passages: walls do not push
    them back, those who cannot walk turn to where they want to go, nobody turns their feet into others while stepping, and
    members of a walking group avoid each other for `sim_kinematic.crowd.step.COMPANY_S`."""

    @classmethod
    def of_version(cls, version: int, *, wary: bool = False, early: bool = False, frees: bool = False) -> CrowdSpec:
        """Return the constants for a version of the rules; with ``early``, of those up to version 5.

        With ``wary``, the constants keep the horizons and speeds of version 2, and find narrow places as in version 4. With
        ``frees``, passages hold nobody up from version 10 on.
        """
        if wary or version < 3:
            near = 0.0 if version > 7 and not early else cls.company_m
            gain, guard = (0.0, cls.horizon_s) if version > 8 else (cls.company_gain, cls.guard_s)
            return cls(
                version=min(version, 4),
                company_m=near,
                company_gain=gain,
                guard_s=guard,
                frees=frees and version > 9 and not early,
            )
        kept = min(version, 5) if early else version
        quick = cls(horizon_s=1.2, way_horizon_s=0.7, aside_mps=1.0, back_mps=1.1, version=kept)
        sooner = replace(quick, wait_m=1.7, aside_mps=1.3, back_mps=1.3, way_share=0.1) if kept > 4 else quick
        return replace(sooner, wait_m=2.0, aside_m=1.2) if kept > 5 else sooner

    @property
    def numbers(self) -> Array:
        """Constants that the kernels take, in the order of the fields."""
        return np.array(astuple(self))


class Traits(NamedTuple):
    """Traits of one person of a crowd."""

    speed_mps: float
    """Walking speed of the person on a free path [m/s]."""
    relaxation_s: float
    """Time constant with which `social_force` returns to the desired velocity [s]."""
    reaction_s: float
    """Time between two decisions [s]."""
    radius_m: float
    """Radius of the person's disc, which others' discs must not overlap [m]: half of the width of the body with
    swinging arms."""
    side: float
    """Side to which the person moves when meeting another person head-on: 1 is right, -1 left."""
    patience_s: float
    """Time without progress after which a person chooses another goal [s]."""


LEAST_SPEED, MOST_SPEED = 0.5, 1.5
"""Smallest and largest free walking speed as multiples of the mean."""
SPEED_SD, RIGHT_SHARE = 0.27, 0.85
"""Standard deviation of free speeds over their mean (0.35 m/s of 1.3 m/s, as among the pedestrians of ETH and UCY); and
share of people who keep to the right (measured crowds pass on their majority's side in 54 to 78% of encounters)."""


def sample_traits(seed: int, number: int, mean_speed_mps: float) -> Traits:
    """Return the traits of agent ``number`` in an episode, which follow from its seed.

    Args:
        seed: Seed of the episode.
        number: Number of the agent.
        mean_speed_mps: Mean free speed of people [m/s].
    """
    rng = generator(seed, "crowd_traits", world=number)
    share = float(np.clip(rng.normal(1.0, SPEED_SD), LEAST_SPEED, MOST_SPEED))
    return Traits(
        speed_mps=mean_speed_mps * share,
        relaxation_s=float(rng.uniform(0.4, 0.6)),
        reaction_s=float(rng.uniform(0.1, 0.3)),
        radius_m=0.34,
        side=1.0 if rng.random() < RIGHT_SHARE else -1.0,
        patience_s=float(rng.uniform(4.0, 8.0)),
    )
