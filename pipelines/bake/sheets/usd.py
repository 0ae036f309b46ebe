"""Script for docs/pictures/usd.jpg: a generated home, the same home read from USD, and the number of different pixels.

python -m bake.sheets.usd docs/pictures/usd.jpg
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image, ImageDraw, ImageFont

from h3data.render.sheets.scene_map import plan_picture
from h3data.scene.open import named_scenes, open_scene
from h3data_worlds.usd.writing import write_usd

SCENE, PIXELS_PER_M, TITLE = "small2-doors:3", 40.0, 20


def main(out: str) -> None:
    """Write the home as USD, read it, and render both."""
    own = open_scene(named_scenes(SCENE)[0].source)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "home.usdz"
        write_usd(own, path)
        size = path.stat().st_size
        again = open_scene(named_scenes(str(path))[0].source)
    pictures = [plan_picture(scene, pixels_per_m=PIXELS_PER_M)[0] for scene in (own, again)]
    high, wide = pictures[0].shape[:2]
    differ = int((pictures[0] != pictures[1]).any(-1).sum())
    names = [SCENE, f"home.usdz ({size / 1e6:.1f} MB), read back: {differ} pixels differ"]
    sheet = Image.new("RGB", (2 * (wide + 6) - 6, high + TITLE), "white")
    for n, (image, name) in enumerate(zip(pictures, names, strict=True)):
        sheet.paste(Image.fromarray(image), (n * (wide + 6), TITLE))
        ImageDraw.Draw(sheet).text((n * (wide + 6) + 3, 2), name, "black", ImageFont.load_default(14))
    sheet.save(out, quality=80, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
