"""Causes of contact between the robot and the person in social navigation, each changed alone.

``python -m benchmarks.studies.contact_causes --scenes h3-homes/val --episodes 96 --seed 41`` plays the same episodes of the
paper's rules once for each variant and prints S, SPS, F and CR, with what the contacts were like.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from h3data.metrics import measure
from h3data.recording import Recording
from h3data.stats.intervals import wilson_interval
from h3data_pipelines.jobs.evaluation_runs import EvaluationRequest
from sim_kinematic.motion.spec import HOME_BASE, HOME_WALKER, STEP_S, BaseSpec, SocialNavSpec, WalkerSpec
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.social_nav import EXPERT, heuristic_expert, next_waypoint
from sim_kinematic.policies.views import SocialNavView

TURNS_ABOVE_RAD = 0.1
"""Habitat's navigation skill turns on the spot above this error of heading (spec/habitat.md 1.6)."""
METRICS = ("S", "SPS", "F", "CR", "BYR", "TD", "FD")


def turns_then_drives(view: SocialNavView, spec: BaseSpec) -> Velocity:
    """Return the heuristic expert, but it approaches as Habitat's navigation skill: it turns on the spot or drives at
    full speed.
    """
    if not np.isfinite(view.geodesic_m) or view.geodesic_m <= EXPERT.keep_distance_m:
        return heuristic_expert(view, spec)
    dx, dz = next_waypoint(view, spec) - view.robot_xz
    error = float((np.arctan2(-dz, dx) - view.robot_heading + np.pi) % (2 * np.pi) - np.pi)
    if abs(error) > TURNS_ABOVE_RAD:
        return Velocity(0.0, float(np.clip(error / (spec.max_turn_rad_s * STEP_S), -1, 1)), "find")
    gap = (view.geodesic_m - EXPERT.keep_distance_m) / (spec.max_speed_mps * STEP_S)
    return Velocity(min(gap, 1.0), 0.0, "find")


def backs_at_full_speed(view: SocialNavView, spec: BaseSpec) -> Velocity:
    """Return the heuristic expert, but within 1.5 m it always backs at full speed, where the other only restores the
    distance.
    """
    told = heuristic_expert(view, spec)
    return told._replace(forward=-1.0) if told.forward < 0 else told


class Variant(NamedTuple):
    """Differences from the rules that all variants share."""

    about: str
    rules: Mapping[str, Any]
    policy: str = "heuristic_expert"


BEFORE = {"robot": HOME_BASE, "human": HOME_WALKER, "person_contact": "body"}
"""Rules of ``--rules paper`` before the causes of contacts were known; each variant changes them."""
PAPER_BASE, PAPER_WALKER, BONES = {"robot": BaseSpec()}, {"human": WalkerSpec()}, {"person_contact": "bones"}
OWN = "benchmarks.studies.contact_causes:"
VARIANTS = {
    "before": Variant("whole bodies, base of three discs, people keep clear of walls", {}),
    "bones": Variant("people collide with boxes along their bones", BONES),
    "base": Variant("the paper's base: two discs, centre and front", PAPER_BASE),
    "slide": Variant("the same, which slides as Habitat's", {"robot": BaseSpec(slide="habitat")}),
    "walker": Variant("people on shortest paths, which cut corners", PAPER_WALKER),
    "driving": Variant("turns on the spot, then drives, as Habitat's skill", {}, f"{OWN}turns_then_drives"),
    "backing": Variant("backs at full speed", {}, f"{OWN}backs_at_full_speed"),
    "bones+base": Variant("bones and the paper's base", {**BONES, **PAPER_BASE}),
    "bones+base+walker": Variant("bones, the paper's base, shortest paths", {**BONES, **PAPER_BASE, **PAPER_WALKER}),
    "all": Variant(
        "the same, sliding as Habitat's",
        {**BONES, "robot": BaseSpec(slide="habitat"), **PAPER_WALKER},
    ),
    "all+driving": Variant(
        "and turns on the spot, then drives",
        {**BONES, "robot": BaseSpec(slide="habitat"), **PAPER_WALKER},
        f"{OWN}turns_then_drives",
    ),
    "all+backing": Variant(
        "all, and backs at full speed",
        {**BONES, "robot": BaseSpec(slide="habitat"), **PAPER_WALKER},
        f"{OWN}backs_at_full_speed",
    ),
}


def contact_of(recording: Recording) -> dict[str, float]:
    """Return data of the step of contact: whether the robot was told to back, whether its base was against an obstacle,
    and the speed at which the person came nearer [m/s].
    """
    robot, person = (recording.agent_column(k, "base_pose")[-2:, [0, 2]].astype(np.float64) for k in (0, 1))
    towards = person[0] - robot[0]
    towards /= max(float(np.hypot(*towards)), 1e-9)
    return {
        "backs": float(recording.columns["agent_0.action"][-1][0] < 0),
        "at_wall": float(recording.columns["metrics.robot_contact"][-1]),
        "person_mps": -float((person[1] - person[0]) @ towards) / STEP_S,
    }


def play(job: Any, variant: Variant) -> dict[str, float]:
    """Return the metrics of one episode, and of its contact if it ends in one."""
    spec = replace(job.spec, **{**BEFORE, **variant.rules})
    recording = replace(job, spec=spec, policy=variant.policy).record()
    values = measure(recording).to_dict()["values"]
    found = {name: np.nan if values[name] is None else float(values[name]) for name in METRICS}
    return {**found, **(contact_of(recording) if found["CR"] else {})}


def summary(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Return the means over episodes, with the 95% interval of CR, and shares of contacts."""
    means: dict[str, Any] = {name: float(np.nanmean([row[name] for row in rows])) for name in METRICS}
    hits = [row for row in rows if "at_wall" in row]
    means["CR_interval"] = [float(v) for v in wilson_interval(len(hits), len(rows))]
    for name, holds in _KINDS.items():
        means[name] = sum(map(holds, hits)) / max(len(hits), 1)
    return {**means, "episodes": len(rows)}


_KINDS: Mapping[str, Callable[[dict[str, float]], bool]] = {
    "backs_at_wall": lambda hit: bool(hit["backs"] and hit["at_wall"]),
    "person_comes": lambda hit: hit["person_mps"] > 0.1,
}
"""Shares of contacts in which the robot backs away but is at a wall, and in which the person walks at it."""


def main() -> None:
    """Play and prints, one line of JSON for each variant and then a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", default="h3-homes/val", help="homes, as for h3data evaluate")
    parser.add_argument("--homes", type=int, default=12, help="number of homes of a preset")
    parser.add_argument("--episodes", type=int, default=120)
    parser.add_argument("--seed", type=int, default=41)
    parser.add_argument("--variants", default=",".join(VARIANTS))
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    request = EvaluationRequest(
        task="social_nav",
        policies=("heuristic_expert",),
        scenes=(args.scenes,),
        episodes=args.episodes,
        homes=args.homes,
        seed=args.seed,
        rules="paper",
    )
    jobs = [evaluation.base for evaluation in request.jobs()]
    assert all(isinstance(job.spec, SocialNavSpec) for job in jobs)
    with ProcessPoolExecutor(args.workers) as pool:
        for name in args.variants.split(","):
            rows = list(pool.map(partial(play, variant=VARIANTS[name]), jobs, chunksize=4))
            print(json.dumps({"variant": name, "scenes": args.scenes, "seed": args.seed, **summary(rows)}), flush=True)


if __name__ == "__main__":
    main()
