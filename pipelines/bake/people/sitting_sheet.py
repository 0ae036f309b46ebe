"""Script for docs/pictures/sitting.jpg: three bodies sit down on three seats; all bodies on seats of their size.

python -m bake.people.sitting_sheet docs/pictures/sitting.jpg
"""

from __future__ import annotations

import sys

import numpy as np

from h3data.bodies import humanoid_names, load_humanoid
from h3data.bodies.people.sitting import Sitting, sitting_on
from h3data.mesh.mesh import Mesh
from h3data.mesh.primitives import box_mesh
from h3data.render.image_files import write_jpg
from h3data.render.sheets.people_sheet import lined_up

STAGES = ("female_0", 0.45), ("male_1", 0.57), ("older_0", 0.42)
SHARES = (0.0, 0.25, 0.5, 0.75, 0.9, 1.0)
WIDTH, SPACING_M, ROW_M, HEADING = 1300, 1.25, 2.05, -0.25
WOOD = (150, 110, 80)


def chair(sitting: Sitting, depth_m: float = 0.46) -> list[Mesh]:
    """Return a seat and its backrest behind a person, in the agent root frame."""
    edge, top = sitting.edge_m, sitting.seat_m
    return [
        box_mesh((depth_m / 2, 0.02, 0.23), center=(edge - depth_m / 2, top - 0.02, 0), color=WOOD),
        box_mesh((0.02, 0.2, 0.23), center=(edge - depth_m - 0.02, top + 0.2, 0), color=WOOD),
        *(
            box_mesh((0.02, top / 2, 0.02), center=(edge - x, top / 2, z), color=WOOD)
            for x in (0.03, depth_m - 0.03)
            for z in (-0.2, 0.2)
        ),
    ]


def main(out: str) -> None:
    """Render the picture of people who sit down."""
    rows = []
    for name, height in STAGES:
        sitting = sitting_on(load_humanoid(name), height)
        quats, pelvis = sitting.pose(SHARES)
        poses = [(sitting.body, quats[k : k + 1], pelvis[k : k + 1]) for k in range(len(SHARES))]
        props = [chair(sitting)] * len(SHARES)
        rows.append(lined_up(poses, HEADING, False, 6, WIDTH, spacing=SPACING_M, row_m=ROW_M, props=props))
    seated = [sitting_on(body := load_humanoid(name), round(0.26 * body.height_m, 2)) for name in humanoid_names()]
    for k in range(0, len(seated), 6):
        row = seated[k : k + 6]
        poses = [(sitting.body, *sitting.pose(1.0)) for sitting in row]
        props = [chair(sitting) for sitting in row]
        rows.append(lined_up(poses, -0.9, False, 6, WIDTH, spacing=SPACING_M, row_m=1.5, props=props))
    write_jpg(out, np.vstack(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
