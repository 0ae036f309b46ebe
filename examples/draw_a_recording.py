"""One idea: any recording, any camera. Usage: python examples/draw_a_recording.py out/demo/episode.mcap picture.png

The recording can be any .mcap file; this one is made by: h3data demo -o out/demo
"""

import sys

import numpy as np

import h3data
from h3data.render import look_at, pinhole, write_png
from h3data.replay import CameraTrack

if len(sys.argv) < 3:
    sys.exit(__doc__)
recording = h3data.open(sys.argv[1])
replay = h3data.Replay(recording)
robot = replay.at(len(replay) // 2).agents["robot"]["base_pose"]

# a camera of our own: two metres up, looking at the robot half-way through the recording
eye = robot[:3] + np.array([1.2, 2.0, 1.2])
camera = pinhole(640, 480, hfov_deg=80, pose=look_at(eye, robot[:3]), hidden_layers=("ceiling",))
track = CameraTrack(camera=camera, poses=camera.pose[None])
_, (picture,) = next(iter(replay.frames([track], [len(replay) // 2], outputs=("rgb",), samples=4)))
write_png(sys.argv[2], picture["rgb"])
