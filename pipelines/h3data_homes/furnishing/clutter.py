"""Random small objects on the receptacles of furniture in generated homes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from h3data.geometry import IDENTITY_QUAT, pose_multiply, quat_from_heading
from h3data.scene.kinds import CATEGORIES
from h3data.scene.records import Asset, Instance
from h3data_homes.furnishing.objects import AFFINITY, OBJECT_MAKERS, renamed
from h3data_homes.style import Style

_VARIANTS = 3
_CHANCE = {"dining_table": 1.0, "kitchen_counter": 0.85, "coffee_table": 0.9, "bed": 0.3, "sofa": 0.35, "armchair": 0.3}
"""Probability that a receptacle holds anything; 0.8 for other furniture."""
_MAX_COUNT = {"dining_table": 4, "kitchen_counter": 2, "shelf": 2, "coffee_table": 3, "kitchen_island": 4}
"""Largest number of objects per receptacle; 1 for other furniture."""
_LIFT = 0.001
"""Height at which objects hover above their surface, so that collision checks do not report contact [m]."""


def object_assets(rng: np.random.Generator, style: Style) -> dict[str, list[Asset]]:
    """Return a few variants of each small object, by category."""
    return {
        category: [renamed(make(rng, style), f"{category}_{i}") for i in range(_VARIANTS)]
        for category, make in OBJECT_MAKERS.items()
    }


def clutter(
    rng: np.random.Generator,
    assets: dict[str, list[Asset]],
    furniture: Sequence[tuple[Instance, Asset]],
    amount: float = 1.0,
) -> list[Instance]:
    """Place small objects on the receptacles of ``furniture`` as kinematic instances that do not overlap.

    Every object stands inside its receptacle and fits under its clearance, and bounding discs keep objects apart.
    ``amount`` scales the probability that a receptacle holds an object and, above 1, the largest number of objects on
    it.
    """
    out: list[Instance] = []
    count: dict[str, int] = {}
    for instance, asset in furniture:
        categories = AFFINITY.get(asset.category)
        if categories is None:
            continue
        for receptacle in asset.receptacles:
            chance = _CHANCE.get(asset.category, 0.8) * amount
            if rng.random() > chance:
                continue
            most = round(_MAX_COUNT.get(asset.category, 1) * max(1.0, chance if amount > 1 else 1.0))
            discs: list[tuple[float, float, float]] = []
            for _ in range(int(rng.integers(1, most + 1))):
                category = categories[int(rng.integers(len(categories)))]
                thing = assets[category][int(rng.integers(_VARIANTS))]
                low, high = thing.mesh.bounds.astype(float)
                radius = float(np.hypot(*np.maximum(-low, high)[[0, 2]]))
                margin = receptacle.half_size - radius
                if margin.min() < 0 or high[1] - low[1] + 0.02 > receptacle.clearance_m:
                    continue
                spot = _free_spot(rng, margin, radius, discs)
                if spot is None:
                    continue
                discs.append((*spot, radius))
                local = receptacle.center + np.array([spot[0], _LIFT - low[1], spot[1]])
                pose = np.empty(7)
                pose[:3] = pose_multiply(instance.pose, np.concatenate([local, IDENTITY_QUAT]))[:3]
                pose[3:] = quat_from_heading(rng.uniform(-np.pi, np.pi))
                count[category] = count.get(category, -1) + 1
                out.append(
                    Instance(
                        name=f"{category}_{count[category]}",
                        asset=thing.name,
                        pose=pose,
                        semantic_id=CATEGORIES[category],
                        motion="kinematic",
                    )
                )
    return out


def _free_spot(
    rng: np.random.Generator, margin: np.ndarray, radius: float, discs: Sequence[tuple[float, float, float]]
) -> tuple[float, float] | None:
    """Return a random centre within +-``margin`` of a disc that meets no other disc (x, z, radius); None after 8 attempts."""
    for _ in range(8):
        x, z = (rng.uniform(-1, 1, 2) * margin).tolist()
        if all(np.hypot(x - a, z - b) > radius + r + 0.01 for a, b, r in discs):
            return x, z
    return None
