"""One idea: one recording from many cameras. Usage: python examples/readme_picture.py out/demo/episode.mcap OUT.jpg [STEP]"""

import sys

import cv2
import numpy as np

import h3data
from h3data.render import depth_to_rgb, instance_to_rgb
from h3data.replay import camera_track
from h3data_pipelines.pictures.rendering import draw_trajectories

HEIGHT = 420

if len(sys.argv) < 3:
    sys.exit(__doc__)
replay = h3data.Replay(h3data.open(sys.argv[1]))
step = int(sys.argv[3]) if len(sys.argv) > 3 else len(replay) // 2
tracks = [camera_track(replay, name) for name in ("third_person", "robot_arm", "top_down")]
_, (trailing, arm, above) = next(iter(replay.frames(tracks, [step], outputs=("rgb", "depth", "instance"), samples=4)))
draw_trajectories(above["rgb"], replay, tracks[2], step)
arm_views = [arm["rgb"], depth_to_rgb(arm["depth"], near=0.0, far=6.0), instance_to_rgb(arm["instance"])]


def scaled(image: np.ndarray, height: int) -> np.ndarray:
    width = round(image.shape[1] * height / image.shape[0])
    method = cv2.INTER_AREA if height < image.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=method)


column = np.concatenate([scaled(view, HEIGHT // 3) for view in arm_views])
picture = np.concatenate([scaled(trailing["rgb"], HEIGHT), column, scaled(above["rgb"], HEIGHT)], axis=1)
cv2.imwrite(sys.argv[2], picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
