"""Script for docs/pictures/gestures.jpg: gestures of people, four moments of each, on bodies of several sizes.

python -m bake.people.gesture_sheet docs/pictures/gestures.jpg
"""

from __future__ import annotations

import sys

import numpy as np

from h3data.bodies import humanoid_names, load_humanoid
from h3data.bodies.people.gestures import GESTURES, NAMES, add_gestures
from h3data.bodies.people.sitting import sitting_on
from h3data.mesh.mesh import Mesh
from h3data.render.image_files import write_jpg
from h3data.render.sheets.people_sheet import lined_up

from .sitting_sheet import chair

WIDTH, SPACING_M, ROW_M, HEADING, MOMENTS = 1300, 0.95, 2.05, -1.3, (0.0, 0.25, 0.5, 0.75)


def main(out: str) -> None:
    """Render the picture of gestures, with two gestures in a row."""
    poses, props, names = [], [], humanoid_names()
    for number, name in enumerate(NAMES):
        body = load_humanoid(names[number % len(names)])
        prop: list[Mesh] = []
        quats, pelvis = body.clip_pose(np.zeros(len(MOMENTS), np.int64), np.zeros(len(MOMENTS)))
        if GESTURES[name].seated:
            sitting = sitting_on(body, round(0.26 * body.height_m, 2))
            quats, pelvis = sitting.pose(np.ones(len(MOMENTS)))
            prop = chair(sitting)
        seconds = np.array(MOMENTS) * GESTURES[name].seconds
        add_gestures(
            body, quats, pelvis, np.column_stack([np.full(len(seconds), number), seconds, np.ones(len(seconds))])
        )
        poses += [(body, quats[k : k + 1], pelvis[k : k + 1]) for k in range(len(seconds))]
        props += [prop] * len(seconds)
    look = {"spacing": SPACING_M, "row_m": ROW_M}
    rows = [
        lined_up(poses[k : k + 8], HEADING, False, 8, WIDTH, props=props[k : k + 8], **look)
        for k in range(0, len(poses), 8)
    ]
    write_jpg(out, np.vstack(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
