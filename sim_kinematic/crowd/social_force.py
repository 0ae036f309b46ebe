"""Social force between people (Moussaid et al. 2009)."""

from __future__ import annotations

import math

from h3data.kernels import kernel
from sim_kinematic.motion.step import wrap_angle


@kernel(error_model="numpy")
def interaction(px, pz, vx, vz, lambda_, gamma, n, n_prime):
    """Return the acceleration by one neighbour, before it is weighed.

    It slows down against the direction of the interaction, which is that to the neighbour turned by the relative velocity,
    and turns aside, both falling exponentially with the distance.

    Args:
        px: Position of the neighbour relative to the person [m].
        pz: The same along z.
        vx: Velocity of the person relative to the neighbour [m/s].
        vz: The same along z.
        lambda_: Weight of the relative velocity in the direction of the interaction.
        gamma: Range for each length of that direction.
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
