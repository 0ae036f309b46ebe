"""docs/pictures/gallery.webp: six moments of learned policies, found in recordings by how agents move and by events.

h3data generate social_nav --rules paper --policy end_to_end_paper --scenes h3-homes/test --episodes 24 --seed 9107 -o nav
h3data generate rearrange --policy learn_pop --partner both --scenes h3-homes/test --episodes 16 --seed 9107 -o tidy
python -m bake.sheets.gallery nav tidy docs/pictures/gallery.webp

Each moment is the one with the highest score over all episodes; nothing is chosen by hand.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from h3data.progress import progress
from h3data.recording import Dataset, Recording
from h3data.replay import Replay, camera_track

SIZE, GAP, STEPS, EVERY = (400, 225), 4, 150, 3
"""Size of a picture [px], the gap between pictures, steps of a moment, and steps between frames."""
Track = NDArray[np.floating[Any]]


def track_of(recording: Recording, agent: int) -> tuple[Track, Track]:
    """Places [T, 2] [m] of an agent, and its speed along its heading [T] [m/s]."""
    pose = recording.columns[f"agent_{agent}.base_pose"].astype(np.float64)
    heading = 2 * np.arctan2(pose[:, 4], pose[:, 6])
    moved = np.diff(pose[:, [0, 2]], axis=0, prepend=pose[:1, [0, 2]])
    return pose[:, [0, 2]], 30 * (moved[:, 0] * np.cos(heading) - moved[:, 1] * np.sin(heading))


def over_window(values: Track, reduce: Callable[..., Any] = np.mean) -> Track:
    """Reduces each window of `STEPS` steps, [T - STEPS + 1]."""
    return reduce(np.lib.stride_tricks.sliding_window_view(values, STEPS), axis=1)


def path_length(places: Track) -> Track:
    """Length of the path in each window [m]."""
    return over_window(np.hypot(*np.diff(places, axis=0, prepend=places[:1]).T), np.sum)


def backs_up(recording: Recording) -> Track:
    """Distance that the robot drives backwards before a person who comes closer than 2 m."""
    (_, speed), near = track_of(recording, 0), recording.columns["metrics.dist_agents"] < 2.0
    return over_window(np.where(near, np.maximum(-speed, 0), 0)) - 0.3 * over_window(np.maximum(speed, 0))


def finds(recording: Recording) -> Track:
    """Steps of the search, where the robot finds the person in the last third of the window."""
    out = np.zeros(max(len(recording) - STEPS + 1, 0))
    for event in recording.events:
        if event.kind == "found" and 0 <= event.step - STEPS * 2 // 3 < len(out):
            out[event.step - STEPS * 2 // 3] = event.step
    return out


def follows(recording: Recording) -> Track:
    """Length of the person's path while the robot is 1 to 2 m away."""
    away = recording.columns["metrics.dist_agents"]
    return path_length(track_of(recording, 1)[0]) * over_window(np.where((away > 1) & (away < 2), 1.0, 0.0)) ** 4


def gives_way(recording: Recording) -> Track:
    """Nearness of agents who both move in opposite directions without a touch."""
    (mine, _), (theirs, _) = track_of(recording, 0), track_of(recording, 1)
    ahead, coming = (np.diff(track, axis=0, append=track[-1:]) * 30 for track in (mine, theirs))
    meets = (
        (np.hypot(ahead[:, 0], ahead[:, 1]) > 0.3)
        & (np.hypot(coming[:, 0], coming[:, 1]) > 0.5)
        & ((ahead * coming).sum(1) < -0.15)
    )
    clear = over_window(recording.columns["metrics.collision"].astype(float), np.max) == 0
    score = np.where(meets, 1 / np.maximum(recording.columns["metrics.dist_agents"], 0.5), 0)
    return clear * score[STEPS // 2 : len(score) - (STEPS - STEPS // 2) + 1]


def at_once(kind: str) -> Callable[[Recording], Track]:
    """Score of windows in whose middle both agents, near each other, do the same within a short time."""

    def score(recording: Recording) -> Track:
        out = np.full(max(len(recording) - STEPS + 1, 0), -np.inf)
        own = [event for event in recording.events if event.kind == kind]
        for one in own:
            for other in own:
                begin = (one.step + other.step - STEPS) // 2
                if one.agent < other.agent and 0 <= begin < len(out):
                    away = recording.columns["metrics.dist_agents"][(one.step + other.step) // 2]
                    out[begin] = -abs(one.step - other.step) / 30 - away
        return out

    return score


MOMENTS = (
    ("backs up before a person", 0, backs_up),
    ("finds a person", 0, finds),
    ("follows at 1 to 2 m", 0, follows),
    ("passes a person", 1, gives_way),
    ("both pick", 1, at_once("pick")),
    ("both place", 1, at_once("place")),
)


def main(nav: str, tidy: str, out: str) -> None:
    """Finds the moments, prints where they are, and renders them side by side."""
    datasets = Dataset(nav), Dataset(tidy)
    sheets = [Image.new("RGB", (3 * SIZE[0] + 2 * GAP, 2 * SIZE[1] + GAP), "white") for _ in range(0, STEPS, EVERY)]
    font = ImageFont.load_default(15)
    for k, (name, which, score) in enumerate(progress(MOMENTS, desc="moments", unit="moment")):
        scores = [score(recording) for recording in map(datasets[which].recording, range(len(datasets[which])))]
        episode = int(np.argmax([own.max(initial=-np.inf) for own in scores]))
        first = int(np.argmax(scores[episode]))
        sys.stdout.write(f"{name}: episode {episode}, step {first}\n")
        replay = Replay(datasets[which].recording(episode), light="baked")
        camera = camera_track(replay, "third_person").resized(*SIZE)
        for sheet, (_, (seen,)) in zip(
            sheets, replay.frames([camera], range(first, first + STEPS, EVERY), samples=4, threads=1), strict=True
        ):
            picture = Image.fromarray(seen["rgb"])
            pen = ImageDraw.Draw(picture)
            pen.rectangle((0, 0, pen.textlength(name, font=font) + 12, 22), fill="black")
            pen.text((6, 2), name, font=font, fill="white")
            sheet.paste(picture, (k % 3 * (SIZE[0] + GAP), k // 3 * (SIZE[1] + GAP)))
    sheets[0].save(out, save_all=True, append_images=sheets[1:], duration=100, loop=0, quality=68, method=4)


if __name__ == "__main__":
    main(*sys.argv[1:])
