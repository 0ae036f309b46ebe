"""Script for docs/pictures/behaviour_*.webp: six films of learned policies, found in recordings by events and motion.

h3data generate social_nav --policy end_to_end --scenes h3-homes/test --episodes 30 --seed 9107 -o nav
h3data generate rearrange --policy plan_pop_3_pixels --partner both --scenes h3-homes/test --episodes 12 --seed 9107 -o pixels
h3data generate rearrange --policy plan_pop_3_robot --partner object_1 --scenes h3-homes/test --episodes 8 --seed 9107 -o one
python -m bake.sheets.behaviour docs/pictures nav pixels [NAME ...]
python -m bake.sheets.behaviour docs/pictures one fetch

Each film shows the moment with the highest score over all episodes of all datasets; nothing is chosen by hand. No episode is
shown twice. With names of films, only these are rendered.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from h3data.progress import progress
from h3data.recording import Dataset, Recording
from h3data.render import look_at, pinhole
from h3data.replay import CameraTrack, Replay, camera_track
from h3data.scene import Room

SIZE, SIZE_ABOVE, FRAMES, MILLISECONDS = (400, 300), (560, 420), 48, 100
"""Sizes of pictures [px], the most frames of a film, and how long each is shown [ms]."""
FPS = 30
ROBOT, PERSON = 0, 1
Track = NDArray[np.floating[Any]]


@dataclass(frozen=True, kw_only=True)
class Moment:
    """Part of a recording in which an event happens."""

    score: float
    first: int
    last: int
    """First and last step of the moment, both included."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Movements of the robot and the person of a recording; arrays have a row for each agent, robot first."""

    places: Track
    """Floor positions (x, z) of both agents, shape [2, T, 2] [m]."""
    moved: Track
    """Distance in each step, [2, T] [m]."""
    forward: Track
    """Distance along the agent's heading in each step, shape [2, T] [m]."""
    away: Track
    """Distance between the agents, [T] [m]."""
    touching: NDArray[np.bool_]
    """Contact between the agents, [T]."""
    rooms: NDArray[np.int64]
    """Room that each agent is in, -1 in none, [2, T]."""

    @classmethod
    def of(cls, recording: Recording, rooms: Sequence[Room]) -> Motion:
        """Read the motion of a recording of one robot and one person."""
        pose = np.stack([recording.columns[f"agent_{k}.base_pose"].astype(np.float64) for k in (ROBOT, PERSON)])
        places = pose[..., [0, 2]]
        heading = 2 * np.arctan2(pose[..., 4], pose[..., 6])
        step = np.diff(places, axis=1, prepend=places[:, :1])
        return cls(
            places=places,
            moved=np.hypot(step[..., 0], step[..., 1]),
            forward=step[..., 0] * np.cos(heading) - step[..., 1] * np.sin(heading),
            away=np.hypot(*(places[ROBOT] - places[PERSON]).T),
            touching=recording.columns["metrics.collision"].astype(np.bool_),
            rooms=room_of(places, rooms),
        )

    def passes_door(self, agent: int) -> NDArray[np.bool_]:
        """Return a mask of the steps in which an agent goes from one room into another, [T]."""
        own = self.rooms[agent]
        return np.append(False, (own[1:] != own[:-1]) & (own[1:] >= 0) & (own[:-1] >= 0))


def room_of(places: Track, rooms: Sequence[Room]) -> NDArray[np.int64]:
    """Return the number of the room at each place [..., 2]; -1: none."""
    found = np.full(places.shape[:-1], -1)
    x, z = places[..., 0], places[..., 1]
    for k, room in enumerate(rooms):
        for x0, z0, x1, z1 in room.rectangles:
            found[(x >= x0) & (x < x1) & (z >= z0) & (z < z1)] = k
    return found


def windows(values: NDArray[Any], steps: int, reduce: Callable[..., Any] = np.sum) -> Track:
    """Return ``reduce`` of each window of ``steps`` steps, shape [T - steps + 1]; empty if there are fewer steps."""
    if len(values) < steps:
        return np.zeros(0)
    return reduce(np.lib.stride_tricks.sliding_window_view(values, steps, axis=0), axis=-1)


def best(scores: Track, steps: int) -> list[Moment]:
    """Return the window with the highest score, if any has one above 0."""
    if not len(scores) or scores.max() <= 0:
        return []
    first = int(scores.argmax())
    return [Moment(score=float(scores[first]), first=first, last=first + steps - 1)]


# --- events -----------------------------------------------------------------------------------------------------------
def backs_up_at_a_door(recording: Recording, motion: Motion) -> list[Moment]:
    """Find where the robot drives backwards for 0.4 m or more before a person who comes through a door towards it."""
    steps = 120
    near = motion.away < 2.0
    back = windows(np.where(near, np.maximum(-motion.forward[ROBOT], 0), 0), steps)
    ahead = windows(np.maximum(motion.forward[ROBOT], 0), steps)
    doors, hit = (windows(flags, steps, np.max) > 0 for flags in (motion.passes_door(PERSON) & near, motion.touching))
    return best(np.where((back >= 0.4) & doors & ~hit, back - 0.3 * ahead, 0), steps)


def gives_way(recording: Recording, motion: Motion) -> list[Moment]:
    """Find where the robot moves aside by 0.25 m or more for a walking person, who passes without a touch."""
    half = 60  # of the steps of a film
    found = []
    total = len(motion.away)
    for middle in range(half, total - half + 1, 3):
        if motion.away[middle] > 1.4:
            continue
        part = slice(middle - half, middle + half)
        walked = motion.places[PERSON, middle + half - 1] - motion.places[PERSON, middle - half]
        length = float(np.hypot(*walked))
        if length < 1.5 or motion.touching[part].any():
            continue
        along = walked / length
        gap = motion.places[ROBOT, part] - motion.places[PERSON, part]
        ahead, aside = gap @ along, np.abs(gap @ np.array([-along[1], along[0]]))
        lateral = (motion.places[ROBOT, part] - motion.places[ROBOT, middle - half]) @ np.array([-along[1], along[0]])
        # in the path at first, beside it when they pass, behind the person at the end
        if ahead[0] > 0.8 and ahead[-1] < -0.3 and aside[: half // 2].min() < 0.4:
            passing = int(np.abs(ahead).argmin())
            if abs(lateral[passing]) >= 0.25 and motion.moved[ROBOT, part].sum() > 0.25:
                found.append(Moment(score=abs(float(lateral[passing])), first=part.start, last=part.stop - 1))
    return sorted(found, key=lambda moment: -moment.score)[:1]


def fetches_what_is_left(recording: Recording, motion: Motion) -> list[Moment]:
    """Find where the robot brings an object to its goal that the person never brings: their plan is the other one alone."""
    if recording.episode.info.get("partner") not in ("object_1", "object_2"):
        return []
    picks = {(e.agent, e.target): e.step for e in recording.events if e.kind == "pick"}
    theirs = {target for agent, target in picks if agent == PERSON}
    found = []
    for event in recording.events:
        is_own = event.kind == "place" and event.agent == ROBOT and event.detail == "at its goal"
        if is_own and theirs and event.target not in theirs and (ROBOT, event.target) in picks:
            first, last = max(picks[ROBOT, event.target] - 45, 0), min(event.step + 15, len(motion.away) - 1)
            # the shorter, the better it is seen
            found.append(Moment(score=1000.0 / (last - first), first=first, last=last))
    return found


def waits(recording: Recording, motion: Motion) -> list[Moment]:
    """Find where the robot stands still for a second or more while a person walks past it within 2 m, and then drives on."""
    still = motion.moved[ROBOT] < 0.05 / FPS
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    found = []
    for begin, end in edges.reshape(-1, 2).tolist():
        last = min(end + 45, len(still) - 1)
        part = slice(max(begin - 30, 0), last + 1)
        near = motion.away[begin:end] < 2.0
        walked = float((motion.moved[PERSON, begin:end] * near).sum())
        sets_off = (
            motion.moved[ROBOT, end : last + 1].sum() > 0.3 and motion.moved[ROBOT, part.start : begin].sum() > 0.1
        )
        if 30 <= end - begin <= 120 and walked > 0.8 and sets_off and not motion.touching[part].any():
            found.append(Moment(score=walked, first=part.start, last=last))
    return sorted(found, key=lambda moment: -moment.score)[:1]


def follows_around_a_corner(recording: Recording, motion: Motion) -> list[Moment]:
    """Find where the robot stays 1 to 2 m from a person who turns by 70 degrees or more and goes into another room."""
    steps, leg = 150, 40
    found = []
    inside = windows((motion.away > 1.0) & (motion.away < 2.0), steps, np.mean)
    doors = windows(motion.passes_door(PERSON), steps, np.max) > 0
    for first in np.flatnonzero((inside > 0.97) & doors).tolist():
        turns = []
        for places in motion.places[:, first : first + steps]:
            start, end = places[leg] - places[0], places[-1] - places[-1 - leg]
            lengths = np.hypot(*start), np.hypot(*end)
            turns.append(np.degrees(np.arccos(np.clip(start @ end / max(lengths[0] * lengths[1], 1e-9), -1, 1))))
            turns[-1] *= min(lengths) > 0.6
        if min(turns) >= 70 and max(turns) <= 130:
            path = motion.moved[:, first : first + steps].sum(1).min()
            found.append(Moment(score=float(path), first=first, last=first + steps - 1))
    return sorted(found, key=lambda moment: -moment.score)[:1]


def shares_the_task(recording: Recording, motion: Motion) -> list[Moment]:
    """Find where both agents bring an object to its goal, come within 1.5 m of each other and never touch."""
    done = [e for e in recording.events if e.kind == "place" and e.detail == "at its goal"]
    succeeded = any(e.kind == "success" for e in recording.events)
    if not succeeded or {e.agent for e in done} != {ROBOT, PERSON} or motion.touching.any() or motion.away.min() > 1.5:
        return []
    picks = [e.step for e in recording.events if e.kind == "pick"]
    first, last = max(min(picks) - 60, 0), len(motion.away) - 1
    together = abs(done[0].step - done[-1].step)
    return [Moment(score=1000.0 / (last - first + together), first=first, last=last)]


FILMS: dict[str, tuple[Callable[[Recording, Motion], list[Moment]], str]] = {
    "door": (backs_up_at_a_door, "third_person"),
    "way": (gives_way, "third_person"),
    "fetch": (fetches_what_is_left, "third_person"),
    "wait": (waits, "third_person"),
    "corner": (follows_around_a_corner, "third_person"),
    "share": (shares_the_task, "above"),
}
"""Event and camera of each film, by its name."""


# --- films ------------------------------------------------------------------------------------------------------------
def above(replay: Replay, motion: Motion, moment: Moment) -> CameraTrack:
    """Return a camera that stands above all places of both agents in a moment, without ceilings."""
    there = motion.places[:, moment.first : moment.last + 1].reshape(-1, 2)
    low, high = there.min(0) - 0.8, there.max(0) + 0.8
    (x, z), (width, depth) = (low + high) / 2, high - low
    floor = float(replay.recording.columns["agent_0.base_pose"][0, 1])
    eye_y = max(width * SIZE_ABOVE[1] / SIZE_ABOVE[0], depth) * 1.05 + 1.0
    lens = pinhole(
        *SIZE_ABOVE,
        hfov_deg=60,
        name="above",
        pose=look_at(np.array([x, floor + eye_y, z + 0.35 * eye_y]), np.array([x, floor + 0.5, z])),
        hidden_layers=("ceiling",),
    )
    return CameraTrack(camera=lens, poses=np.repeat(lens.pose[None], len(replay), 0))


def film(recording: Recording, moment: Moment, camera: str, file: Path) -> int:
    """Render a moment and return the number of steps between frames."""
    replay = Replay(recording, light="baked")
    every = max(-(-(moment.last - moment.first + 1) // FRAMES), 3)
    if camera == "above":
        track = above(replay, Motion.of(recording, replay.scene.rooms if replay.scene else ()), moment)
    else:
        track = camera_track(replay, camera).resized(*SIZE)
    steps = range(moment.first, moment.last + 1, every)
    frames = [Image.fromarray(seen["rgb"]) for _, (seen,) in replay.frames([track], steps, samples=4, threads=1)]
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=MILLISECONDS, loop=0, quality=66, method=4)
    return every


def main(out: Path, folders: Sequence[str], only: Sequence[str] = ()) -> None:
    """Find the moments, print where they are, and render a film of each."""
    datasets = {folder: Dataset(folder) for folder in folders}
    episodes = [(folder, k) for folder, data in datasets.items() for k in range(len(data))]
    found: dict[str, list[tuple[float, str, int, Moment]]] = {name: [] for name in FILMS}
    for folder, k in progress(episodes, desc="moments", unit="episode"):
        recording = datasets[folder].recording(k)
        scene = Replay(recording).scene
        motion = Motion.of(recording, scene.rooms if scene else ())
        for name, (event, _) in FILMS.items():
            found[name] += [(m.score, folder, k, m) for m in event(recording, motion)]
    shown: set[tuple[str, int]] = set()
    for name, (_, camera) in FILMS.items():
        ranked = sorted((row for row in found[name] if row[1:3] not in shown), key=lambda row: -row[0])
        if not ranked:
            sys.stdout.write(f"{name}: nothing found\n")
            continue
        score, folder, k, moment = ranked[0]
        shown.add((folder, k))
        said = f"{name}: {len(ranked)} found, {folder}#{k}, steps {moment.first} to {moment.last}, score {score:.2f}"
        if not only or name in only:
            file = out / f"behaviour_{name}.webp"
            every = film(datasets[folder].recording(k), moment, camera, file)
            said += f", {every * 1000 / FPS / MILLISECONDS:.1f} times real time, {file.stat().st_size / 1e3:.0f} kB"
        sys.stdout.write(said + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    given = sys.argv[1:]
    main(Path(given[0]), [g for g in given[1:] if g not in FILMS], [g for g in given[1:] if g in FILMS])
