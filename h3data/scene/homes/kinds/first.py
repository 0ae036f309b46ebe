"""Mass and grasp of the kinds of the first generation, whose models are functions in `furnishing`."""

from __future__ import annotations

from h3data.scene.homes.kinds.kind import Grasp, Kind, Role
from h3data.scene.homes.spec import CATEGORIES

_MASS_KG = {
    "wall": 900.0, "floor": 60.0, "ceiling": 300.0, "door": 45.0, "window": 40.0, "trim": 12.0, "sofa": 55.0,
    "armchair": 28.0, "coffee_table": 16.0, "tv_stand": 32.0, "tv": 16.0, "shelf": 40.0, "dining_table": 42.0,
    "chair": 5.5, "kitchen_counter": 55.0, "stove": 48.0, "fridge": 75.0, "kitchen_cabinet": 20.0, "bed": 75.0,
    "nightstand": 14.0, "wardrobe": 95.0, "desk": 38.0, "toilet": 32.0, "bathroom_sink": 35.0, "bathtub": 70.0,
    "shower": 60.0, "rug": 9.0, "floor_lamp": 5.0, "plant": 9.0, "picture": 2.0, "mirror": 8.0, "ceiling_lamp": 1.5,
    "console": 22.0, "kitchen_island": 90.0, "washer": 68.0, "bench": 14.0, "blind": 1.5, "can": 0.37, "mug": 0.35,
    "bowl": 0.4, "box": 0.45, "bottle": 0.8, "book": 0.5, "apple": 0.18, "orange": 0.17,
}  # fmt: skip
_GRASP: dict[str, Grasp] = {
    "can": "body", "mug": "handle", "bowl": "rim", "box": "body", "bottle": "body", "book": "edge", "apple": "body",
    "orange": "body", "chair": "edge",
}  # fmt: skip


def _role(semantic_id: int) -> Role:
    return "building" if semantic_id < 10 else "thing" if semantic_id >= 60 else "furniture"


FIRST = {
    name: Kind(
        name=name,
        semantic_id=number,
        role=_role(number),
        mass_kg=_MASS_KG[name],
        grasp=_GRASP.get(name, "none"),
        hold_m=(0.062, 0.046, 0.0) if name == "mug" else None,
    )
    for name, number in CATEGORIES.items()
}
