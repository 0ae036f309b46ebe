"""Training run of rearrangement in a folder, with players, learners, learning curve, checkpoints and policies."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from h3data.errors import FormatError, InputError
from h3data.files import part_file
from h3data.plugins import own_version
from h3data.terminal import counted
from h3data_training import checkpoints
from h3data_training.curve import EventLog, save_curve
from h3data_training.envs.torch_env import checked_device
from h3data_training.launch import StopRequest
from h3data_training.populations.learner import ChooserLearner, plan_at
from h3data_training.populations.playing import Job, Played, Players
from h3data_training.populations.pool import bank_of, default_workers, episodes_of, pool_of, pool_order, with_scenes
from h3data_training.populations.settings import ROBOT, PopulationSettings
from h3data_training.running import SPARE_S, RunResult, Say, one_thread, share_of, stop_asked
from sim_kinematic.policies.network import RUN_POLICY
from sim_kinematic.policies.visual_policy import save_policy
from sim_kinematic.tasks.rearrange.episode import ORACLE_RULES, RearrangeEpisode

if TYPE_CHECKING:
    from h3data_training.populations.worlds import TensorPlayers

CHECKPOINT, POLICY, EPISODES, BANK = "checkpoint.pt", RUN_POLICY, "episodes.json.gz", "episodes.npz"
FORMAT = "h3data.populations/1"


def train(
    folder: Path,
    settings: PopulationSettings,
    *,
    seed: int = 0,
    workers: int | None = None,
    device: str = "cpu",
    resume: bool = False,
    stop_after: float | None = None,
    checkpoint_s: float = 30.0,
    episodes_file: Path | None = None,
    episodes: Sequence[RearrangeEpisode] | None = None,
    say: Say = lambda text: None,
) -> RunResult:
    """Train until the run ends, ``stop_after`` minutes have passed, or an interruption occurs, and save the state.

    A run whose length is given in updates gives identical weights with any number of workers, interrupted or not.

    Args:
        folder: Existing folder. `POLICY` (the robot), ``partner_0.npz``, ... (partners that learn), `CHECKPOINT` and the
            learning curve (`h3data_training.curve`) are written there.
        settings: Settings of the training.
        seed: Seed of everything random.
        workers: Number of processes that play; None is one for each core, and 1 uses this process.
        device: Torch device of the learners, and of worlds with oracle skills (`PopulationSettings.oracle`).
        resume: True continues from the checkpoint in the folder, if there is one.
        stop_after: Time limit of this call including set-up [min]; None for the whole run.
        checkpoint_s: Time between two checkpoints [s].
        episodes_file: File of the episodes to play, which runs may share; it is written if it does not exist. The
            default is `EPISODES` in the folder, or `BANK` for worlds on a device.
        episodes: Episodes to play instead of those of a file.
        say: Function that is called with lines of text about the progress.

    Raises:
        InputError: a setting does not fit, or the checkpoint or the episodes have other settings.
        FormatError: the checkpoint, or the file of episodes, is damaged.
        H3DataError: processes that play are lost repeatedly.
    """
    began = time.time()
    count = workers or default_workers()
    if count < 1:
        raise InputError(f"Expected at least 1 worker, got {count}.", code="H3-TRAIN-030")
    checked_device(device)
    kept = checkpoints.load_checkpoint(folder / CHECKPOINT, settings, seed, form=FORMAT) if resume else None
    with stop_asked() as stop:
        players = _players(episodes, settings, count, device, episodes_file, folder, say)
        say(f"{players.size} episodes in {players.homes} homes after {time.time() - began:.0f} s")
        try:
            with one_thread("cpu"):
                run = _Run(folder, settings, seed, players, kept, began, say)
                return run.go(stop, stop_after=stop_after, checkpoint_s=checkpoint_s)
        finally:
            players.close()


def _players(
    episodes: Sequence[RearrangeEpisode] | None,
    settings: PopulationSettings,
    workers: int,
    device: str,
    file: Path | None,
    folder: Path,
    say: Say,
) -> Players | TensorPlayers:
    """Return processes with the full rules, or worlds on a device, with these episodes or those of a file."""
    if not settings.oracle:
        if episodes is None:
            episodes = episodes_of(pool_of(settings, file or folder / EPISODES, workers=workers), settings)
        return Players(episodes, workers, device=device, say=say)
    from h3data_training.populations.worlds import TensorPlayers
    from h3data_training.torch.rearrange.bank import RearrangeBank

    if episodes is None:
        bank = bank_of(settings, file or folder / BANK, workers=workers)
        if settings.pixels:
            bank = with_scenes(bank, file or folder / BANK)
    else:
        bank = RearrangeBank.of([replace(one, spec=ORACLE_RULES) for one in episodes])
    return TensorPlayers(
        bank,
        device,
        moves_starts=settings.moves_starts,
        picture_size=settings.picture_size if settings.pixels else None,
    )


class _Run:
    def __init__(
        self,
        folder: Path,
        settings: PopulationSettings,
        seed: int,
        players: Players | TensorPlayers,
        kept: dict[str, Any] | None,
        began: float,
        say: Say,
    ) -> None:
        self.folder, self.settings, self.seed, self.say = folder, settings, seed, say
        self.players, self._began = players, began
        self.learners = {
            name: ChooserLearner(settings, name, seed=seed, device=players.device) for name in settings.learners
        }
        self.curve: list[dict[str, float]] = []
        self.before_s = self.setups_s = 0.0
        if kept is not None:
            self._restore(kept)
        self.events = EventLog(folder, self.curve)
        self.players.warm_up(self._jobs(0))
        self.setup_s = self.elapsed()
        self.setups_s += self.setup_s
        learners, workers = counted(len(self.learners), "learner"), counted(players.workers, "worker")
        say(f"{settings.population}: {learners}, {workers} after {self.setup_s:.0f} s")

    def elapsed(self) -> float:
        """Return the seconds of this call."""
        return time.time() - self._began

    @property
    def seconds(self) -> float:
        """Duration of all calls so far [s]."""
        return self.before_s + self.elapsed()

    @property
    def share(self) -> float:
        return share_of(self.settings, self.curve, self.seconds, self.setups_s)

    def go(self, stop: StopRequest, *, stop_after: float | None, checkpoint_s: float) -> RunResult:
        limit = float("inf") if stop_after is None else stop_after * 60 - SPARE_S / 2
        saved = said = time.monotonic()
        took = 0.0  # by the last update: one that would not end in time is not begun
        while (self.share < 1 or not self.curve) and self.elapsed() + took < limit and not stop.is_set():
            if time.monotonic() - saved > checkpoint_s and self.curve:
                self._save(is_last=False)
                saved = time.monotonic()
            start = time.monotonic()
            row = self._update(self.share)
            if not all(map(isfinite, row.values())):
                raise InputError(
                    f"Training diverged in update {len(self.curve) + 1}: a number is not finite. The checkpoint is as it was. "
                    f"Hint: another seed. Folder: {self.folder}",
                    code="H3-TRAIN-031",
                )
            self.curve.append(row)
            now = time.monotonic()
            took = now - start
            if now - said > 10 or len(self.curve) == 1:
                said = now
                self.say(self._line())
        self._save(is_last=True)
        last = dict(self.curve[-1]) if self.curve else {}
        return RunResult(
            folder=self.folder,
            done=self.share >= 1,
            updates=len(self.curve),
            decisions=int(last.get("decisions", 0)),
            seconds=self.seconds,
            setup_s=self.setup_s,
            last=last,
        )

    def _jobs(self, update: int) -> list[Job]:
        """Return the episodes of an update."""
        s = self.settings
        networks = {name: learner.network() for name, learner in self.learners.items()}
        jobs = []
        for number in range(update * s.episodes, (update + 1) * s.episodes):
            partner = s.partner_of(self.seed, number)
            jobs.append(
                Job(
                    number=number,
                    entry=pool_order(self.players.size, self.seed, number),
                    partner=partner,
                    networks={name: networks[name] for name in (ROBOT, partner) if name in networks},
                    seed=self.seed,
                    gamma=1 - 1 / s.horizon,
                )
            )
        return jobs

    def _update(self, share: float) -> dict[str, float]:
        """Play the episodes of one update and learn from them; return a row of the learning curve."""
        update, start = len(self.curve), time.monotonic()
        plan = plan_at(self.settings, share, update)
        played, found = self.players.play(self._jobs(update))
        playing_s = time.monotonic() - start
        losses: dict[str, dict[str, float]] = {}
        for name, learner in self.learners.items():
            if name in found:
                losses[name] = learner.update(found[name], plan, update=update)
        before = self.curve[-1] if self.curve else {}
        decisions = sum(map(len, found.values()))
        steps = sum(p.steps for p in played)
        row = {
            "update": update + 1,
            "episodes": before.get("episodes", 0) + len(played),
            "decisions": before.get("decisions", 0) + decisions,
            "steps": before.get("steps", 0) + steps,
            "seconds": round(self.seconds, 2),
            **_outcome(played),
            **losses[ROBOT],
            **_others({name: row for name, row in losses.items() if name != ROBOT}),
            "rate": plan.rate,
            "playing_share": playing_s / (time.monotonic() - start),
            "steps_per_s": steps / (time.monotonic() - start),
        }
        return {name: float(value) for name, value in row.items()}

    def _line(self) -> str:
        row, share = self.curve[-1], self.share
        spent = self.seconds - self.setups_s
        left = timedelta(seconds=round(spent * (1 - share) / share)) if share > 0 else "?"
        recent = self.curve[-10:]
        mean = {
            name: float(np.mean([r[name] for r in recent])) for name in ("success", "collided", "steps_per_episode")
        }
        return (
            f"{share:.0%}  update {row['update']:.0f}  {row['episodes']:.0f} episodes  reward {row['reward']:.1f}  last ten: "
            f"success {mean['success']:.0%}  collided {mean['collided']:.0%}  {mean['steps_per_episode']:.0f} steps  "
            f"{row['steps_per_s']:.0f} steps/s  {left} left"
        )

    # --- files ------------------------------------------------------------------------------------------------------------
    def _restore(self, kept: dict[str, Any]) -> None:
        try:
            for name, learner in self.learners.items():
                learner.restore(kept["learners"][name])
            self.curve, self.before_s, self.setups_s = kept["curve"], kept["seconds"], kept["setups_s"]
        except (KeyError, RuntimeError, ValueError) as fault:
            reason = str(fault).splitlines()[0]
            raise FormatError(
                f"The checkpoint does not fit ({reason}). File: {self.folder / CHECKPOINT}", code="H3-TRAIN-032"
            ) from None

    def _save(self, *, is_last: bool) -> None:
        """Save checkpoint, curve and policies, each completely or not at all.

        A full disk ends the run only at its end.
        """
        kept = {
            "format": FORMAT,
            "settings": self.settings.as_dict(),
            "seed": self.seed,
            "curve": self.curve,
            "seconds": self.seconds,
            "setups_s": self.setups_s,
            "learners": {name: learner.state for name, learner in self.learners.items()},
        }
        try:
            with part_file(self.folder / CHECKPOINT) as part:
                torch.save(kept, part)
            if self.curve:
                save_curve(self.curve, self.folder)
                self.events.write(self.curve)
            training = self._training()
            for name, learner in self.learners.items():
                save_policy(learner.network(training), self.folder / (POLICY if name == ROBOT else f"{name}.npz"))
        except (OSError, RuntimeError) as fault:  # torch reports a full disk as RuntimeError
            if is_last:
                raise OSError(f"The run could not be saved ({fault}). Folder: {self.folder}") from fault
            self.say(f"could not save ({fault}); training goes on, the last checkpoint is as it was")

    def _training(self) -> dict[str, Any]:
        """Return the origin of the policies, for their cards."""
        last = self.curve[-1] if self.curve else {}
        shown = ("reward", "success", "collided", "steps_per_episode", "robot_share")
        return {
            "population": self.settings.population,
            "seed": self.seed,
            "updates": len(self.curve),
            **{name: int(last.get(name, 0)) for name in ("episodes", "decisions", "steps")},
            "seconds": round(self.seconds, 1),
            "workers": self.players.workers,
            "device": str(self.learners[ROBOT].device),
            "torch": str(torch.__version__),
            "h3data": own_version(),
            "settings": self.settings.as_dict(),
            "last_update": {name: round(last[name], 4) for name in shown if name in last},
        }


def _outcome(played: Sequence[Played]) -> dict[str, float]:
    """Return means over the episodes of an update, by column of the curve."""
    there = sum(p.at_goal for p in played)
    return {
        "reward": float(np.mean([p.reward for p in played])),
        "success": float(np.mean([p.ended == "success" for p in played])),
        "collided": float(np.mean([p.ended == "collision" for p in played])),
        "steps_per_episode": float(np.mean([p.steps for p in played])),
        "robot_share": sum(p.placed for p in played) / max(there, 1),
    }


def _others(losses: dict[str, dict[str, float]]) -> dict[str, float]:
    """Return the mean losses of the partners that learn."""
    names = ("value_loss", "entropy", "kl", "clipped", "explained", "gradient_steps")
    return {f"partners_{n}": float(np.mean([row[n] for row in losses.values()])) for n in names} if losses else {}
