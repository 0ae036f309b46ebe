"""One idea: 32 worlds in four homes, one policy for all. Usage: python examples/vector_env.py"""

import numpy as np

import h3data

WORLDS = 32
env = h3data.make("social_nav", scenes=[f"h3-homes/train#{k}" for k in range(4)], num_envs=WORLDS)


def towards_person(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Return actions that turn to the person, and drive while the person is ahead and not near; walls are ignored."""
    distance, to_the_right = observation["humanoid_gps"].T
    forward = np.where((distance > 1.5) & (np.abs(to_the_right) < 1.0), 1.0, 0.0)
    return np.stack([forward, np.clip(-4 * to_the_right, -1, 1)], axis=-1).astype(np.float32)


observation, _ = env.reset(seed=0)
returns, found, collisions, ended = np.zeros(WORLDS), np.zeros(WORLDS, bool), 0, 0
for _ in range(600):
    observation, reward, terminated, truncated, info = env.step(towards_person(observation))
    returns += reward  # a world whose episode has ended begins its next one by itself
    found |= info["found"]
    collisions, ended = collisions + terminated.sum(), ended + (terminated | truncated).sum()
print(f"{WORLDS} worlds x 600 steps: {ended} episodes ended, {collisions} of them by touching the person")
print(f"{found.mean():.0%} of the worlds found the person; reward per step {returns.mean() / 600:.2f}")
