"""One idea: train a robot policy on a dataset. Usage: python examples/behaviour_cloning.py DATASET [EPOCHS]

DATASET is a folder of recordings, made by: h3data generate social_nav --episodes 50 -o DATASET
"""

import sys

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from h3data.recording import Dataset
from h3data_training.samples import WindowDataset

HISTORY, HORIZON = 4, 8

if len(sys.argv) < 2:
    sys.exit(__doc__)
torch.manual_seed(0)
windows = WindowDataset(
    Dataset(sys.argv[1]),  # e.g. of: h3data generate social_nav --episodes 50 -o ds/
    ["agent_0.base_pose", "agent_1.base_pose", "agent_0.action"],
    history=HISTORY,
    horizon=HORIZON,
)
print(windows)


def person_seen(window: dict[str, Tensor]) -> Tensor:
    """Return the positions of the person in the robot's frame in the past steps: forward and right [m], flattened."""
    robot, person = (window[f"agent_{i}.base_pose"][:, :HISTORY] for i in range(2))
    heading = 2 * torch.atan2(robot[..., 4], robot[..., 6])
    x, z = (person - robot)[..., 0], (person - robot)[..., 2]
    forward, right = x * heading.cos() - z * heading.sin(), x * heading.sin() + z * heading.cos()
    return torch.stack([forward, right], -1).flatten(1)


actions = windows[0]["agent_0.action"].shape[1]
policy = nn.Sequential(nn.Linear(2 * HISTORY, 64), nn.ReLU(), nn.Linear(64, HORIZON * actions))
optimiser = torch.optim.Adam(policy.parameters(), lr=1e-3)
for epoch in range(int(sys.argv[2]) if len(sys.argv) > 2 else 5):
    losses = []
    for window in DataLoader(windows, batch_size=64, shuffle=True):
        loss = nn.functional.mse_loss(policy(person_seen(window)), window["agent_0.action"][:, HISTORY:].flatten(1))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    print(f"epoch {epoch}: mean squared error of the next {HORIZON} actions {sum(losses) / len(losses):.4f}")
