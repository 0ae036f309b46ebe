"""Film of a minute of a morning: three people and a robot in a home; they cook, fetch things, and sit down to read.

python examples/morning.py out/morning           # episode.mcap, morning.mp4 and sheets of 12 frames each
h3data replay out/morning/episode.mcap --verify  # simulates it again, bit for bit
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

import h3data
from h3data.recording import Recording, write_mcap
from h3data.render.image_files import write_png
from h3data.render.video import VideoWriter
from h3data.replay import CameraTrack, Replay, camera_track
from sim_kinematic.crowd.routines import Routine, Stop
from sim_kinematic.policies.crowd.people import CrowdPolicy

SCENE, SEED, SECONDS, FPS = "medium2:1", 3, 60, 30
ROSTER = ("robot", "female_1", "male_2", "female_3")
SIZE = 1280, 720
ROUTINES = {
    1: (Stop("kitchen_counter_0", "cook", 9.0), Stop("sofa_0", "read", 12.0), Stop("window_2", "look_out", 6.0)),
    2: (Stop("fridge_0", "fetch", 5.0), Stop("sofa_0", "read", 16.0), Stop("kitchen_counter_0", "cook", 9.0)),
    3: (Stop("sofa_0", "read", 12.0), Stop("fridge_0", "fetch", 5.0), Stop("window_2", "look_out", 6.0)),
}
"""Places, activities and seconds of each person."""
SHOTS = ((0, "human_1/third_person"), (20, "living.toml"), (45, "human_2/third_person"))
"""Cameras, and the seconds at which their shots begin."""
LIVING = "eye = [4.6, 2.2, 7.6]\ntarget = [7.6, 0.7, 10.4]\nhfov_deg = 75\n"


def resident(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """Policy of a person who follows their routine."""
    own = episode.roster[number].body
    routine = Routine(episode.scene, episode.free, ROUTINES[number], own)
    return CrowdPolicy("orca", episode.free, episode.seed, number, episode.spec.human, routine=routine)


def play(seed: int = SEED) -> Recording:
    """Simulates the minute."""
    agents = {"human": f"{__name__}:resident", "robot": "wander"}
    return h3data.simulate(
        "wander", SCENE, roster=ROSTER, agents=agents, seed=seed, max_steps=SECONDS * FPS, spawn_distance_m=1.0
    )


def film(recording: Recording, folder: Path) -> None:
    """Renders the shots one after the other, and a sheet of every twelve seconds."""
    replay = Replay(recording, light="baked")
    (folder / "living.toml").write_text(LIVING)
    cut = [start * FPS for start, _ in SHOTS] + [len(recording)]
    frames = []
    with VideoWriter(folder / "morning.mp4", fps=FPS, width=SIZE[0], height=SIZE[1]) as video:
        for (_, name), start, end in zip(SHOTS, cut[:-1], cut[1:], strict=True):
            track: CameraTrack = camera_track(replay, str(folder / name) if name.endswith(".toml") else name)
            for step, (outputs,) in replay.frames([track.resized(*SIZE)], range(start, end), samples=4, threads=2):
                video.write(outputs["rgb"])
                if step % FPS == 0:
                    frames.append(outputs["rgb"][::3, ::3])
    for k in range(0, len(frames), 12):
        rows = [np.hstack(frames[j : j + 4]) for j in range(k, k + 12, 4)]
        write_png(folder / f"sheet_{k // 12}.png", np.vstack(rows))


def main(out: str) -> None:
    """Plays, records and renders."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    recording = play()
    write_mcap(recording, folder / "episode.mcap", overwrite=True)
    film(recording, folder)


if __name__ == "__main__":
    main(*sys.argv[1:])
