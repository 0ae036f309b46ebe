"""Striped placeholders for assets that are not on this machine, which cannot be mistaken for real assets."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Literal

import numpy as np

from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import joined
from h3data.mesh.primitives import capsule_mesh

PlaceholderKind = Literal["stage", "human", "robot_link", "small_object", "furniture"]

MAGENTA = (255, 0, 200)


def placeholder_kind(uri: str) -> PlaceholderKind:
    """Return the probable kind of object of a missing asset file, from its recorded path alone."""
    kinds: dict[PlaceholderKind, str] = {
        "human": r"(^|/)(humanoids?|humanoid_data)/|(^|/)(human|male|female|neutral)(_\w+)?\.\w+$",
        "robot_link": r"(^|/)robots?/|hab_spot_arm|hab_fetch|hab_stretch",
        "stage": r"(^|/)(stages?|scenes)/[^/]*$|(^|/)stages?/",
        "small_object": r"(^|/)(ycb|objects_ovmm|google_object_dataset|amazon_berkeley|rearranged_objects)/|^handle:",
    }
    # the first that fits counts: people and robots also lie in folders that are named after scenes
    for kind, pattern in kinds.items():
        if re.search(pattern, uri):
            return kind
    return "furniture"


@lru_cache(maxsize=512)
def placeholder_mesh(uri: str) -> Mesh:
    """Return a striped placeholder for a missing asset file, in the frame of its node: +Y up (robot links: z up) [m].

    Sizes follow from the path. Furniture has 0.4 m and stands on its origin (in a real session, 181 of 308 HSSD objects
    have their origin exactly at the floor). Doors and windows have 0.4 m around the origin, and YCB objects 0.1 m. A
    person has 1.7 m, with the pelvis at 0.9 m, and a stage is a floor of 40 m around the origin. Spot's links have
    sizes by name, and links of other robots 0.12 m.
    """
    kind = placeholder_kind(uri)
    # the other colour of the stripes, by kind; one is always `MAGENTA`
    stripes: dict[PlaceholderKind, tuple[int, int, int]] = {
        "stage": (150, 145, 150),
        "human": (40, 90, 220),
        "robot_link": (240, 190, 0),
        "small_object": (0, 150, 60),
        "furniture": (50, 45, 50),
    }
    color = stripes[kind]
    if kind == "human":
        return _figure(color)
    if kind == "stage":
        return striped_box((20, 0.01, 20), center=(0, -0.02, 0), color=color, stripes=20, share=0.04)
    # centre and half extents [m] in the link's frame (x forward, y left, z up). Lengths are the distances
    # between joints of the Spot in a real recording (base to hip, hip to knee, ...); the thicknesses are
    # guesses.
    spot_links: tuple[tuple[str, tuple[float, float, float], tuple[float, float, float]], ...] = (
        ("base", (0, 0, 0), (0.42, 0.1, 0.09)),
        ("hip", (0, 0, 0), (0.06, 0.045, 0.06)),
        ("uleg", (0.012, 0, -0.16), (0.04, 0.03, 0.17)),
        ("lleg", (0, 0, -0.16), (0.025, 0.025, 0.165)),
        ("link_sh0", (0, 0, -0.02), (0.06, 0.06, 0.05)),
        ("link_sh1", (0, 0, 0), (0.045, 0.05, 0.045)),
        ("link_hr0", (0.17, 0, 0), (0.17, 0.035, 0.035)),
        ("link_el0", (0.2, 0, 0.04), (0.2, 0.03, 0.03)),
        ("link_wr1", (0.1, 0, 0), (0.1, 0.045, 0.03)),
        ("link_fngr", (0.04, 0, 0.01), (0.05, 0.04, 0.012)),
    )
    if kind == "robot_link":
        stem = PurePosixPath(uri).stem
        for ending, center, half in spot_links:
            if stem == ending or stem.endswith("." + ending):
                return striped_box(half, center=center, color=color)
        return striped_box((0.06, 0.06, 0.06), color=color)
    if kind == "furniture" and "/openings/" not in uri:
        return striped_box((0.2, 0.2, 0.2), center=(0, 0.2, 0), color=color)
    size = 0.05 if kind == "small_object" else 0.2
    return striped_box((size, size, size), color=color)


def striped_box(
    half_extents: Sequence[float],
    *,
    center: Sequence[float] = (0, 0, 0),
    color: Sequence[int] = (20, 20, 20),
    stripes: int = 3,
    share: float = 0.35,
) -> Mesh:
    """Return a box in ``color`` with ``stripes`` magenta stripes on each face, which cover the share ``share`` of it."""
    middles = (np.arange(stripes) + 0.5) / stripes * 2 - 1
    edges = np.unique(np.concatenate([[-1, 1], middles - share / stripes, middles + share / stripes]))
    # one face of the unit cube at +z, cut along x; the others are rotations of it
    strip = np.stack([[(a, -1, 1), (b, -1, 1), (b, 1, 1), (a, 1, 1)] for a, b in pairwise(edges)])
    turns = [(0, 1, 2), (2, 0, 1), (1, 2, 0)]
    faces = [strip[..., t] * sign for t in turns for sign in (1, -1)]
    quads = np.concatenate([f if s == 0 else f[:, ::-1] for s, f in zip((0, 1) * 3, faces, strict=True)])
    vertices = quads.reshape(-1, 3) * np.asarray(half_extents, np.float64) + np.asarray(center, np.float64)
    first = np.arange(0, len(vertices), 4)[:, None]
    pattern = np.where((np.arange(len(quads)) % len(strip) % 2 == 1)[:, None], np.array(MAGENTA), np.asarray(color))
    return Mesh(
        vertices=vertices.astype(np.float32),
        faces=np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])]).astype(np.int32),
        colors=np.repeat(pattern, 4, axis=0).astype(np.uint8),
    )


def _figure(color: Sequence[int]) -> Mesh:
    """Return a standing person of 1.7 m made of capsules: +Y up, +Z forward, +X left, origin 0.9 m above the soles."""
    limbs = [
        ((0, 0.02, 0), (0, 0.45, 0), 0.13),  # trunk
        ((0, 0.62, 0.02), (0, 0.70, 0.02), 0.095),  # head
        ((0, 0.66, 0.11), (0, 0.66, 0.13), 0.02),  # nose: shows which way it faces
    ]
    for side in (-1, 1):
        limbs += [
            ((0.09 * side, -0.02, 0), (0.1 * side, -0.45, 0.01), 0.075),
            ((0.1 * side, -0.45, 0.01), (0.1 * side, -0.83, -0.01), 0.055),
            ((0.1 * side, -0.86, -0.02), (0.1 * side, -0.86, 0.13), 0.04),
            ((0.18 * side, 0.45, 0), (0.24 * side, 0.18, 0), 0.045),
            ((0.24 * side, 0.18, 0), (0.26 * side, -0.06, 0.04), 0.038),
        ]
    marked = (2, 4, 7, 9, 12)  # nose, shins, forearms: enough to see that it is no real person
    parts = [capsule_mesh(a, b, r, color=MAGENTA if i in marked else color) for i, (a, b, r) in enumerate(limbs)]
    return joined(parts)
