"""One idea: pictures that two agents see at work. Usage: python examples/environment_pictures.py PICTURE.jpg [SCENE]"""

import sys

import numpy as np
from PIL import Image

import h3data
from h3data.render import depth_to_rgb

if len(sys.argv) < 2:
    sys.exit(__doc__)
SIZE = 320, 240
env = h3data.make(
    "rearrange",
    scenes=sys.argv[2] if len(sys.argv) > 2 else "h3-homes/test#0",
    agents=("robot", "human"),
    observations=("arm_rgb", "arm_depth", "humanoid_mask", "head_rgb"),
    depth_size=SIZE,
    rgb_size=SIZE,
    interrupts_when_close=False,
    render_mode="rgb_array",
)
seen, infos = env.reset(seed=0)
print(env)
# By number (sim_kinematic.agents.skills.choices): walk to the object, pick it, walk to its goal, place it; then wait.
plans = {"robot": iter([0, 4, 2, 6]), "human": iter([1, 5, 3, 7])}
rows = []
while env.agents and len(rows) < 13:
    rows.append(
        np.hstack(
            [
                np.asarray(Image.fromarray(env.render()).resize(SIZE)),
                seen["robot"]["arm_rgb"],
                depth_to_rgb(10 * seen["robot"]["arm_depth"][..., 0], 0.2, 5.0),
                np.repeat((255 * seen["robot"]["humanoid_mask"]).astype(np.uint8), 3, axis=-1),
                seen["human"]["head_rgb"],
            ]
        )
    )
    actions = {agent: next(plans[agent], 8) if infos[agent]["choosing"] else 8 for agent in env.agents}
    seen, _, _, _, infos = env.step(actions)
    told = {agent: (infos[agent]["step"], infos[agent]["outcome"]) for agent in infos}
    print(told)
# by then the robot has come to where it sees the person
Image.fromarray(np.vstack(rows[-4:])).save(sys.argv[1], quality=85)
