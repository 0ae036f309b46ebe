"""Pictures of a breakfast: people take something out of the fridge, carry a tray with two hands, and look at a phone.

python examples/breakfast.py out/breakfast       # breakfast.mcap, sheet.jpg
(cd examples; h3data replay ../out/breakfast/breakfast.mcap --verify --trust breakfast)  # simulates it again, bit for bit
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

import h3data
from h3data.recording import Recording, write_mcap
from h3data.render.image_files import write_jpg
from h3data.replay import Replay, camera_track
from h3data_crowds.chores import ChoreRoutine
from h3data_crowds.routines import Stop
from sim_kinematic.policies.crowd.people import CrowdPolicy

SCENE, SEED, SECONDS, FPS = "medium-open:3", 3, 45, 30
ROSTER = ("robot", "female_1", "male_2", "female_3")
SIZE = 360, 270
ROUTINES = {
    1: (Stop("fridge_0", "take", 12.5), Stop("kitchen_counter_0", "put", 9.0), Stop("window_0", "look_out", 6.0)),
    2: (Stop("kitchen_counter_2", "lift", 8.5), Stop("dining_table_0", "put", 9.0), Stop("window_1", "phone", 8.0)),
    3: (Stop("window_0", "phone", 12.0), Stop("dining_table_0", "eat", 12.0)),
}
"""Places, activities and seconds of each person."""
SHOTS = {
    "1 takes carton": ((7.35, 1.6, 9.75), (8.75, 0.9, 8.95), -70, -30, 0, 60),
    "1 puts carton": ((5.6, 1.8, 9.9), (7.0, 0.9, 8.8), -90, -30, 0, 60),
    "2 takes tray": ((8.4, 1.7, 12.7), (6.7, 0.8, 13.7), -60, -15, 30, 120),
    "2 puts tray": ((9.3, 1.8, 11.8), (7.9, 0.8, 10.0), -100, -40, 0, 70),
    "3 activity phone": ((2.6, 1.7, 12.4), (4.0, 1.0, 13.7), 20, 80, 140, 200),
}
"""Agent, kind and thing of an event; eye and target of a camera, and moments beside the event [steps]."""


def resident(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """Return the policy of a person who follows their routine."""
    own, start = episode.roster[number].body, episode.starts[number, :2]
    routine = ChoreRoutine(episode.scene, episode.free, ROUTINES[number], own, start=start, number=number)
    return CrowdPolicy("orca", episode.free, episode.seed, number, episode.spec.human, routine=routine)


def play(seed: int = SEED) -> Recording:
    """Simulate the breakfast."""
    agents = {"human": f"{Path(__file__).stem}:resident", "robot": "wander"}
    return h3data.simulate(
        "wander", SCENE, roster=ROSTER, agents=agents, seed=seed, max_steps=SECONDS * FPS, spawn_distance_m=1.0
    )


def sheet(recording: Recording, out: Path) -> None:
    """Render moments around each thing that people take and put down, and of a look at a phone, one per row."""
    replay, rows = Replay(recording, light="baked"), []
    for name, moments in SHOTS.items():
        agent, kind, word = (int(name[0]), *name[2:].split())
        steps = [
            event.step
            for event in recording.events
            if event.agent == agent and event.kind == kind and word in event.target
        ]
        eye, target, *offsets = moments
        camera = out.with_name("camera.toml")
        camera.write_text(f"eye = {list(eye)}\ntarget = {list(target)}\nhfov_deg = 62\n")
        track = camera_track(replay, str(camera)).resized(*SIZE)
        rows.append(
            np.hstack(
                [
                    replay_frame["rgb"]
                    for offset in offsets
                    for _, (replay_frame,) in replay.frames([track], [steps[0] + offset], samples=4)
                ]
            )
        )
    write_jpg(out, np.vstack(rows))


def main(out: str) -> None:
    """Play, record and render the breakfast."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    recording = play()
    write_mcap(recording, folder / "breakfast.mcap", overwrite=True)
    sheet(recording, folder / "sheet.jpg")


if __name__ == "__main__":
    main(*sys.argv[1:])
