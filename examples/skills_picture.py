"""A robot at work in a recording of rearrangement: when it picks, when it passes the person, when it places.

python examples/skills_picture.py out/ds/mcap/000000.mcap docs/pictures/skills.jpg
"""

import sys

import cv2
import numpy as np

import h3data
from h3data.render import look_at, pinhole
from h3data.replay import CameraTrack

SIZE = 400, 320
if len(sys.argv) < 3:
    sys.exit(__doc__)
recording = h3data.open(sys.argv[1])
replay = h3data.Replay(recording)
robot, person = (recording.columns[f"agent_{k}.base_pose"][:, [0, 2]] for k in (0, 1))
steps = {event.kind: event.step for event in reversed(recording.events) if event.agent == 0}
moments = [
    ("picks", steps["pick"]),
    ("passes", int(np.hypot(*(robot - person).T).argmin())),
    ("places", steps["place"]),
]
pictures = []
for name, step in sorted(moments, key=lambda moment: moment[1]):
    pose = replay.at(step).agents["robot"]["base_pose"]
    turn = 2 * np.arctan2(pose[4], pose[6])
    ahead, left = np.array([np.cos(turn), 0, -np.sin(turn)]), np.array([-np.sin(turn), 0, -np.cos(turn)])
    target = pose[:3] + 0.45 * ahead + np.array([0, 0.4, 0])
    eye = target - 0.9 * ahead + 1.1 * left + np.array([0, 1.7, 0])
    camera = pinhole(*SIZE, hfov_deg=75, pose=look_at(eye, target), hidden_layers=("ceiling",))
    track = CameraTrack(camera=camera, poses=camera.pose[None])
    _, (picture,) = next(iter(replay.frames([track], [step], outputs=("rgb",), samples=4)))
    rgb = np.ascontiguousarray(picture["rgb"])
    cv2.putText(
        rgb, f"{name}, {step / 30:.1f} s", (12, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (20, 20, 20), 2, cv2.LINE_AA
    )
    pictures.append(rgb)
cv2.imwrite(sys.argv[2], np.hstack(pictures)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
