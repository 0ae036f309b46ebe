"""Makes ``docs/pictures/demo.webp``, the moving picture of the README, from the demo: ``python -m
pipelines.bake.moving_picture``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

SIZE = (480, 320)
"""Width and height of the third-person picture [px]; robot's depth and the map stand to its right, half as high."""
EVERY, FRAMES, MILLISECONDS = 3, 100, 100
"""A frame every 3 steps, 10 s of life, shown in real time."""


def main(demo: Path, out: Path) -> None:
    """Makes a looping WebP of the middle of the demo's three videos."""
    videos = [_pictures(demo / f"{name}.mp4") for name in ("third_person", "arm_depth", "top_down")]
    frames = [_sheet(*three) for three in zip(*videos, strict=True)]
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=MILLISECONDS, loop=0, quality=60, method=4)
    sys.stdout.write(f"{out}: {len(frames)} frames, {out.stat().st_size / 1e6:.1f} MB\n")


def _pictures(video: Path) -> list[NDArray[np.uint8]]:
    import av

    with av.open(str(video)) as container:
        every: list[NDArray[Any]] = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    first = max((len(every) - EVERY * FRAMES) // 2, 0)
    return every[first : first + EVERY * FRAMES : EVERY]


def _sheet(third_person: NDArray[np.uint8], depth: NDArray[np.uint8], top_down: NDArray[np.uint8]) -> Image.Image:
    width, height = SIZE
    sheet = Image.new("RGB", (width + height * 3 // 4, height), (24, 24, 27))
    sheet.paste(_filled(third_person, (width, height)), (0, 0))
    for row, picture in enumerate((depth, top_down)):
        sheet.paste(_filled(picture, (height * 3 // 4 - 4, height // 2 - 2)), (width + 4, row * (height // 2 + 2)))
    return sheet


def _filled(pixels: NDArray[np.uint8], size: tuple[int, int]) -> Image.Image:
    """The picture scaled and cut to a size, around its middle."""
    picture = Image.fromarray(pixels)
    scale = max(size[0] / picture.width, size[1] / picture.height)
    picture = picture.resize((round(picture.width * scale), round(picture.height * scale)), Image.Resampling.LANCZOS)
    left, top = (picture.width - size[0]) // 2, (picture.height - size[1]) // 2
    return picture.crop((left, top, left + size[0], top + size[1]))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/demo"), Path("docs/pictures/demo.webp"))
