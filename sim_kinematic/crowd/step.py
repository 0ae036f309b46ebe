"""Step of all people of a crowd: the velocity that each chooses, and the motion of the bodies towards it.

People walk in the direction of view and a little sideways, and set off, brake and turn no faster than `StrideSpec`
says, so that their feet stay planted. Whatever they decide, the discs of two people never overlap.
"""

from __future__ import annotations

import math

import numpy as np

from h3data.kernels import kernel
from h3data.scene.freespace.free_space import sample_sdf, sdf_gradient
from sim_kinematic.crowd.company import keep_company, walk_beside
from sim_kinematic.crowd.orca import half_plane, nearest_velocity
from sim_kinematic.crowd.reactions import IMPASSIVE, TABLE, notice, reacting_velocity, sees
from sim_kinematic.crowd.social_force import interaction
from sim_kinematic.motion.step import wrap_angle
from sim_kinematic.motion.stride import point_along, progress_along, slide_along_walls

WALL_M = 0.25
"""Distance that people keep from walls and furniture, beside which their arms fold in [m]."""
FOOT_M, FOOT_S, FOOT_ROOM_M = 0.2, 0.1, 0.22
"""Distance ahead of the first foot of a person who sets off [m]; time that is multiplied by the speed and added to this
distance [s]; and room that the foot needs [m]."""
CREEP_MPS = 0.25
"""Speed up to which people step in any direction, regardless of their heading [m/s]."""
AHEAD_M = 0.1
"""Length of the steps in which narrow places are searched along a path [m]."""
PROGRESS_M = 0.25
"""Progress along the path above which a person does not count as stuck [m]."""
SLIDES = 3
"""Number of attempts to move past other people with whom a step would collide."""
SEATED = 3.0
"""Value in ``stays`` for people who sit down, sit or get up, whose places are prescribed."""
BACK_M, START_M = 1.5, 0.1
"""Distance that people in a narrow place go back along their path to let others through, and distance from the start of
the path within which they cannot go back [m]."""
STRIDE_M, NEAR_END_M, GROUP_S, COMPANY_S = 0.2, 0.1, 0.5, 0.6
"""Distance by which feet and hands reach farther ahead and behind than sideways [m]; distance from the place of a person who
stands within which they do not step back to it [m]; time in which forces of a group become velocities, the time constant of
Moussaid et al. [s]; time within which members of a group avoid a collision with each other by `CrowdSpec.frees` [s]."""


@kernel(error_model="numpy")
def reach_between(m, j, px, pz, radii, body):
    """Return the least distance [m] between person ``m`` and disc ``j`` at ``(px, pz)`` from them.

    The distance is the sum of both radii, and more along the direction of view, since feet and hands reach ahead and
    behind when people set off.
    """
    reach, line = radii[m] + radii[j], math.atan2(-pz, px)
    for k in (m, j):
        if k < len(body):
            reach += STRIDE_M * math.cos(body[k, 0] - line) ** 2
    return reach


@kernel(error_model="numpy")
def who_decides(xz, paths, counts, best, traits, until, step, dt, arrived_m):
    """Return whether a person of a crowd has arrived, is stuck, has stayed long enough or has no path.

    Args:
        xz: Positions of the people [M, 2] [m].
        paths: Paths of the people [M, K, 2] [m].
        counts: Number of points of each path [M].
        best: Largest progress so far, and the step in which it was made [M, 2].
        traits: `Traits` of the people [M, 6].
        until: Step until which each person stays where they are [M]; -1: they walk.
        step: Number of the step.
        dt: Duration of a step [s].
        arrived_m: Distance to the end of the path from which on they have arrived [m].
    """
    for m in range(len(counts)):
        if counts[m] < 2:
            return True
        if until[m] >= 0.0:
            if until[m] <= step:
                return True
            continue
        end = counts[m] - 1
        left = math.hypot(paths[m, end, 0] - xz[m, 0], paths[m, end, 1] - xz[m, 1])
        if left < arrived_m or (step - best[m, 1]) * dt > traits[m, 5]:
            return True
    return False


@kernel(error_model="numpy")
def is_narrow(sdf, origin, cell, x, z, narrow, beside):
    """Return whether two people cannot pass each other at a place.

    With ``beside``, a place next to a wall is not narrow if there is room on its other side, because shortest paths
    lead along walls even in wide rooms.
    """
    missing = narrow - sample_sdf(sdf, origin, cell, x, z)
    if missing <= 0.0 or not beside:
        return missing > 0.0
    gx, gz = sdf_gradient(sdf, origin, cell, x, z)
    steep = max(math.hypot(gx, gz), 1e-9)
    # a little farther, as distances of the grid are interpolated
    missing += 0.02
    return sample_sdf(sdf, origin, cell, x + gx / steep * missing, z + gz / steep * missing) < narrow


@kernel(error_model="numpy")
def find_narrow(sdf, origin, cell, path, cumulative, along, narrow, within, beside):
    """Return the distance along the path of the first narrow place from ``along`` on [m]; -1 if none is near.

    Places beyond ``within`` [m] are not searched.
    """
    at = along
    while at <= min(along + within, cumulative[-1]):
        x, z = point_along(path, cumulative, at)
        if is_narrow(sdf, origin, cell, x, z, narrow, beside):
            return at
        at += AHEAD_M
    return -1.0


@kernel(error_model="numpy")
def claim_passages(sdf, origin, cell, xz, paths, counts, lengths, along, claims, step, rules):
    """Note in ``claims`` [M, 6], in place, which people are in or before a narrow place.

    A row holds the step in which the person came to the place (0: no place), the point (x, z) where it starts for them,
    the direction in which they pass it, and whether they are in it.
    """
    narrow, wait, beside = rules[5], rules[6], rules[18] > 4.0
    for m in range(len(xz)):
        path, cumulative = paths[m, : counts[m]], lengths[m, : counts[m]]
        inside = is_narrow(sdf, origin, cell, xz[m, 0], xz[m, 1], narrow, beside)
        at = along[m] if inside else find_narrow(sdf, origin, cell, path, cumulative, along[m], narrow, wait, beside)
        if at < 0.0 or counts[m] < 2:
            claims[m, 0] = 0.0
            continue
        ax, az = point_along(path, cumulative, at)
        bx, bz = point_along(path, cumulative, at + 0.4)
        length = max(math.hypot(bx - ax, bz - az), 1e-9)
        # one more than the step, as 0 means that the person is at no narrow place
        if claims[m, 0] == 0.0:
            claims[m, 0] = step + 1.0
        claims[m, 1], claims[m, 2] = ax, az
        claims[m, 3], claims[m, 4] = (bx - ax) / length, (bz - az) / length
        claims[m, 5] = 1.0 if inside else 0.0


@kernel(error_model="numpy")
def first_through(claims, company, m, wait, to_come):
    """Return the number of the person who passes a narrow place before person ``m`` from the other side, or -1.

    With ``to_come``, people whose narrow place begins beyond that of person ``m`` do not count: they have passed it.
    """
    if claims[m, 0] == 0.0:
        return -1
    for j in range(len(claims)):
        if j == m or claims[j, 0] == 0.0 or (company[m] >= 0 and company[j] == company[m]):
            continue
        # people who walk one behind the other go through together
        opposite = claims[m, 3] * claims[j, 3] + claims[m, 4] * claims[j, 4] < -0.3
        px, pz = claims[m, 1] - claims[j, 1], claims[m, 2] - claims[j, 2]
        near = math.hypot(px, pz) < wait + 0.4
        passed = to_come and px * claims[j, 3] + pz * claims[j, 4] < 0.0
        earlier = claims[j, 0] < claims[m, 0] or (claims[j, 0] == claims[m, 0] and j < m)
        # who is in the passage goes on before anybody who is still outside
        if claims[j, 5] != claims[m, 5]:
            earlier = claims[j, 5] > 0.0
        if opposite and near and earlier and not passed:
            return j
    return -1


@kernel(error_model="numpy")
def wanted_velocity(sdf, origin, cell, x, z, path, cumulative, along, speed, decel):
    """Return the velocity (x, z) [m/s] towards a point ahead on a path, slower before its end."""
    # with less room to a nearer point, as a straight line to a far one could cut a corner
    room = sample_sdf(sdf, origin, cell, x, z) - WALL_M
    ahead = min(0.3 + max(room, 0.0), 0.9)
    tx, tz = point_along(path, cumulative, min(along + ahead, cumulative[-1]))
    distance = math.hypot(tx - x, tz - z)
    if distance < 1e-6:
        return 0.0, 0.0
    left = max(cumulative[-1] - along, distance)
    speed = min(speed, math.sqrt(2.0 * decel * left))
    return (tx - x) / distance * speed, (tz - z) / distance * speed


@kernel(error_model="numpy")
def yield_velocity(sdf, origin, cell, x, z, path, cumulative, along, theirs, their_lengths, their_along, inside, rules):
    """Return the velocity (x, z) [m/s] of a person who gives way: off the other's path, or back out of the passage."""
    if inside:
        tx, tz = point_along(path, cumulative, max(along - BACK_M, 0.0))
        distance = math.hypot(tx - x, tz - z)
        return (0.0, 0.0) if distance < 0.1 else ((tx - x) / distance * rules[21], (tz - z) / distance * rules[21])
    nearest, ax, az = rules[7], 0.0, 0.0
    for k in range(30):
        px, pz = point_along(theirs, their_lengths, min(their_along + k * AHEAD_M, their_lengths[-1]))
        distance = math.hypot(x - px, z - pz)
        if distance < nearest:
            nearest, ax, az = distance, x - px, z - pz
    # far enough from the other's path already
    if nearest >= rules[7]:
        return 0.0, 0.0
    gx, gz = sdf_gradient(sdf, origin, cell, x, z)
    if nearest < 1e-3:
        ax, az = gx, gz
    if sample_sdf(sdf, origin, cell, x, z) < 0.4:  # not into the wall, but along it
        ax, az = ax + 0.5 * gx, az + 0.5 * gz
    length = max(math.hypot(ax, az), 1e-9)
    return ax / length * rules[20], az / length * rules[20]


@kernel(error_model="numpy")
def choose_velocity(
    sdf,
    origin,
    cell,
    m,
    places,
    velocities,
    radii,
    body,
    stays,
    firsts,
    company,
    wx,
    wz,
    most,
    furniture,
    traits,
    forces,
    rules,
):
    """Return the velocity (x, z) [m/s] that person ``m`` chooses, given the wanted velocity ``(wx, wz)``.

    Args:
        sdf: Signed distances of the floor's grid [m].
        origin: Position of the grid.
        cell: Size of its cells [m].
        m: Number of the person within the crowd.
        places: Positions of all agents' discs (x, z) [N, 2] [m]; the first are those of the crowd's people.
        velocities: Velocities of the discs [N, 2] [m/s].
        radii: Radii of the discs [N] [m].
        body: Motion of the crowd's people (`follow`) [M, 4].
        stays: Stays of the people, as in `step_crowd` [M, 3]; people who are seated do not make way.
        firsts: Number of the person to whom each person gives way (`first_through`) [M]; -1: nobody.
        company: Number of the group with which each person walks [M]; -1: none.
        wx: Wanted velocity along x [m/s].
        wz: Wanted velocity along z [m/s].
        most: Greatest speed [m/s].
        furniture: Number of discs behind those of the crowd that the person takes for furniture or walks up to: those of
            robots, or none.
        traits: `Traits` of the crowd's people [M, 6].
        forces: True for social force, False for reciprocal avoidance.
        rules: `CrowdSpec.numbers`.
    """
    x, z, tau, side = places[m, 0], places[m, 1], traits[m, 1], traits[m, 4]
    vx, vz = velocities[m, 0], velocities[m, 1]
    near = np.empty(len(places), np.intp)
    count, wanted = 0, math.hypot(wx, wz)
    keeps_side = False
    for j in range(len(places)):
        if j == m:
            continue
        px, pz = places[j, 0] - x, places[j, 1] - z
        distance = math.hypot(px, pz)
        # people behind walls do not count, or those in the next room would be avoided
        if distance > rules[3] or not sees(sdf, origin, cell, x, z, places[j, 0], places[j, 1]):
            continue
        near[count] = j
        count += 1
        # somebody ahead who stands or comes towards the person is passed on the person's side
        ahead = wx * px + wz * pz > 0.8 * wanted * distance
        if (
            wanted > 0.1
            and not len(body) <= j < len(body) + furniture
            and distance < rules[8]
            and ahead
            and velocities[j, 0] * wx + velocities[j, 1] * wz < 0.1 * wanted
        ):
            keeps_side = True
    if keeps_side:  # to the right is (-z, x) of a direction (x, z), with y up
        angle = side * rules[9]
        wx, wz = wx * math.cos(angle) - wz * math.sin(angle), wz * math.cos(angle) + wx * math.sin(angle)
    clear = sample_sdf(sdf, origin, cell, x, z)
    gx, gz = sdf_gradient(sdf, origin, cell, x, z)
    steep = max(math.hypot(gx, gz), 1e-9)
    gx, gz = gx / steep, gz / steep
    horizon, most, easy = rules[0], max(most, 1e-3), rules[18] > 5.0
    if forces:
        ax, az = rules[10] * (wx - vx) / tau, rules[10] * (wz - vz) / tau
        for k in range(count):
            j = near[k]
            if len(body) <= j < len(body) + furniture:
                px, pz = x - places[j, 0], z - places[j, 1]
                distance = max(math.hypot(px, pz), 1e-6)
                push = rules[12] * math.exp(-max(distance - radii[m] - radii[j], 0.0) / rules[13])
                ax, az = ax + push * px / distance, az + push * pz / distance
                continue
            fx, fz = interaction(
                places[j, 0] - x,
                places[j, 1] - z,
                vx - velocities[j, 0],
                vz - velocities[j, 1],
                rules[14],
                rules[15],
                rules[16],
                rules[17],
            )
            gain = rules[24 if j < len(body) and company[m] >= 0 and company[j] == company[m] else 11]
            ax, az = ax + gain * fx, az + gain * fz
        push = rules[12] * math.exp(-max(clear - WALL_M, 0.0) / rules[13])
        # paths lead past walls: before a passage, what these push against the wanted direction would hold people back
        back = min(gx * wx + gz * wz, 0.0) / max(wx * wx + wz * wz, 1e-9) if rules[25] > 0.0 else 0.0
        ax, az = ax + push * (gx - back * wx), az + push * (gz - back * wz)
        span = traits[m, 2]
        # forces become a velocity over the time until the next decision
        wx, wz = vx + ax * span, vz + az * span
        # forces alone let people touch, so half-planes guard the next moments
        horizon = rules[2]
    planes = np.empty((count + 2, 3))
    planes[0, 0], planes[0, 1] = gx, gz
    # the speed towards the nearest wall is at most that which reaches it at the end of the horizon
    planes[0, 2] = -(clear - WALL_M) / rules[1]
    # the foot ahead comes no nearer to what it would step into
    ahead = FOOT_M + FOOT_S * body[m, 2]
    fx, fz = x + ahead * math.cos(body[m, 0]), z - ahead * math.sin(body[m, 0])
    gx, gz = sdf_gradient(sdf, origin, cell, fx, fz)
    steep = max(math.hypot(gx, gz), 1e-9)
    planes[1, 0], planes[1, 1] = gx / steep, gz / steep
    planes[1, 2] = min(FOOT_ROOM_M - sample_sdf(sdf, origin, cell, fx, fz), 0.0) / rules[1]
    for k in range(count):
        j = near[k]
        px, pz = places[j, 0] - x, places[j, 1] - z
        # people of the crowd do their half; robots and people of other policies are not relied on
        share = 0.5 if j < len(body) and stays[j, 2] != SEATED else 1.0
        reach, ahead_s, jx, jz = reach_between(m, j, px, pz, radii, body), horizon, velocities[j, 0], velocities[j, 1]
        if len(body) <= j < len(body) + furniture:
            ahead_s, jx, jz = rules[1], 0.0, 0.0
        else:
            own = j < len(body) and company[m] >= 0 and company[j] == company[m]
            reach += rules[23] if own else rules[4]
            ahead_s = COMPANY_S if own and rules[25] > 0.0 else ahead_s
            # who gives way is on the way out of the path
            if j < len(body) and firsts[j] == m and not forces:
                ahead_s = rules[19]
                share = rules[22]
            elif j < len(body) and firsts[m] == j and not forces:
                share = 1.0 - rules[22]
        # discs that overlap come apart within half a second; offsets of changes become those of velocities
        nx, nz, offset = half_plane(px, pz, vx - jx, vz - jz, reach, ahead_s, 0.5, share)
        # only changes that are needed are shared, and not what others leave free
        offset = offset / share if easy and offset < 0.0 else offset
        planes[k + 2, 0], planes[k + 2, 1], planes[k + 2, 2] = nx, nz, offset + nx * vx + nz * vz
    return nearest_velocity(planes, count + 2, wx, wz, most)


@kernel(error_model="numpy")
def follow(sdf, origin, cell, m, places, radii, body, chosen, looks, limits, dt, guards):
    """Move the body of person ``m`` as far as it can follow the chosen velocity, in place.

    Args:
        sdf: Signed distances of the floor's grid [m].
        origin: Position of the grid.
        cell: Size of its cells [m].
        m: Number of the person within the crowd.
        places: Positions of all discs [N, 2] [m]; for people who have already moved in this step, the new ones.
        radii: Radii of the discs [N] [m].
        body: Heading [rad], turn rate [rad/s], speed [m/s] and direction of walking [rad] of each person [M, 4].
        chosen: Chosen velocities [M, 2] [m/s].
        looks: Place that each person faces while they stand or step (x, z), and 1 if there is one [M, 3].
        limits: `StrideSpec.limits`.
        dt: Duration of a step [s].
        guards: True if people who step do not turn where this brings their feet to another person.
    """
    accel, decel, turn_rate, turn_accel, gain, _, sidestep, sidestep_rate, _ = limits
    x, z = places[m, 0], places[m, 1]
    heading, turn, v, direction = body[m, 0], body[m, 1], body[m, 2], body[m, 3]
    most = math.hypot(chosen[m, 0], chosen[m, 1])
    bearing, wanted = 0.0, 0.0
    if most > 0.05:
        bearing = wrap_angle(math.atan2(-chosen[m, 1], chosen[m, 0]) - heading)
        wanted = min(max(gain * bearing, -turn_rate), turn_rate)
    else:
        most = 0.0
    if looks[m, 2] > 0.0 and most <= CREEP_MPS:
        wanted = gain * wrap_angle(math.atan2(z - looks[m, 1], looks[m, 0] - x) - heading)
        wanted = min(max(wanted, -turn_rate), turn_rate)
    turn += min(max(wanted - turn, -turn_accel * dt), turn_accel * dt)
    if abs(bearing) > sidestep:  # until they have turned they step aside, slowly
        most = (
            min(most, CREEP_MPS + (most - CREEP_MPS) * max(math.cos(bearing), 0.0) ** 2) if most > CREEP_MPS else most
        )
    v += min(max(most - v, -2.0 * decel * dt), accel * dt)
    aim = bearing
    if v > CREEP_MPS:
        aim = min(max(bearing, -sidestep), sidestep)
        off = wrap_angle(direction - heading)
        aim = off + min(max(wrap_angle(aim - off), -2.0 * sidestep_rate * dt), 2.0 * sidestep_rate * dt)
    if most > 0.0 or v > CREEP_MPS:
        direction = heading + aim
    heading = wrap_angle(heading + turn * dt)
    nx, nz = x + math.cos(direction) * v * dt, z - math.sin(direction) * v * dt
    if v > 0.0 and sample_sdf(sdf, origin, cell, nx, nz) < WALL_M:
        sx, sz, moved, clearance = slide_along_walls(sdf, origin, cell, WALL_M, x, z, nx, nz, v * dt)
        if clearance >= min(WALL_M, sample_sdf(sdf, origin, cell, x, z)) - 1e-3:
            nx, nz, v = sx, sz, min(v, max(moved / dt, v - decel * dt))
        else:
            nx, nz, v = x, z, 0.0
    # before the distances to others, which depend on where the person looks (`reach_between`)
    was, body[m, 0], body[m, 1] = body[m, 0], heading, turn
    for j in range(len(places) if guards and v > 0.0 else 0):
        px, pz = places[j, 0] - x, places[j, 1] - z
        reach, body[m, 0] = reach_between(m, j, px, pz, radii, body), was
        if j != m and reach > max(math.hypot(px, pz), reach_between(m, j, px, pz, radii, body)):
            heading, body[m, 1] = was, 0.0
        body[m, 0] = heading
    sx, sz = nx - x, nz - z
    for attempt in range(SLIDES):
        free = True
        for j in range(len(places)):
            if j == m:
                continue
            px, pz = places[j, 0] - x, places[j, 1] - z
            reach, before = reach_between(m, j, px, pz, radii, body), math.hypot(px, pz)
            if math.hypot(px - sx, pz - sz) < reach and sx * px + sz * pz > 0.0:
                free = False
                # without the part of the step that leads towards the other, it passes beside them
                towards = (sx * px + sz * pz) / (before * before)
                sx, sz = sx - towards * px, sz - towards * pz
        if free:
            break
        if attempt == SLIDES - 1 or sample_sdf(sdf, origin, cell, x + sx, z + sz) < min(
            WALL_M, sample_sdf(sdf, origin, cell, x, z)
        ):
            sx, sz = 0.0, 0.0
            break
    if sx != nx - x or sz != nz - z:
        nx, nz, v = x + sx, z + sz, max(math.hypot(sx, sz) / dt, v - 2.0 * decel * dt) if v > 0.0 else 0.0
    places[m, 0], places[m, 1] = nx, nz
    body[m, 2], body[m, 3] = v, direction


@kernel(error_model="numpy")
def step_crowd(
    sdf,
    origin,
    cell,
    places,
    now,
    before,
    heading,
    radii,
    paths,
    counts,
    lengths,
    along,
    best,
    until,
    claims,
    body,
    chosen,
    stays,
    company,
    moods,
    looks,
    robots,
    of_robots,
    pace,
    traits,
    forces,
    rules,
    limits,
    step,
    dt,
    arrived_m,
    asks,
    moves,
):
    """Move all people of a crowd by one step, in place, unless somebody has to decide first.

    Args:
        sdf: Signed distances of the floor's grid [m].
        origin: Position of the grid.
        cell: Size of its cells [m].
        places: Positions of all discs, first those of the crowd [N, 2] [m], which change.
        now: Their positions at the beginning of the step [N, 2] [m].
        before: Their positions one step earlier [N, 2] [m].
        heading: Headings of the people at the beginning of the step [M] [rad].
        radii: Radii of all discs [N] [m]; those of the people are overwritten by their traits.
        paths: Paths of the people [M, K, 2] [m].
        counts: Number of points of each path [M].
        lengths: Distance along each path up to each point [M, K] [m].
        along: Progress of each person along their path [M] [m].
        best: Largest progress so far, and the step in which it was made [M, 2].
        until: Step until which each person stays where they are [M]; -1: they walk.
        claims: Narrow places that people are in or before (`claim_passages`) [M, 6].
        body: Motion of the bodies (`follow`) [M, 4].
        chosen: Chosen velocities [M, 2] [m/s].
        stays: Place (x, z) to face while standing, and 0: walks, -1: backs out, 1: stands as they come, 2: stands and
            faces it, `SEATED`: is where ``places`` say [M, 3].
        company: Number of the group with which each person walks, -1: none [M].
        moods: Number of each person's reaction, the step in which it began, and 1 while they react (`notice`) [M, 3].
        looks: Place that each person faces (x, z), and 1 if there is one [M, 3].
        robots: Places and headings of the robots (x, z, heading) [R, 3].
        of_robots: Number of discs of robots, which come first after those of the crowd.
        pace: Speed at which each person wants to walk, that of their group [M] [m/s].
        traits: `Traits` of the people [M, 6].
        forces: True for social force, False for reciprocal avoidance.
        rules: `CrowdSpec.numbers`.
        limits: `StrideSpec.limits`.
        step: Number of the step.
        dt: Duration of a step [s].
        arrived_m: Distance to the end of a path from which on people have arrived [m].
        asks: True if the step begins, so that people may have to decide; False: they have decided.
        moves: True if people move as soon as nobody has to decide.

    Returns:
        Whether somebody has to decide, and whether people have moved.
    """
    if asks:
        body[:, 0], radii[: len(heading)] = heading, traits[:, 3]
    decides = asks and who_decides(now, paths, counts, best, traits, until, step, dt, arrived_m)
    if decides or not moves:
        return decides, False
    velocities = (now - before) / dt
    decel, unblocked, to_come = limits[1], rules[18] > 3.0, rules[18] > 5.0
    for m in range(len(counts)):
        path, cumulative = paths[m, : counts[m]], lengths[m, : counts[m]]
        along[m] = progress_along(path, cumulative, along[m], places[m, 0], places[m, 1])
        if along[m] > best[m, 0] + PROGRESS_M:
            best[m, 0], best[m, 1] = along[m], step
    claim_passages(sdf, origin, cell, places[: len(counts)], paths, counts, lengths, along, claims, step, rules)
    for m in range(len(counts)):
        claims[m, 0] = claims[m, 0] if stays[m, 2] >= 0.0 else 0.0
        if stays[m, 2] > 0.0 or (moods[m, 2] > 0.0 and TABLE[int(moods[m, 0]), 8] == 0.0):
            claims[m, 0] = 0.0  # who stands does not go through
            best[m, 1] = step
    firsts = np.empty(len(counts), np.intp)
    for m in range(len(counts)):
        firsts[m] = first_through(claims, company, m, rules[6], to_come)
    for m in range(len(counts)):
        # each decides at steps of their own, so that not all decide in the same one
        pause = max(int(traits[m, 2] / dt + 0.5), 1)
        if (step + m) % pause != 0 or stays[m, 2] == SEATED:
            continue
        path, cumulative = paths[m, : counts[m]], lengths[m, : counts[m]]
        x, z, most = places[m, 0], places[m, 1], traits[m, 0]
        j = firsts[m]
        # with nothing of the path behind them they cannot go back
        if j >= 0 and not (unblocked and claims[m, 5] > 0.0 and along[m] < START_M):
            wx, wz = yield_velocity(
                sdf,
                origin,
                cell,
                x,
                z,
                path,
                cumulative,
                along[m],
                paths[j, : counts[j]],
                lengths[j, : counts[j]],
                along[j],
                claims[m, 5] > 0.0,
                rules,
            )
        else:
            wx, wz = wanted_velocity(sdf, origin, cell, x, z, path, cumulative, along[m], pace[m], decel)
            if stays[m, 2] > 0.0 and math.hypot(path[-1, 0] - x, path[-1, 1] - z) < NEAR_END_M:
                wx, wz = 0.0, 0.0
            elif company[m] >= 0:
                wx, wz = walk_beside(sdf, origin, cell, x, z, path, cumulative, along[m], wx, wz)
                wx, wz = keep_company(
                    sdf, origin, cell, m, company, places, wx, wz, GROUP_S, rules[18] > 1.0, unblocked
                )
        looks[m, 0], looks[m, 1], looks[m, 2] = stays[m, 0], stays[m, 1], stays[m, 2] - 1.0
        # who cannot walk turns to where they want to go, as the reach of their feet may be all that blocks them
        if rules[25] > 0.0 and stays[m, 2] <= 0.0 and math.hypot(wx, wz) > 0.1:
            looks[m, 0], looks[m, 1], looks[m, 2] = x + wx, z + wz, 1.0
        reaction, nearest, r = TABLE[int(moods[m, 0])], np.inf, -1
        if reaction[0] > 0.0:
            for k in range(len(robots)):
                distance = math.hypot(robots[k, 0] - x, robots[k, 1] - z)
                if distance < nearest:
                    nearest, r = distance, k
        if r >= 0 and notice(
            reaction,
            moods[m, 1:],
            x,
            z,
            body[m, 0],
            robots[r],
            nearest <= reaction[0] and sees(sdf, origin, cell, x, z, robots[r, 0], robots[r, 1]),
            step,
            dt,
        ):
            radius = radii[len(counts)] if of_robots > 0 else 0.0
            wx, wz = reacting_velocity(reaction, x, z, robots[r], radius, wx, wz, traits[m, 1])
            most = max(reaction[3], 0.0 if reaction[8] > 0.0 else most)
            if reaction[8] == 0.0:
                looks[m, 0], looks[m, 1], looks[m, 2] = robots[r, 0], robots[r, 1], 1.0
        walks_up = moods[m, 2] > 0.0 and reaction[5] > 0.0
        furniture = of_robots if walks_up or int(moods[m, 0]) == IMPASSIVE else 0
        chosen[m, 0], chosen[m, 1] = choose_velocity(
            sdf,
            origin,
            cell,
            m,
            places,
            velocities,
            radii,
            body,
            stays,
            firsts,
            company,
            wx,
            wz,
            most,
            furniture,
            traits,
            forces,
            rules,
        )
    # after all have chosen: nobody chooses by where others have moved in this step
    for m in range(len(counts)):
        if stays[m, 2] == SEATED:
            continue
        follow(sdf, origin, cell, m, places, radii, body, chosen, looks, limits, dt, rules[25] > 0.0)
    return False, True
