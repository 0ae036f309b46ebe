"""One idea: a Gymnasium environment. Usage: python examples/random_agent.py [PICTURE.png]"""

import sys

from PIL import Image

import h3data
from sim_kinematic.sensing.table import PAPER_OBSERVATIONS

# What the paper's policy sees: depth of the arm's camera, the humanoid detector, the humanoid GPS.
env = h3data.make(
    "social_nav",
    scenes="h3-homes/train#0",
    observations=(*PAPER_OBSERVATIONS, "egomotion"),
    depth_size=(112, 86),
    render_mode="rgb_array",
)
observation, info = env.reset(seed=0)
env.action_space.seed(0)
print({name: array.shape for name, array in observation.items()}, "in", info["scene"])
total, terminated, truncated, step = 0.0, False, False, 0
while step < 100 and not (terminated or truncated):
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    total, step = total + reward, step + 1
print(f"{step} steps, return {total:.1f}, {info['geodesic_m']:.1f} m from the person, found: {bool(info['found'])}")
if len(sys.argv) > 1:
    Image.fromarray(env.render()).save(sys.argv[1])
