"""Training run in a folder, with episodes, worlds, learner, learning curve, checkpoints and the policy file."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from datetime import timedelta
from math import isfinite
from pathlib import Path
from typing import Any

import torch

from h3data.errors import InputError
from h3data.files import part_file
from h3data.plugins import own_version
from h3data_training import checkpoints
from h3data_training.crowds.settings import CrowdSettings
from h3data_training.crowds.worlds import ActionRepeatCrowd, make_crowd_bank
from h3data_training.curve import EventLog, save_curve
from h3data_training.episodes import make_bank
from h3data_training.launch import StopRequest, launch
from h3data_training.networks import warm_start
from h3data_training.ppo import Learner, schedule
from h3data_training.ranks import Ranks, connect, leave, own_place, torchrun_place
from h3data_training.running import SPARE_S, RunResult, Say, one_thread, share_of, stop_asked
from h3data_training.settings import Settings
from h3data_training.skills.episodes import make_skill_bank
from h3data_training.skills.settings import SkillSettings
from h3data_training.skills.worlds import ActionRepeatSkills
from h3data_training.torch.crowd.bank import CrowdBank
from h3data_training.torch.episodes import EpisodeBank
from h3data_training.torch.skills.bank import SkillBank
from h3data_training.worlds import ActionRepeatEnv
from sim_kinematic.policies.network import RUN_POLICY
from sim_kinematic.policies.networks.resnet_lstm import ResNetPolicy
from sim_kinematic.policies.visual_policy import PolicyCard, VisualPolicy, save_policy

Bank = EpisodeBank | SkillBank | CrowdBank
CHECKPOINT, POLICY = "checkpoint.pt", RUN_POLICY
STARTS = "starts.npz"
"""Name of the file of a skill's episode starts, so that a continued run does not search for them again."""


def train(
    folder: Path,
    settings: Settings,
    *,
    seed: int = 0,
    device: str = "cpu",
    gpus: int = 1,
    init: VisualPolicy | None = None,
    resume: bool = False,
    stop_after: float | None = None,
    checkpoint_s: float = 30.0,
    compile: bool | None = None,
    name: str = "",
    bank: Bank | None = None,
    say: Say = lambda text: None,
) -> RunResult:
    """Train until the run ends, ``stop_after`` minutes have passed, or an interruption occurs, and save the state.

    On the CPU, a run that was interrupted and continued gives the same weights as one that was not, if its length is
    given in updates; progress in minutes depends on the clock. A process that torchrun has started joins the other
    processes.

    Args:
        folder: Existing folder. `POLICY`, `CHECKPOINT` and the learning curve (`h3data_training.curve`) are written
            there, and for a skill also `STARTS`.
        settings: Settings of training for social navigation or for a skill
            (`h3data_training.skills.settings.SkillSettings`).
        seed: Seed of everything random.
        device: ``cpu`` or ``cuda``.
        gpus: Number of processes that train together, one for each GPU, or on the CPU; each has its share of the
            worlds.
        init: Trained policy to start with; the critic is new.
        resume: True continues from the checkpoint in the folder, if there is one.
        stop_after: Time limit of this call including set-up [min]; None for the whole run.
        checkpoint_s: Time between two checkpoints [s].
        compile: True compiles the worlds, as in `SocialNavTorchEnv`.
        name: Name of the recipe, for the card.
        bank: Episodes to train on; None samples them.
        say: Function that is called with lines of text about the progress.

    Raises:
        InputError: a setting does not fit, the checkpoint has other settings, or a GPU is too small.
        FormatError: the checkpoint is damaged.
    """
    job = _Job(
        folder=folder,
        settings=settings,
        seed=seed,
        device=device,
        init=init,
        resume=resume,
        stop_after=stop_after,
        checkpoint_s=checkpoint_s,
        compile=compile,
        name=name,
        bank=bank,
        began=time.time(),
    )
    place = torchrun_place()
    processes = place[1] if place else gpus
    if processes < 1 or settings.worlds % (processes * settings.minibatches):
        raise InputError(
            f"Expected worlds in multiples of {settings.minibatches} minibatches for each of {processes} processes, "
            f"got {settings.worlds}.",
            code="H3-TRAIN-041",
        )
    job.load_checkpoint()
    with stop_asked() as stop:
        if place is None and processes > 1:
            return launch(_work, processes, replace(job, bank=job.episodes(say)), stop=stop, say=say)
        return _work(job, stop, say)


@dataclass(frozen=True, kw_only=True)
class _Job:
    """Arguments of `train` that are passed to its processes."""

    folder: Path
    settings: Settings
    seed: int
    device: str
    init: VisualPolicy | None
    resume: bool
    stop_after: float | None
    checkpoint_s: float
    compile: bool | None
    name: str
    bank: Bank | None
    began: float
    """Start of the job by the wall clock, which all processes see [s]."""

    def load_checkpoint(self) -> dict[str, Any] | None:
        """Return the checkpoint to go on from."""
        return checkpoints.load_checkpoint(self.folder / CHECKPOINT, self.settings, self.seed) if self.resume else None

    def episodes(self, say: Say) -> Bank:
        bank = self.bank
        if bank is None:
            s = self.settings
            if isinstance(s, SkillSettings):
                bank = make_skill_bank(s, seed=self.seed, file=self.folder / STARTS)
            elif isinstance(s, CrowdSettings):
                bank = make_crowd_bank(s, seed=self.seed)
            else:
                bank = make_bank(s, seed=self.seed)
        say(f"{len(bank)} episodes in {len(bank.scenes)} homes after {time.time() - self.began:.0f} s")
        return bank


def _work(job: _Job, stop: StopRequest, say: Say) -> RunResult:
    """Return the work of one process."""
    ranks, device = own_place(job.device)
    if not ranks.is_first:
        say = _silent
    bank = job.episodes(say if job.bank is None else _silent)
    with one_thread(job.device):
        try:
            return _Run(job, ranks, device, bank, say).go(stop)
        except torch.cuda.OutOfMemoryError as fault:
            raise InputError(
                f"The GPU is too small for {job.settings.worlds // ranks.count} worlds. "
                f"Hint: --worlds {max(job.settings.worlds // 2, 1)}. ({str(fault).splitlines()[0]})",
                code="H3-TRAIN-043",
            ) from None
        finally:
            leave()


def worlds_of(
    settings: Settings, bank: Bank, *, device: str, compile: bool | None = None, count: int | None = None
) -> ActionRepeatEnv | ActionRepeatSkills | ActionRepeatCrowd:
    """Return the training worlds for some settings and the episodes of a bank."""
    if isinstance(settings, SkillSettings):
        assert isinstance(bank, SkillBank)
        return ActionRepeatSkills(settings, bank, device=device, compile=compile, count=count)
    if isinstance(settings, CrowdSettings):
        assert isinstance(bank, CrowdBank)
        return ActionRepeatCrowd(settings, bank, device=device, compile=compile, count=count)
    assert isinstance(bank, EpisodeBank)
    return ActionRepeatEnv(settings, bank, device=device, compile=compile, count=count)


def _silent(line: str) -> None:
    """Say nothing: the first process speaks for all."""


class _Run:
    def __init__(self, job: _Job, ranks: Ranks, device: str, bank: Bank, say: Say) -> None:
        self.job, self.ranks, self.say = job, ranks, say
        self.folder, self.settings = job.folder, job.settings
        torch.set_float32_matmul_precision("high")
        count = self.settings.worlds // ranks.count
        worlds = worlds_of(self.settings, bank, device=device, compile=job.compile, count=count)
        self.learner = Learner(self.settings, worlds, seed=job.seed, ranks=ranks)
        connect(ranks, worlds.device)
        self.curve: list[dict[str, float]] = []
        self.before_s = self.setups_s = 0.0
        self.parent: dict[str, Any] = {}
        kept = job.load_checkpoint()
        if kept is not None:
            checkpoints.restore(self.learner, kept, self.folder / CHECKPOINT)
            self.curve, self.before_s, self.setups_s = kept["curve"], kept["seconds"], kept["setups_s"]
            self.parent = kept.get("parent", {})
        elif job.init is not None:
            self.parent = warm_start(self.learner.net, job.init, self.settings)
        self.events = EventLog(self.folder, self.curve) if ranks.is_first else None
        self.device = torch.cuda.get_device_name() if worlds.device.type == "cuda" else "cpu"
        self.setup_s = self.elapsed()
        self.setups_s += self.setup_s
        about = f"{ranks.count} x {self.device}" if ranks.count > 1 else self.device
        say(f"{self.settings.worlds} worlds on {about} after {self.setup_s:.0f} s")

    def elapsed(self) -> float:
        """Return the seconds of this call."""
        return time.time() - self.job.began

    @property
    def seconds(self) -> float:
        """Duration of all calls so far [s]."""
        return self.before_s + self.elapsed()

    @property
    def share(self) -> float:
        return share_of(self.settings, self.curve, self.seconds, self.setups_s)

    def go(self, stop: StopRequest) -> RunResult:
        job, is_first = self.job, self.ranks.is_first
        limit = float("inf") if job.stop_after is None else job.stop_after * 60 - SPARE_S / 2
        saved = said = time.monotonic()
        while True:
            share, is_saving, goes_on = self._agreed(
                self.share,
                time.monotonic() - saved > job.checkpoint_s,
                (self.share < 1 or not self.curve) and self.elapsed() < limit and not stop.is_set(),
            )
            if not goes_on:
                break
            if is_saving and self.curve:
                self._save(is_last=False)
                saved = time.monotonic()
            update, start = len(self.curve), time.monotonic()
            row = self.learner.update(schedule(self.settings, share, update))
            size, now = self.settings.decisions_per_update, time.monotonic()
            self.curve.append(
                {
                    "update": update + 1,
                    "decisions": (update + 1) * size,
                    "seconds": round(self.seconds, 2),
                    **row,
                    "decisions_per_s": size / (now - start),
                }
            )
            if not all(map(isfinite, row.values())):
                raise InputError(
                    f"Training diverged in update {update + 1}: a number is not finite. The checkpoint is as it was. "
                    f"Hint: another seed, or a lower rate. Folder: {self.folder}",
                    code="H3-TRAIN-031",
                )
            if is_first and (now - said > 10 or update == 0):
                said = now
                self.say(self._line())
        done = self.share >= 1
        self._save(is_last=True)
        updates = len(self.curve)
        return RunResult(
            folder=self.folder,
            done=done,
            updates=updates,
            decisions=updates * self.settings.decisions_per_update,
            seconds=self.seconds,
            setup_s=self.setup_s,
            last=dict(self.curve[-1]) if self.curve else {},
        )

    def _agreed(self, *values: float) -> list[float]:
        """Return the values that the first process has: clocks differ, and all processes have to do the same."""
        where = self.learner.memory.state.device
        return self.ranks.first(torch.tensor(values, dtype=torch.float64, device=where)).tolist()

    def _line(self) -> str:
        row, share = self.curve[-1], self.share
        spent = self.seconds - self.setups_s
        left = timedelta(seconds=round(spent * (1 - share) / share)) if share > 0 else "?"
        return (
            f"{share:.0%}  update {row['update']:.0f}  {row['decisions'] / 1e6:.2f} M decisions  reward {row['reward']:.3f}  "
            f"{figures_of(row)}  "
            f"{row['decisions_per_s']:.0f} decisions/s  {left} left"
        )

    # --- files ------------------------------------------------------------------------------------------------------------
    def _save(self, *, is_last: bool) -> None:
        """Save checkpoint, curve and policy, each completely or not at all.

        A full disk ends the run only at its end.
        """
        kept = {
            "format": checkpoints.FORMAT,
            "settings": self.settings.as_dict(),
            "seed": self.job.seed,
            "curve": self.curve,
            "seconds": self.seconds,
            "setups_s": self.setups_s,
            "parent": self.parent,
            **checkpoints.state_of(self.learner),
        }
        if not self.ranks.is_first:
            return
        try:
            with part_file(self.folder / CHECKPOINT) as part:
                torch.save(kept, part)
            if self.curve:
                save_curve(self.curve, self.folder)
                if self.events is not None:
                    self.events.write(self.curve)
            save_policy(self.policy(), self.folder / POLICY)
        except (OSError, RuntimeError) as fault:  # torch reports a full disk as RuntimeError
            if is_last:
                raise OSError(f"The run could not be saved ({fault}). Folder: {self.folder}") from fault
            self.say(f"could not save ({fault}); training goes on, the last checkpoint is as it was")

    def policy(self) -> VisualPolicy:
        """Return the policy that has been learned so far."""
        s, updates = self.settings, len(self.curve)
        last = {k: v for k, v in self.curve[-1].items() if k in TOLD} if self.curve else {}
        kind = VisualPolicy if s.network == "cnn_gru" else ResNetPolicy
        return kind(
            card=PolicyCard(
                task=s.task,
                actions=s.actions,
                robot=s.robot,
                observations=s.observations,
                picture_size=s.picture_size if s.pictured else None,
                light=s.light,
                hold=s.hold,
                network=s.network,
                training={
                    "recipe": self.job.name,
                    "seed": self.job.seed,
                    "updates": updates,
                    "decisions": updates * s.decisions_per_update,
                    "steps": updates * s.decisions_per_update * s.hold,
                    "seconds": round(self.seconds, 1),
                    "device": self.device,
                    "torch": str(torch.__version__),
                    "h3data": own_version(),
                    "settings": s.as_dict(),
                    "last_update": last,
                    "processes": self.ranks.count,
                    **({"parent": self.parent} if self.parent else {}),
                },
            ),
            arrays=self.learner.net.arrays(),
        )


TOLD = ("reward", "follows", "collided", "met", "succeeded", "failed")
"""Names of the columns of the last update that a policy's card contains."""


def figures_of(row: dict[str, float]) -> str:
    """Return text about the episodes of an update, from a row of the learning curve."""
    if "follows" in row:
        return f"following {row['follows']:.0%} of steps  collided {row['collided']:.0%}"
    if row.get("ended") == 0:
        return "no episode has ended"
    return f"succeeded {row['succeeded']:.0%}  failed {row['failed']:.0%}  {row['steps_per_episode']:.0f} steps"


def describe(settings: Settings) -> str:
    """Return the settings as readable JSON with line breaks."""
    return json.dumps(settings.as_dict(), indent=1)
