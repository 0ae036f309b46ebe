"""Command ``h3data plan``, which forecasts the duration, cost and bottleneck of a job on many cores."""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from h3data.commands.command import JsonFlag, Outcome
from h3data.errors import InputError
from h3data_pipelines.machine.costs import FRAMES, Costs, measure_costs
from h3data_pipelines.machine.schedule import Workload, simulate_schedule

_CORES = (1, 2, 10, 100, 1_000, 10_000)


@dataclass(frozen=True)
class Plan:
    """Forecast the time, CPU hours, price, size and bottleneck of a job of h3data generate on many cores.

    The costs of an episode are measured on this machine in half a minute, as CPU time, or come from a file of an earlier
    measurement; the schedule is simulated shard by shard. Only the costs are measured; the results are forecasts.

    Examples:
        h3data plan social_nav --measure
        h3data plan social_nav --episodes 1000000 --cores 1000
        h3data plan social_nav --episodes 1000000 --cores 10000 --datasets 100 --camera robot_arm
        h3data plan rearrange --costs costs.json --cores 1000 --price 0.01
    """

    task: tyro.conf.Positional[str]
    """Task of the job: social_nav, rearrange, wander, or an installed task."""
    episodes: int = 100_000
    cores: int = 1000
    """Number of cores of the cluster; the table also shows smaller numbers."""
    datasets: int = 1
    """Number of datasets into which the job is divided, each written by its own command."""
    scenes: int = 37
    """Number of different homes (h3-homes/train has 37)."""
    steps: float | None = None
    """Mean length of an episode [steps] (default: the measured length)."""
    cameras: tuple[str, ...] = ()
    """Cameras whose videos are added: robot_arm, human_head or top_down."""
    price: float = 0.02
    """Price of a core for an hour, in your currency; spot prices vary by region and day."""
    lost_nodes: float = 0.05
    """Share of the nodes that fail in an hour, as spot machines do; each failure costs half a shard, one start and
    the preparation of homes.
    """
    costs: Path | None = None
    """File with costs that `h3data plan TASK --measure --json` printed (default: costs are measured now)."""
    measure: bool = False
    """Only measure and print the costs."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return the forecast for several numbers of cores, or the costs measured on this machine."""
        for name in ("episodes", "cores", "datasets", "scenes"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name} must be at least 1, got {getattr(self, name)}.", code="H3-MACHINE-017")
        if strangers := [name for name in self.cameras if name not in FRAMES]:
            raise InputError(
                f"--camera: expected some of {', '.join(FRAMES)}, got {', '.join(strangers)}.", code="H3-MACHINE-015"
            )
        costs = self._costs()
        if self.measure:
            return Outcome(text=_costs_text(costs), data={"costs": costs.to_json()})
        rows = [self._row(costs, cores) for cores in sorted({*(n for n in _CORES if n < self.cores), self.cores})]
        data = {"costs": costs.to_json(), "episodes": self.episodes, "datasets": self.datasets, "rows": rows}
        return Outcome(text=self._text(costs, rows), data=data)

    def _costs(self) -> Costs:
        if self.costs is None:
            return measure_costs(self.task)
        try:
            costs = Costs.from_json(json_module.loads(self.costs.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise InputError(f"Cannot read the costs ({error}): {self.costs}", code="H3-MACHINE-018") from None
        if costs.task != self.task:
            raise InputError(
                f"Expected costs of {self.task}, these are of {costs.task}: {self.costs}", code="H3-MACHINE-016"
            )
        return costs

    def _row(self, costs: Costs, cores: int) -> dict[str, Any]:
        steps = costs.steps if self.steps is None else self.steps
        frames = sum(costs.frame_s[name] for name in self.cameras)
        shard_s = costs.episode_s + steps * (costs.step_s + frames)
        load = Workload(
            shards=self.episodes,
            shard_s=shard_s,
            scenes=self.scenes,
            scene_s=costs.scene_s,
            start_s=costs.start_s,
            driver_s=costs.driver_s * steps / costs.steps,
        )
        went = simulate_schedule(load, cores, datasets=min(self.datasets, cores))
        deaths = self.lost_nodes * cores * went.seconds / 3600
        again_s = deaths * (shard_s / 2 + costs.start_s + min(self.scenes, self.episodes / cores) * costs.scene_s)
        hours = (went.cpu_s + again_s) / 3600
        return {
            "cores": cores,
            "seconds": went.seconds + again_s / cores,
            "busy": went.cpu_s / (cores * went.seconds),
            "speedup": went.speedup,
            "core_hours": cores * went.seconds / 3600 + again_s / 3600,
            "cpu_hours": hours,
            "price": (cores * went.seconds + again_s) / 3600 * self.price,
            "held_up_by": went.held_up_by,
        }

    def _text(self, costs: Costs, rows: list[dict[str, Any]]) -> str:
        lines = [
            _costs_text(costs),
            "",
            f"{self.episodes:,} episodes into {self.datasets} dataset{'s' if self.datasets > 1 else ''}, "
            f"{self.episodes * costs.episode_bytes / 1e9:.1f} GB without videos (forecast)",
            f"{'cores':>7}{'time':>16}{'speed-up':>10}{'busy':>7}{'core hours':>12}{'price':>10}  held up by",
        ]
        lines += [
            f"{row['cores']:>7,}{_duration(row['seconds']):>16}{row['speedup']:>10,.0f}{row['busy']:>7.0%}"
            f"{row['core_hours']:>12,.1f}{row['price']:>10,.2f}  {row['held_up_by']}"
            for row in rows
        ]
        if rows[-1]["held_up_by"] == "writer":
            lines.append(
                "One process writes a dataset: cut the job with --datasets N, and give each its own --seed and -o."
            )
        return "\n".join(lines)


def _costs_text(costs: Costs) -> str:
    million = 1e6 / 3600
    per_episode = (costs.episode_s / costs.steps + costs.step_s) * million
    lines = [
        f"{costs.task}, core hours for a million steps (mean length {costs.steps:.0f}):",
        f"  simulate {per_episode:.3f}",
        *(f"  render {name} {FRAMES[name]} {seconds * million:.2f}" for name, seconds in costs.frame_s.items()),
        f"  metrics {costs.metrics_s / costs.steps * million:.4f}",
        f"  store {costs.driver_s / costs.steps * million:.4f} (one process for each dataset)",
        f"a worker starts in {costs.start_s:.1f} s, a home costs {costs.scene_s:.2f} s once, an episode takes "
        f"{costs.episode_bytes / 1e3:.0f} kB",
    ]
    return "\n".join(lines)


def _duration(seconds: float) -> str:
    hours, rest = divmod(round(seconds), 3600)
    return f"{hours:,} h {rest // 60:02d} min" if hours else f"{rest // 60} min {rest % 60:02d} s"
