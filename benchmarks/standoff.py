"""Stand-offs of rearrangement: how often two agents keep each other from getting on, and how long an episode takes.

A stand-off is `STEPS` consecutive steps within `WITHIN_M` of each other in which an agent has something to do, neither
completes a skill, and neither shortens the path to where it is going (on the floor) by more than `GETS_ON_M`. Somebody
who drives is going to their errand. The homes are ``small:0`` to ``small:9``, in turn. In half of the episodes a robot
plays ``complement`` beside a person who plans to bring ``both`` objects. In the others, somebody drives the robot:

* `Errands` (``driven.*``): they go from place to place, stop in doorways for 2 to 8 s, look around, and go on where
  somebody waits. At most 1.6 times the steps of the person alone is asked of these episodes, at the 95th percentile: 1.52
  in 150 episodes of unseen seeds, without a stand-off.
* `Parks` (``parked.*``, ``--driver parks``): they drive from doorway to doorway and stay in each for 15 s, whoever waits. No
  rule of giving way helps a planner while every way is shut, so ``p95_ratio_while_open`` leaves those steps out. In the 56
  episodes played, 1.76 times the steps of the person alone, 1.17 times while a way was open.

    python -m benchmarks.standoff 300 --first 6000 --workers 2 -o out/standoff.jsonl    # `make bench` takes 40, from seed 0
    python -m benchmarks.standoff 300 --first 6000 --workers 2 -o out/standoff.jsonl --driver parks

A second call with the same file plays only the episodes that are not in it; remove it after a change of the rules. An episode
takes a core 2 to 4 s.
"""

from __future__ import annotations

import argparse
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import load_humanoid
from h3data.bodies.people.reach import Hand
from h3data.geometry import heading_from_quat, wrap_angle
from h3data.recording import Recording
from h3data.scene import FreeSpace, Scene
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data_pipelines.execution.processes import Processes
from sim_kinematic.agents.person_clearance import reach_room
from sim_kinematic.agents.person_skills import HANDS
from sim_kinematic.agents.skills import ALL_SKILLS, CONTROL, Action
from sim_kinematic.agents.stands import person_stands
from sim_kinematic.avoidance.routes import FloorRoutes, distance_to_path, first_of_path
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.policies.views import RearrangeView
from sim_kinematic.tasks.rearrange.codec import solo_steps_of
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode, RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import simulate

Emit = Callable[[str, float, str], None]
EPISODES, HOMES = 40, 10
STEPS, WITHIN_M, GETS_ON_M = 300, 2.5, 1.0
PATIENCE_STEPS = 150
"""Number of steps for which a driver waits while another agent blocks the path."""
DOORWAY_STEPS, STAYS_STEPS, LOOKS_AROUND_STEPS = (60, 240), (90, 300), 300
"""Ranges of steps that a driver with errands stays in a doorway, stays at an errand, and drives between looks around."""
NOTICES_M, MEETS_M, BESIDE_M, MEETS_STEPS = 4.0, 1.5, 0.8, 60
"""Distances [m] at which a driver notices a waiting agent, lets an agent pass, and counts an agent as beside the path;
and number of steps for which they let it pass."""
PARKED_STEPS, STOPS_M = 450, 1.5
"""Number of steps that a parking driver stays in a doorway, and distance to the person below which they stop [m]."""
NAVIGATES = {ALL_SKILLS.index("nav_to_object"): False, ALL_SKILLS.index("nav_to_goal"): True}
"""Whether a skill goes to where its object belongs."""
LOOKS_STEPS = 10
WAIT = ALL_SKILLS.index("wait")
PLANS = "plans"
LINES = {PLANS: "planned.", "errands": "driven.", "parks": "parked."}
"""Names of lines, by who moves the robot."""


def run(emit: Emit, episodes: int = EPISODES) -> None:
    """Emit ``standoff.rearrange.*``, of all episodes and by who moves the robot."""
    report(emit, played(range(episodes)))
    report(emit, played(filter(is_driven, range(episodes)), driver="parks"))


def played(
    seeds: Iterable[int], file: Path | None = None, *, driver: str = "errands", workers: int = 1
) -> Iterator[dict[str, Any]]:
    """Play episodes in some processes; those that a file has already are taken from there, the others are added to it."""
    jobs = [(seed, driver if is_driven(seed) else PLANS) for seed in seeds]
    known: dict[tuple[int, str], dict[str, Any]] = {}
    if file is not None and file.exists():
        known = {(row["seed"], row["robot"]): row for row in map(json.loads, file.read_text().splitlines())}
    yield from (known[job] for job in jobs if job in known)
    for row in Processes(workers).run(_row, [job for job in jobs if job not in known]):
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            with file.open("a") as lines:
                lines.write(json.dumps(row) + "\n")
        yield row


def _row(job: tuple[int, str]) -> dict[str, Any]:
    seed, robot = job
    scene, free = _home(seed % HOMES)
    recording, alone, driver = play(seed, robot)
    errands = None if driver is None else driver.errands
    return {
        "seed": seed,
        "home": f"small:{seed % HOMES}",
        "robot": robot,
        "steps": len(recording),
        "alone": alone,
        "ended": recording.episode.info["ended"],
        "stand_offs": stand_offs(recording, free, errands),
        "doorway_stops": 0 if driver is None else driver.doorway_stops,
        "shut": 0 if robot == PLANS else shut_steps(recording, scene, free),
    }


def report(emit: Emit, episodes: Iterable[dict[str, Any]]) -> None:
    """Emit every stand-off, then counts and ratios of some episodes."""
    rows = []
    for row in episodes:
        rows.append(row)
        for first, last in row["stand_offs"]:
            what = f"{LINES[row['robot']]}{row['home']}.seed_{row['seed']}.from_{first}"
            emit(f"standoff.rearrange.episode.{what}", last - first, "steps")
    by_robot = {line: [row for row in rows if row["robot"] == robot] for robot, line in LINES.items()}
    together = {"": rows} if sum(map(bool, by_robot.values())) > 1 else {}
    for name, some in (together | by_robot).items():
        if not some:
            continue
        ratios = [row["steps"] / row["alone"] for row in some]
        emit(f"standoff.rearrange.{name}episodes", len(some), "episodes")
        emit(f"standoff.rearrange.{name}homes", len({row["home"] for row in some}), "homes")
        emit(f"standoff.rearrange.{name}count", sum(len(row["stand_offs"]) for row in some), "stand-offs")
        emit(f"standoff.rearrange.{name}successes", sum(row["ended"] == "success" for row in some), "episodes")
        emit(f"standoff.rearrange.{name}doorway_stops", sum(row["doorway_stops"] for row in some), "stops")
        emit(f"standoff.rearrange.{name}shut_share", _share(some, "shut"), "of all steps")
        emit(f"standoff.rearrange.{name}p95_ratio", float(np.percentile(ratios, 95)), "x alone")
        ratios = [(row["steps"] - row["shut"]) / row["alone"] for row in some]
        emit(f"standoff.rearrange.{name}p95_ratio_while_open", float(np.percentile(ratios, 95)), "x alone")


def _share(rows: list[dict[str, Any]], name: str) -> float:
    return sum(row[name] for row in rows) / sum(row["steps"] for row in rows)


def is_driven(seed: int) -> bool:
    """Return whether the robot of an episode is driven, as in every second round of the homes."""
    return seed // HOMES % 2 == 1


def play(seed: int, robot: str = PLANS) -> tuple[Recording, int, Errands | Parks | None]:
    """Return one episode, the steps that its person takes alone, and who drove the robot."""
    scene, free = _home(seed % HOMES)
    episode = Rearrange().episode(scene, seed=seed, free=free)
    driver = DRIVERS[robot](free, seed) if robot in DRIVERS else None
    assert isinstance(episode, RearrangeEpisode)
    recording = simulate(Rearrange(), episode, {"robot": driver or "complement", "human": "both"})
    return recording, solo_steps_of(Rearrange(), episode), driver


def stand_offs(
    recording: Recording, free: FreeSpace, errands: Sequence[tuple[int, float]] | None = None
) -> list[tuple[int, int]]:
    """Return first and last step of every stand-off of two agents.

    Args:
        recording: The episode; agent 0 is the robot.
        free: Its floor.
        errands: Of a robot that somebody drives, the number of their errand at each step, and the length of the path
            that is left of it [m], NaN where none leads there: they get on if it becomes shorter, as others do.
    """
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
        if k == 0 and errands is not None:
            numbers, lengths = np.array(errands[:steps], np.float64).reshape(-1, 2).T
            lefts[0] = lengths
            changes = np.diff(numbers, prepend=-1) != 0
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
    """Return the length of the path from every place [T, 2] to the agent's goal [m], [T]; infinite without a goal."""
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
    """Return steps in which no way led the person around the robot, as it stood, to any place from which a hand gets to
    where they were going: no rule of giving way helps against these. Looked at in every `LOOKS_STEPS`-th step.
    """
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
            stands: list[tuple[NDArray[np.float64], Hand]] = []
            for hand in HANDS:
                stands.extend((stand, hand) for stand in person_stands(free, body, end, hand))
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
class Driver(ABC):
    """Driver of a robot from place to place, in place of a person at the controls."""

    free: FreeSpace
    seed: int
    doorway_stops: int = 0
    _goal: NDArray[np.float64] | None = None
    _stands: int = 0
    """Number of steps for which the driver still stands."""
    _turns: float = 0.0
    """Turn command while the driver stands and looks around."""
    _speed: float = 0.0
    """Forward command while the driver backs out."""
    _waited: int = 0
    _doorways: list[NDArray[np.float64]] = field(default_factory=list)
    errands: list[tuple[int, float]] = field(default_factory=list)
    """At each step the number of the errand, and the length of the path that is left of it [m]; NaN without one."""
    _number: int = 0

    def act(self, view: RearrangeView) -> Action:
        """Return the command of one step."""
        action = self._decide(view)
        goal = self._goal
        left = np.nan if goal is None else float(self.free.geodesic(view.xz[None], goal[None], max_snap_m=1.0)[0])
        self.errands.append((self._number, left if np.isfinite(left) else np.nan))
        return action

    @abstractmethod
    def _decide(self, view: RearrangeView) -> Action: ...

    def __post_init__(self) -> None:
        self._doorways = narrow_places(self.free)
        self._rng = np.random.default_rng(self.seed)

    def _heads_for(self, goal: NDArray[np.float64] | None) -> None:
        self._goal, self._stands, self._turns, self._speed, self._waited = goal, 0, 0.0, 0.0, 0
        self._number += 1

    def _drive_on(self, view: RearrangeView) -> tuple[float, Action]:
        """Return the length of the path that is left [m], and the command that follows it."""
        assert self._goal is not None
        length, waypoint = self.free.first_leg(view.xz, self._goal, beyond_m=0.1, max_snap_m=1.0)
        dx, dz = waypoint - view.xz
        error = float(wrap_angle(np.arctan2(-dz, dx) - view.heading))
        return length, _drives(view, 0.4 * max(0.0, float(np.cos(error))) ** 4, float(np.clip(3 * error, -1, 1)))


@dataclass
class Errands(Driver):
    """Driver with errands, who stops for some seconds in each doorway and at each errand and looks around now and then.

    The driver lets agents pass who come towards the robot, and takes another path if that takes long. They also do so
    if the other agent has waited for a second while they stand.
    """

    _passed: set[int] = field(default_factory=set)
    """Doorways in which they have stopped on this errand."""

    def _decide(self, view: RearrangeView) -> Action:
        if self._goal is None:
            self._go_elsewhere(view)
        apart = float(np.hypot(*(view.other_xz - view.xz)))
        if self._stands:
            self._stands -= 1
            if apart < NOTICES_M and _waits(view):
                self._go_elsewhere(view)
            return _drives(view, self._speed, self._turns)
        length, command = self._drive_on(view)
        if length < 0.3 or not np.isfinite(length):
            self._go_elsewhere(view)
            self._stand(*STAYS_STEPS)
            return _drives(view, 0.0, 0.0)
        for k, doorway in enumerate(self._doorways):
            if k not in self._passed and float(np.hypot(*(doorway - view.xz))) < 0.25:
                self._passed.add(k)
                self.doorway_stops += 1
                self._stand(*DOORWAY_STEPS)
        if self._rng.random() < 1 / LOOKS_AROUND_STEPS:
            self._stand(30, 60)
            self._turns = float(self._rng.choice([-0.3, 0.3]))
        met = self._meets(view, apart)
        self._waited = self._waited + 1 if met or float(np.hypot(*(view.before[:2] - view.xz))) < 1e-3 else 0
        if self._waited > MEETS_STEPS:
            self._go_elsewhere(view)
            self._stands, self._speed = 0 if met else 20, -0.4  # out of where they are wedged
        return _drives(view, 0.0, 0.0) if met else command

    def _meets(self, view: RearrangeView, apart_m: float) -> bool:
        """Return whether the other agent is on the next metres of the path."""
        if self._goal is None or apart_m >= MEETS_M:
            return False
        ahead = first_of_path(self.free.path(view.xz, self._goal, max_snap_m=1.0), MEETS_M)
        return float(distance_to_path(view.other_xz, ahead)) < min(BESIDE_M, apart_m - 0.05)

    def _stand(self, least: int, most: int) -> None:
        self._stands, self._turns, self._speed = int(self._rng.integers(least, most)), 0.0, 0.0

    def _go_elsewhere(self, view: RearrangeView) -> None:
        """Drive to a place with room, more than 2 m away, whose path leads as little as possible towards the other."""
        places = self.free.sample(self._rng, 12)
        paths = [self.free.path(view.xz, place, max_snap_m=1.0) for place in places]
        far = [path for path in paths if len(path) > 1 and np.hypot(*np.diff(path, axis=0).T).sum() > 2.0]
        clear = [min(float(distance_to_path(view.other_xz, path)), MEETS_M) for path in far]
        self._heads_for(far[int(np.argmax(clear))][-1] if far else places[0])
        self._passed = {k for k, doorway in enumerate(self._doorways) if np.hypot(*(doorway - view.xz)) < 0.6}


@dataclass
class Parks(Driver):
    """Driver who is in the way on purpose, by stopping in doorways for `PARKED_STEPS` regardless of waiting agents.

    If an agent is in the driver's way, the driver waits for `PATIENCE_STEPS` and then goes to the next doorway.
    """

    _visits: int = 0
    _parked: int = 0

    def _decide(self, view: RearrangeView) -> Action:
        if self._goal is None:
            self._heads_for(self._doorways[(self.seed + self._visits) % len(self._doorways)])
        length, command = self._drive_on(view)
        if length < 0.15 or not np.isfinite(length) or self._parked:
            self.doorway_stops += self._parked == 0
            self._parked += 1
            if self._parked > PARKED_STEPS:
                self._next()
            return _drives(view, 0.0, 0.0)
        if float(np.hypot(*(view.other_xz - view.xz))) < STOPS_M:
            self._waited += 1
            if self._waited > PATIENCE_STEPS:
                self._next()
            return _drives(view, 0.0, 0.0)
        return command

    def _next(self) -> None:
        self._heads_for(None)
        self._parked, self._visits = 0, self._visits + 1


DRIVERS: dict[str, type[Errands | Parks]] = {"errands": Errands, "parks": Parks}


def _waits(view: RearrangeView) -> bool:
    """Return whether the other agent has been standing for as long as agents are observed."""
    return bool(np.hypot(*(view.other_track - view.other_xz).T).max() < 0.1)


def _drives(view: RearrangeView, forward: float, turn: float) -> Action:
    return Action(CONTROL, command=np.array([forward, turn, *np.zeros(len(view.arm) + 1)]))


def narrow_places(free: FreeSpace) -> list[NDArray[np.float64]]:
    """Return floor points [2] through which most paths between places of a home lead, a metre or more apart."""
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
    parser.add_argument("--workers", type=int, default=1, help="processes that play episodes")
    parser.add_argument("--driver", choices=sorted(DRIVERS), default="errands", help="who drives the robot")
    given = parser.parse_args()
    report(
        lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True),
        played(range(given.first, given.first + given.episodes), given.out, driver=given.driver, workers=given.workers),
    )
