"""Walks of a crowd by itself or beside robots, without worlds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from h3data.geometry import Array
from sim_kinematic.crowd.crowd import Crowd


class Discs(NamedTuple):
    """Agents around a crowd, who stand: centres [N, 2] [m] and radii [N] [m], robots (x, z, heading) [R, 3] and their discs."""

    xz: Array = np.zeros((0, 2))
    radius: Array = np.zeros(0)
    robots: Array = np.zeros((0, 3))
    of_robots: int = 0


NOBODY = Discs()


def step(crowd: Crowd, xz: Array, heading: Array, before: Array, others: Discs, number: int) -> tuple[Array, Array]:
    """Places [M, 2] and headings [M] after a step of people who were at places ``before`` one step ago."""
    now, was = np.concatenate([xz, others.xz]), np.concatenate([before, others.xz])
    radii = np.concatenate([np.zeros(len(xz)), others.radius])
    return crowd.step(now, was, heading, radii, others.robots, others.of_robots, number)
