"""A wheeled robot with a lift and a telescoping arm, of the kind of Hello Robot's Stretch: ``datasets/robots/lift_arm``.

A round-cornered base 0.34 m across on two wheels, 1.4 m high, an arm that reaches 0.52 m to the right in four
stages that move alike (URDF mimic), a wrist of three joints, two fingers, a head that turns. Its sizes are about those
that the maker publishes of that robot; looks and shapes are our own. URDF frames: x forward, y left, z up, and the
axle of the wheels is the origin.
"""

from __future__ import annotations

import numpy as np

from bake.robots.links import (
    AMBER,
    GLASS,
    GRAPHITE,
    IVORY,
    RUBBER,
    STEEL,
    TEAL,
    Camera,
    Design,
    Link,
    box_collision,
    capsule_collision,
)
from bake.robots.solids import ball_points, box_points, disc_points, solid

WHEEL_RADIUS, WHEEL_Y = 0.0508, 0.157
MAST_X, MAST_Y, MAST_TOP = -0.067, 0.135, 1.21
ARM_Z = 0.17
"""Height of the arm above the axle with the lift down."""
LIFT = (0.0, 1.0)
STAGES, STAGE_M, STAGE_LENGTH = 4, 0.13, 0.20
WRIST_Y = -0.24
"""Distance from the middle of the carriage to the joint of the wrist with the arm retracted [m]."""
FINGER = 0.19
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def base() -> tuple[Link, ...]:
    """Return the base: a tub with an ivory lid, a lit band in front, the mast, two wheels and a ball."""
    corners = [
        disc_points(0.06, 0.10, axis=2, center=(x, y, 0.035), bevel=0.012)
        for x in (-0.21, 0.07)
        for y in (-0.105, 0.105)
    ]
    lid = [
        disc_points(0.055, 0.03, axis=2, center=(x, y, 0.098), bevel=0.012)
        for x in (-0.21, 0.07)
        for y in (-0.105, 0.105)
    ]
    band = [box_points((0.006, 0.14, 0.012), bevel=0.002, center=(0.130, 0, 0.055))]
    foot = [box_points((0.10, 0.09, 0.05), bevel=0.012, center=(MAST_X, MAST_Y - 0.02, 0.125))]
    mast = [box_points((0.056, 0.056, MAST_TOP - 0.1), bevel=0.012, center=(MAST_X, MAST_Y, (MAST_TOP + 0.1) / 2))]
    rail = [
        box_points((0.012, 0.010, MAST_TOP - 0.2), bevel=0.003, center=(MAST_X, MAST_Y - 0.03, (MAST_TOP + 0.1) / 2))
    ]
    ball = [ball_points(0.028, center=(-0.22, 0, 0.028 - WHEEL_RADIUS), sides=12)]
    mesh = (
        solid(corners, GRAPHITE),
        solid(lid, IVORY),
        solid(band, TEAL),
        solid(foot, GRAPHITE),
        solid(mast, STEEL),
        solid(rail, GRAPHITE),
        solid(ball, RUBBER),
    )
    wheel = (
        solid(disc_points(WHEEL_RADIUS, 0.025, axis=1, bevel=0.006, sides=24), RUBBER),
        solid(disc_points(0.030, 0.029, axis=1, bevel=0.004, sides=18), AMBER),
    )
    sides = ("left", 1.0), ("right", -1.0)
    return (
        Link(
            name="base_link",
            mesh=mesh,
            collision=(
                box_collision((0.40, 0.33, 0.13), (-0.07, 0, 0.05)),
                capsule_collision((MAST_X, MAST_Y, 0.12), (MAST_X, MAST_Y, MAST_TOP - 0.03), 0.036),
            ),
        ),
        *(
            Link(
                name=f"wheel_{name}",
                parent="base_link",
                joint=f"wheel_{name}",
                kind="continuous",
                xyz=(0, side * WHEEL_Y, 0),
                axis=Y,
                mesh=wheel,
                collision=(capsule_collision((0, -0.002, 0), (0, 0.002, 0), WHEEL_RADIUS - 0.004),),
            )
            for name, side in sides
        ),
    )


def arm() -> tuple[Link, ...]:
    """Return the carriage on the mast, four stages one in the other."""
    carriage = (
        solid(box_points((0.10, 0.10, 0.13), bevel=0.015, center=(MAST_X, MAST_Y, 0)), GRAPHITE),
        solid(box_points((0.074, 0.24, 0.084), bevel=0.016, center=(MAST_X, MAST_Y - 0.10, 0)), IVORY),
    )
    stages = []
    for k in range(STAGES):
        size = 0.064 - 0.009 * k
        tube = solid(box_points((size, STAGE_LENGTH, size), bevel=0.010, center=(0, -0.105, 0)), (STEEL, IVORY)[k % 2])
        end = solid(box_points((size + 0.006, 0.014, size + 0.006), bevel=0.004, center=(0, -0.203, 0)), GRAPHITE)
        stages.append(
            Link(
                name=f"arm_stage_{k}",
                parent="lift_carriage" if k == 0 else f"arm_stage_{k - 1}",
                joint="arm_extend" if k == 0 else f"arm_extend_{k}",
                kind="prismatic",
                xyz=(MAST_X, MAST_Y - 0.03, 0) if k == 0 else (0, 0, 0),
                axis=(0.0, -1.0, 0.0),
                limits=(0.0, STAGE_M),
                mimic=None if k == 0 else ("arm_extend", 1.0),
                mesh=(tube, end),
                collision=(capsule_collision((0, -0.02, 0), (0, -0.19, 0), size * 0.62),),
            )
        )
    return (
        Link(
            name="lift_carriage",
            parent="base_link",
            joint="lift",
            kind="prismatic",
            xyz=(0, 0, ARM_Z),
            axis=Z,
            limits=LIFT,
            mesh=carriage,
            collision=(box_collision((0.10, 0.25, 0.12), (MAST_X, MAST_Y - 0.08, 0)),),
        ),
        *stages,
    )


def wrist() -> tuple[Link, ...]:
    """Return the links of the wrist (yaw, pitch, roll) and of a hand with two fingers.

    At zero, the hand points in the direction of the arm, to the right (-y).
    """
    yaw = (
        solid(disc_points(0.030, 0.060, axis=2, bevel=0.006), GRAPHITE),
        solid(disc_points(0.024, 0.030, axis=2, center=(0, 0, -0.040), bevel=0.005), AMBER),
    )
    pitch = (
        solid(
            [
                disc_points(0.024, 0.050, axis=0, bevel=0.005),
                disc_points(0.024, 0.012, axis=1, center=(0, -0.036, 0), bevel=0.004),
            ],
            GRAPHITE,
        ),
    )
    hand = (
        solid(disc_points(0.026, 0.012, axis=1, center=(0, -0.008, 0), bevel=0.003), STEEL),
        solid(
            [
                disc_points(0.026, 0.012, axis=1, center=(0, -0.020, 0), bevel=0.004),
                box_points((0.080, 0.050, 0.034), bevel=0.010, center=(0, -0.060, 0)),
            ],
            IVORY,
        ),
        solid(box_points((0.050, 0.028, 0.020), bevel=0.005, center=(0, -0.062, 0.030)), GRAPHITE),
        solid(disc_points(0.008, 0.006, axis=1, center=(0, -0.077, 0.031), bevel=0.002, sides=14), GLASS),
    )

    def finger(name: str, side: float) -> Link:
        knuckle = box_points((0.010, 0.020, 0.018), bevel=0.003, center=(side * 0.006, -0.005, 0))
        bend = box_points((0.006, 0.020, 0.016), bevel=0.002, center=(side * 0.030, -0.085, 0))
        end = box_points((0.006, 0.016, 0.016), bevel=0.002, center=(side * 0.006, -FINGER + 0.015, 0))
        blade, tip = solid([knuckle, bend], STEEL), solid([bend, end], STEEL)
        cup = solid(disc_points(0.016, 0.012, axis=0, center=(-side * 0.002, -FINGER + 0.010, 0), bevel=0.004), RUBBER)
        return Link(
            name=f"finger_{name}",
            parent="hand",
            joint="gripper" if side > 0 else "gripper_right",
            xyz=(side * 0.028, -0.075, -0.004),
            axis=(0.0, 0.0, side),
            limits=(-0.12, 0.60),
            mimic=None if side > 0 else ("gripper", 1.0),
            mesh=(blade, tip, cup),
            collision=(
                capsule_collision((side * 0.01, 0, 0), (side * 0.026, -0.09, 0), 0.012),
                capsule_collision((side * 0.026, -0.09, 0), (0, -FINGER + 0.010, 0), 0.014),
            ),
        )

    last = f"arm_stage_{STAGES - 1}"
    return (
        Link(
            name="wrist_yaw",
            parent=last,
            joint="wrist_yaw",
            xyz=(0, WRIST_Y, 0),
            axis=Z,
            limits=(-1.75, 4.0),
            mesh=yaw,
            collision=(capsule_collision((0, 0, -0.03), (0, 0, 0.01), 0.032),),
        ),
        Link(
            name="wrist_pitch",
            parent="wrist_yaw",
            joint="wrist_pitch",
            xyz=(0, 0, -0.075),
            axis=(-1.0, 0.0, 0.0),
            limits=(-1.57, 0.56),
            mesh=pitch,
            collision=(capsule_collision((0, 0, 0), (0, -0.035, 0), 0.027),),
        ),
        Link(
            name="hand",
            parent="wrist_pitch",
            joint="wrist_roll",
            xyz=(0, -0.042, 0),
            axis=(0.0, -1.0, 0.0),
            limits=(-3.14, 3.14),
            mesh=hand,
            collision=(capsule_collision((0, -0.02, 0.004), (0, -0.065, 0.008), 0.036),),
        ),
        finger("left", 1.0),
        finger("right", -1.0),
    )


def head() -> tuple[Link, ...]:
    """Return the head, which pans and tilts on top of the mast; the camera is upright, for portrait images."""
    pan = (
        solid(disc_points(0.044, 0.036, axis=2, center=(0, 0, 0.018), bevel=0.006), GRAPHITE),
        solid(
            [box_points((0.030, 0.014, 0.05), bevel=0.004, center=(0.012, y, 0.055)) for y in (-0.040, 0.040)], GRAPHITE
        ),
    )
    tilt = (
        solid(box_points((0.040, 0.060, 0.130), bevel=0.012, center=(0.016, 0, 0)), IVORY),
        solid(box_points((0.006, 0.046, 0.112), bevel=0.002, center=(0.035, 0, 0)), GRAPHITE),
        *(
            solid(disc_points(0.009, 0.006, axis=0, center=(0.037, 0, z), bevel=0.002, sides=14), GLASS)
            for z in (-0.026, 0.026)
        ),
    )
    return (
        Link(
            name="head_pan",
            parent="base_link",
            joint="head_pan",
            xyz=(MAST_X, MAST_Y, MAST_TOP),
            axis=Z,
            limits=(-3.9, 1.5),
            mesh=pan,
            collision=(capsule_collision((0, 0, 0.02), (0, 0, 0.06), 0.036),),
        ),
        Link(
            name="head_tilt",
            parent="head_pan",
            joint="head_tilt",
            xyz=(0.012, 0, 0.085),
            axis=(0.0, -1.0, 0.0),
            limits=(-1.53, 0.79),
            mesh=tilt,
            collision=(capsule_collision((0.02, 0, -0.03), (0.02, 0, 0.03), 0.028),),
        ),
    )


def design() -> Design:
    """Return the whole robot, arm drawn in at the height of a table, hand and head looking forward and a little down."""
    dip = np.radians(8)
    ahead = (0.0, -float(np.cos(dip)), -float(np.sin(dip)))
    return Design(
        name="lift_arm",
        links=(*base(), *arm(), *wrist(), *head()),
        # wheels, lift, arm, wrist yaw, pitch and roll, gripper, head pan and tilt
        rest=(0.0, 0.0, 0.60, 0.0, 1.57, -0.15, 0.0, 0.0, 0.0, -0.2),
        body_top_m=MAST_TOP + 0.1,
        base_discs_m=(-0.08, 0.08),
        base_profiles=(("habitat", (0.0,)),),
        hand=("hand", (0.0, -0.075 - FINGER + 0.010, -0.004)),
        hand_forward=(0.0, -1.0, 0.0),
        reach_bearing_deg=-90.0,
        cameras=(
            Camera(
                name="robot_arm",
                link="hand",
                position=(0, -0.081, 0.031),
                forward=ahead,
                width=224,
                height=171,
                hfov_deg=55.0,
                note="224 wide, 171 high",
            ),
            Camera(
                name="robot_head", link="head_tilt", position=(0.041, 0, 0.026), width=480, height=640, hfov_deg=43.0
            ),
        ),
    )
