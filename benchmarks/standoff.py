"""Stand-offs of rearrangement: how often two agents keep each other from getting on, and how long an episode takes.

A stand-off is `STEPS` consecutive steps within `WITHIN_M` of each other in which an agent has something to do, neither
completes a skill, and neither shortens the path to where it is going (on the floor) by more than `GETS_ON_M`. The homes are
``small:0`` to ``small:9``, in turn. In half of the episodes a robot plays ``complement`` beside a person who plans to
bring ``both`` objects. In the others, somebody drives the robot into the doorways of the home and stops for `PARKED_STEPS`
in each.

    python -m benchmarks.standoff 300 --first 5000 -o out/standoff.jsonl    # `make bench` takes 40, from seed 0

A second call with the same file plays only the seeds that are not in it; remove it after a change of the rules.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import load_humanoid
from h3data.geometry import heading_from_quat, wrap_angle
from h3data.recording import Recording
from h3data.scene import FreeSpace, Scene
from h3data.scene.open import named_scenes, open_free_space, open_scene
from sim_kinematic.agents.person_clearance import reach_room
from sim_kinematic.agents.person_skills import HANDS
from sim_kinematic.agents.skills import ALL_SKILLS, CONTROL, Action
from sim_kinematic.agents.stands import person_stands
from sim_kinematic.avoidance.routes import FloorRoutes
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.policies.views import RearrangeView
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode, RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange, solo_steps_of
from sim_kinematic.tasks.runner import simulate

Emit = Callable[[str, float, str], None]
EPISODES, HOMES = 40, 10
STEPS, WITHIN_M, GETS_ON_M = 300, 2.5, 1.0
PARKED_STEPS, PATIENCE_STEPS = 450, 150
STOPS_M = 1.5
"""Whoever drives the robot stops when the person is nearer than this."""
NAVIGATES = {ALL_SKILLS.index("nav_to_object"): False, ALL_SKILLS.index("nav_to_goal"): True}
"""Whether a skill goes to where its object belongs."""
LOOKS_STEPS = 10
WAIT = ALL_SKILLS.index("wait")


def run(emit: Emit, episodes: int = EPISODES) -> None:
    """Emits ``standoff.rearrange.*``, of all episodes and of those in which the robot was driven or planned."""
    report(emit, played(range(episodes)))


def played(seeds: Iterable[int], file: Path | None = None) -> Iterator[dict[str, Any]]:
    """Plays episodes; those that a file has already are taken from there, the others are added to it."""
    known: dict[int, dict[str, Any]] = {}
    if file is not None and file.exists():
        known = {row["seed"]: row for row in map(json.loads, file.read_text().splitlines())}
    for seed in seeds:
        if seed not in known:
            driven = is_driven(seed)
            recording, alone = play(seed, driven=driven)
            known[seed] = {
                "seed": seed, "home": f"small:{seed % HOMES}", "driven": driven, "steps": len(recording), "alone": alone,
                "ended": recording.episode.info["ended"], "stand_offs": stand_offs(recording, _home(seed % HOMES)[1]),
                "shut": shut_steps(recording, *_home(seed % HOMES)) if driven else 0,
            }  # fmt: skip
            if file is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                with file.open("a") as lines:
                    lines.write(json.dumps(known[seed]) + "\n")
        yield known[seed]


def report(emit: Emit, episodes: Iterable[dict[str, Any]]) -> None:
    """Emits every stand-off, then counts and ratios of some episodes."""
    rows = []
    for row in episodes:
        rows.append(row)
        for first, last in row["stand_offs"]:
            what = f"{'driven' if row['driven'] else 'planned'}.{row['home']}.seed_{row['seed']}.from_{first}"
            emit(f"standoff.rearrange.episode.{what}", last - first, "steps")
    for name, kinds in {"": (False, True), "planned.": (False,), "driven.": (True,)}.items():
        some = [row for row in rows if row["driven"] in kinds]
        if not some:
            continue
        ratios = [row["steps"] / row["alone"] for row in some]
        emit(f"standoff.rearrange.{name}episodes", len(some), "episodes")
        emit(f"standoff.rearrange.{name}homes", len({row["home"] for row in some}), "homes")
        emit(f"standoff.rearrange.{name}count", sum(len(row["stand_offs"]) for row in some), "stand-offs")
        emit(f"standoff.rearrange.{name}successes", sum(row["ended"] == "success" for row in some), "episodes")
        emit(f"standoff.rearrange.{name}p95_ratio", float(np.percentile(ratios, 95)), "x alone")
        ratios = [(row["steps"] - row["shut"]) / row["alone"] for row in some]
        emit(f"standoff.rearrange.{name}p95_ratio_while_open", float(np.percentile(ratios, 95)), "x alone")


def is_driven(seed: int) -> bool:
    """Whether the robot of an episode is driven: in every second round of the homes."""
    return seed // HOMES % 2 == 1


def play(seed: int, *, driven: bool = False) -> tuple[Recording, int]:
    """One episode, and the steps that its person takes alone."""
    scene, free = _home(seed % HOMES)
    episode = Rearrange().episode(scene, seed=seed, free=free)
    robot = Parked(free, seed) if driven else "complement"
    assert isinstance(episode, RearrangeEpisode)
    recording = simulate(Rearrange(), episode, {"robot": robot, "human": "both"})
    return recording, solo_steps_of(episode)


def stand_offs(recording: Recording, free: FreeSpace) -> list[tuple[int, int]]:
    """First and last step of every stand-off of two agents."""
    columns, steps = recording.columns, len(recording)
    near = columns["metrics.dist_agents"] <= WITHIN_M
    busy = np.zeros(steps, np.bool_)
    done = np.zeros(steps, np.bool_)
    for span in recording.skills:
        done[span.end_step] |= span.outcome == "done" and span.name not in ("wait", "control")
    lefts, legs = [], []
    for k in range(2):
        skill, target = columns[f"agent_{k}.skill"], columns[f"agent_{k}.skill_target"]
        xz = columns[f"agent_{k}.base_pose"][:, [0, 2]].astype(np.float64)
        lefts.append(_left(recording, free, xz, skill, target))
        changes = np.diff(skill * 1000 + target, prepend=-1) != 0
        legs.append(np.maximum.accumulate(np.where(changes, np.arange(steps), 0)))  # first step with this goal
        busy |= ~np.isin(skill, (WAIT, ALL_SKILLS.index(CONTROL)))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]]).astype(int)))
    found: list[tuple[int, int]] = []
    for begin, end in edges.reshape(-1, 2).tolist():
        first = begin
        while first <= end - STEPS:
            gets_on = done[first:end].copy()
            for left, leg in zip(lefts, legs, strict=True):
                since = np.maximum(leg[first:end], first)
                with np.errstate(invalid="ignore"):  # infinite where it goes nowhere
                    gets_on |= left[since] - left[first:end] > GETS_ON_M
            lasts = int(gets_on.argmax()) if gets_on.any() else end - first
            if lasts >= STEPS and busy[first : first + lasts].mean() > 0.5:
                found.append((first, first + lasts - 1))
                first += lasts
            else:
                first += 1
    return found


def _left(recording: Recording, free: FreeSpace, xz: NDArray, skill: NDArray, target: NDArray) -> NDArray[np.float64]:
    """Length of the path from every place [T, 2] to where the agent is going [m], [T]; infinite where it goes nowhere."""
    left = np.full(len(xz), np.inf)
    goals = [goal["position"] for goal in recording.episode.info["goals"]]
    for number, to_goal in NAVIGATES.items():
        for k, goal in enumerate(goals):
            at = np.flatnonzero((skill == number) & (target == k))
            ends = np.tile(np.array(goal), (len(at), 1)) if to_goal else recording.columns["object_pose"][at, k, :3]
            if len(at):
                left[at] = free.geodesic(xz[at], ends[:, [0, 2]].astype(np.float64), max_snap_m=2.0)
    return left


def shut_steps(recording: Recording, scene: Scene, free: FreeSpace) -> int:
    """Steps in which no way led the person around the robot, as it stood, to any place from which a hand gets to where they
    were going: no rule of giving way helps against these. Looked at in every `LOOKS_STEPS`-th step."""
    columns, goals = recording.columns, [goal["position"] for goal in recording.episode.info["goals"]]
    body = load_humanoid(recording.agents[1].model.removeprefix("humanoid/"))
    routes, room, shut = FloorRoutes.of(free), reach_room(scene, body, free.floor_y), 0
    places: dict[tuple[float, ...], NDArray[np.float64]] = {}
    for step in range(0, len(recording), LOOKS_STEPS):
        skill, k = int(columns["agent_1.skill"][step]), int(columns["agent_1.skill_target"][step])
        if skill not in NAVIGATES:
            continue
        end = np.asarray(goals[k] if NAVIGATES[skill] else columns["object_pose"][step, k, :3], np.float64)
        key = tuple(end.round(2).tolist())
        if key not in places:
            stands = [(stand, hand) for hand in HANDS for stand in person_stands(free, body, end, hand)]
            places[key] = np.array([s[:2] for s, hand in stands if room.is_clear(s, end, hand)]).reshape(-1, 2)
        robot, person = (columns[f"agent_{n}.base_pose"][step].astype(np.float64) for n in range(2))
        heading = float(heading_from_quat(robot[3:]))
        along = np.array([np.cos(heading), -np.sin(heading)])
        radius = AVOIDANCE.robot.radius_m + AVOIDANCE.person.radius_m
        discs = np.array([(*(robot[[0, 2]] + offset * along), radius) for offset in AVOIDANCE.robot.offsets_m])
        alone, around = (routes.flood(person[[0, 2]], them).reaches(places[key]) for them in (discs[:0], discs))
        shut += bool(alone.any() and not around.any())
    return min(shut * LOOKS_STEPS, len(recording))


@dataclass
class Parked:
    """Somebody who drives a robot from doorway to doorway and stops in each. Whoever is in the way is waited for, for
    `PATIENCE_STEPS`; then comes the next doorway."""

    free: FreeSpace
    seed: int
    _goal: NDArray[np.float64] | None = None
    _parked: int = 0
    _waited: int = 0
    _visits: int = 0
    _doorways: list[NDArray[np.float64]] = field(default_factory=list)

    def act(self, view: RearrangeView) -> Action:
        """The command of one step."""
        if not self._doorways:
            self._doorways = narrow_places(self.free)
        if self._goal is None:
            self._goal = self._doorways[(self.seed + self._visits) % len(self._doorways)]
        length, waypoint = self.free.first_leg(view.xz, self._goal, beyond_m=0.1, max_snap_m=1.0)
        if length < 0.15 or not np.isfinite(length) or self._parked:
            self._parked += 1
            if self._parked > PARKED_STEPS:
                self._goal, self._parked, self._visits = None, 0, self._visits + 1
            return _drives(view, 0.0, 0.0)
        dx, dz = waypoint - view.xz
        error = float(wrap_angle(np.arctan2(-dz, dx) - view.heading))
        if float(np.hypot(*(view.other_xz - view.xz))) < STOPS_M:
            self._waited += 1
            if self._waited > PATIENCE_STEPS:
                self._goal, self._waited, self._visits = None, 0, self._visits + 1
            return _drives(view, 0.0, 0.0)
        return _drives(view, 0.4 * max(0.0, float(np.cos(error))) ** 4, float(np.clip(3 * error, -1, 1)))


def _drives(view: RearrangeView, forward: float, turn: float) -> Action:
    return Action(CONTROL, command=np.array([forward, turn, *np.zeros(len(view.arm) + 1)]))


def narrow_places(free: FreeSpace) -> list[NDArray[np.float64]]:
    """Floor points [2] through which most paths between places of a home lead, a metre or more apart, in that order."""
    rng = np.random.default_rng(0)
    ends = free.sample(rng, 60)
    points = []
    for a, b in zip(ends[::2], ends[1::2], strict=True):
        path = free.path(a, b, max_snap_m=1.0)
        for p, q in pairwise(path):
            points.append(np.linspace(p, q, 2 + int(np.hypot(*(q - p)) / 0.1)))
    dots = np.concatenate(points)
    around = np.stack(np.meshgrid(*[np.linspace(-0.3, 0.3, 7)] * 2), axis=-1).reshape(-1, 2)
    tries = dots[:, None] + around
    room = free.signed_distance(tries.reshape(-1, 2)).reshape(len(dots), -1)
    dots = tries[np.arange(len(dots)), room.argmax(axis=1)][room.max(axis=1) < 0.65]  # the middle of a doorway
    crowd = np.array([(np.hypot(*(dots - dot).T) < 0.4).sum() for dot in dots])
    places: list[NDArray[np.float64]] = []
    for k in np.argsort(-crowd, kind="stable"):
        if all(np.hypot(*(dots[k] - place)) > 1.0 for place in places):
            places.append(dots[k])
    return places[:4]


@lru_cache(maxsize=HOMES)
def _home(index: int) -> tuple[Scene, FreeSpace]:
    (named,) = named_scenes(f"small:{index}")
    spec = RearrangeSpec()
    return open_scene(named.source), open_free_space(named.source, spec.agent_radius_m, spec.agent_height_m)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.standoff", description="Counts stand-offs.")
    parser.add_argument("episodes", type=int, nargs="?", default=EPISODES)
    parser.add_argument("--first", type=int, default=0, help="seed of the first episode, the others follow")
    parser.add_argument("-o", "--out", type=Path, help="a file of a line per episode, with which a second call goes on")
    given = parser.parse_args()
    report(
        lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True),
        played(range(given.first, given.first + given.episodes), given.out),
    )
