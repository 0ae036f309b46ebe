"""Maneuvers of a base in narrow places, back and forth and around, for places where no single command makes progress.

A long robot gets stuck where the shortest path of a disc turns sharply: it would have to back up first. A search over
poses (hybrid A*; Dolgov et al., 2008) over the robot's own commands finds the commands. It runs only when a base is
stuck, because it takes milliseconds where the usual command takes microseconds.
"""

from __future__ import annotations

import heapq
import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import wrap_angle
from h3data.kernels import kernel
from h3data.scene import FreeSpace
from sim_kinematic.avoidance.robot_base import hull_of
from sim_kinematic.avoidance.routes import FloorRoutes
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.velocity import least_gap
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.motion.step import are_clear, drive_base, least_clearance

HEADINGS = 30
"""Number of cells into which a full turn of headings is divided."""
GAIN_M = 1.5
"""Reduction of the remaining path at which a maneuver ends [m]."""
MOVE_M, SLIDES_M, AGENT_GAP_M = 0.1, 0.02, 0.05
"""Length of a move, which is also the side of a cell in which two poses count as one; length below which a first move
along a wall does not count; and least gap to other agents [m]."""
TURN_COST_M, BACKWARDS_COST, GREED = 0.06, 1.5, 1.5
"""Cost of a turn by one cell [m]; cost of a metre backwards [m]; and weight of the remaining path, where a larger
weight finds longer maneuvers sooner."""


@kernel(error_model="numpy")
def _some_end_is_near(
    sdf, origin, cell, x, z, margin, offsets, radius, hull, discs, left, grid_origin, grid_cell, enough, bearing, facing
):
    """Return whether a search from (x, z) may find an end, by upper bounds of the room in each cell of the grid.

    Where somebody stands at the goal or in the only passage to it, it would look at all poses that the base reaches before it
    gives up. All cells up to ``margin`` from the one of (x, z) count as reached; from there on it goes from cell to cell,
    with any heading that a cell may have room for. At the end the heading is ``bearing`` to within ``facing`` [rad].
    """
    # no place in a cell is farther from its middle, with 1e-6 m for rounding
    (nx, nz), place_m, middle = left.shape, math.sqrt(0.5) * grid_cell + 1e-6, np.zeros(1)
    i, j = int((x - grid_origin[0]) / grid_cell), int((z - grid_origin[1]) / grid_cell)
    # one more than there are cells, as that of (x, z) may come twice
    seen, queue, n, count = np.zeros((nx, nz), np.bool_), np.full(nx * nz + 1, i * nz + j), 0, 1
    while n < count:
        a, b, n = queue[n] // nz, queue[n] % nz, n + 1
        mx, mz = grid_origin[0] + (a + 0.5) * grid_cell, grid_origin[1] + (b + 0.5) * grid_cell
        ends, aims = left[a, b] <= enough, left[a, b] <= enough and facing < math.inf
        # with any heading the disc nearest to the middle counts as there; a heading turns no disc farther
        base, base_m = (offsets, np.abs(offsets).max() * facing) if aims else (middle, np.abs(offsets).min())
        body, hull_m = (hull, np.abs(hull).max() * facing) if aims else (middle, np.abs(hull).min())
        # between samples the signed distance changes by up to the square root of 2 per metre
        room = least_clearance(sdf, origin, cell, mx, mz, bearing, base) - radius + math.sqrt(2.0) * (place_m + base_m)
        for disc in discs:
            room = min(room, least_gap(mx, mz, bearing, disc[0], disc[1], body, disc[2]) + place_m + hull_m)
        reached = room >= 0.0 or (not aims and max(abs(a - i), abs(b - j)) <= margin)
        if ends and reached:
            return True
        # another heading may lead on from where the base cannot have the one of the end
        for c in range(max(a - 1, 0), min(a + 2, nx) if reached or aims else 0):
            for d in range(max(b - 1, 0), min(b + 2, nz)):
                if not seen[c, d]:
                    seen[c, d], queue[count] = True, c * nz + d
                    count += 1
    return False


@kernel(error_model="numpy")
def _search(
    sdf,
    origin,
    cell,
    x,
    z,
    heading,
    offsets,
    radius,
    hull,
    discs,
    left,
    grid_origin,
    grid_cell,
    moves,
    steps,
    dt,
    enough,
    bearing,
    facing,
    slides,
    slide,
    poses,
    parents,
    moved,
):
    """Search for a maneuver; return the number of its last node, or -1 if there is none.

    Fills ``poses`` [N, 3], ``parents`` [N] and ``moved`` [N] (the move that leads to a node). ``bearing`` is the wanted
    heading at the end, to within ``facing`` [rad]. If ``slides``, the first move slides along obstacles as in
    `drive_base`, with ``slide`` as radius, iterations, tolerances and longest step; the same search without sliding
    must have failed before.
    """
    nx, nz = left.shape
    sector, way = 2.0 * math.pi / HEADINGS, np.empty((steps + 1, 2))
    # cells that the first move may reach: a slide turns about any disc, and needs room to within a tolerance
    margin = 1 + (math.ceil((MOVE_M + 2.0 * slide[0] * sector + steps * slide[2]) / grid_cell) if slides else 0)
    if not _some_end_is_near(
        sdf,
        origin,
        cell,
        x,
        z,
        margin,
        offsets,
        radius,
        hull,
        discs,
        left,
        grid_origin,
        grid_cell,
        enough,
        bearing,
        facing,
    ):
        return -1
    seen = np.zeros((nx, nz, HEADINGS), np.bool_)
    # moves that turn alike pass the same headings, whose cosines and sines are computed once
    alike, axes = np.arange(len(moves)), np.empty((len(moves), steps + 1, 3))
    for m in range(1, len(moves)):
        for other in range(m - 1, -1, -1):
            alike[m] = other if moves[other, 1] == moves[m, 1] else alike[m]
    poses[0, 0], poses[0, 1], poses[0, 2] = x, z, heading
    parents[0], moved[0], count, slid = -1, -1, 1, False
    heap = [(0.0, 0.0, 0)]
    while len(heap) > 0:
        _, cost, node = heapq.heappop(heap)
        px, pz, ph = poses[node, 0], poses[node, 1], poses[node, 2]
        i, j = int((px - grid_origin[0]) / grid_cell), int((pz - grid_origin[1]) / grid_cell)
        k = int(math.floor(ph / sector + 0.5)) % HEADINGS
        # the heap may hold a pose of this cell several times; the first one that comes out was the cheapest
        if seen[i, j, k]:
            continue
        seen[i, j, k] = True
        turned = ph - bearing
        off = abs(turned - 2.0 * math.pi * math.floor(turned / (2.0 * math.pi) + 0.5))
        if left[i, j] <= enough and off <= facing and node > 0:
            return node
        for m in range(len(moves)):
            if alike[m] == m:
                nh = ph
                for s in range(steps + 1):
                    axes[m, s, 0], axes[m, s, 1], axes[m, s, 2] = math.cos(nh), math.sin(nh), nh
                    nh += moves[m, 1] * dt
            # bounded: the world stands still while it searches, and a robot that finds nothing may wait or
            # take a detour
            if count >= len(parents):
                return -1
            nx_, nz_, nh, turn = px, pz, ph, alike[m]
            for s in range(1, steps + 1):  # as `integrate`
                nx_ += axes[turn, s - 1, 0] * moves[m, 0] * dt
                nz_ -= axes[turn, s - 1, 1] * moves[m, 0] * dt
                way[s, 0], way[s, 1], nh = nx_, nz_, axes[turn, s, 2]
            # only the first move slides: it frees a base that is wedged in, and costs more than a test of a
            # pose
            if slides and node == 0:
                nx_, nz_, nh = px, pz, ph
                for s in range(1, steps + 1):
                    nx_, nz_, nh, _ = drive_base(
                        sdf, origin, cell, nx_, nz_, nh, moves[m, 0], 0.0, moves[m, 1], dt, offsets, *slide
                    )
                    slid |= nx_ != way[s, 0] or nz_ != way[s, 1] or nh != axes[turn, s, 2]
            gone = math.hypot(nx_ - px, nz_ - pz) + abs(nh - ph) * grid_cell
            # else a base pressed against a wall would creep along it by millimetres, through thousands of
            # nodes
            # a turn counts as at a distance of a cell from the middle
            if gone < SLIDES_M:
                continue
            a, b = int((nx_ - grid_origin[0]) / grid_cell), int((nz_ - grid_origin[1]) / grid_cell)
            c = int(math.floor(nh / sector + 0.5)) % HEADINGS
            if a < 0 or b < 0 or a >= nx or b >= nz or seen[a, b, c] or not math.isfinite(left[a, b]):
                continue
            # only now, where it leads to anything new: to ask the floor is what costs
            free = True
            for s in range(1, 1 if slides and node == 0 else steps + 1):
                if not are_clear(
                    sdf, origin, cell, way[s, 0], way[s, 1], axes[turn, s, 0], axes[turn, s, 1], offsets, radius
                ):
                    free = False
                    break
            if not free:
                continue
            for d in range(len(discs)):
                if least_gap(nx_, nz_, nh, discs[d, 0], discs[d, 1], hull, discs[d, 2]) < 0.0:
                    free = False
            if not free:
                continue
            gone = moves[m, 0] * steps * dt
            cost_here = (
                cost + (gone if gone > 0 else -BACKWARDS_COST * gone) + (TURN_COST_M if moves[m, 1] != 0.0 else 0.0)
            )
            poses[count, 0], poses[count, 1], poses[count, 2] = nx_, nz_, nh
            parents[count], moved[count] = node, m
            turned = nh - bearing
            off = abs(turned - 2.0 * math.pi * math.floor(turned / (2.0 * math.pi) + 0.5))
            rest = max(left[a, b] - enough, 0.0) + max(off - facing, 0.0) / sector * TURN_COST_M
            heapq.heappush(heap, (cost_here + GREED * rest, cost_here, count))
            count += 1
        # a search that begins like the one without sliding, which has failed, would fail as well
        if slides and not slid:
            return -1
    return -1


def plan_maneuver(
    free: FreeSpace,
    base: BaseSpec,
    xz: NDArray,
    heading: float,
    goal: NDArray,
    discs: NDArray,
    *,
    within_m: float = 0.05,
    bearing: float | None = None,
) -> NDArray[np.float64]:
    """Return commands [N, 2] (forward, turn: -1..1 of the limits), one per step, that bring a base nearer to ``goal`` [2].

    The commands lead past the next `GAIN_M` of the path, or to within ``within_m`` of the goal and there to the heading
    ``bearing`` [rad]. The result is empty if no maneuver does so.

    Args:
        free: The floor.
        base: Discs and limits of the base.
        xz: Floor point of the base [2] [m].
        heading: Heading of the base [rad].
        goal: Floor point [2].
        discs: Discs ``(x, z, radius)`` [M, 3] of other agents, which the robot's hull keeps clear of.
        within_m: Distance at which the base is at the goal [m].
        bearing: Desired heading at the goal [rad].
    """
    grid = FloorRoutes.of(free)
    left = _left_to(grid, *goal.tolist())
    i, j = np.clip(((xz - grid.origin) / AVOIDANCE.cell_m).astype(int), 0, np.array(left.shape) - 1).tolist()
    here = float(left[i, j])
    no_commands = np.zeros((0, 2))
    if not math.isfinite(here):
        return no_commands
    ends = here - GAIN_M <= within_m
    moves, steps = _moves(base)
    hull, offsets = np.array(hull_of(base)), np.array(base.disc_offsets_m)
    wide = np.array(discs, np.float64).reshape(-1, 3)
    # an agent that is nearer already must not rule out every command: the robot may move away from it
    for disc in wide:
        now = least_gap(xz[0], xz[1], heading, disc[0], disc[1], hull, 0.0)
        disc[2] = min(disc[2] + base.disc_radius_m + AGENT_GAP_M, now - 1e-3)
    # a search gives up when it has looked at as many poses
    poses = np.empty((30_000, 3))
    parents, moved = np.empty(len(poses), np.int64), np.empty(len(poses), np.int64)
    slide = base.disc_radius_m, base.slide_iterations, base.clearance_tolerance_m, base.contact_tolerance_m
    node = -1
    for slides in (False, True):  # a base wedged between two walls cannot move without sliding
        if node < 0:
            node = _search(
                free.sdf,
                free.origin,
                free.cell_m,
                float(xz[0]),
                float(xz[1]),
                float(heading),
                offsets,
                base.disc_radius_m - base.clearance_tolerance_m,
                hull,
                wide,
                left,
                grid.origin,
                AVOIDANCE.cell_m,
                moves,
                steps,
                STEP_S,
                max(here - GAIN_M, within_m),
                0.0 if bearing is None else bearing,
                math.pi / HEADINGS if ends and bearing is not None else math.inf,
                slides,
                (*slide, base.farthest_m(STEP_S)),
                poses,
                parents,
                moved,
            )
    chosen: list[int] = []
    while node > 0:
        chosen.append(int(moved[node]))
        node = int(parents[node])
    limits = np.array([base.max_speed_mps, base.max_turn_rad_s])
    return np.repeat(moves[chosen[::-1]] / limits, steps, axis=0) if chosen else no_commands


def _moves(base: BaseSpec) -> tuple[NDArray[np.float64], int]:
    """Return the velocities (m/s, rad/s) of the moves [M, 2], and the steps that each of them takes."""
    turn = 2 * math.pi / HEADINGS
    # a move takes whole steps, and changes its cell: a shorter one would be thrown away as seen before
    steps = math.ceil(max(MOVE_M / (base.max_speed_mps * STEP_S), turn / (base.max_turn_rad_s * STEP_S), 3.0))
    ahead, aside = MOVE_M / (steps * STEP_S), turn / (steps * STEP_S)
    moves = [(ahead, 0.0), (ahead, aside), (ahead, -aside), (0.0, aside), (0.0, -aside)]
    if base.allow_back:
        moves += [(-ahead, 0.0), (-ahead, aside), (-ahead, -aside)]
    return np.array(moves), steps


# a robot that is stuck asks for one goal several times
@lru_cache(maxsize=16)
def _left_to(grid: FloorRoutes, x: float, z: float) -> NDArray[np.float64]:
    """Return the lengths [nx, nz] [m] of the paths from all cells to a floor point, not to be written to.

    Cells without a path have that of their nearest neighbour: the middle of a long base may pass over such cells, though a
    disc with the agents' radius does not fit there.
    """
    left = grid.flood(np.array([x, z]), np.zeros((0, 3))).distance
    padded = np.pad(left, 1, constant_values=np.inf)
    around = [padded[a : a + left.shape[0], b : b + left.shape[1]] for a in range(3) for b in range(3)]
    return np.where(np.isfinite(left), left, np.min(around, axis=0) + AVOIDANCE.cell_m)


def heading_to(xz: NDArray, point: NDArray, reach: float) -> float:
    """Return the heading [rad] with which a robot at a point [2] sees another point at a bearing to its left [rad]."""
    dx, dz = point - xz
    return float(wrap_angle(math.atan2(-dz, dx) - reach))
