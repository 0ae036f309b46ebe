"""Social force between people (Moussaid et al. 2009)."""

from __future__ import annotations

import math

from h3data.kernels import kernel
from sim_kinematic.motion.step import wrap_angle


@kernel(error_model="numpy")
def interaction(px, pz, vx, vz, lambda_, gamma, n, n_prime):
    """Return the acceleration caused by one neighbour, before it is weighted.

    The acceleration has a part that slows the person down, against the direction of the interaction, and a part that
    turns them aside. Both fall exponentially with the distance. The direction of the interaction is the direction to
    the neighbour, turned by the relative velocity.

    Args:
        px: Position of the neighbour relative to the person along x [m].
        pz: Position of the neighbour relative to the person along z [m].
        vx: Velocity of the person relative to the neighbour along x [m/s].
        vz: Velocity of the person relative to the neighbour along z [m/s].
        lambda_: Weight of the relative velocity in the direction of the interaction.
        gamma: Range of the interaction for each m/s of the interaction vector.
        n: Angular range of slowing down.
        n_prime: Angular range of turning aside.
    """
    # two people at one place have no direction to each other
    distance = max(math.hypot(px, pz), 1e-6)
    ex, ez = px / distance, pz / distance
    ix, iz = lambda_ * vx + ex, lambda_ * vz + ez
    length = math.hypot(ix, iz)
    if length < 1e-9:
        return 0.0, 0.0
    ix, iz = ix / length, iz / length
    reach = gamma * length
    theta = wrap_angle(math.atan2(ez, ex) - math.atan2(iz, ix))
    slow = -math.exp(-distance / reach - (n_prime * reach * theta) ** 2)
    turn = math.exp(-distance / reach - (n * reach * theta) ** 2)
    turn = -turn if theta >= 0.0 else turn  # away from the side on which the neighbour is
    return slow * ix - turn * iz, slow * iz + turn * ix
