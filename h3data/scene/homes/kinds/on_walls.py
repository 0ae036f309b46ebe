"""Things on walls and ceilings. Their frame has the middle of the back at the origin, so y is measured from the middle."""

from __future__ import annotations

from h3data.scene.homes.kinds.kind import Kind, numbered, piece, top
from h3data.scene.homes.kinds.parts import Nested, arc, ball, box, leaves, line, rod, soft


def _hung(name: str, mass_kg: float, *parts: Nested, **more: object) -> Kind:
    return piece(name, mass_kg, *parts, solid="none", role="wall", **more)  # type: ignore[arg-type]


_CLOCK = (
    rod("wood_dark", 0, -0.16, 0.015, 0.16, 0.03, turn=(90, 0, 0), n=22),
    rod("paper", 0, -0.145, 0.031, 0.145, 0.004, turn=(90, 0, 0), n=22),
)

WALL_KINDS = (
    _hung("wall_clock", 1.0, _CLOCK, box("black", -0.022, 0.0, 0.0345, 0.01, 0.085, 0.003, turn=(0, 0, 32)), box("black",
        0.03, 0.006, 0.0345, 0.008, 0.115, 0.003, turn=(0, 0, -64)), tuple(box("black", 0.12 * x, 0.12 * y - 0.012, 0.0335,
        0.01, 0.024, 0.002) for x, y in ((0, 1), (1, 0), (0, -1), (-1, 0)))),
    piece("wall_shelf", 3.0, box("wood", 0, -0.012, 0.11, 0.8, 0.024, 0.2, bevel=0.003), tuple(box("metal", s * 0.3, -0.12,
        0.05, 0.018, 0.11, 0.07) for s in (-1, 1)), solid="none", role="wall", surfaces=(top(0, 0.012, 0.11, 0.72, 0.15,
        0.5),)),
    _hung("coat_hooks", 1.2, box("wood", 0, -0.05, 0.012, 0.7, 0.1, 0.02, bevel=0.003), tuple(line("metal", 0.007, (x, -0.01,
        0.02), (x, -0.03, 0.06), (x, 0.015, 0.075)) for x in (-0.27, -0.09, 0.09, 0.27)), soft("cloth", -0.27, -0.78, 0.075,
        0.26, 0.78, 0.09, 0.04), soft("cloth2", 0.09, -0.62, 0.07, 0.24, 0.62, 0.08, 0.035), soft("leather", 0.27, -0.34,
        0.07, 0.2, 0.22, 0.07, 0.03), arc("leather", 0.27, -0.13, 0.07, 0, 180, 0.006, z=0.07)),
    _hung("towel_rail", 0.8, line("metal", 0.009, (-0.28, 0, 0.0), (-0.28, 0, 0.06), (0.28, 0, 0.06), (0.28, 0, 0.0)),
        soft("cloth", -0.05, -0.5, 0.06, 0.36, 0.52, 0.035, 0.014), box("cloth*1.2", -0.05, -0.42, 0.079, 0.36, 0.03, 0.002)),
    _hung("radiator", 18.0, tuple(box("white", -0.4 + 0.1 * i, -0.3, 0.06, 0.085, 0.56, 0.05, bevel=0.014) for i in range(9)),
        tuple(box("white", 0, y, 0.06, 0.9, 0.035, 0.03) for y in (-0.27, 0.2)), rod("steel", 0.48, -0.28, 0.06, 0.02, 0.07,
        turn=(0, 0, 90), n=8)),
    _hung("whiteboard", 5.0, box("steel", 0, -0.35, 0.01, 1.1, 0.7, 0.018, bevel=0.003), box("white", 0, -0.33, 0.02, 1.06,
        0.66, 0.003), box("steel", 0, -0.36, 0.04, 0.5, 0.012, 0.05), tuple(box(c, x, y, 0.0225, w, 0.012, 0.001) for c, x, y,
        w in (("toy", -0.25, 0.18, 0.4), ("toy2", -0.28, 0.1, 0.32), ("toy", -0.2, 0.02, 0.46), ("black", 0.3, -0.1, 0.24))),
        rod("toy3", 0.32, 0.04, 0.022, 0.09, 0.002, turn=(90, 0, 0), n=16)),
    _hung("cork_board", 2.0, box("wood", 0, -0.3, 0.01, 0.9, 0.6, 0.018, bevel=0.003), box((186, 140, 96), 0, -0.275, 0.02,
        0.85, 0.55, 0.003), tuple(box(c, x, y, 0.0225, w, h, 0.001, turn=(0, 0, a)) for c, x, y, w, h, a in (("paper", -0.25,
        -0.05, 0.2, 0.26, 4), ("pastel", 0.05, 0.06, 0.14, 0.14, -6), ("pastel2", 0.26, -0.12, 0.14, 0.14, 3), ("paper", 0.1,
        -0.22, 0.18, 0.13, -3))), tuple(ball("toy", x, y, 0.026, 0.008, n=6) for x, y in ((-0.25, 0.19), (0.05, 0.18), (0.26,
        0.01), (0.1, -0.1)))),
    _hung("tool_board", 6.0, box("plastic", 0, -0.35, 0.01, 1.3, 0.7, 0.018), rod("wood", -0.45, -0.12, 0.022, 0.014, 0.3,
        n=8), box("steel*0.7", -0.45, 0.17, 0.038, 0.14, 0.035, 0.03), box("steel", -0.1, -0.14, 0.024, 0.12, 0.34, 0.004,
        turn=(0, 0, 12)), box("wood", -0.06, 0.17, 0.03, 0.13, 0.09, 0.02, bevel=0.008), tuple(box("steel", 0.14 + 0.08 * i,
        -0.08 + 0.03 * i, 0.026, 0.022, 0.24 - 0.03 * i, 0.008) for i in range(4)), tuple(rod("tool", 0.5 + 0.06 * i, 0.02,
        0.022, 0.013, 0.1, n=8) for i in range(2)), tuple(rod("steel", 0.5 + 0.06 * i, -0.12, 0.03, 0.004, 0.15, n=5) for i in
        range(2)), arc("tool", -0.3, -0.2, 0.08, 0, 360, 0.01, z=0.034, n=10)),
    _hung("wall_lamp", 0.9, box("brass", 0, -0.06, 0.01, 0.08, 0.12, 0.02, bevel=0.004), line("brass", 0.007, (0, 0, 0.02),
        (0, 0.0, 0.1), (0, 0.04, 0.11)), rod("lampshade", 0, 0.03, 0.11, 0.09, 0.13, top=0.06, n=16)),
    _hung("key_rack", 0.5, box("wood", 0, -0.06, 0.01, 0.3, 0.12, 0.018, bevel=0.004), tuple(rod("brass", 0.08 * i, -0.03,
        0.03, 0.006, 0.03, turn=(90, 0, 0), n=6) for i in (-1, 0, 1)), tuple(box("steel", 0.08 * i, -0.1, 0.036, 0.014, 0.075,
        0.004) for i in (-1, 1))),
    _hung("pennants", 0.2, tuple(line("linen", 0.003, (-0.7 + 0.35 * i, 0.1 - 0.05 * (1 - abs(i - 2) / 2), 0.012), (-0.35 +
        0.35 * i, 0.1 - 0.05 * (1 - abs(i - 1) / 2), 0.012), n=4) for i in range(4)), tuple(box(f"toy{k % 4 or ''}", -0.62 +
        0.155 * k, -0.06 + 0.012 * abs(k - 4), 0.012, 0.1, 0.1, 0.004, turn=(0, 0, 45)) for k in range(9))),
    _hung("calendar", 0.3, box("paper", 0, -0.21, 0.004, 0.29, 0.42, 0.006), box("bright", 0, 0.02, 0.0075, 0.27, 0.17,
        0.002), ball("flower", 0.03, 0.1, 0.0085, 0.06, 0.05, 0.002, n=10), tuple(box("black", -0.105 + 0.035 * i, -0.05 -
        0.035 * k, 0.0072, 0.014, 0.012, 0.001) for i in range(7) for k in range(4))),
    _hung("hanging_plant", 1.5, line("metal", 0.006, (0, 0.12, 0.0), (0, 0.12, 0.15)), tuple(line("linen", 0.003, (0, 0.12,
        0.15), (0.08 * x, -0.1, 0.15 + 0.08 * z), n=4) for x, z in ((1, 0), (-0.5, 0.87), (-0.5, -0.87))), rod("clay", 0,
        -0.22, 0.15, 0.07, 0.13, top=0.09, n=14), leaves("green", 0, -0.1, 0.16, 15, 0.16, (0.5, 1.5), 0.02)),
    _hung("thermostat", 0.2, box("white", 0, -0.05, 0.012, 0.1, 0.1, 0.022, bevel=0.006), rod("device", 0, -0.03, 0.026, 0.03,
        0.006, turn=(90, 0, 0), n=14)),
    _hung("growth_chart", 0.4, box("pastel", 0, -0.55, 0.004, 0.2, 1.1, 0.007), tuple(box("black", -0.06, -0.5 + 0.1 * k,
        0.008, 0.05 + 0.02 * (k % 2), 0.006, 0.001) for k in range(11)), tuple(ball(f"toy{k}", 0.045, -0.3 + 0.3 * k, 0.008,
        0.035, 0.035, 0.003, n=10) for k in range(3))),
    _hung("sun_mirror", 0.6, rod("brass", 0, -0.2, 0.01, 0.2, 0.012, turn=(90, 0, 0), n=20), tuple(line("brass", 0.007, (0.19
        * x, 0.19 * y, 0.012), (0.32 * x, 0.32 * y, 0.012), n=5) for x, y in ((1, 0), (0.87, 0.5), (0.5, 0.87), (0, 1), (-0.5,
        0.87), (-0.87, 0.5), (-1, 0), (-0.87, -0.5), (-0.5, -0.87), (0, -1), (0.5, -0.87), (0.87, -0.5))), rod("glass", 0,
        -0.16, 0.017, 0.16, 0.004, turn=(90, 0, 0), n=20)),
)  # fmt: skip

ON_WALLS = numbered(180, WALL_KINDS)
