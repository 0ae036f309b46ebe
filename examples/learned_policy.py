"""One idea: a policy from a file of weights. A small network imitates the expert of social navigation from a few episodes.
It is saved, and then drives the robot by its name. Usage: python examples/learned_policy.py [weights.npz]"""

import sys

import numpy as np
import torch
from torch import nn

import h3data
from h3data.metrics import measure
from h3data.policies import from_torch, navigation_input, save_network
from h3data.tasks import SocialNavSpec, WalkerSpec
from sim_kinematic.policies.social_nav import rollout_expert

FILE = sys.argv[1] if len(sys.argv) > 1 else "expert.npz"
NAMES = ("humanoid_gps", "way")
torch.manual_seed(0)
home = h3data.build_home(h3data.HomeSpec(preset="small", seed=0))
spec = SocialNavSpec(max_steps=400, human=WalkerSpec(speed_mps=1.2))
seen, done = [], []


def watched_expert(view, base):
    command = rollout_expert(view, base)
    seen.append(navigation_input(view, base, NAMES))
    done.append([command.forward, command.turn])
    return command


for seed in range(4):
    h3data.simulate("social_nav", home, seed=seed, spec=spec, agents={"robot": watched_expert})
x, y = np.array(seen), np.array(done, np.float32)
mean, scale = x.mean(0), x.std(0)
net = nn.Sequential(nn.Linear(x.shape[1], 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 2))
inputs, wanted = torch.from_numpy((x - mean) / scale), torch.from_numpy(y)
optimizer = torch.optim.Adam(net.parameters(), 1e-2)
for _ in range(500):
    optimizer.zero_grad()
    loss = nn.functional.mse_loss(net(inputs), wanted)
    loss.backward()
    optimizer.step()
save_network(from_torch(net, task="social_nav", observations=NAMES, mean=mean, scale=scale), FILE)

for policy in ("stand_still", f"weights:{FILE}", "rollout_expert"):
    recording = h3data.simulate("social_nav", home, seed=9, spec=spec, agents={"robot": policy})
    print(f"{policy}: followed {measure(recording).values['F']:.2f} of the possible steps")
