"""Film of a breakfast: one person takes something out of the fridge and carries it to the table, one carries a tray with two hands,
one looks at a phone.

python examples/breakfast.py out/breakfast       # simulated.mcap, acted.mcap, breakfast.mp4, sheet.png
h3data replay out/breakfast/simulated.mcap --verify
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
from h3data.replay import Replay, camera_track
from h3data_crowds.chores import ChoreRoutine, act_out
from sim_kinematic.crowd.routines import Stop
from sim_kinematic.policies.crowd.people import CrowdPolicy

SCENE, SEED, SECONDS, FPS = "medium-open:3", 3, 45, 30
ROSTER = ("robot", "female_1", "male_2", "female_3")
SIZE = 640, 360
ROUTINES = {
    1: (Stop("fridge_0", "take", 10.5), Stop("kitchen_counter_0", "put", 6.5), Stop("window_0", "look_out", 6.0)),
    2: (Stop("kitchen_counter_2", "lift", 6.5), Stop("dining_table_0", "put", 6.5), Stop("window_1", "phone", 8.0)),
    3: (Stop("window_0", "phone", 12.0), Stop("dining_table_0", "eat", 12.0)),
}
"""Places, activities and seconds of each person."""


def resident(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """Policy of a person who follows their routine."""
    own = episode.roster[number].body
    routine = ChoreRoutine(episode.scene, episode.free, ROUTINES[number], own)
    return CrowdPolicy("orca", episode.free, episode.seed, number, episode.spec.human, routine=routine)


def play(seed: int = SEED) -> Recording:
    """Simulates the breakfast."""
    agents = {"human": f"{Path(__file__).stem}:resident", "robot": "wander"}
    return h3data.simulate(
        "wander", SCENE, roster=ROSTER, agents=agents, seed=seed, max_steps=SECONDS * FPS, spawn_distance_m=1.0
    )


def main(out: str) -> None:
    """Plays, acts out, records and renders."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    recording = play()
    write_mcap(recording, folder / "simulated.mcap", overwrite=True)
    acted = act_out(recording)
    write_mcap(acted, folder / "acted.mcap", overwrite=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
