"""Script for docs/pictures/lying.jpg: two bodies lie down on a bed and a child on a low one; all bodies lying.

python -m bake.people.lying_sheet docs/pictures/lying.jpg
"""

from __future__ import annotations

import sys

import numpy as np

from h3data.bodies import humanoid_names, load_humanoid
from h3data.bodies.people.sitting import TABLE, Sitting, sitting_on
from h3data.mesh.mesh import Mesh
from h3data.mesh.primitives import box_mesh
from h3data.render.image_files import write_jpg
from h3data.render.sheets.people_sheet import lined_up

STAGES = ("female_0", 0.48), ("male_1", 0.57), ("child_1", 0.33)
AT = (0, 10, 20, 46, 53, 60)
WIDTH, SPACING_M, ROW_M, HEADING = 1300, 2.1, 1.7, -0.5
LINEN = (176, 160, 140)


def bed(sitting: Sitting, *, along: bool) -> list[Mesh]:
    """Return a surface under a person, in the agent root frame: behind the edge, or along the body."""
    top = sitting.seat_m - 0.002
    behind, ahead, aside = sitting.lying_size
    if along:
        middle = sitting.lying[1][-1, 0] + (ahead - behind) / 2
        return [
            box_mesh(((behind + ahead) / 2 + 0.02, top / 2, aside + 0.02), center=(middle, top / 2, 0), color=LINEN)
        ]
    return [box_mesh((aside + 0.02, top / 2, 0.5), center=(sitting.edge_m - aside - 0.02, top / 2, 0), color=LINEN)]


def main(out: str) -> None:
    """Render the picture of people who lie down."""
    rows = []
    for name, height in STAGES:
        sitting = sitting_on(load_humanoid(name), height)
        quats, pelvis = sitting.lying
        poses = [(sitting.body, quats[k : k + 1], pelvis[k : k + 1]) for k in AT]
        props = [bed(sitting, along=k > TABLE // 2) for k in AT]
        rows.append(lined_up(poses, HEADING, False, 6, WIDTH, spacing=SPACING_M, row_m=ROW_M, props=props))
    lying = [sitting_on(body := load_humanoid(name), round(0.26 * body.height_m, 2)) for name in humanoid_names()]
    for k in range(0, len(lying), 6):
        row = lying[k : k + 6]
        poses = [(sitting.body, sitting.lying[0][-1:], sitting.lying[1][-1:]) for sitting in row]
        props = [bed(sitting, along=True) for sitting in row]
        rows.append(lined_up(poses, HEADING, False, 6, WIDTH, spacing=SPACING_M, row_m=1.0, props=props))
    write_jpg(out, np.vstack(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
