"""Write `datasets/robots/quad_arm`, a four-legged robot with a 7-DoF arm: ``python -m h3data_pipelines.bake.robot``.

The joints have the order and the roles that Habitat's Spot has (spec/habitat.md 4): arm 0-6, gripper 7, legs 8-19; its
resting joint positions give a natural stance with the arm stowed. The design is our own. URDF frames:
x forward, y left, z up.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from h3data.bodies.meshes import write_plain_glb
from h3data.bodies import Robot, load_robot
from h3data.builtin import builtin_root
from h3data.scene.meshes import joined
from h3data.scene.records import Mesh
from h3data_pipelines.bake.solids import ball_points, box_points, disc_points, solid

log = logging.getLogger(__name__)

AMBER, IVORY, GRAPHITE, STEEL = (226, 150, 58), (226, 220, 207), (58, 61, 67), (150, 154, 160)
RUBBER, TEAL, GLASS = (34, 35, 38), (64, 186, 176), (20, 26, 34)

ARM_REST = (0.0, -3.14, 0.0, 3.0, 0.0, 0.0, 0.0)
GRIPPER_REST = 0.0
LEG_REST = (0.0, 0.7, -1.5)
HIP_X, HIP_Y, HIP_OUT = 0.32, 0.125, 0.08
THIGH, SHANK = 0.345, 0.31
"""Their ratio puts the feet below the hips at the resting leg angles."""
FOOT_RADIUS = 0.03
CAMERA_PITCH_DEG = 18.0
"""Below the hand's axis, which the stowed arm holds 8 degrees upwards: the picture's middle is 10 degrees down."""


@dataclass(frozen=True, kw_only=True)
class Link:
    """A link and the joint that carries it."""

    name: str
    parent: str = ""
    joint: str = ""
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    limits: tuple[float, float] = (0.0, 0.0)
    mesh: tuple[Mesh, ...] = ()
    collision: tuple[str, ...] = ()
    """URDF text of the collision elements."""


def box_collision(size: Sequence[float], center: Sequence[float] = (0, 0, 0)) -> str:
    return _collision(f'<box size="{_text(size)}"/>', center, (0, 0, 0))


def capsule_collision(start: Sequence[float], end: Sequence[float], radius: float) -> str:
    """A capsule between two points; ``radius`` at both ends."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    way = b - a
    length = float(np.linalg.norm(way))
    pitch = float(np.arctan2(np.hypot(way[0], way[1]), way[2]))
    yaw = float(np.arctan2(way[1], way[0]))
    return _collision(f'<capsule radius="{radius:g}" length="{length:.6g}"/>', (a + b) / 2, (0, pitch, yaw))


def _collision(shape: str, center: Sequence[float] | np.ndarray, rpy: Sequence[float]) -> str:
    return f'<collision><origin xyz="{_text(center)}" rpy="{_text(rpy)}"/><geometry>{shape}</geometry></collision>'


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{round(float(v), 6) + 0.0:g}" for v in values)


# --- the parts --------------------------------------------------------------------------------------------------------
def torso() -> Link:
    """Graphite tub, ivory shell with a sloping nose, a lit band and two windows in front."""
    shell = [
        box_points((0.80, 0.27, 0.05), bevel=0.018, center=(-0.01, 0, 0.035)),
        box_points((0.66, 0.19, 0.03), bevel=0.012, center=(-0.02, 0, 0.080)),
    ]
    tub = [box_points((0.84, 0.24, 0.07), bevel=0.02, center=(0, 0, -0.030)),
           box_points((0.70, 0.16, 0.03), bevel=0.012, center=(0, 0, -0.072))]  # fmt: skip
    nose = [box_points((0.05, 0.23, 0.10), bevel=0.015, center=(0.405, 0, -0.005)),
            box_points((0.03, 0.15, 0.05), bevel=0.01, center=(0.445, 0, -0.012))]  # fmt: skip
    tail = [box_points((0.05, 0.22, 0.10), bevel=0.015, center=(-0.415, 0, 0))]
    band = [box_points((0.006, 0.13, 0.010), bevel=0.002, center=(0.460, 0, 0.006))]
    eyes = [
        disc_points(0.016, 0.012, axis=0, center=(0.459, y, -0.018), bevel=0.003, sides=14) for y in (-0.045, 0.045)
    ]
    seat = [disc_points(0.082, 0.03, axis=2, center=(0.27, 0, 0.098))]
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
        solid(disc_points(0.058, 0.13, axis=0, center=(x, y * HIP_Y * 0.86, 0)), GRAPHITE)
        for x in (-HIP_X, HIP_X) for y in (-1, 1)
    ]  # fmt: skip
    mesh = (
        solid(shell, IVORY), solid(tub, GRAPHITE), solid(nose, GRAPHITE), solid(tail, GRAPHITE), solid(band, TEAL),
        *(solid(e, GLASS) for e in eyes), solid(seat, STEEL), *rails, *axles,
    )  # fmt: skip
    return Link(name="base_link", mesh=mesh, collision=(box_collision((0.90, 0.27, 0.19), (0.01, 0, 0.005)),))


def arm() -> tuple[Link, ...]:
    """Turret, upper arm in two rolling halves, elbow that carries the forearm above, wrist, hand, jaw."""
    turret = (
        solid(disc_points(0.070, 0.05, axis=2, center=(0, 0, 0.02)), GRAPHITE),
        solid([disc_points(0.052, 0.030, axis=1, center=(0, y, 0.06)) for y in (-0.052, 0.052)]
              + [disc_points(0.06, 0.02, axis=2, center=(0, 0, 0.03))], AMBER),
    )  # fmt: skip
    upper = (
        solid(disc_points(0.045, 0.145, axis=1), GRAPHITE),
        solid([disc_points(0.040, 0.06, axis=1), disc_points(0.033, 0.02, axis=0, center=(0.17, 0, 0))], AMBER),
    )
    upper_end = (
        solid(disc_points(0.033, 0.02, axis=0, center=(-0.016, 0, 0)), STEEL),
        solid(
            [disc_points(0.033, 0.01, axis=0, center=(0, 0, 0)), disc_points(0.038, 0.05, axis=1, center=(0.16, 0, 0))],
            AMBER,
        ),
    )
    elbow = (
        solid(disc_points(0.040, 0.085, axis=1), GRAPHITE),
        solid([disc_points(0.030, 0.070, axis=1), disc_points(0.028, 0.02, axis=0, center=(0.030, 0, 0.09))], GRAPHITE),
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
        solid([box_points((0.02, 0.06, 0.055), bevel=0.008, center=(0.02, 0, 0)),
               box_points((0.13, 0.085, 0.045), bevel=0.010, center=(0.10, 0, 0.018))], IVORY),
        solid([box_points((0.08, 0.05, 0.02), bevel=0.006, center=(0.12, 0, 0.045)),
               box_points((0.045, 0.044, 0.034), bevel=0.006, center=(0.160, 0, 0.058))], GRAPHITE),
        solid(disc_points(0.012, 0.008, axis=0, center=(0.182, 0, 0.062), bevel=0.002, sides=14), GLASS),
    )  # fmt: skip
    jaw = (
        solid(disc_points(0.014, 0.07, axis=1), STEEL),
        solid([box_points((0.02, 0.066, 0.016), bevel=0.004, center=(0.005, 0, -0.004)),
               box_points((0.02, 0.050, 0.010), bevel=0.003, center=(0.105, 0, 0.004))], GRAPHITE),
    )  # fmt: skip
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    return (
        Link(name="arm_turret", parent="base_link", joint="arm_0", xyz=(0.27, 0, 0.11), axis=z, limits=(-2.6, 3.14),
             mesh=turret, collision=(capsule_collision((0, 0, 0.02), (0, 0, 0.05), 0.07),)),
        Link(name="arm_upper", parent="arm_turret", joint="arm_1", xyz=(0, 0, 0.06), axis=y, limits=(-3.15, 0.55),
             mesh=upper, collision=(capsule_collision((0, 0, 0), (0.17, 0, 0), 0.04),
                        capsule_collision((0, -0.05, 0), (0, 0.05, 0), 0.045))),
        Link(name="arm_upper_end", parent="arm_upper", joint="arm_2", xyz=(0.20, 0, 0), axis=x, limits=(-2.8, 2.8),
             mesh=upper_end, collision=(capsule_collision((0, 0, 0), (0.16, 0, 0), 0.040),)),
        Link(name="arm_elbow", parent="arm_upper_end", joint="arm_3", xyz=(0.16, 0, 0), axis=y, limits=(0.0, 3.14),
             mesh=elbow, collision=(capsule_collision((0, 0, 0), (0.02, 0, 0.09), 0.034),
                        capsule_collision((0, -0.03, 0), (0, 0.03, 0), 0.036))),
        Link(name="arm_forearm", parent="arm_elbow", joint="arm_4", xyz=(0.05, 0, 0.09), axis=x, limits=(-2.8, 2.8),
             mesh=forearm, collision=(capsule_collision((0, 0, 0), (0.33, 0, 0), 0.034),)),
        Link(name="arm_wrist", parent="arm_forearm", joint="arm_5", xyz=(0.33, 0, 0), axis=y, limits=(-1.84, 1.84),
             mesh=wrist, collision=(capsule_collision((0, 0, 0), (0.045, 0, 0), 0.032),)),
        Link(name="arm_hand", parent="arm_wrist", joint="arm_6", xyz=(0.05, 0, 0), axis=x, limits=(-2.9, 2.9),
             mesh=hand, collision=(capsule_collision((0.02, 0, 0.02), (0.14, 0, 0.03), 0.048),)),
        Link(name="gripper_jaw", parent="arm_hand", joint="gripper", xyz=(0.055, 0, -0.018), axis=(0.0, -1.0, 0.0),
             limits=(-1.57, 0.0), mesh=jaw, collision=(capsule_collision((0.01, 0, 0), (0.10, 0, 0.002), 0.018),)),
    )  # fmt: skip


def leg(name: str, front: float, left: float) -> tuple[Link, ...]:
    """Hip roll, hip pitch, knee. ``front`` and ``left`` are +1 or -1."""
    out = left * HIP_OUT
    hip = (
        solid(
            [disc_points(0.050, 0.07, axis=0, bevel=0.010), disc_points(0.056, 0.05, axis=1, center=(0, 0.6 * out, 0))],
            STEEL,
        ),
    )
    thigh = (
        solid([disc_points(0.060, 0.050, axis=1, center=(0, left * 0.004, 0)),
               disc_points(0.036, 0.040, axis=1, center=(0, 0, -THIGH))], GRAPHITE),
        solid([disc_points(0.046, 0.012, axis=1, center=(0, left * 0.030, 0), bevel=0.004),
               disc_points(0.022, 0.010, axis=1, center=(0, left * 0.023, -0.72 * THIGH), bevel=0.003)], AMBER),
    )  # fmt: skip
    shank = (
        solid(disc_points(0.030, 0.050, axis=1), STEEL),
        solid([ball_points(0.026), ball_points(0.018, center=(0, 0, -SHANK + 0.01))], GRAPHITE),
        solid(ball_points(FOOT_RADIUS, center=(0, 0, -SHANK), sides=14), RUBBER),
    )
    return (
        Link(name=f"{name}_hip", parent="base_link", joint=f"{name}_hip_roll", xyz=(front * HIP_X, left * HIP_Y, 0),
             axis=(1.0, 0.0, 0.0), limits=(-0.8, 0.8), mesh=hip,
             collision=(capsule_collision((0, 0, 0), (0, 0.6 * out, 0), 0.055),)),
        Link(name=f"{name}_thigh", parent=f"{name}_hip", joint=f"{name}_hip_pitch", xyz=(0, out, 0), limits=(-0.9, 2.3),
             mesh=thigh, collision=(capsule_collision((0, 0, 0), (0, 0, -THIGH), 0.045),)),
        Link(name=f"{name}_shank", parent=f"{name}_thigh", joint=f"{name}_knee", xyz=(0, 0, -THIGH), limits=(-2.8, -0.25),
             mesh=shank, collision=(capsule_collision((0, 0, 0), (0, 0, -SHANK), FOOT_RADIUS),)),
    )  # fmt: skip


def links() -> tuple[Link, ...]:
    """All links; their joints are in Habitat's order."""
    legs = [
        leg(f"{'front' if f > 0 else 'rear'}_{'left' if s > 0 else 'right'}", f, s)
        for f in (1.0, -1.0)
        for s in (1.0, -1.0)
    ]
    return (torso(), *arm(), *(part for each in legs for part in each))


# --- the files --------------------------------------------------------------------------------------------------------
def urdf_text(parts: Sequence[Link]) -> str:
    """The URDF."""
    lines = ['<?xml version="1.0"?>', "<!-- Generated by h3data_pipelines.bake.robot: edit that, not this. -->"]
    lines.append('<robot name="quad_arm">')
    for part in parts:
        lines.append(f'  <link name="{part.name}">')
        lines.append(f'    <visual><geometry><mesh filename="meshes/{part.name}.glb"/></geometry></visual>')
        lines += [f"    {text}" for text in part.collision]
        lines.append("  </link>")
    for part in parts:
        if not part.joint:
            continue
        lower, upper = part.limits
        lines.append(f'  <joint name="{part.joint}" type="revolute">')
        lines.append(f'    <parent link="{part.parent}"/><child link="{part.name}"/>')
        lines.append(f'    <origin xyz="{_text(part.xyz)}" rpy="0 0 0"/><axis xyz="{_text(part.axis)}"/>')
        lines.append(f'    <limit lower="{lower:g}" upper="{upper:g}" effort="100" velocity="5"/>')
        lines.append("  </joint>")
    return "\n".join([*lines, "</robot>", ""])


SETTINGS = """# What URDF cannot say about this robot. Read by h3data.bodies.robot. Generated by h3data_pipelines.bake.robot.
base_height_m = {height:.4f}      # URDF base frame above the floor, resting posture
body_height_m = {top:.3f}       # the two discs reach up to here
base_discs_m = [0.0, 0.225]  # places along x (spec/habitat.md 4, v0.3.0)
base_radius_m = 0.25
rest = [{rest}]

[[cameras]]                  # 224 wide, 171 high
name = "robot_arm"
link = "arm_hand"
position = [0.190, 0.0, 0.062]
forward = [{forward}]
width = 224
height = 171
hfov_deg = 55.0

[[cameras]]                  # as Habitat has it: height 224, width 171 (spec/habitat-findings.md, Limits 8)
name = "robot_arm_habitat"
link = "arm_hand"
position = [0.190, 0.0, 0.062]
forward = [{forward}]
width = 171
height = 224
hfov_deg = 55.0
"""


def settings_text(height: float) -> str:
    """The ``robot.toml``."""
    pitch = np.radians(CAMERA_PITCH_DEG)
    rest = ", ".join(f"{v}" for v in (*ARM_REST, GRIPPER_REST, *LEG_REST * 4))
    forward = f"{np.cos(pitch):.6f}, 0.0, {-np.sin(pitch):.6f}"
    return SETTINGS.format(height=height, top=height + 0.11, rest=rest, forward=forward)


def standing_height(robot: Robot) -> float:
    """How high the base frame stands when the lowest vertex of the resting robot touches the floor [m]."""
    frames = robot.link_matrices(np.array([[0, 0, 0, 0, 0, 0, 1.0]]), robot.rest[None])[0]
    lowest = [
        (link.mesh.vertices @ frame[1, :3] + frame[1, 3]).min()
        for link, frame in zip(robot.links, frames, strict=True)
        if link.mesh is not None
    ]
    return float(robot.base_height_m - min(lowest))


def main(folder: Path | None = None) -> None:
    """Write the URDF, the meshes and the settings."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    folder = folder or builtin_root() / "robots" / "quad_arm"
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    parts = links()
    for part in parts:
        write_plain_glb(folder / "meshes" / f"{part.name}.glb", joined(part.mesh))
    (folder / "robot.urdf").write_text(urdf_text(parts))
    (folder / "robot.toml").write_text(settings_text(0.5))
    load_robot.cache_clear()
    height = standing_height(load_robot(folder / "robot.urdf"))
    (folder / "robot.toml").write_text(settings_text(height))
    load_robot.cache_clear()
    size = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    log.info("%s: %d kB, base at %.4f m", folder, size // 1000, height)


if __name__ == "__main__":
    main()
