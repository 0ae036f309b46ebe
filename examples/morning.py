"""Film of a minute of a morning: three people and a robot in a home; they cook, take things out of the fridge, and read.

python examples/morning.py out/morning           # episode.mcap, morning.mp4, morning.webp, sheets of 12 frames
(cd examples; h3data replay ../out/morning/episode.mcap --verify --trust morning)  # simulates it again, bit for bit
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import h3data
from h3data.recording import Recording, write_mcap
from h3data.render.image_files import write_png
from h3data.render.video import VideoWriter
from h3data.replay import Replay, camera_track
from h3data_crowds.chores import ChoreRoutine
from h3data_crowds.routines import Stop
from sim_kinematic.policies.crowd.people import CrowdPolicy

SCENE, SEED, SECONDS, FPS = "medium2-open:1", 13, 60, 30
ROSTER = ("robot", "female_1", "male_2", "female_3")
SIZE = 640, 360
ROUTINES = {
    1: (Stop("kitchen_counter_0", "cook", 9.0), Stop("sofa_0", "read", 12.0), Stop("window_2", "look_out", 6.0)),
    2: (Stop("fridge_0", "take", 12.0), Stop("dining_table_0", "put", 8.5), Stop("sofa_0", "read", 14.0)),
    3: (Stop("sofa_0", "read", 12.0), Stop("fridge_0", "take", 12.0), Stop("kitchen_counter_0", "put", 8.5)),
}
"""Places, activities and seconds of each person."""
CAMERAS = {
    "kitchen": "eye = [5.2, 2.3, 6.3]\ntarget = [7.2, 0.5, 3.8]\nhfov_deg = 80\n",
    "stove": "eye = [8.8, 2.3, 6.2]\ntarget = [6.2, 0.5, 3.9]\nhfov_deg = 80\n",
    "fridge": "eye = [7.4, 2.2, 6.6]\ntarget = [8.9, 0.8, 4.0]\nhfov_deg = 80\n",
    "sofa": "eye = [5.3, 2.2, 12.4]\ntarget = [7.9, 0.5, 9.6]\nhfov_deg = 80\n",
    "living": "eye = [5.2, 2.3, 7.2]\ntarget = [7.6, 0.5, 10.2]\nhfov_deg = 80\n",
}
SHOTS = (
    (0, "kitchen"),
    (3, "sofa"),
    (6, "fridge"),
    (10, "sofa"),
    (14, "stove"),
    (22, "living"),
    (27, "third_person"),
    (30, "sofa"),
    (36, "fridge"),
    (45, "sofa"),
    (49, "stove"),
    (55, "third_person"),
)
"""Seconds at which the shots begin, and their cameras: `CAMERAS`, or named ones."""


def resident(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """Return the policy of a person who follows their routine."""
    own, start = episode.roster[number].body, episode.starts[number, :2]
    routine = ChoreRoutine(episode.scene, episode.free, ROUTINES[number], own, start=start, number=number)
    return CrowdPolicy("orca", episode.free, episode.seed, number, episode.spec.human, routine=routine)


def play(seed: int = SEED) -> Recording:
    """Simulate the minute."""
    agents = {"human": f"{Path(__file__).stem}:resident", "robot": "wander"}
    return h3data.simulate(
        "wander", SCENE, roster=ROSTER, agents=agents, seed=seed, max_steps=SECONDS * FPS, spawn_distance_m=1.0
    )


def film(recording: Recording, folder: Path) -> None:
    """Render the shots one after the other, a small film of every half second, and a sheet of every twelve seconds."""
    replay = Replay(recording, light="baked")
    for name, text in CAMERAS.items():
        (folder / f"{name}.toml").write_text(text)
    cut = [*(start * FPS for start, _ in SHOTS), len(recording)]
    frames, small = [], []
    with VideoWriter(folder / "morning.mp4", fps=FPS, width=SIZE[0], height=SIZE[1]) as video:
        for (_, name), start, end in zip(SHOTS, cut[:-1], cut[1:], strict=True):
            track = camera_track(replay, str(folder / f"{name}.toml") if name in CAMERAS else name).resized(*SIZE)
            for step, (outputs,) in replay.frames([track], range(start, end), samples=4, threads=2):
                video.write(outputs["rgb"])
                if step % (FPS // 2) == 0:
                    small.append(Image.fromarray(outputs["rgb"]).resize((400, 225), Image.Resampling.LANCZOS))
                if step % FPS == 0:
                    frames.append(outputs["rgb"])
    still, *others = small
    still.save(folder / "morning.webp", save_all=True, append_images=others, duration=350, loop=0, quality=45, method=6)
    for k in range(0, len(frames), 12):
        rows = [np.hstack(frames[j : j + 4]) for j in range(k, k + 12, 4)]
        write_png(folder / f"sheet_{k // 12}.png", np.vstack(rows))


def main(out: str) -> None:
    """Play, record and render the morning."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    recording = play()
    write_mcap(recording, folder / "episode.mcap", overwrite=True)
    film(recording, folder)


if __name__ == "__main__":
    main(*sys.argv[1:])
