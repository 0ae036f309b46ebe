"""One idea: twenty homes at a glance. Usage: python examples/contact_sheet.py docs/pictures/homes.jpg"""

import sys
from pathlib import Path

import cv2
import numpy as np

from h3data.render.sheets.scene_map import plan_picture
from h3data.scenes import HomeSpec, build_home

HOMES, COLUMNS = {"small": 9, "medium": 8, "large": 3}, 5
CELL_W, CELL_H, LABEL_H = 330, 440, 26
LIMIT_BYTES = 900_000

if len(sys.argv) < 2:
    sys.exit(__doc__)
cells = []
for preset, count in HOMES.items():
    for seed in range(count):
        home = build_home(HomeSpec(preset=preset, seed=seed))
        span = np.ptp(home.bounds[:, [0, 2]], axis=0) + 1.0
        turn = span[0] > span[1]  # wide homes lie on their side, to fill their cell
        if turn:
            span = span[::-1]
        scale = min(CELL_W / span[0], (CELL_H - LABEL_H) / span[1])  # each home as large as its cell allows
        picture, _ = plan_picture(home, pixels_per_m=float(scale))
        picture = np.rot90(picture) if turn else picture
        cell = np.full((CELL_H, CELL_W, 3), 250, np.uint8)
        height, width = (min(a, b) for a, b in zip(picture.shape[:2], (CELL_H - LABEL_H, CELL_W), strict=True))
        left = (CELL_W - width) // 2
        cell[LABEL_H : LABEL_H + height, left : left + width] = picture[:height, :width]
        label = f"{preset}:{seed}   {len(home.rooms)} rooms"
        cv2.putText(cell, label, (10, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (30, 30, 36), 1, cv2.LINE_AA)
        cells.append(cell)

rows = [np.concatenate(cells[k : k + COLUMNS], axis=1) for k in range(0, len(cells), COLUMNS)]
sheet = np.concatenate(rows)
for quality in range(92, 30, -4):
    data = cv2.imencode(".jpg", sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    if len(data) <= LIMIT_BYTES:
        break
out = Path(sys.argv[1])
out.parent.mkdir(parents=True, exist_ok=True)
out.write_bytes(data)
print(f"{out}: {len(cells)} homes, {sheet.shape[1]}x{sheet.shape[0]}, {len(data) / 1e3:.0f} kB at quality {quality}")
