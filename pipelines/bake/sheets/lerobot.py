"""Script for docs/pictures/lerobot.jpg: frames of a dataset's video, and its environment after the same actions.

python -m bake.sheets.lerobot docs/pictures/lerobot.jpg
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import h3data
from h3data.envs import DatasetEnv
from h3data_pipelines.cli import main as run

CAMERA, SIDE, STEPS, SEED, TITLE = "robot_arm_rgb", 224, 300, 9, 18
SHOWN = (120, 170, 220, 270)


def frames_of(folder: Path) -> list[NDArray[np.uint8]]:
    """Return all frames of the only video below a folder, RGB [H, W, 3]."""
    import av

    with av.open(str(next(folder.rglob("*.mp4")))) as video:
        return [np.asarray(frame.to_ndarray(format="rgb24"), np.uint8) for frame in video.decode(video=0)]


def main(out: str) -> None:
    """Make the dataset, repeat its actions in its environment, and render both."""
    with TemporaryDirectory() as name:
        source, demos = str(Path(name) / "ds"), Path(name) / "demos"
        options = f"--scenes medium:1 --seed {SEED} --episodes 1 --max-steps {STEPS} --cameras {CAMERA}@{SIDE}x{SIDE}"
        assert run(["generate", "social_nav", *options.split(), "-o", source]) == 0
        assert run(["export", source, "--to", "lerobot", "-o", str(demos)]) == 0
        video, env = frames_of(demos), DatasetEnv(demos, episodes="recorded")
        actions = h3data.load_recording(f"{source}#0").columns["agent_0.action"]
        observation, _ = env.reset(seed=0)
        key, seen = next(name for name in observation if name.startswith("observation.images")), []
        for step in range(1, len(video)):
            seen.append(np.asarray(observation[key]))
            observation, *_ = env.step(actions[step])
    sheet = Image.new("RGB", ((SIDE + 4) * len(SHOWN) - 4, 2 * (SIDE + TITLE)), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for row, (frames, what) in enumerate(((video, "video of the dataset"), (seen, "environment"))):
        top = row * (SIDE + TITLE)
        for n, step in enumerate(SHOWN):
            sheet.paste(Image.fromarray(frames[step]), (n * (SIDE + 4), top + TITLE))
            pen.text((n * (SIDE + 4) + 2, top + 1), f"{what}, frame {step}", "black", font)
    sheet.save(out, quality=78, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
