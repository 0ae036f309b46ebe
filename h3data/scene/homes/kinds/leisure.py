"""Books and paper, electronics, things of a desk, and toys."""

from __future__ import annotations

from h3data.scene.homes.kinds.kind import numbered, thing
from h3data.scene.homes.kinds.parts import arc, ball, box, lathe, line, rod, soft


def _spines(*books: tuple[float, float, str], deep: float = 0.17) -> tuple:
    """Upright books side by side: thickness, height, colour."""
    width, out = sum(b[0] for b in books), []
    at = -width / 2
    for thick, tall, color in books:
        out.append(box(color, at + thick / 2, 0, 0, thick - 0.002, tall, deep, bevel=0.002))
        out.append(box("paper", at + thick / 2, tall - 0.001, 0.002, thick - 0.008, 0.002, deep - 0.008))
        out.append(box("paper*0.85", at + thick / 2, 0.7 * tall, deep / 2 - 0.0005, thick - 0.012, 0.03, 0.0015))
        at += thick
    return tuple(out)


_PAPER = (
    thing("book_row", 2.4, "body", _spines((0.03, 0.24, "bright"), (0.022, 0.21, "bright2*0.8"), (0.04, 0.25, "leather"),
          (0.026, 0.22, "bright3"), (0.034, 0.2, "paper*0.7"), (0.02, 0.23, "bright4*0.7")), aligned=True),
    thing("magazine", 0.25, "edge", box("bright", 0, 0, 0, 0.21, 0.008, 0.28), box("paper", -0.02, 0.008, 0.02, 0.14, 0.0006,
          0.16), box("bright2", 0, 0.008, -0.11, 0.18, 0.0008, 0.04)),
    thing("newspaper", 0.2, "edge", box("paper*0.92", 0, 0, 0, 0.29, 0.012, 0.2, bevel=0.003), tuple(box((120, 120, 118), x,
          0.012, 0.03 * k - 0.02, 0.11, 0.0006, 0.018) for x in (-0.07, 0.07) for k in range(3)), box((60, 60, 62), 0, 0.012,
          -0.07, 0.22, 0.0006, 0.026)),
    thing("notebook", 0.3, "edge", box("bright*0.7", 0, 0, 0, 0.15, 0.018, 0.21, bevel=0.003), box("paper", 0.002, 0.003, 0,
          0.148, 0.012, 0.206), box("black", 0.055, 0.0005, 0, 0.005, 0.0185, 0.211), aligned=False),
    thing("open_book", 0.5, "edge", box("bright", 0, 0, 0, 0.32, 0.005, 0.22), tuple(box("paper", 0.077 * s, 0.007, 0, 0.15,
          0.012, 0.21, bevel=0.004, turn=(0, 0, s * 5)) for s in (-1, 1)), tuple(box((150, 150, 148), 0.077 * s, 0.0192, 0.03 *
          k, 0.1, 0.0008, 0.012, turn=(0, 0, s * 5)) for s in (-1, 1) for k in (-2, -1, 0, 1, 2))),
    thing("binder", 0.8, "edge", box("bright", 0, 0, 0, 0.07, 0.31, 0.28, bevel=0.003), box("paper", 0, 0.18, 0.1405, 0.05,
          0.09, 0.0015), rod("steel", 0, 0.04, 0.14, 0.014, 0.003, turn=(90, 0, 0)), aligned=True),
    thing("paper_stack", 1.0, "edge", box("paper", 0, 0, 0, 0.21, 0.022, 0.297), box("paper*0.94", 0.006, 0.022, 0.003, 0.21,
          0.012, 0.297, turn=(0, 5, 0)), aligned=True),
    thing("letters", 0.1, "edge", box("paper", 0, 0, 0, 0.22, 0.004, 0.11), box("paper*0.93", 0.012, 0.004, 0.01, 0.22, 0.004,
          0.11, turn=(0, 14, 0)), box("cardboard", -0.01, 0.008, 0, 0.2, 0.004, 0.1, turn=(0, -9, 0)), box("bright", 0.075,
          0.0125, -0.012, 0.022, 0.0006, 0.026)),
)  # fmt: skip

_SCREEN = (54, 78, 110)
_DEVICES = (
    thing("laptop", 1.6, "edge", box("steel", 0, 0, 0.0, 0.32, 0.016, 0.22, bevel=0.004), box("black", 0, 0.016, -0.02, 0.28,
          0.001, 0.1), box("steel*0.85", 0, 0.016, 0.07, 0.1, 0.001, 0.06), box("steel", 0, 0.01, -0.135, 0.32, 0.21, 0.008,
          bevel=0.003, turn=(-18, 0, 0)), box(_SCREEN, 0, 0.022, -0.1295, 0.296, 0.18, 0.004, turn=(-18, 0, 0)), aligned=True),
    thing("tablet", 0.5, "edge", box("device", 0, 0, 0, 0.17, 0.008, 0.24, bevel=0.003), box(_SCREEN, 0, 0.008, 0, 0.155,
          0.0006, 0.215)),
    thing("smartphone", 0.18, "edge", box("device", 0, 0, 0, 0.072, 0.009, 0.148, bevel=0.003), box((30, 36, 48), 0, 0.009, 0,
          0.066, 0.0006, 0.14)),
    thing("keyboard", 0.7, "edge", box("device", 0, 0, 0, 0.42, 0.018, 0.14, bevel=0.004), tuple(box("device*0.8", 0, 0.018,
          0.028 * k - 0.045, 0.39, 0.006, 0.022) for k in range(4)), aligned=True),
    thing("computer_mouse", 0.1, "body", soft("device", 0, 0, 0, 0.062, 0.036, 0.11, 0.017), box("black", 0, 0.034, -0.025,
          0.008, 0.006, 0.022, bevel=0.002)),
    thing("printer", 6.5, "none", box("device", 0, 0, 0, 0.42, 0.15, 0.32, bevel=0.012), box("black", 0, 0.15, -0.02, 0.36,
          0.014, 0.24, bevel=0.004), box("paper", 0, 0.05, 0.18, 0.23, 0.004, 0.1), box("black", 0, 0.042, 0.17, 0.27, 0.008,
          0.08), box("paper", 0, 0.15, -0.13, 0.22, 0.13, 0.004, turn=(-15, 0, 0)), box((90, 170, 210), 0.13, 0.166, 0.09, 0.07,
          0.002, 0.03), aligned=True),
    thing("router", 0.4, "body", box("device", 0, 0, 0, 0.22, 0.035, 0.14, bevel=0.008), tuple(rod("black", 0.08 * s, 0.03,
        -0.06, 0.006, 0.15, n=6) for s in (-1, 1)), box((110, 220, 130), 0, 0.018, 0.0705, 0.1, 0.004, 0.001), aligned=True),
    thing("desk_lamp", 1.5, "body", rod("tool", 0, 0, 0, 0.08, 0.02, n=16), line("metal", 0.008, (0, 0.02, 0), (-0.08, 0.24, 0),
          (0.05, 0.4, 0)), rod("tool", 0.065, 0.35, 0, 0.06, 0.08, top=0.02, turn=(0, 0, 20), n=12), ball((252, 244, 214), 0.07,
          0.352, 0, 0.03, n=8)),
    thing("pen_cup", 0.25, "body", lathe("steel", (0, 0), (0.036, 0), (0.036, 0.1), (0.033, 0.1), (0.033, 0.01), (0, 0.01)),
          line("toy", 0.004, (0, 0.012, 0), (0.028, 0.17, 0), n=6), line("toy2", 0.004, (0, 0.012, 0.01), (-0.02, 0.165, 0.018),
          n=6), line("toy3", 0.004, (0, 0.012, -0.01), (0.004, 0.16, -0.028), n=6), solid="box"),
    thing("stapler", 0.25, "body", box("black", 0, 0, 0, 0.038, 0.01, 0.13, bevel=0.003), box("toy", 0, 0.016, -0.002, 0.034,
          0.028, 0.12, bevel=0.009, turn=(-7, 0, 0))),
    thing("tape_dispenser", 0.5, "body", box("plastic", 0, 0, 0.01, 0.05, 0.03, 0.14, bevel=0.006), rod("plastic*0.8", 0,
        0.022, -0.01, 0.034, 0.03, turn=(0, 0, 90), n=14), rod((230, 214, 160), 0, 0.026, -0.01, 0.03, 0.022, turn=(0, 0, 90),
        n=14)),
    thing("calculator", 0.15, "edge", box("device", 0, 0, 0, 0.085, 0.014, 0.15, bevel=0.004), box((150, 170, 150), 0, 0.014,
          -0.05, 0.066, 0.001, 0.026), tuple(box("plastic*0.8", -0.026 + 0.026 * i, 0.014, -0.015 + 0.022 * k, 0.018, 0.003,
          0.014) for i in range(3) for k in range(4))),
    thing("globe", 1.2, "body", rod("wood_dark", 0, 0, 0, 0.08, 0.02, n=16), rod("brass", 0, 0.02, 0, 0.008, 0.05, n=8), ball(
          (88, 140, 184), 0, 0.175, 0, 0.1, n=14), ball((120, 150, 92), 0.028, 0.2, 0.03, 0.078, 0.05, 0.066, n=8), ball((196,
          176, 120), -0.03, 0.155, -0.03, 0.076, 0.045, 0.066, n=8), arc("brass", 0, 0.175, 0.108, -90, 90, 0.005, n=8)),
    thing("headphones", 0.25, "body", arc("black", 0, 0.07, 0.08, 0, 180, 0.008, n=8), tuple(rod("device", 0.08 * s, 0.025, 0,
          0.038, 0.03, turn=(0, 0, 90), n=12) for s in (-1, 1))),
    thing("remote_control", 0.12, "edge", box("device*0.7", 0, 0, 0, 0.046, 0.018, 0.17, bevel=0.006), rod("steel", 0, 0.018,
          -0.025, 0.014, 0.003, n=10), rod((200, 50, 44), 0.012, 0.018, -0.068, 0.005, 0.003, n=6), tuple(box("plastic", 0.013 *
          i, 0.018, 0.02 + 0.018 * k, 0.008, 0.002, 0.01) for i in (-1, 0, 1) for k in range(3))),
    thing("game_controller", 0.25, "body", soft("device", 0, 0.006, 0, 0.11, 0.036, 0.065, 0.016), tuple(soft("device", 0.058
        * s, 0.0, 0.025, 0.042, 0.04, 0.1, 0.018) for s in (-1, 1)), tuple(rod("black", 0.026 * s, 0.042, 0.016, 0.009, 0.012,
        n=8) for s in (-1, 1))),
    thing("speaker", 2.2, "body", box("wood", 0, 0, 0, 0.15, 0.25, 0.17, bevel=0.006), box("black", 0, 0.008, 0.0855, 0.136,
          0.234, 0.002), rod("device*0.8", 0, 0.03, 0.087, 0.052, 0.006, turn=(90, 0, 0), n=14), rod("steel", 0, 0.16, 0.088,
          0.026, 0.006, turn=(90, 0, 0), n=12), aligned=True),
    thing("radio", 1.0, "handle", box("pastel", 0, 0, 0, 0.26, 0.15, 0.09, bevel=0.018), rod("linen", -0.06, 0.02, 0.046, 0.052,
          0.004, turn=(90, 0, 0), n=16), box("paper", 0.065, 0.085, 0.046, 0.09, 0.03, 0.003), rod("brass", 0.065, 0.03, 0.05,
          0.018, 0.014, turn=(90, 0, 0)), line("leather", 0.007, (-0.09, 0.148, 0), (-0.07, 0.178, 0), (0.07, 0.178, 0), (0.09,
          0.148, 0)), hold=(0, 0.178, 0), aligned=True),
    thing("camera", 0.6, "body", box("black", 0, 0, 0, 0.13, 0.075, 0.05, bevel=0.008), box("black", 0, 0.075, 0, 0.045,
        0.022, 0.045, bevel=0.006), rod("steel", 0, 0.008, 0.04, 0.032, 0.05, turn=(90, 0, 0), n=14), rod((40, 48, 66), 0,
        0.014, 0.066, 0.026, 0.002, turn=(90, 0, 0), n=14), rod("steel", 0.045, 0.075, 0, 0.009, 0.008, n=8)),
    thing("alarm_clock", 0.35, "body", rod("tool", 0, 0.014, 0, 0.052, 0.05, turn=(90, 0, 0), n=16), rod("paper", 0, 0.021,
        0.026, 0.045, 0.002, turn=(90, 0, 0), n=16), box("black", 0, 0.066, 0.0275, 0.004, 0.03, 0.001), box("black", 0.012,
        0.064, 0.0275, 0.026, 0.004, 0.001), tuple(ball("brass", 0.03 * s, 0.125, 0, 0.02, 0.014, 0.02, n=8) for s in (-1,
        1)), tuple( line("steel", 0.004, (0.028 * s, 0.03, 0), (0.038 * s, 0.0, 0)) for s in (-1, 1)), aligned=True),
    thing("game_console", 3.2, "body", box("device", 0, 0, 0, 0.3, 0.055, 0.24, bevel=0.006), box((60, 130, 220), 0, 0.026,
          0.1205, 0.28, 0.004, 0.001), aligned=True),
    thing("record_player", 5.0, "none", box("wood", 0, 0.01, 0, 0.42, 0.09, 0.34, bevel=0.006), rod("black", -0.05, 0.1, 0,
        0.15, 0.008, n=22), rod("tool", -0.05, 0.1085, 0, 0.045, 0.001, n=14), line("steel", 0.006, (0.16, 0.125, -0.12),
        (0.16, 0.125, 0.02), (0.06, 0.118, 0.08)), rod("steel", 0.16, 0.1, -0.12, 0.022, 0.03), aligned=True),
)  # fmt: skip


def _wheels(xs: tuple[float, ...], half: float, r: float, color: str = "black") -> tuple:
    return tuple(rod(color, x, 0, s * half, r, 0.016, turn=(90, 0, 0), n=10) for x in xs for s in (-1, 1))


_TOYS = (
    thing("toy_car", 0.2, "body", soft("toy", 0, 0.018, 0, 0.15, 0.035, 0.07, 0.014), soft("toy*0.85", -0.01, 0.048, 0, 0.08,
        0.03, 0.06, 0.012), box((176, 208, 226), -0.01, 0.052, 0, 0.07, 0.018, 0.0615), _wheels((-0.045, 0.045), 0.034,
        0.019)),
    thing("toy_truck", 0.6, "body", box("toy", 0.075, 0.035, 0, 0.08, 0.09, 0.1, bevel=0.01), box((176, 208, 226), 0.1, 0.08,
        0, 0.032, 0.03, 0.09), box("toy2", -0.055, 0.035, 0, 0.16, 0.012, 0.11), tuple(box("toy2", -0.055, 0.045, 0.052 * s,
        0.16, 0.055, 0.008) for s in (-1, 1)), box("toy2", -0.132, 0.045, 0, 0.008, 0.055, 0.11), _wheels((-0.09, -0.03,
        0.075), 0.05, 0.026)),
    thing("toy_train", 0.5, "body", box("toy", 0, 0.02, 0, 0.2, 0.02, 0.07), rod("toy2", 0.03, 0.036, 0, 0.03, 0.13, turn=(0,
        0, 90)), box("toy", -0.06, 0.04, 0, 0.06, 0.075, 0.07, bevel=0.004), box("toy2*0.8", -0.06, 0.115, 0, 0.075, 0.01,
        0.08, bevel=0.003), rod("black", 0.065, 0.09, 0, 0.012, 0.045, top=0.018, n=8), _wheels((-0.065, 0.0, 0.065), 0.036,
        0.022)),
    thing("toy_blocks", 0.5, "body", box("toy", -0.045, 0, 0.0, 0.05, 0.05, 0.05, bevel=0.003), box("toy2", 0.012, 0, 0.005,
        0.05, 0.05, 0.05, bevel=0.003, turn=(0, 18, 0)), box("toy3", -0.02, 0.05, 0.0, 0.05, 0.05, 0.05, bevel=0.003, turn=(0,
        9, 0)), rod("toy4", -0.02, 0.1, 0, 0.036, 0.045, top=0.002, n=4, turn=(0, 30, 0)), rod("toy5", 0.055, 0, -0.045, 0.02,
        0.05, n=12)),
    thing("teddy_bear", 0.35, "body", ball("fur", 0, 0.1, 0, 0.075, 0.085, 0.065), ball("fur", 0, 0.215, 0.005, 0.06, 0.055,
        0.055), tuple(ball("fur*0.9", 0.045 * s, 0.26, 0, 0.024, 0.024, 0.014, n=8) for s in (-1, 1)), ball("fur*1.2", 0, 0.2,
        0.052, 0.026, 0.02, 0.016, n=8), ball("black", 0, 0.208, 0.067, 0.008, n=6), tuple(ball("fur", 0.06 * s, 0.034, 0.06,
        0.034, 0.034, 0.06, n=8) for s in (-1, 1)), tuple(ball("fur", 0.085 * s, 0.125, 0.02, 0.03, 0.05, 0.03, n=8) for s in
        (-1, 1)), tuple(ball("black", 0.022 * s, 0.228, 0.056, 0.006, n=6) for s in (-1, 1))),
    thing("toy_rabbit", 0.2, "body", ball("pastel", 0, 0.07, 0, 0.055, 0.065, 0.05), ball("pastel", 0, 0.155, 0.005, 0.042,
        0.04, 0.04), tuple(ball("pastel*0.93", 0.022 * s, 0.23, 0, 0.013, 0.05, 0.01, n=8) for s in (-1, 1)),
        tuple(ball("pastel", 0.04 * s, 0.024, 0.04, 0.024, 0.024, 0.045, n=8) for s in (-1, 1)), tuple(ball("black", 0.016 *
        s, 0.163, 0.04, 0.005, n=6) for s in (-1, 1))),
    thing("ball", 0.4, "body", ball("toy", 0, 0.1, 0, 0.1, n=14), lathe("white", (0.0955, -0.03), (0.1005, 0), (0.0955, 0.03),
          y=0.1, n=14), solid="round"),
    thing("doll", 0.25, "body", rod("pastel", 0, 0.0, 0, 0.065, 0.15, top=0.025, n=12), ball((232, 190, 160), 0, 0.185, 0,
        0.036, n=10), ball("leather", 0, 0.197, -0.008, 0.04, 0.034, 0.036, n=10), tuple(line((232, 190, 160), 0.01, (0.025 *
        s, 0.135, 0), (0.065 * s, 0.085, 0.012)) for s in (-1, 1)), solid="box"),
    thing("toy_robot", 0.4, "body", box("steel", 0, 0.07, 0, 0.09, 0.1, 0.06, bevel=0.006), box("steel*1.1", 0, 0.178, 0,
        0.065, 0.055, 0.055, bevel=0.006), tuple(rod("toy", 0.017 * s, 0.196, 0.026, 0.009, 0.008, turn=(90, 0, 0), n=8) for s
        in (-1, 1)), tuple( box("toy2", 0.024 * s, 0, 0.006, 0.034, 0.07, 0.06, bevel=0.004) for s in (-1, 1)),
        tuple(box("toy", 0.06 * s, 0.075, 0, 0.022, 0.085, 0.03, bevel=0.005) for s in (-1, 1)), rod("toy", 0, 0.233, 0,
        0.004, 0.03, n=5), box("toy2", 0, 0.1, 0.031, 0.06, 0.04, 0.003)),
    thing("puzzle_box", 0.6, "body", box("toy", 0, 0, 0, 0.27, 0.05, 0.19, bevel=0.003), box("pastel", 0, 0.05, 0, 0.23, 0.0008,
          0.15), box("toy2", -0.05, 0.0508, 0.01, 0.09, 0.0006, 0.08), rod("toy3", 0.06, 0.0508, -0.01, 0.035, 0.0006, n=12),
          aligned=True),
    thing("board_game", 1.2, "body", box("bright", 0, 0, 0, 0.28, 0.06, 0.28, bevel=0.003), box("paper", 0, 0.06, 0, 0.2,
        0.0008, 0.2), box("bright2", 0, 0.0608, -0.05, 0.17, 0.0006, 0.05), aligned=True),
    thing("stacking_rings", 0.4, "top", rod("wood", 0, 0, 0, 0.07, 0.015, n=16), rod("wood", 0, 0.015, 0, 0.009, 0.13, n=8),
        tuple( lathe(f"toy{'' if k == 0 else k}", (0.02, 0), (0.062 - 0.009 * k, 0.004), (0.066 - 0.009 * k, 0.013), (0.062 -
        0.009 * k, 0.022), (0.02, 0.026), y=0.015 + 0.026 * k, n=12) for k in range(4)), ball("toy", 0, 0.15, 0, 0.02, n=8),
        solid="round"),
    thing("toy_dinosaur", 0.3, "body", ball("green", 0, 0.08, 0, 0.07, 0.045, 0.04), line("green", 0.018, (0.05, 0.09, 0),
        (0.085, 0.14, 0), (0.1, 0.175, 0), n=8), ball("green", 0.115, 0.185, 0, 0.034, 0.02, 0.022, n=8), line("green*0.9",
        0.016, (-0.05, 0.08, 0), (-0.1, 0.06, 0), (-0.15, 0.03, 0), n=8), tuple(rod("green*0.85", 0.035 * sx, 0, 0.026 * sz,
        0.016, 0.07, n=8) for sx in (-1, 1) for sz in (-1, 1)), tuple(box("toy", -0.05 + 0.033 * k, 0.115, 0, 0.024, 0.024,
        0.006, turn=(0, 0, 45)) for k in range(4))),
    thing("toy_plane", 0.25, "body", lathe("toy", (0, 0), (0.022, 0.04), (0.025, 0.14), (0.008, 0.24), (0, 0.24), n=10,
        x=0.12, y=0.05, turn=(0, 0, 90)), box("toy2", 0.03, 0.052, 0, 0.05, 0.008, 0.26, bevel=0.003), box("toy2", -0.1,
        0.055, 0, 0.03, 0.006, 0.1), box("toy2", -0.105, 0.055, 0, 0.03, 0.055, 0.006), _wheels((0.045,), 0.025, 0.016),
        rod("black", -0.09, 0.0, 0, 0.008, 0.05, n=6)),
    thing("magic_cube", 0.1, "body", box("black", 0, 0, 0, 0.057, 0.057, 0.057, bevel=0.002), tuple(box(c, -0.0185 + 0.0185 *
        (k % 3), 0.057, -0.0185 + 0.0185 * (k // 3), 0.016, 0.0008, 0.016) for k, c in enumerate(("toy", "toy2", "white",
        "toy3", "toy4", "toy", "toy2", "white", "toy3"))), tuple(box(c, -0.0185 + 0.0185 * (k % 3), 0.002 + 0.0185 * (k // 3),
        0.0287, 0.016, 0.016, 0.0008) for k, c in enumerate(("toy3", "white", "toy", "toy2", "toy4", "toy3", "white", "toy",
        "toy4")))),
    thing("crayon_box", 0.2, "body", box("toy", 0, 0, 0, 0.1, 0.08, 0.03, bevel=0.002), tuple(rod(f"toy{k}", -0.036 + 0.018 *
        k, 0.075, 0, 0.007, 0.035, top=0.002, n=6) for k in range(1, 6)), aligned=False),
    thing("toy_drum", 0.5, "rim", rod("toy", 0, 0, 0, 0.085, 0.12, n=18), rod("toy2", 0, 0, 0, 0.088, 0.016, n=18),
        rod("toy2", 0, 0.105, 0, 0.088, 0.016, n=18), rod("paper", 0, 0.121, 0, 0.082, 0.002, n=18), line("wood", 0.005,
        (-0.06, 0.128, 0.02), (0.09, 0.13, -0.03)), solid="round"),
    thing("xylophone", 0.6, "edge", tuple(box("wood", 0, 0, 0.05 * s, 0.28, 0.025, 0.014) for s in (-1, 1)),
        tuple(box(f"toy{k}" if k else "toy", -0.115 + 0.046 * k, 0.025, 0, 0.034, 0.008, 0.19 - 0.018 * k, bevel=0.002) for k
        in range(6))),
    thing("toy_boat", 0.25, "body", lathe("toy", (0, 0), (0.05, 0.005), (0.07, 0.045), (0.064, 0.045), (0, 0.03), n=12,
        stretch=(1.5, 0.7)), rod("wood", 0, 0.03, 0, 0.005, 0.2, n=6), box("linen", 0.03, 0.07, 0, 0.06, 0.14, 0.003),
        box("toy2", -0.024, 0.07, 0, 0.035, 0.1, 0.003)),
    thing("toy_bucket", 0.15, "handle", lathe("toy", (0, 0), (0.06, 0), (0.08, 0.12), (0.076, 0.12), (0.056, 0.01), (0, 0.01),
        n=14), arc( "toy2", 0, 0.115, 0.079, 0, 180, 0.005, n=7), line("toy3", 0.008, (0, 0.03, 0.01), (0.03, 0.19, 0.02)),
        box("toy3", 0.033, 0.17, 0.022, 0.05, 0.07, 0.006), hold=(0, 0.19, 0)),
)  # fmt: skip

LEISURE = numbered(400, (*_PAPER, *_DEVICES, *_TOYS))
