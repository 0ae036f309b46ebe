"""Learning curves of runs of ``h3data train``, one line per run: docs/pictures/training.png, populations.png, skills.png.

python examples/training_picture.py OUT.png out/nav/0 out/nav/1 out/nav/2
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from h3data_training.curve import curve_of

SOCIAL_NAV = {
    "follows": ("share of steps in which the robot follows", 1.0),
    "collided": ("share of ended episodes that ended in contact", 1.0),
}
REARRANGE = {
    "success": ("share of episodes that succeed", 1.0),
    "steps_per_episode": ("thousands of steps of an episode", 1000.0),
}
SKILLS = {
    "succeeded": ("share of ended episodes that succeed", 1.0),
    "contact": ("share of steps in which the base touches something", 1.0),
}
COLORS = ((180, 119, 31), (14, 127, 255), (44, 160, 44), (189, 103, 148), (40, 39, 214), (75, 86, 140))
WIDTH, HEIGHT, LEFT, TOP, BOTTOM = 720, 420, 60, 50, 50
SMOOTH = 9  # updates

out, folders = Path(sys.argv[1]), [Path(folder) for folder in sys.argv[2:]]
runs = [curve_of(folder) for folder in folders]
over = "episodes" if "episodes" in runs[0][0] else "decisions"
last = max(row[over] for run in runs for row in run)
unit, name_of_unit = (1e6, "millions") if last > 2e6 else (1e3, "thousands")


def write(panel: np.ndarray, text: str, x: int, y: int, color: tuple[int, int, int] = (40, 40, 40)) -> None:
    cv2.putText(panel, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, 1, cv2.LINE_AA)


def ticks(most: float) -> np.ndarray:
    """Return round numbers from 0 to ``most``, six at most."""
    size = 10.0 ** np.floor(np.log10(most / 5))
    step = next(size * k for k in (1, 2, 5, 10) if most <= 5 * size * k)
    return np.arange(0, most + step / 100, step)


def drawn(name: str, title: str, scale: float) -> np.ndarray:
    panel = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    wide, high = WIDTH - LEFT - 30, HEIGHT - TOP - BOTTOM
    for share in np.linspace(0, 1, 6):
        y = int(TOP + high * (1 - share))
        cv2.line(panel, (LEFT, y), (LEFT + wide, y), (225, 225, 225), 1)
        write(panel, f"{share:.1f}", 20, y + 5)
    for tick in ticks(last / unit):
        write(panel, f"{tick:g}", int(LEFT + wide * tick * unit / last) - 10, HEIGHT - 28)
    legend = TOP + 18 if over == "decisions" else HEIGHT - BOTTOM - 17 * len(runs)
    for k, run in enumerate(runs):
        values = np.array([row[name] for row in run]) / scale
        values = np.convolve(np.pad(values, SMOOTH // 2, mode="edge"), np.ones(SMOOTH) / SMOOTH, mode="valid")
        x = LEFT + wide * np.array([row[over] for row in run]) / last
        points = np.stack([x, TOP + high * (1 - values)], 1)
        cv2.polylines(
            panel, [np.rint(points * 16).astype(np.int32)], False, COLORS[k % len(COLORS)], 2, cv2.LINE_AA, shift=4
        )
        write(panel, folders[k].name, LEFT + wide - 110, legend + 17 * k, COLORS[k % len(COLORS)])
    write(panel, title, LEFT, 30)
    write(panel, f"{name_of_unit} of {over}", WIDTH // 2 - 80, HEIGHT - 8)
    return panel


first = runs[0][0]
panels = REARRANGE if "success" in first else SKILLS if "succeeded" in first else SOCIAL_NAV
cv2.imwrite(str(out), np.hstack([drawn(name, *of) for name, of in panels.items()]))
