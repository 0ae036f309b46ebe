"""Script for docs/pictures/scenarios.png: an episode of each scenario card from above, with the tracks of all agents.

    PYTHONPATH=pipelines python -m bake.sheets.scenario docs/pictures/scenarios.png

Each is played under `dwa` in a home where the card fits, otherwise in its plan. Outlines are the bodies at every second; the
robot's goal is a cross.
"""

from __future__ import annotations

import sys

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from h3data.recording import Recording
from h3data.scene import FreeSpace
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data_crowds.cards import load_cards
from h3data_crowds.scenarios import Scenarios, ScenarioSpec
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.tasks.recorder import simulate

SCENE, SEED, COLUMNS = "medium:1", 1, 5
HALF_M, RADIUS_M, EVERY = 4.2, 0.25, 30
SIZE, TITLE, FINER = 250, 22, 3
ROBOT, PEOPLE = "#d1495b", ("#30638e", "#3d8f5f", "#8a5a9e", "#b7791f", "#4a4a4a", "#2a9d8f")


def draw(name: str, recording: Recording, free: FreeSpace) -> Image.Image:
    """Return an episode from above: the free floor in white, and the paths of all agents."""
    extra, pixels = recording.episode.info["extra"], SIZE * FINER
    tracks = [recording.columns[f"agent_{k}.base_pose"][:, [0, 2]] for k in range(len(recording.agents))]
    everything = np.vstack([*tracks, [extra["goal"]]])
    corner = (everything.min(0) + everything.max(0)) / 2 - HALF_M
    scale = pixels / (2 * HALF_M)
    ticks = (np.arange(pixels) + 0.5) / scale
    grid = np.stack(np.meshgrid(corner[0] + ticks, corner[1] + ticks), -1)
    floor = free.signed_distance(grid) > 0.0
    picture = Image.fromarray(np.where(floor, 252, 200).astype(np.uint8)).convert("RGB")
    pen = ImageDraw.Draw(picture)
    for k, track in reversed(list(enumerate(tracks))):
        color = ROBOT if k == 0 else PEOPLE[(k - 1) % len(PEOPLE)]
        points = (track - corner) * scale
        pen.line([tuple(point) for point in points.tolist()], fill=color, width=2 * FINER)
        for n, (x, z) in enumerate(points[::EVERY].tolist()):
            r = RADIUS_M * scale
            pen.ellipse((x - r, z - r, x + r, z + r), fill=color if n == 0 else None, outline=color, width=FINER)
    x, z = ((np.array(extra["goal"]) - corner) * scale).tolist()
    for a, b in ((-1, -1), (-1, 1)):
        pen.line((x + 8 * FINER * a, z + 8 * FINER * b, x - 8 * FINER * a, z - 8 * FINER * b), ROBOT, 3 * FINER)
    panel = Image.new("RGB", (SIZE, SIZE + TITLE), "white")
    panel.paste(picture.resize((SIZE, SIZE), Image.Resampling.LANCZOS), (0, TITLE))
    where = "home" if extra["where"] == "home" else "plan"
    ImageDraw.Draw(panel).text((4, 3), f"{name.replace('_', ' ')} ({where})", "black", ImageFont.load_default(13))
    return panel


def main(out: str) -> None:
    """Play an episode of each card and draw all of them."""
    task, cards = Scenarios(), list(load_cards())
    source = named_scenes(SCENE)[0].source
    rules = ScenarioSpec()
    home, floor = open_scene(source), open_free_space(source, rules.agent_radius_m, rules.agent_height_m)
    wide, high = SIZE + 6, SIZE + TITLE + 6
    sheet = Image.new("RGB", (wide * COLUMNS, high * -(-len(cards) // COLUMNS)), "white")
    for n, name in enumerate(cards):
        spec = ScenarioSpec(card=name, max_steps=600)
        episode = task.sample(home, floor, SEED, spec, make_roster(task.agents))
        panel = draw(name, simulate(task, episode, {"robot": "dwa"}), episode.free)
        sheet.paste(panel, (n % COLUMNS * wide, n // COLUMNS * high))
    sheet.save(out, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
