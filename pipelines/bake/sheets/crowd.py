"""Script for docs/pictures/crowd.jpg: a robot of `crowd_nav` among four people, over its shoulder in four moments.

python -m bake.sheets.crowd docs/pictures/crowd.jpg
"""

from __future__ import annotations

import sys

import numpy as np

import h3data
from h3data.render.image_files import write_jpg
from h3data.replay import CameraTrack, Replay, camera_at
from h3data_crowds.crowd_nav import CrowdNav

ROSTER = ("robot", "female_0", "male_1", "female_2", "male_3")
SCENE, SEED = "medium:1", 6
SHARES = (0.5, 0.8, 0.85, 0.9)


def main(out: str) -> None:
    """Play an episode and write the picture."""
    recording = h3data.simulate(CrowdNav, SCENE, roster=ROSTER, agents={"robot": "mpc"}, seed=SEED)
    replay = Replay(recording, light="baked")
    shots = [("third_person", int(share * (len(recording) - 1))) for share in SHARES]
    pictures = []
    for name, step in shots:
        seen_from = camera_at(replay, name, step)
        track = CameraTrack(camera=seen_from, poses=seen_from.pose[None])
        pictures.append(next(iter(replay.frames([track], [step], outputs=("rgb",))))[1][0]["rgb"])
    write_jpg(out, np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:])]))


if __name__ == "__main__":
    main(*sys.argv[1:])
