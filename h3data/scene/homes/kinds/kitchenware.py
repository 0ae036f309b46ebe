"""Kitchenware, appliances that stand on a worktop, and food."""

from __future__ import annotations

from h3data.scene.homes.kinds.kind import numbered, thing
from h3data.scene.homes.kinds.parts import arc, ball, box, lathe, leaves, line, rod, soft

_STEEL, _GLASS, _WOOD = "steel", (206, 222, 226), (186, 142, 92)


def _plate(r: float, h: float = 0.02) -> tuple:
    outer, inner = ((0, 0), (0.55 * r, 0), (0.62 * r, 0.35 * h), (r, h)), ((r, h), (0.64 * r, 0.45 * h), (0, 0.3 * h))
    return lathe("ceramic", *outer, n=18), lathe("ceramic*0.93", *inner, n=18)


def _vessel(color: str, r: float, h: float, wall: float = 0.004, *, n: int = 16) -> tuple:
    """An open pot: outside, rim, inside."""
    return (
        lathe(color, (0, 0), (r - 0.006, 0), (r, 0.008), (r, h), n=n),
        lathe(f"{color}*0.8", (r, h), (r - wall, h), (r - wall, 0.01), (0, 0.01), n=n),
    )


_DISHES = (
    thing("plate", 0.5, "edge", _plate(0.13), solid="round"),
    thing("dessert_plate", 0.3, "edge", _plate(0.095, 0.016), solid="round"),
    thing("teacup", 0.25, "handle", lathe("ceramic", (0, 0), (0.05, 0.002), (0.07, 0.012), (0, 0.009)),
          lathe("ceramic", (0, 0.01), (0.022, 0.01), (0.036, 0.04), (0.04, 0.068), (0.037, 0.068), (0, 0.05)),
          arc("ceramic", 0.036, 0.042, 0.018, -80, 80, 0.003, n=4), hold=(0.055, 0.042, 0)),
    thing("tumbler", 0.2, "body", lathe(_GLASS, (0, 0), (0.03, 0), (0.036, 0.11), (0.033, 0.11), (0.028, 0.012),
          (0, 0.012)), solid="round"),
    thing("wine_glass", 0.15, "body", lathe(_GLASS, (0, 0), (0.034, 0.002), (0.005, 0.008), (0.004, 0.085),
          (0.03, 0.11), (0.037, 0.15), (0.032, 0.2), (0.03, 0.2), (0.034, 0.15), (0, 0.1)), solid="round"),
    thing("jug", 0.8, "handle", lathe("ceramic", (0, 0), (0.055, 0), (0.07, 0.06), (0.048, 0.17), (0.055, 0.2),
          (0.05, 0.2), (0, 0.15)), arc("ceramic", 0.052, 0.12, 0.05, -75, 75, 0.007), hold=(0.1, 0.12, 0)),
    thing("teapot", 0.9, "handle", lathe("ceramic", (0, 0), (0.05, 0), (0.085, 0.05), (0.07, 0.11), (0.03, 0.13),
          (0, 0.132)), ball("ceramic*0.85", 0, 0.14, 0, 0.012), line("ceramic", 0.013, (-0.07, 0.055, 0),
          (-0.11, 0.075, 0), (-0.13, 0.115, 0)), arc("ceramic", 0.07, 0.07, 0.045, -80, 80, 0.007),
          hold=(0.115, 0.07, 0)),
    thing("salt_shaker", 0.12, "body", lathe(_GLASS, (0, 0), (0.02, 0), (0.017, 0.06)), rod(_STEEL, 0, 0.06, 0, 0.018,
          0.018, top=0.012), solid="round"),
    thing("pepper_mill", 0.3, "body", lathe(_WOOD, (0, 0), (0.028, 0), (0.022, 0.05), (0.016, 0.09), (0.024, 0.12),
          (0.014, 0.128), (0.022, 0.15), (0.016, 0.17), (0, 0.175)), ball(_STEEL, 0, 0.18, 0, 0.007), solid="round"),
    thing("fork", 0.05, "body", box(_STEEL, 0, 0, 0.035, 0.012, 0.004, 0.12), box(_STEEL, 0, 0, -0.045, 0.024, 0.004,
          0.04), tuple(box(_STEEL, 0.008 * i, 0, -0.082, 0.004, 0.004, 0.04) for i in (-1, 0, 1)), aligned=True),
    thing("table_knife", 0.06, "body", box("steel*0.8", 0, 0, 0.05, 0.014, 0.006, 0.1, bevel=0.002), box(_STEEL, 0.002,
          0, -0.055, 0.016, 0.003, 0.11), aligned=True),
    thing("spoon", 0.05, "body", box(_STEEL, 0, 0, 0.03, 0.01, 0.004, 0.13), lathe(_STEEL, (0, 0), (0.014, 0.002),
          (0.018, 0.008), (0, 0.004), z=-0.055, n=10, stretch=(1, 1.5)), aligned=True),
)  # fmt: skip

_COOKING = (
    thing("kettle", 1.2, "handle", lathe(_STEEL, (0, 0), (0.08, 0), (0.085, 0.02), (0.06, 0.17), (0.05, 0.185),
          (0, 0.19)), rod("black", 0, 0.19, 0, 0.012, 0.02), arc("black", 0.05, 0.12, 0.075, -70, 70, 0.011, n=5),
          line(_STEEL, 0.015, (-0.055, 0.13, 0), (-0.095, 0.17, 0)), hold=(0.125, 0.12, 0)),
    thing("pot", 1.8, "handle", _vessel(_STEEL, 0.11, 0.13), rod(_STEEL, 0, 0.13, 0, 0.112, 0.012), rod("black", 0,
          0.142, 0, 0.016, 0.022), tuple(box("black", s * 0.128, 0.095, 0, 0.036, 0.014, 0.06, bevel=0.004)
          for s in (-1, 1)), hold=(0.14, 0.1, 0)),
    thing("casserole", 3.2, "handle", _vessel("tool", 0.12, 0.1), lathe("tool*1.1", (0.122, 0.1), (0.11, 0.112),
          (0.05, 0.135), (0, 0.138)), ball("brass", 0, 0.15, 0, 0.014), tuple(box("tool", s * 0.135, 0.075, 0, 0.035,
          0.018, 0.07, bevel=0.006) for s in (-1, 1)), hold=(0.145, 0.085, 0)),
    thing("pan", 1.1, "handle", lathe("black", (0, 0), (0.1, 0), (0.13, 0.045), (0.127, 0.045), (0.098, 0.006),
          (0, 0.006), n=18, z=-0.1), box("black", 0, 0.035, 0.12, 0.024, 0.014, 0.19, bevel=0.004), hold=(0, 0.04, 0.14),
          aligned=True),
    thing("colander", 0.5, "rim", lathe(_STEEL, (0, 0), (0.05, 0), (0.05, 0.012), (0.08, 0.03), (0.12, 0.1),
          (0.13, 0.105), (0.117, 0.1), (0.077, 0.035), (0, 0.02), n=18), solid="round"),
    thing("cutting_board", 0.9, "edge", box(_WOOD, 0, 0, 0, 0.36, 0.02, 0.24, bevel=0.006), aligned=True),
    thing("knife_block", 1.6, "body", box(_WOOD, 0, 0.0, 0, 0.1, 0.2, 0.13, bevel=0.006), tuple(box("black", -0.03 +
          0.02 * i, 0.2, -0.04 + 0.03 * (i % 3), 0.012, 0.07 - 0.01 * (i % 2), 0.018) for i in range(4)), aligned=True),
    thing("utensil_jar", 0.8, "body", _vessel("ceramic", 0.05, 0.14), line(_WOOD, 0.005, (0, 0.02, 0), (0.02, 0.3, 0)),
          ball(_WOOD, 0.021, 0.3, 0, 0.02, 0.03, 0.008), line("black", 0.005, (0, 0.02, 0.01), (-0.025, 0.27, 0.015)),
          box("black", -0.026, 0.26, 0.016, 0.045, 0.07, 0.006), line(_STEEL, 0.004, (0, 0.02, -0.01), (0.0, 0.27, -0.03)),
          ball(_STEEL, 0, 0.3, -0.033, 0.022, 0.035, 0.022, n=8), solid="box"),
    thing("rolling_pin", 0.6, "body", rod(_WOOD, 0, 0, 0, 0.028, 0.25, turn=(0, 0, 90)), tuple(rod("wood_dark", s * 0.16,
          0.0, 0, 0.012, 0.07, turn=(0, 0, 90)) for s in (-1, 1)), aligned=True),
    thing("measuring_cup", 0.2, "handle", lathe(_GLASS, (0, 0), (0.045, 0), (0.058, 0.12), (0.055, 0.12), (0.042, 0.006),
          (0, 0.006)), arc(_GLASS, 0.052, 0.065, 0.036, -80, 80, 0.006, n=4), hold=(0.088, 0.065, 0)),
    thing("storage_jar", 0.7, "body", lathe("paper*0.9", (0, 0), (0.05, 0), (0.052, 0.006), (0.052, 0.13)),
          rod(_WOOD, 0, 0.13, 0, 0.053, 0.022), solid="round"),
    thing("spice_jar", 0.1, "body", rod("bright*0.8", 0, 0, 0, 0.021, 0.065), rod("black", 0, 0.065, 0, 0.022, 0.018),
          solid="round"),
    thing("dish_rack", 0.9, "rim", box("steel*0.9", 0, 0, 0, 0.2, 0.012, 0.34), tuple(line("steel", 0.003,
          (s * 0.1, 0.01, -0.17), (s * 0.1, 0.09, -0.17), (s * 0.1, 0.09, 0.17), (s * 0.1, 0.01, 0.17), n=5)
          for s in (-1, 1)), tuple(rod("ceramic", 0, 0.03, -0.12 + 0.045 * i, 0.085, 0.008, turn=(84, 0, 0), n=16)
          for i in range(4)), aligned=True),
    thing("tray", 0.8, "handle", box("wood", 0, 0, 0, 0.42, 0.012, 0.3), tuple(box("wood", 0, 0.0, s * 0.147, 0.42, 0.045,
          0.01) for s in (-1, 1)), tuple(box("wood", s * 0.205, 0.0, 0, 0.01, 0.06, 0.3) for s in (-1, 1)),
          hold=(0.205, 0.06, 0), aligned=True),
    thing("fruit_bowl", 1.2, "rim", lathe("ceramic", (0, 0), (0.05, 0), (0.055, 0.01), (0.1, 0.04), (0.14, 0.08),
          (0.135, 0.08), (0.09, 0.045), (0, 0.02), n=18), ball((198, 60, 44), 0.045, 0.07, 0.03, 0.037),
          ball((150, 176, 62), -0.04, 0.07, 0.035, 0.037), ball((236, 142, 40), 0.0, 0.07, -0.05, 0.037),
          ball((240, 206, 70), 0.0, 0.105, 0.005, 0.03, 0.026, 0.04), solid="round"),
    thing("thermos", 0.6, "body", lathe("tool", (0, 0), (0.038, 0), (0.04, 0.01), (0.04, 0.2), (0.03, 0.22)),
          rod(_STEEL, 0, 0.215, 0, 0.031, 0.05, top=0.027), solid="round"),
    thing("lunch_box", 0.3, "body", box("pastel", 0, 0, 0, 0.19, 0.055, 0.13, bevel=0.01), box("pastel*0.85", 0, 0.055, 0,
          0.195, 0.016, 0.135, bevel=0.006), aligned=True),
    thing("dish_soap", 0.6, "body", lathe("bright", (0, 0), (0.03, 0), (0.032, 0.1), (0.02, 0.16), (0.012, 0.17),
          stretch=(1, 0.7)), rod("white", 0, 0.17, 0, 0.013, 0.035, top=0.007), solid="box"),
    thing("sponge", 0.02, "body", box((236, 204, 76), 0, 0, 0, 0.1, 0.022, 0.065, bevel=0.004), box((72, 130, 84), 0,
          0.022, 0, 0.1, 0.01, 0.065), aligned=True),
    thing("paper_towel", 0.3, "body", rod("wood", 0, 0, 0, 0.075, 0.015, n=16), rod("paper", 0, 0.015, 0, 0.058, 0.22,
          n=16), rod("wood", 0, 0.235, 0, 0.011, 0.05), solid="round"),
)  # fmt: skip

_APPLIANCES = (
    thing("toaster", 1.5, "body", soft("steel", 0, 0.012, 0, 0.27, 0.17, 0.16, 0.035), tuple(box("black", 0, 0.181,
          0.035 * s, 0.2, 0.003, 0.028) for s in (-1, 1)), box("black", 0.142, 0.1, 0, 0.02, 0.02, 0.04, bevel=0.004),
          box("black", 0, 0, 0, 0.24, 0.014, 0.13), aligned=True),
    thing("coffee_machine", 4.0, "body", box("device", 0, 0, -0.02, 0.2, 0.03, 0.3, bevel=0.008), box("device", 0, 0.03,
          -0.11, 0.2, 0.25, 0.12, bevel=0.008), box("device", 0, 0.25, -0.01, 0.2, 0.09, 0.3, bevel=0.012),
          rod(_STEEL, 0, 0.215, 0.05, 0.028, 0.035), lathe(_GLASS, (0, 0.032), (0.05, 0.032), (0.06, 0.08),
          (0.045, 0.13), (0, 0.13), z=0.05), box(_STEEL, 0, 0.285, 0.141, 0.12, 0.03, 0.004), aligned=True),
    thing("microwave", 11.0, "none", box("device", 0, 0.012, 0, 0.46, 0.26, 0.34, bevel=0.008), box((30, 32, 36), -0.05,
          0.04, 0.171, 0.32, 0.2, 0.004), box("device*0.85", 0.17, 0.04, 0.171, 0.09, 0.2, 0.004), rod("steel", 0.17, 0.09,
          0.176, 0.02, 0.016, turn=(90, 0, 0)), box((90, 190, 160), 0.17, 0.19, 0.174, 0.06, 0.025, 0.003), box(_STEEL,
          0.105, 0.06, 0.182, 0.012, 0.16, 0.016), aligned=True),
    thing("blender", 2.5, "handle", rod("device", 0, 0, 0, 0.085, 0.11, top=0.06, n=14), lathe(_GLASS, (0.045, 0.11),
          (0.065, 0.28), (0.06, 0.28), (0, 0.15)), rod("black", 0, 0.28, 0, 0.067, 0.03), arc(_GLASS, 0.056, 0.2, 0.045,
          -70, 70, 0.008, n=4), rod(_STEEL, 0, 0.035, 0.075, 0.018, 0.014, turn=(90, 0, 0)), hold=(0.1, 0.2, 0)),
    thing("stand_mixer", 8.0, "none", box("tool", 0, 0, 0, 0.2, 0.03, 0.32, bevel=0.012), box("tool", 0, 0.03, -0.11,
          0.1, 0.2, 0.1, bevel=0.02), soft("tool", 0, 0.22, 0.0, 0.12, 0.11, 0.32, 0.045), lathe(_STEEL, (0, 0.032),
          (0.06, 0.032), (0.1, 0.1), (0.1, 0.14), (0.095, 0.14), (0, 0.05), z=0.06), rod(_STEEL, 0, 0.14, 0.07, 0.012,
          0.09), aligned=True),
    thing("rice_cooker", 3.0, "handle", lathe("device", (0, 0), (0.11, 0), (0.125, 0.03), (0.12, 0.17), (0.08, 0.205),
          (0, 0.21), n=16), box("black", 0, 0.06, 0.115, 0.09, 0.05, 0.014, bevel=0.003), arc("black", 0, 0.17, 0.07, 20,
          160, 0.009), hold=(0, 0.24, 0)),
    thing("kitchen_scale", 0.7, "body", box("white", 0, 0, 0, 0.18, 0.022, 0.2, bevel=0.006), rod(_GLASS, 0, 0.022, -0.02,
          0.075, 0.006, n=18), box((60, 80, 76), 0, 0.022, 0.08, 0.06, 0.002, 0.022), aligned=True),
    thing("bread_box", 2.0, "none", soft("steel", 0, 0, 0, 0.36, 0.19, 0.24, 0.07), box("wood", 0, 0, 0, 0.37, 0.02,
          0.24), box("wood", 0, 0.09, 0.12, 0.1, 0.014, 0.02), aligned=True),
)  # fmt: skip

_FOOD = (
    thing("banana", 0.35, "body", line((232, 200, 70), 0.017, (-0.09, 0.045, 0), (-0.045, 0.022, 0.0), (0.02, 0.018, 0),
          (0.07, 0.035, 0), n=8), line((212, 182, 60), 0.016, (-0.085, 0.048, 0.03), (-0.04, 0.022, 0.033), (0.025, 0.017,
          0.032), (0.07, 0.03, 0.025), n=8), ball((92, 70, 40), -0.095, 0.05, 0.015, 0.014, 0.01, 0.022, n=6)),
    thing("pear", 0.18, "body", lathe((176, 178, 76), (0, 0), (0.025, 0.005), (0.036, 0.03), (0.026, 0.065), (0.012,
          0.088), (0, 0.092)), rod((86, 66, 38), 0, 0.09, 0, 0.002, 0.015, n=5), solid="round"),
    thing("lemon", 0.1, "body", ball((240, 212, 66), 0, 0.029, 0, 0.038, 0.029, 0.029), ball((232, 200, 58), 0.037, 0.029,
          0, 0.008, n=6)),
    thing("tomato", 0.12, "body", ball((206, 52, 40), 0, 0.03, 0, 0.036, 0.03, 0.036), leaves((70, 120, 56), 0, 0.056, 0,
          5, 0.02, (1.2, 1.5), 0.005), solid="round"),
    thing("bell_pepper", 0.16, "body", lathe("toy", (0, 0.005), (0.022, 0), (0.038, 0.03), (0.04, 0.06), (0.02, 0.08),
          (0, 0.07), n=8), rod((84, 120, 60), 0, 0.072, 0, 0.006, 0.025, n=6), solid="round"),
    thing("bread", 0.6, "body", soft((190, 130, 76), 0, 0, 0, 0.13, 0.1, 0.27, 0.045), tuple(box((222, 178, 122), 0,
          0.094, 0.07 * i, 0.09, 0.008, 0.014, turn=(0, 25, 0)) for i in (-1, 0, 1)), aligned=True),
    thing("cheese", 0.4, "body", lathe((236, 196, 88), (0, 0), (0.08, 0), (0.08, 0.045), (0, 0.045), n=6,
          stretch=(1, 0.6)), box((224, 178, 70), 0, 0.045, 0, 0.05, 0.002, 0.03)),
    thing("milk_carton", 1.05, "body", box("white", 0, 0, 0, 0.075, 0.18, 0.075), box((60, 120, 180), 0, 0.04, 0, 0.076,
          0.07, 0.076), box("white", 0, 0.165, 0, 0.075, 0.05, 0.04, turn=(0, 0, 0)), box("white", 0, 0.21, 0, 0.075,
          0.025, 0.006), rod("tool", 0.0, 0.2, 0.022, 0.014, 0.016, turn=(45, 0, 0), n=8), solid="box"),
    thing("egg_box", 0.4, "body", box((156, 150, 140), 0, 0, 0, 0.24, 0.04, 0.1, bevel=0.008), tuple(lathe((232, 206, 176),
          (0.02, 0), (0.017, 0.018), (0, 0.03), x=-0.085 + 0.042 * i, y=0.038, z=0.022 * s, n=8) for i in range(5)
          for s in (-1, 1)), aligned=True),
    thing("jam_jar", 0.45, "body", rod((150, 36, 50), 0, 0, 0, 0.034, 0.085, n=12), rod("cloth", 0, 0.085, 0, 0.036, 0.018,
          n=12), rod("paper", 0, 0.025, 0, 0.0346, 0.035, n=12), solid="round"),
    thing("cake", 0.9, "rim", rod("ceramic", 0, 0, 0, 0.06, 0.05, top=0.02), rod("ceramic", 0, 0.05, 0, 0.14, 0.008, n=18),
          rod((236, 214, 190), 0, 0.058, 0, 0.11, 0.07, n=18), rod((112, 66, 46), 0, 0.128, 0, 0.112, 0.012, n=18),
          tuple(ball((196, 40, 50), 0.07 * x, 0.146, 0.07 * z, 0.014, n=6) for x, z in ((1, 0), (-0.5, 0.87), (-0.5, -0.87),
          (0.5, 0.87), (0.5, -0.87), (-1, 0))), solid="round"),
    thing("pizza_box", 0.5, "edge", box("cardboard", 0, 0, 0, 0.32, 0.04, 0.32, bevel=0.003), rod("tool", 0, 0.04, 0, 0.09,
          0.001, n=18), aligned=True),
    thing("chocolate_bar", 0.1, "edge", box("bright", 0, 0, 0, 0.16, 0.012, 0.075, bevel=0.003), box("brass", 0.06, 0.0005,
          0, 0.042, 0.0125, 0.0745)),
    thing("yoghurt", 0.2, "body", rod("white", 0, 0, 0, 0.026, 0.07, top=0.034), rod("pastel", 0, 0.02, 0, 0.0295, 0.03,
          top=0.0315), rod("steel", 0, 0.07, 0, 0.035, 0.002), solid="round"),
)  # fmt: skip

KITCHENWARE = numbered(200, (*_DISHES, *_COOKING, *_APPLIANCES, *_FOOD))
