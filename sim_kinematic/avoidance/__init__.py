"""How agents keep out of each other's path: roll-outs, velocities, routes, yielding."""
