"""A four-legged robot with a 7-DoF arm: ``datasets/robots/quad_arm``.

The joints have the order and the roles that Habitat's Spot has (spec/habitat.md 4): arm 0-6, gripper 7, legs 8-19; its
resting joint positions give a natural stance with the arm stowed, its base 0.48 m above the floor. Places and limits of
the joints are Spot's as far as they are published; the shank is so long that the feet stand on the floor in that stance.
Looks and shapes are our own. URDF frames: x forward, y left, z up.
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
    Vector,
    box_collision,
    capsule_collision,
)
from bake.robots.solids import ball_points, box_points, disc_points, solid

ARM_REST = (0.0, -3.14, 0.0, 3.0, 0.0, 0.0, 0.0)
GRIPPER_REST = 0.0
LEG_REST = (0.0, 0.7, -1.5)
HIP_X, HIP_Y, HIP_OUT, THIGH = 0.29785, 0.055, 0.110945, 0.3205
STANDING_M = 0.48
"""Height of the base frame above the floor [m], as Habitat places Spot (spec/habitat.md 4)."""
FOOT_RADIUS = 0.03
SHANK = (STANDING_M - FOOT_RADIUS - THIGH * np.cos(0.7)) / np.cos(0.8)
"""Length from knee to foot [m], so that the feet are on the floor, below the hips, at the resting angles."""
SHOULDER = (0.292, 0.0, 0.188)
UPPER_ARM, FOREARM, ELBOW_RISE = 0.3385, 0.4033, 0.075
HIP_ROLL, HIP_PITCH, KNEE = (-0.785, 0.785), (-0.899, 2.295), (-2.793, -0.247)
BODY_CAMERA = {"width": 120, "height": 212, "hfov_deg": 58.0}
FRONT_CAMERA_X, FRONT_CAMERA_Y = 0.41648, 0.0367


def torso() -> Link:
    """Return the torso: a graphite tub, an ivory shell with a sloping nose, a lit band and two windows in front."""
    shell = [
        box_points((0.74, 0.27, 0.05), bevel=0.018, center=(-0.02, 0, 0.035)),
        box_points((0.60, 0.19, 0.03), bevel=0.012, center=(-0.03, 0, 0.080)),
    ]
    tub = [
        box_points((0.78, 0.24, 0.07), bevel=0.02, center=(-0.01, 0, -0.030)),
        box_points((0.64, 0.16, 0.03), bevel=0.012, center=(-0.01, 0, -0.072)),
    ]
    nose = [
        box_points((0.05, 0.23, 0.10), bevel=0.015, center=(0.360, 0, -0.005)),
        box_points((0.03, 0.16, 0.07), bevel=0.01, center=(0.397, 0, 0.002)),
    ]
    tail = [box_points((0.05, 0.22, 0.10), bevel=0.015, center=(-0.395, 0, 0))]
    band = [box_points((0.006, 0.13, 0.010), bevel=0.002, center=(0.412, 0, 0.025))]
    eyes = [
        disc_points(0.014, 0.010, axis=0, center=(0.410, y, 0), bevel=0.003, sides=14)
        for y in (-FRONT_CAMERA_Y, FRONT_CAMERA_Y)
    ]
    eyes += [
        disc_points(0.014, 0.010, axis=1, center=(-0.05, y, 0.030), bevel=0.003, sides=14) for y in (-0.134, 0.134)
    ]
    eyes += [disc_points(0.014, 0.010, axis=0, center=(-0.418, 0, 0.012), bevel=0.003, sides=14)]
    seat = [disc_points(0.078, 0.044, axis=2, center=(SHOULDER[0], 0, 0.106))]
    rails = [
        solid(
            [
                ball_points(0.011, center=(-0.30, y, 0.104), sides=8),
                ball_points(0.011, center=(0.10, y, 0.104), sides=8),
            ],
            AMBER,
        )
        for y in (-0.085, 0.085)
    ]
    axles = [
        solid(disc_points(0.058, 0.13, axis=0, center=(x, y * 0.085, 0)), GRAPHITE)
        for x in (-HIP_X, HIP_X)
        for y in (-1, 1)
    ]
    mesh = (
        solid(shell, IVORY),
        solid(tub, GRAPHITE),
        solid(nose, GRAPHITE),
        solid(tail, GRAPHITE),
        solid(band, TEAL),
        *(solid(e, GLASS) for e in eyes),
        solid(seat, STEEL),
        *rails,
        *axles,
    )
    return Link(name="base_link", mesh=mesh, collision=(box_collision((0.83, 0.27, 0.19), (-0.005, 0, 0.005)),))


def arm() -> tuple[Link, ...]:
    """Return the arm: turret, upper arm in two rolling halves, elbow with the forearm above, wrist, hand and jaw."""
    turret = (
        solid(disc_points(0.070, 0.05, axis=2, center=(0, 0, 0.02)), GRAPHITE),
        solid(
            [disc_points(0.052, 0.030, axis=1, center=(0, y, 0.06)) for y in (-0.052, 0.052)]
            + [disc_points(0.06, 0.02, axis=2, center=(0, 0, 0.03))],
            AMBER,
        ),
    )
    upper = (
        solid(disc_points(0.045, 0.145, axis=1), GRAPHITE),
        solid([disc_points(0.040, 0.06, axis=1), disc_points(0.033, 0.02, axis=0, center=(0.16, 0, 0))], AMBER),
    )
    upper_end = (
        solid(disc_points(0.033, 0.02, axis=0, center=(-0.016, 0, 0)), STEEL),
        solid(
            [
                disc_points(0.033, 0.01, axis=0, center=(0, 0, 0)),
                disc_points(0.038, 0.05, axis=1, center=(UPPER_ARM - 0.19, 0, 0)),
            ],
            AMBER,
        ),
    )
    elbow = (
        solid(disc_points(0.040, 0.085, axis=1), GRAPHITE),
        solid(
            [disc_points(0.030, 0.070, axis=1), disc_points(0.028, 0.02, axis=0, center=(0.052, 0, ELBOW_RISE))],
            GRAPHITE,
        ),
    )
    forearm = (
        solid(disc_points(0.031, 0.02, axis=0), STEEL),
        solid(
            [
                disc_points(0.031, 0.02, axis=0, center=(0.02, 0, 0)),
                disc_points(0.026, 0.04, axis=1, center=(0.33, 0, 0)),
            ],
            IVORY,
        ),
    )
    wrist = (
        solid(disc_points(0.028, 0.066, axis=1), GRAPHITE),
        solid([disc_points(0.024, 0.03, axis=1), disc_points(0.027, 0.01, axis=0, center=(0.045, 0, 0))], GRAPHITE),
    )
    hand = (
        solid(disc_points(0.030, 0.016, axis=0, center=(0.002, 0, 0)), STEEL),
        solid(
            [
                box_points((0.02, 0.06, 0.055), bevel=0.008, center=(0.02, 0, 0)),
                box_points((0.125, 0.085, 0.055), bevel=0.010, center=(0.095, 0, 0.020)),
            ],
            IVORY,
        ),
        solid([box_points((0.09, 0.05, 0.012), bevel=0.004, center=(0.10, 0, 0.050))], GRAPHITE),
        solid([box_points((0.010, 0.070, 0.040), bevel=0.004, center=(0.156, 0, 0.022))], GRAPHITE),
        *(
            solid(disc_points(radius, 0.006, axis=0, center=(0.161, y, z), bevel=0.002, sides=14), GLASS)
            for radius, y, z in ((0.010, 0, 0.018), (0.007, 0.023, 0.03))
        ),
    )
    jaw = (
        solid(disc_points(0.014, 0.07, axis=1), STEEL),
        solid(
            [
                box_points((0.02, 0.066, 0.016), bevel=0.004, center=(0.005, 0, -0.004)),
                box_points((0.02, 0.050, 0.010), bevel=0.003, center=(0.105, 0, 0.004)),
            ],
            GRAPHITE,
        ),
    )
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    return (
        Link(
            name="arm_turret",
            parent="base_link",
            joint="arm_0",
            xyz=(SHOULDER[0], 0, SHOULDER[2] - 0.06),
            axis=z,
            limits=(-2.618, 3.1416),
            mesh=turret,
            collision=(capsule_collision((0, 0, 0.02), (0, 0, 0.05), 0.07),),
        ),
        Link(
            name="arm_upper",
            parent="arm_turret",
            joint="arm_1",
            xyz=(0, 0, 0.06),
            axis=y,
            limits=(-3.1416, 0.5236),
            mesh=upper,
            collision=(
                capsule_collision((0, 0, 0), (0.16, 0, 0), 0.04),
                capsule_collision((0, -0.05, 0), (0, 0.05, 0), 0.045),
            ),
        ),
        Link(
            name="arm_upper_end",
            parent="arm_upper",
            joint="arm_2",
            xyz=(0.19, 0, 0),
            axis=x,
            limits=(-2.8, 2.8),
            mesh=upper_end,
            collision=(capsule_collision((0, 0, 0), (UPPER_ARM - 0.19, 0, 0), 0.040),),
        ),
        Link(
            name="arm_elbow",
            parent="arm_upper_end",
            joint="arm_3",
            xyz=(UPPER_ARM - 0.19, 0, 0),
            axis=y,
            limits=(0.0, 3.1416),
            mesh=elbow,
            collision=(
                capsule_collision((0, 0, 0), (0.05, 0, ELBOW_RISE), 0.034),
                capsule_collision((0, -0.03, 0), (0, 0.03, 0), 0.036),
            ),
        ),
        Link(
            name="arm_forearm",
            parent="arm_elbow",
            joint="arm_4",
            xyz=(FOREARM - 0.33, 0, ELBOW_RISE),
            axis=x,
            limits=(-2.793, 2.793),
            mesh=forearm,
            collision=(capsule_collision((0, 0, 0), (0.33, 0, 0), 0.034),),
        ),
        Link(
            name="arm_wrist",
            parent="arm_forearm",
            joint="arm_5",
            xyz=(0.33, 0, 0),
            axis=y,
            limits=(-1.833, 1.833),
            mesh=wrist,
            collision=(capsule_collision((0, 0, 0), (0.045, 0, 0), 0.032),),
        ),
        Link(
            name="arm_hand",
            parent="arm_wrist",
            joint="arm_6",
            xyz=(0.05, 0, 0),
            axis=x,
            limits=(-2.88, 2.88),
            mesh=hand,
            collision=(capsule_collision((0.02, 0, 0.018), (0.12, 0, 0.024), 0.046),),
        ),
        Link(
            name="gripper_jaw",
            parent="arm_hand",
            joint="gripper",
            xyz=(0.055, 0, -0.026),
            axis=(0.0, -1.0, 0.0),
            limits=(-1.57, 0.0),
            mesh=jaw,
            collision=(capsule_collision((0.01, 0, 0), (0.10, 0, 0.002), 0.018),),
        ),
    )


def leg(name: str, front: float, left: float) -> tuple[Link, ...]:
    """Return a leg with hip roll, hip pitch and knee. ``front`` and ``left`` are +1 or -1."""
    out = left * HIP_OUT
    hip = (
        solid(
            [disc_points(0.050, 0.07, axis=0, bevel=0.010), disc_points(0.056, 0.05, axis=1, center=(0, 0.6 * out, 0))],
            STEEL,
        ),
    )
    thigh = (
        solid(
            [
                disc_points(0.060, 0.050, axis=1, center=(0, left * 0.004, 0)),
                disc_points(0.036, 0.040, axis=1, center=(0, 0, -THIGH)),
            ],
            GRAPHITE,
        ),
        solid(
            [
                disc_points(0.046, 0.012, axis=1, center=(0, left * 0.030, 0), bevel=0.004),
                disc_points(0.022, 0.010, axis=1, center=(0, left * 0.023, -0.72 * THIGH), bevel=0.003),
            ],
            AMBER,
        ),
    )
    shank = (
        solid(disc_points(0.030, 0.050, axis=1), STEEL),
        solid([ball_points(0.026), ball_points(0.018, center=(0, 0, -SHANK + 0.01))], GRAPHITE),
        solid(ball_points(FOOT_RADIUS, center=(0, 0, -SHANK), sides=14), RUBBER),
    )
    return (
        Link(
            name=f"{name}_hip",
            parent="base_link",
            joint=f"{name}_hip_roll",
            xyz=(front * HIP_X, left * HIP_Y, 0),
            axis=(1.0, 0.0, 0.0),
            limits=HIP_ROLL,
            mesh=hip,
            collision=(capsule_collision((0, 0, 0), (0, 0.6 * out, 0), 0.055),),
        ),
        Link(
            name=f"{name}_thigh",
            parent=f"{name}_hip",
            joint=f"{name}_hip_pitch",
            xyz=(0, out, 0),
            limits=HIP_PITCH,
            mesh=thigh,
            collision=(capsule_collision((0, 0, 0), (0, 0, -THIGH), 0.045),),
        ),
        Link(
            name=f"{name}_shank",
            parent=f"{name}_thigh",
            joint=f"{name}_knee",
            xyz=(0, 0, -THIGH),
            limits=KNEE,
            mesh=shank,
            collision=(capsule_collision((0, 0, 0), (0, 0, -SHANK), FOOT_RADIUS),),
        ),
    )


def cameras() -> tuple[Camera, ...]:
    """Return the cameras, two on the hand and five on the body; each provides colour and depth.

    Cameras on the hand and in front have Habitat's poses (spec/habitat.md 4): the front cameras look across each other
    and are rolled symmetrically. No source gives the poses of the cameras at the sides and the rear.
    """
    hand: Vector = (0.166, 0.0, 0.018)
    down = np.radians(25)
    level, dip = float(np.cos(down)), -float(np.sin(down))

    def front(name: str, side: float) -> Camera:
        return Camera(
            name=name,
            link="base_link",
            position=(FRONT_CAMERA_X, side * FRONT_CAMERA_Y, 0.0),
            forward=(0.7578, -side * 0.5894, -0.2799),
            up=(0.3580, side * 0.0171, 0.9336),
            **BODY_CAMERA,
        )

    def body(name: str, position: Vector, x: float, y: float) -> Camera:
        return Camera(
            name=name, link="base_link", position=position, forward=(x * level, y * level, dip), **BODY_CAMERA
        )

    return (
        Camera(
            name="robot_arm",
            link="arm_hand",
            position=hand,
            width=224,
            height=171,
            hfov_deg=55.0,
            note="224 wide, 171 high",
        ),
        Camera(
            name="robot_arm_habitat",
            link="arm_hand",
            position=hand,
            width=171,
            height=224,
            hfov_deg=55.0,
            note="as Habitat has it: height 224, width 171 (spec/habitat-findings.md, Limits 8)",
        ),
        Camera(
            name="robot_arm_rgb", link="arm_hand", position=(0.166, 0.023, 0.03), width=640, height=480, hfov_deg=47.0
        ),
        front("robot_front_left", 1.0),
        front("robot_front_right", -1.0),
        body("robot_left", (-0.05, 0.142, 0.03), 0, 1),
        body("robot_right", (-0.05, -0.142, 0.03), 0, -1),
        body("robot_back", (-0.426, 0, 0.012), -1, 0),
    )


LEGS = tuple(
    (f"{'front' if f > 0 else 'rear'}_{'left' if s > 0 else 'right'}", f, s) for f in (1.0, -1.0) for s in (1.0, -1.0)
)


def design() -> Design:
    """Return the whole robot; its joints are in Habitat's order."""
    legs = [part for name, front, left in LEGS for part in leg(name, front, left)]
    return Design(
        name="quad_arm",
        links=(torso(), *arm(), *legs),
        rest=(*ARM_REST, GRIPPER_REST, *LEG_REST * 4),
        body_top_m=0.11,
        base_discs_m=(-0.4, 0.02, 0.33),
        hull_discs_m=(-0.3, 0.0, 0.4),
        base_profiles=(("habitat", (0.0, 0.225)), ("three", (0.0, 0.25, -0.25))),
        hand=("arm_hand", (0.14, 0.0, -0.018)),
        legs=tuple(
            ((f"{name}_hip_roll", f"{name}_hip_pitch", f"{name}_knee"), (0.0, 0.0, -float(SHANK)))
            for name, _, _ in LEGS
        ),
        cameras=cameras(),
    )
