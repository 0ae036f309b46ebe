"""People under commands beside others: they slide along them, and get no nearer than their discs."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.motion.spec import HOME_BASE
from sim_kinematic.motion.step import discs_at, keep_apart
from sim_kinematic.world import DriveCommand, World

OPEN = np.full((200, 200), 5.0)
PLACE = st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))


@given(start=PLACE, step=st.tuples(st.floats(-0.12, 0.12), st.floats(-0.12, 0.12)), others=st.lists(PLACE, max_size=3))
def test_nobody_gets_nearer_than_the_discs_or_than_they_are(start, step, others):
    discs = np.array([[*place, 0.25] for place in others]).reshape(-1, 3)
    target = np.add(start, step)
    x, z, touched = keep_apart(OPEN, np.full(2, -5.0), 0.05, *start, *target, discs, 0.25, 0.25)
    before = np.hypot(*(discs[:, :2] - start).T)
    after = np.hypot(*(discs[:, :2] - (x, z)).T)
    assert (after >= np.minimum(before, 0.5) - 1e-5).all()
    assert np.hypot(x - start[0], z - start[1]) <= np.hypot(*step) + 1e-5
    assert touched or (x, z) == tuple(target)


def test_who_walks_past_slides_and_a_wall_behind_holds():
    disc = np.array([[0.5, 0.0, 0.25]])
    x, z, touched = keep_apart(OPEN, np.full(2, -5.0), 0.05, 0.02, 0.2, 0.1, 0.2, disc, 0.25, 0.25)
    assert touched
    assert np.isclose(np.hypot(x - 0.5, z), 0.5)
    assert z > 0.2
    assert x > 0.02
    walled = np.tile(np.linspace(5.0, -5.0, 200), (200, 1))  # the wall is at z = 0
    assert keep_apart(
        walled, np.full(2, -5.0), 0.05, 0.0, -0.25, 0.1, -0.25, np.array([[0.45, -0.3, 0.25]]), 0.25, 0.249
    )[:2] == (0.0, -0.25)


def test_worlds_may_be_solid():
    """A person walks at a robot that stands: through it where nothing is said, up to its discs where others are solid;
    one world as many."""
    free = FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)))
    roster = make_roster(["robot", "human"])
    i, j = np.unravel_index(np.argmax(free.sdf), free.sdf.shape)
    place = np.asarray(free.origin) + (np.array([i, j]) + 0.5) * free.cell_m
    starts = np.array([[*place, 0.0], [place[0] - 1.2, place[1] + 0.05, 0.0]])
    nearest = {}
    for solid, count in ((False, 1), (True, 1), (True, 3)):
        world = World(roster, worlds=count, base=HOME_BASE, solid=solid)
        world.place(np.tile(starts, (count, 1, 1)), [free] * count)
        gaps = []
        for _ in range(40):
            world.step([DriveCommand(np.zeros((count, 2))), DriveCommand(np.tile([0.6, 0.0], (count, 1)))])
            robot, person = world.state.agents
            discs = discs_at(robot.xz, robot.heading, world.bases[0].disc_offsets_m, world.bases[0].disc_radius_m)
            gaps.append(np.hypot(*np.moveaxis(discs[:, :, :2] - person.xz[:, None], -1, 0)).min())
        nearest[solid, count] = min(gaps)
    assert nearest[False, 1] < 0.3
    assert 0.5 - 1e-5 <= nearest[True, 1] < 0.51
    assert nearest[True, 3] == nearest[True, 1]
