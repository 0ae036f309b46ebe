"""One idea: a robot learns to find and follow a person by reinforcement learning (PPO, Schulman et al. 2017), in minutes.

A thousand worlds are stepped as tensors, on the CPU or a GPU. The result is a file of weights that every command accepts as a
policy: python examples/train_social_nav.py --out follower.npz --compile, then
h3data evaluate social_nav --policies weights:follower.npz -o out/follower"""

import time
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor, nn

import h3data
from h3data.errors import InputError
from h3data.files import part_file
from h3data.policies import from_torch, save_network

OBSERVATIONS = ("humanoid_gps", "humanoid_velocity", "egomotion", "way", "range_scan")
ROLLOUT, EPOCHS = 64, 3  # steps in each world, times they are learned from
LAMBDA, CLIP, ENTROPY, RATE = 0.95, 0.2, 0.002, 1e-3


class Learner(nn.Module):
    """Actor and critic networks, with the normalisation of observations."""

    def __init__(self, inputs: int, actions: int = 2) -> None:
        super().__init__()
        self.actor, self.critic = (
            nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))
            for outputs in (actions, 1)
        )
        self.log_std = nn.Parameter(torch.full((actions,), -0.5))
        for name, start in (("mean", torch.zeros(inputs)), ("var", torch.ones(inputs)), ("seen", torch.tensor(1e4))):
            self.register_buffer(name, start)

    def scale(self) -> Tensor:
        return self.var.sqrt().clamp_min(1e-3)

    def policy(self, x: Tensor) -> torch.distributions.Normal:
        mean = self.actor((x - self.mean) / self.scale())
        return torch.distributions.Normal(mean, self.log_std.exp(), validate_args=False)

    def value(self, x: Tensor) -> Tensor:
        return self.critic((x - self.mean) / self.scale())[..., 0]

    def look(self, x: Tensor) -> None:
        """Update mean and variance with observations [n, inputs] (Chan, Golub and LeVeque 1979)."""
        share, off = len(x) / (self.seen + len(x)), x.mean(0) - self.mean
        self.var.lerp_(x.var(0), share).add_(share * (1 - share) * off**2)
        self.mean.add_(share * off)
        self.seen.add_(len(x))


def flat(observation: dict[str, Tensor]) -> Tensor:
    return torch.cat(list(observation.values()), 1)


def roll_out(env: Any, learner: Learner, generator: torch.Generator, x: Tensor) -> tuple[dict[str, Tensor], Tensor]:
    """Collect `ROLLOUT` steps, arrays [T, W, ...], and return them with the observation that follows."""
    rows, info = [], env.info()
    for _ in range(ROLLOUT):
        begins, before, chosen = env.play.ended.clone(), info["followed"], learner.policy(x)
        action = chosen.mean + chosen.stddev * torch.randn(chosen.mean.shape, generator=generator, device=x.device)
        observation, reward, terminated, truncated, info = env.step(action)
        rows.append(
            {
                "x": x,
                "action": action,
                "log_prob": chosen.log_prob(action).sum(1),
                "reward": reward,
                "begins": begins,
                "terminated": terminated,
                "ended": terminated | truncated,
                "followed": (info["followed"] > before) & ~begins,
                "touches": terminated & info["collides"],
            }
        )
        x = flat(observation)
    return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}, x


def add_advantages(seen: dict[str, Tensor], learner: Learner, last: Tensor, gamma: float) -> None:
    """Add generalised advantage estimates (Schulman et al. 2016); truncated episodes count as if they continued."""
    value = learner.value(torch.cat([seen["x"], last[None]]))
    gain = (1 - gamma) * seen["reward"] + gamma * value[1:] * ~seen["terminated"] - value[:-1]
    for t in reversed(range(len(gain) - 1)):
        gain[t] += gamma * LAMBDA * ~seen["ended"][t] * gain[t + 1]
    seen |= {"gain": gain, "return": gain + value[:-1]}


def learn(
    seen: dict[str, Tensor], learner: Learner, optimizer: torch.optim.Adam, generator: torch.Generator, size: int
) -> None:
    """Learn for some epochs, from ``size`` samples at once.

    Steps that begin an episode have no action, so nothing is learned from them.
    """
    samples = {name: rows[~seen["begins"]] for name, rows in seen.items()}
    samples["gain"] = (samples["gain"] - samples["gain"].mean()) / samples["gain"].std()
    for _ in range(EPOCHS):
        for k in torch.randperm(len(samples["x"]), generator=generator, device=generator.device).split(size):
            x, gain, chosen = samples["x"][k], samples["gain"][k], learner.policy(samples["x"][k])
            ratio = (chosen.log_prob(samples["action"][k]).sum(1) - samples["log_prob"][k]).exp()
            worth = torch.minimum(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
            surprise = (learner.value(x) - samples["return"][k]).square().mean()
            optimizer.zero_grad()
            (surprise - worth - ENTROPY * chosen.entropy().sum(1).mean()).backward()
            nn.utils.clip_grad_norm_(learner.parameters(), 0.5)
            optimizer.step()
    learner.look(samples["x"])


def train(
    out: Path = Path("follower.npz"),
    *,
    scenes: str = "h3-homes/train",
    episodes: int = 1024,
    device: str = "cpu",
    compile: bool = False,
    worlds: int = 1024,
    minibatch: int = 2048,
    steps: int = 40_000_000,
    seed: int = 0,
    horizon: tuple[int, int] = (100, 500),
    observations: tuple[str, ...] = OBSERVATIONS,
    checkpoint_s: float = 10.0,
    resume: bool = False,
) -> list[dict[str, float]]:
    """Learn, write a file of weights, and return the learning curve.

    Args:
        out: File of weights. The learning curve (``.csv``) and the checkpoint (``.checkpoint``) are written next to it.
        scenes: Homes for learning.
        episodes: Number of different episodes that are played.
        device: cpu or cuda.
        compile: Fuse the operations of a step: a minute of compiling, then three times as fast; the CPU needs g++.
        worlds: Number of worlds that are stepped at once.
        minibatch: Number of samples in a gradient step; more worlds need more samples.
        steps: Number of steps of all worlds together.
        seed: Seed of all random numbers.
        horizon: Number of steps that the robot looks ahead at first and at last, so that finding the person is learned
            first.
        observations: Observations of the robot (docs/environments.md).
        checkpoint_s: Time between two checkpoints [s].
        resume: Continue from the checkpoint; the weights are those of an uninterrupted run.
    """
    torch.manual_seed(seed)
    env = h3data.make(
        "social_nav",
        scenes=scenes,
        num_envs=worlds,
        device=device,
        dtype=torch.float32,
        observations=observations,
        episodes=episodes,
        episodes_seed=seed,
        compile=compile,
    )
    x = flat(env.reset(seed=seed)[0])
    learner = Learner(x.shape[1]).to(device)
    optimizer = torch.optim.Adam(learner.parameters(), RATE)
    generator = torch.Generator(device).manual_seed(seed)
    checkpoint, curve = out.with_suffix(".checkpoint"), []
    asked = {
        "scenes": scenes,
        "episodes": len(env.bank),
        "worlds": worlds,
        "minibatch": minibatch,
        "steps": steps,
        "seed": seed,
        "horizon": horizon,
        "observations": observations,
    }
    if resume:
        kept = torch.load(checkpoint, map_location="cpu", weights_only=True)
        if kept["asked"] != asked:
            raise InputError(f"Resume with the options of the checkpoint: {kept['asked']}. Got: {asked}.")
        learner.load_state_dict(kept["learner"])
        optimizer.load_state_dict(kept["optimizer"])
        generator.set_state(kept["generator"])
        x, curve = kept["x"].to(device), kept["curve"]
        for mine, theirs in zip(env.play.tensors(), kept["play"], strict=True):
            mine.copy_(theirs)
    size, first, began, saved = worlds * ROLLOUT, len(curve), 0.0, 0.0
    rounds = max(steps // size, 1)
    for done in range(first + 1, rounds + 1):
        share = (done - 1) / rounds
        optimizer.param_groups[0]["lr"] = RATE * (1 - share)
        gamma = 1 - 1 / (horizon[0] + share * (horizon[1] - horizon[0]))
        with torch.no_grad():
            seen, x = roll_out(env, learner, generator, x)
            add_advantages(seen, learner, x, gamma)
        learn(seen, learner, optimizer, generator, minibatch)
        total = {name: float(seen[name].sum()) for name in ("begins", "reward", "followed", "touches", "ended")}
        moves, ends = size - total["begins"], max(total["ended"], 1.0)
        curve.append(
            {
                "step": done * size,
                "reward": total["reward"] / moves,
                "followed": total["followed"] / moves,
                "collided": total["touches"] / ends,
            }
        )
        now = time.time()
        if done == first + 1:
            began = now  # compiling took longer than all that comes
        if (now - saved > checkpoint_s and now > began) or done == rounds:
            saved, left = now, (now - began) / max(done - first - 1, 1) * (rounds - done) / 60
            print(*(f"{name} {figure:.3g}" for name, figure in curve[-1].items()), f"{left:.1f} min left", sep="  ")
            kept = {
                "learner": learner.state_dict(),
                "optimizer": optimizer.state_dict(),
                "generator": generator.get_state(),
            }
            with part_file(checkpoint) as part:
                torch.save({**kept, "asked": asked, "x": x, "play": list(env.play.tensors()), "curve": curve}, part)
            with part_file(out.with_suffix(".csv")) as part:
                part.write_text(
                    "".join(",".join(map(str, line)) + "\n" for line in [curve[0], *(r.values() for r in curve)])
                )
    norm = {"mean": learner.mean.cpu(), "scale": learner.scale().cpu()}
    save_network(from_torch(learner.actor, task="social_nav", observations=observations, **norm), out)
    return curve


if __name__ == "__main__":
    tyro.cli(train)
