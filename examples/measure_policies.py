"""One idea: play the same episodes with two policies, and compare them by their metrics."""

import h3data
from h3data.metrics import measure_many
from h3data.tasks import SocialNavSpec, WalkerSpec

EPISODES = 4

home = h3data.build_home(h3data.HomeSpec(preset="small", seed=0))
spec = SocialNavSpec(max_steps=300, human=WalkerSpec(speed_mps=1.2))

for policy in ("rollout_expert", "stand_still"):
    recordings = [
        h3data.simulate("social_nav", home, seed=seed, spec=spec, agents={"robot": policy}) for seed in range(EPISODES)
    ]
    print(f"{policy}\n{measure_many(recordings).to_text()}\n")
