"""One idea: the same episodes under two policies, and what the metrics say about them."""

import h3data
from h3data.metrics import measure_many
from h3data.scene import FreeSpace
from sim_kinematic.motion.spec import SocialNavSpec, WalkerSpec
from sim_kinematic.tasks.social_nav import SocialNavWorld, simulate_social_nav

EPISODES = 4

home = h3data.build_home(h3data.HomeSpec(preset="small", seed=0))
free = FreeSpace.from_scene(home)
spec = SocialNavSpec(max_steps=300, human=WalkerSpec(speed_mps=1.2))

for policy in ("heuristic_expert", "stand_still"):
    recordings = [
        simulate_social_nav(SocialNavWorld.create(home, seed=seed, spec=spec, free=free), policy=policy)
        for seed in range(EPISODES)
    ]
    print(f"{policy}\n{measure_many(recordings).to_text()}\n")
