"""Script that makes ``docs/pictures/demo.webp``, the moving picture of the front page, from the demo's recording.

``python -m pipelines.bake.moving_picture [out/demo/episode.mcap [FIRST_STEP]]``
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from h3data.commands.command import open_episode
from h3data.progress import progress
from h3data.render import depth_to_rgb
from h3data.replay import Replay, camera_track
from h3data_pipelines.pictures.rendering import draw_trajectories

SIZE = (832, 468)
"""Width and height of the third-person picture [px]; the robot's depth and the map are to its right, half as high."""
GAP = 4
EVERY, FRAMES, MILLISECONDS = 3, 120, 100
"""Number of steps per frame, number of frames, and duration of a frame [ms]: 12 s in real time."""


def main(recording: Path, first: int, out: Path) -> None:
    """Render a looping WebP of three cameras, with smooth edges, from step ``first`` on."""
    replay = Replay(open_episode(recording), light="baked")
    side = ((SIZE[1] - GAP) // 2 * 4 // 3, (SIZE[1] - GAP) // 2)
    stage, renderer = replay.stage, replay.stage.renderer()
    person, above = (
        camera_track(replay, name).resized(*size) for name, size in (("third_person", SIZE), ("top_down", side))
    )
    arm = camera_track(replay, "robot_arm").resized(*side)
    frames = []
    steps = range(first, min(first + EVERY * FRAMES, len(replay.recording)), EVERY)
    for step in progress(steps, desc="moving picture", unit="frame"):
        (seen, plan) = (
            stage.render(renderer, step, [track.at(step)], outputs=("rgb",), samples=4)[0]["rgb"]
            for track in (person, above)
        )
        draw_trajectories(plan, replay, above, step)
        (depth,) = stage.render(renderer, step, [arm.at(step)], outputs=("depth",))
        frames.append(_sheet(seen, depth_to_rgb(depth["depth"], 0.0, 6.0), plan))
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=MILLISECONDS, loop=0, quality=62, method=4)
    sys.stdout.write(f"{out}: {len(frames)} frames, {out.stat().st_size / 1e6:.1f} MB\n")


def _sheet(third_person: NDArray[np.uint8], *beside: NDArray[Any]) -> Image.Image:
    sheet = Image.new("RGB", (SIZE[0] + GAP + beside[0].shape[1], SIZE[1]), (24, 24, 27))
    sheet.paste(Image.fromarray(third_person), (0, 0))
    for row, picture in enumerate(beside):
        sheet.paste(Image.fromarray(picture), (SIZE[0] + GAP, row * (picture.shape[0] + GAP)))
    return sheet


if __name__ == "__main__":
    given = sys.argv[1:]
    main(
        Path(given[0] if given else "out/demo/episode.mcap"),
        int(given[1]) if len(given) > 1 else 114,
        Path("docs/pictures/demo.webp"),
    )
