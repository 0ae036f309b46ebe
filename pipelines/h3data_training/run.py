"""A training run in a folder: episodes, worlds, learner, learning curve, checkpoints, and the policy file."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch

from h3data.errors import FormatError, InputError
from h3data.files import part_file
from h3data_training.curve import EventLog, save_curve
from h3data_training.episodes import make_bank
from h3data_training.ppo import Learner, schedule
from h3data_training.settings import Settings
from h3data_training.worlds import HeldWorlds
from sim_kinematic.policies.pictured import PicturedNetwork, PolicyCard, save_pictured
from sim_kinematic.torch.episodes import EpisodeBank

CHECKPOINT, POLICY = "checkpoint.pt", "policy.npz"
FORMAT = "h3data.training/1"
FREE = ("minutes", "updates")
"""Settings that may change when a run goes on: they only say how long it is."""
SPARE_S = 10.0
"""Kept at the end of a run of so many minutes, for the last update and the files."""

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a call of `train` came to."""

    folder: Path
    done: bool
    """The run is over; else it goes on from the checkpoint."""
    updates: int
    decisions: int
    seconds: float
    """Of all calls, set-up included."""
    setup_s: float
    """Of this call."""
    last: dict[str, float]
    """Last row of the learning curve."""


def train(
    folder: Path, settings: Settings, *, seed: int = 0, device: str = "cpu", resume: bool = False,
    stop_after: float | None = None, checkpoint_s: float = 30.0, compile: bool | None = None, name: str = "",
    bank: EpisodeBank | None = None, say: Say = lambda text: None,
) -> Result:  # fmt: skip
    """Trains until the run is over, ``stop_after`` minutes have passed, or somebody interrupts it, and saves.

    On the CPU, a run that was interrupted and goes on comes to the very weights of one that was not, if its length is given in
    updates; progress in minutes depends on the clock.

    Args:
        folder: Of the run; it exists. `POLICY`, `CHECKPOINT` and the learning curve (`h3data_training.curve`) appear there.
        settings: What is trained.
        seed: Everything random follows from it.
        device: ``cpu`` or ``cuda``.
        resume: Go on from the checkpoint in the folder, if there is one.
        stop_after: Minutes of this call, set-up included; None: until the run is over.
        checkpoint_s: Seconds between two checkpoints.
        compile: As of `SocialNavTorchEnv`.
        name: Of the recipe, for the card.
        bank: Episodes to train on; None makes them.
        say: Told what goes on, in lines.

    Raises:
        InputError: a setting does not fit, the checkpoint is of other settings, or the GPU is too small.
        FormatError: the checkpoint is damaged.
    """
    began = time.monotonic()
    kept = _read(folder / CHECKPOINT, settings, seed) if resume and (folder / CHECKPOINT).exists() else None
    if kept is not None and _is_over(settings, kept["curve"], kept["seconds"], kept["setups_s"]):
        raise InputError(
            f"The run is over: {len(kept['curve'])} updates in {kept['seconds'] / 60:.1f} minutes. "
            f"Hint: give it more --minutes. Folder: {folder}"
        )
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise InputError("There is no GPU that this torch can use. Hint: --device cpu with --recipe tiny.")
    with _stop_asked() as stop, _one_thread(device):
        try:
            return _Run(folder, settings, seed, device, kept, compile, name, bank, say, began).go(
                stop, stop_after, checkpoint_s
            )
        except torch.cuda.OutOfMemoryError as fault:
            raise InputError(
                f"The GPU is too small for {settings.worlds} worlds. Hint: --worlds {max(settings.worlds // 2, 1)}. "
                f"({str(fault).splitlines()[0]})"
            ) from None


class _Run:
    def __init__(
        self, folder: Path, settings: Settings, seed: int, device: str, kept: dict[str, Any] | None,
        compile: bool | None, name: str, bank: EpisodeBank | None, say: Say, began: float,
    ) -> None:  # fmt: skip
        self.folder, self.settings, self.seed, self.name, self.say, self.began = (
            folder,
            settings,
            seed,
            name,
            say,
            began,
        )
        bank = make_bank(settings, seed=seed) if bank is None else bank
        say(f"{len(bank)} episodes in {len(bank.scenes)} homes after {self.elapsed():.0f} s")
        torch.set_float32_matmul_precision("high")
        worlds = HeldWorlds(settings, bank, device=device, compile=compile)
        self.learner = Learner(settings, worlds, seed=seed)
        self.curve: list[dict[str, float]] = []
        self.before_s = self.setups_s = 0.0
        if kept is not None:
            self._restore(kept)
        self.events = EventLog(folder, self.curve)
        self.device = torch.cuda.get_device_name() if worlds.device.type == "cuda" else "cpu"
        self.setup_s = self.elapsed()
        self.setups_s += self.setup_s
        say(f"{settings.worlds} worlds on {self.device} after {self.setup_s:.0f} s")

    def elapsed(self) -> float:
        """Seconds of this call."""
        return time.monotonic() - self.began

    @property
    def seconds(self) -> float:
        """Of all calls."""
        return self.before_s + self.elapsed()

    @property
    def share(self) -> float:
        return _share(self.settings, self.curve, self.seconds, self.setups_s)

    def go(self, stop: threading.Event, stop_after: float | None, checkpoint_s: float) -> Result:
        limit = float("inf") if stop_after is None else stop_after * 60 - SPARE_S / 2
        saved = said = time.monotonic()
        while (self.share < 1 or not self.curve) and self.elapsed() < limit and not stop.is_set():
            update, start = len(self.curve), time.monotonic()
            row = self.learner.update(schedule(self.settings, self.share, update))
            size, now = self.settings.decisions_per_update, time.monotonic()
            self.curve.append(
                {
                    "update": update + 1, "decisions": (update + 1) * size, "seconds": round(self.seconds, 2), **row,
                    "decisions_per_s": size / (now - start),
                }
            )  # fmt: skip
            if not all(map(_is_finite, row.values())):
                raise InputError(
                    f"Training diverged in update {update + 1}: a number is not finite. The checkpoint is as it was. "
                    f"Hint: another seed, or a lower rate. Folder: {self.folder}"
                )
            if now - said > 10 or update == 0:
                said = now
                self.say(self._line())
            if now - saved > checkpoint_s:
                self._save(is_last=False)
                saved = time.monotonic()
        done = self.share >= 1
        self._save(is_last=True)
        updates = len(self.curve)
        return Result(
            folder=self.folder, done=done, updates=updates, decisions=updates * self.settings.decisions_per_update,
            seconds=self.seconds, setup_s=self.setup_s, last=dict(self.curve[-1]) if self.curve else {},
        )  # fmt: skip

    def _line(self) -> str:
        row, share = self.curve[-1], self.share
        spent = self.seconds - self.setups_s
        left = timedelta(seconds=round(spent * (1 - share) / share)) if share > 0 else "?"
        return (
            f"{share:.0%}  update {row['update']:.0f}  {row['decisions'] / 1e6:.2f} M decisions  reward {row['reward']:.3f}  "
            f"following {row['follows']:.0%} of steps  collided {row['collided']:.0%}  "
            f"{row['decisions_per_s']:.0f} decisions/s  {left} left"
        )

    # --- files ------------------------------------------------------------------------------------------------------------
    def _save(self, *, is_last: bool) -> None:
        """Checkpoint, curve and policy, each whole or not at all. A disk that is full ends the run only at its end."""
        m, learner = self.learner.memory, self.learner
        kept = {
            "format": FORMAT, "settings": self.settings.as_dict(), "seed": self.seed, "curve": self.curve,
            "seconds": self.seconds, "setups_s": self.setups_s, "net": learner.net.state_dict(),
            "optimizer": learner.optimizer.state_dict(), "dice": learner.dice.get_state(),
            "play": list(learner.worlds.play.tensors()), "shown": m.shown, "state": m.state, "last": m.last, "over": m.over,
        }  # fmt: skip
        try:
            with part_file(self.folder / CHECKPOINT) as part:
                torch.save(kept, part)
            if self.curve:
                save_curve(self.curve, self.folder)
                self.events.write(self.curve)
            save_pictured(self.policy(), self.folder / POLICY)
        except (OSError, RuntimeError) as fault:  # torch reports a full disk as RuntimeError
            if is_last:
                raise OSError(f"The run could not be saved ({fault}). Folder: {self.folder}") from fault
            self.say(f"could not save ({fault}); training goes on, the last checkpoint is as it was")

    def policy(self) -> PicturedNetwork:
        """What has been learned so far."""
        from importlib.metadata import PackageNotFoundError, version

        try:
            own = version("h3data")
        except PackageNotFoundError:  # a source tree on PYTHONPATH
            own = "source"
        s, updates = self.settings, len(self.curve)
        last = {k: self.curve[-1][k] for k in ("reward", "follows", "collided", "met")} if self.curve else {}
        pictured = {"arm_depth", "humanoid_detector"} & set(s.observations)
        return PicturedNetwork(
            card=PolicyCard(
                task="social_nav", robot=s.robot, observations=s.observations,
                picture_size=s.picture_size if pictured else None, hold=s.hold,
                training={
                    "recipe": self.name, "seed": self.seed, "updates": updates,
                    "decisions": updates * s.decisions_per_update, "steps": updates * s.decisions_per_update * s.hold,
                    "seconds": round(self.seconds, 1), "device": self.device, "torch": str(torch.__version__), "h3data": own,
                    "settings": s.as_dict(), "last_update": last,
                },
            ),
            arrays=self.learner.net.arrays(),
        )  # fmt: skip

    def _restore(self, kept: dict[str, Any]) -> None:
        learner, m = self.learner, self.learner.memory
        where = learner.worlds.device
        try:
            learner.net.load_state_dict(kept["net"])
            learner.optimizer.load_state_dict(kept["optimizer"])
            learner.dice.set_state(kept["dice"].cpu())
            for mine, theirs in zip(learner.worlds.play.tensors(), kept["play"], strict=True):
                mine.copy_(theirs)
            m.shown = {n: t.to(where) for n, t in kept["shown"].items()}
            m.state, m.last, m.over = (kept[n].to(where) for n in ("state", "last", "over"))
        except (KeyError, RuntimeError, ValueError) as fault:
            reason = str(fault).splitlines()[0]
            raise FormatError(f"The checkpoint does not fit ({reason}). File: {self.folder / CHECKPOINT}") from None
        self.curve, self.before_s, self.setups_s = kept["curve"], kept["seconds"], kept["setups_s"]


def _read(path: Path, settings: Settings, seed: int) -> dict[str, Any]:
    """A checkpoint of the same settings and seed."""
    try:
        kept = torch.load(path, map_location="cpu", weights_only=True)  # numbers only: nothing in it is executed
        then = kept["settings"] | {"seed": kept["seed"]}
        fits = kept["format"] == FORMAT
    except Exception as fault:  # torch raises whatever the bytes lead to
        raise FormatError(f"Expected a checkpoint of h3data train, this is none, or damaged ({type(fault).__name__}). "
                          f"Hint: --force begins anew. File: {path}") from None  # fmt: skip
    if not fits:
        raise FormatError(f"Expected a checkpoint {FORMAT}, got {kept['format']}. File: {path}")
    now = settings.as_dict() | {"seed": seed}
    other = [f"{n}={then.get(n)!r}, not {now[n]!r}" for n in now if n not in FREE and then.get(n) != now[n]]
    if other:
        raise InputError(
            f"The run in this folder has {'; '.join(other)}. Hint: name the same settings, or another folder."
        )
    return kept


def _share(settings: Settings, curve: list[Any], seconds: float, setups_s: float) -> float:
    """Progress, 0..1: by updates where their number is given, else by the time spent learning."""
    if settings.updates:
        return min(len(curve) / settings.updates, 1.0)
    return min(max((seconds - setups_s) / max(settings.minutes * 60 - setups_s - SPARE_S, 1e-9), 0.0), 1.0)


def _is_over(settings: Settings, curve: list[Any], seconds: float, setups_s: float) -> bool:
    return _share(settings, curve, seconds, setups_s) >= 1


def _is_finite(number: float) -> bool:
    return number == number and abs(number) != float("inf")


@contextmanager
def _stop_asked() -> Iterator[threading.Event]:
    """Set by Ctrl-C or SIGTERM, so that an update is finished and saved; a second one ends the process at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}

    def ask(number: int, frame: Any) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, ask)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _one_thread(device: str) -> Iterator[None]:
    """On the CPU, one thread: the tensors are small, and beside other work several threads wait for each other most of the
    time (145 decisions a second instead of 6,000)."""
    threads = torch.get_num_threads()
    if device == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def describe(settings: Settings) -> str:
    """The settings for people, as JSON in lines."""
    return json.dumps(settings.as_dict(), indent=1)
