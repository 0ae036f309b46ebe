"""One idea: motion capture on a built-in person. Usage: python examples/play_a_motion.py walk.bvh walk.mp4 [BODY]

walk.bvh is a file of motion capture: BVH, AMASS (.npz) or Habitat's (.pkl); BODY one of: h3data bodies list
"""

import sys

from h3data.bodies import load_humanoid
from h3data.render import VideoWriter
from h3data.replay import Replay
from h3data_motion.files import read_motion
from h3data_motion.pictures import follow_camera
from h3data_motion.recording import motion_recording
from h3data_motion.retarget import foot_report, retarget

if len(sys.argv) < 3:
    sys.exit(__doc__)
body = load_humanoid(sys.argv[3] if len(sys.argv) > 3 else "female_1")
motion = retarget(read_motion(sys.argv[1]), body)  # AMASS, Habitat, BVH or an imported .npz
print(motion, foot_report(motion, body), sep="\n")

# a recording like any other: it can be stored (h3data.recording.write_mcap), measured, drawn from any camera
replay = Replay(motion_recording(motion, body))
track = follow_camera(replay, width=640, height=480)
with VideoWriter(sys.argv[2], 640, 480) as video:
    for _, (picture,) in replay.frames([track], range(len(replay)), samples=4):
        video.write(picture["rgb"])
