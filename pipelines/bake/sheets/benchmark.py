"""Script for docs/pictures/benchmark.png: the baselines of the benchmarks, each mean with its 95% interval.

python -m bake.sheets.benchmark docs/pictures/benchmark.png
"""

from __future__ import annotations

import sys

from PIL import Image, ImageDraw, ImageFont

from h3data_pipelines.benchmark.definition import benchmark_labels, find_benchmark
from h3data_pipelines.benchmark.leaderboard import Leaderboard, leaderboard

NAMES_PX, COLUMN_PX, ROW_PX, GAP_PX, FINER = 170, 150, 24, 14, 2
COLOR, FAINT = "#30638e", "#dddddd"


def main(out: str) -> None:
    """Draw a table of dots and intervals for each benchmark that has baselines."""
    boards = [board for label in benchmark_labels() if (board := leaderboard(find_benchmark(label), ())).entries]
    columns = max(len(board.benchmark.file.metrics) for board in boards)
    height = sum(ROW_PX * (len(board.entries) + 2) + GAP_PX for board in boards)
    sheet = Image.new("RGB", ((NAMES_PX + COLUMN_PX * columns) * FINER, height * FINER), "white")
    pen, top = ImageDraw.Draw(sheet), 0
    for board in boards:
        _draw(pen, board, top * FINER)
        top += ROW_PX * (len(board.entries) + 2) + GAP_PX
    sheet.resize((sheet.width // FINER, sheet.height // FINER), Image.Resampling.LANCZOS).quantize(32).save(
        out, optimize=True
    )


def _draw(pen: ImageDraw.ImageDraw, board: Leaderboard, top: int) -> None:
    row, font = ROW_PX * FINER, ImageFont.load_default(13 * FINER)
    pen.text((4 * FINER, top + 4 * FINER), f"{board.benchmark.label}: {board.benchmark.file.about}", "black", font)
    for k, metric in enumerate(board.benchmark.metrics()):
        left, width = (NAMES_PX + COLUMN_PX * k) * FINER, (COLUMN_PX - 20) * FINER
        cells = [entry.row.metrics.get(metric.name, {}) for entry in board.entries]
        ends = [value for cell in cells for name in ("mean", "high") if (value := cell.get(name)) is not None]
        most = max([1.0, *ends])
        unit = "" if metric.unit in ("", "1") else f" {metric.unit}"
        pen.text(
            (left, top + row + 4 * FINER),
            f"{metric.name} (0 to {round(most, 1 if most < 10 else None):g}{unit})",
            "black",
            font,
        )
        for n, (entry, cell) in enumerate(zip(board.entries, cells, strict=True)):
            y = top + row * (n + 2) + row // 2
            if k == 0:
                pen.text((4 * FINER, y - 8 * FINER), entry.row.policy, "black", font)
            pen.line((left, y, left + width, y), FAINT, FINER)
            mean = cell.get("mean")
            if mean is None:
                continue
            ends = (mean if (value := cell.get(name)) is None else value for name in ("mean", "low", "high"))
            at, low, high = (left + width * end / most for end in ends)
            pen.line((low, y, high, y), COLOR, 3 * FINER)
            pen.ellipse((at - 5 * FINER, y - 5 * FINER, at + 5 * FINER, y + 5 * FINER), COLOR)


if __name__ == "__main__":
    main(*sys.argv[1:])
