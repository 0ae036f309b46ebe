"""Kinematics and files of robots: CPU seconds (user + system) of this process, everything warm, the median of some rounds."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from unittest.mock import patch

import numpy as np

from h3data.bodies import Robot, load_robot, solve_ik
from h3data.bodies.robots.trot import trot
from h3data.geometry import ground_pose, pose_from_matrix

Emit = Callable[[str, float, str], None]
WORLDS = 1024
LINKS = 10
"""Links of the arm whose file is read; each shows a mesh of 81,920 triangles of its own, as large robots of makers do."""


def run(emit: Emit) -> None:
    """Emit ``bodies.fk_*``, ``bodies.ik_*`` and ``bodies.trot_us_per_step``, all of ``quad_arm``; ``bodies.mjcf_*``."""
    robot, rng = load_robot("quad_arm"), np.random.default_rng(0)
    bases = ground_pose(rng.uniform(-5, 5, (WORLDS, 2)), rng.uniform(-3, 3, WORLDS))
    joints = rng.uniform(robot.lower, robot.upper, (WORLDS, len(robot.joint_names)))
    emit("bodies.fk_us_per_world", _us(lambda: robot.link_matrices(bases, joints)) / WORLDS, "us")
    emit("bodies.fk_torch_us_per_world", _torch_us(robot, bases, joints) / WORLDS, "us")
    hand = robot.link_index("arm_hand")
    targets = pose_from_matrix(robot.link_matrices(np.tile([0, 0, 0, 0, 0, 0, 1.0], (WORLDS, 1)), joints)[:, hand])
    found = solve_ik(robot, "arm_hand", targets)
    emit("bodies.ik_us", _us(lambda: solve_ik(robot, "arm_hand", targets)) / WORLDS, "us")
    emit("bodies.ik_reached_ratio", float(found.reached.mean()), "ratio")
    near = robot.clamp(joints + rng.normal(0, 0.05, joints.shape)).positions
    emit("bodies.ik_near_us", _us(lambda: solve_ik(robot, "arm_hand", targets, near)) / WORLDS, "us")
    positions = targets[:, :3]
    emit("bodies.ik_position_us", _us(lambda: solve_ik(robot, "arm_hand", positions)) / WORLDS, "us")
    way = np.arange(1500) * 0.05
    track = ground_pose(np.stack([way, np.zeros_like(way)], -1), np.zeros_like(way))
    posed = np.tile(robot.rest, (len(track), 1))
    emit("bodies.trot_us_per_step", _us(lambda: trot(robot, track, posed)) / len(track), "us")
    for name, seconds in zip(("cold", "cached"), _mjcf_s(), strict=True):
        emit(f"bodies.mjcf_819k_triangles_{name}_s", seconds, "s")


def _mjcf_s() -> tuple[float, float]:
    """Return CPU time to load a robot of an MJCF file [s]: with an empty cache folder, and with its thinned meshes."""
    import trimesh

    with tempfile.TemporaryDirectory() as name, patch.dict(os.environ, {"H3DATA_CACHE": str(Path(name) / "cache")}):
        assets, arm = "", ""
        for k in reversed(range(LINKS)):
            trimesh.creation.icosphere(subdivisions=6, radius=0.1 + k / 100).export(Path(name) / f"{k}.stl")
            assets += f'<mesh name="m{k}" file="{k}.stl"/>'
            shown = f'<geom type="mesh" mesh="m{k}" contype="0" conaffinity="0"/>'
            arm = f'<body name="b{k}" pos="0 0 0.2"><joint/>{shown}{arm}</body>'
        taken = []
        for file in ("first.xml", "second.xml"):
            path = Path(name) / file
            path.write_text(f"<mujoco><asset>{assets}</asset><worldbody>{arm}</worldbody></mujoco>")
            before = time.process_time()
            load_robot(path)
            taken.append(time.process_time() - before)
    return taken[0], taken[1]


def _torch_us(robot: Robot, bases: np.ndarray, joints: np.ndarray) -> float:
    import torch

    from h3data.geometry import pose_to_matrix

    roots, positions = torch.from_numpy(pose_to_matrix(bases)).float(), torch.from_numpy(joints).float()
    return _us(lambda: robot.link_matrices_torch(roots, positions))


def _us(work: Callable[[], object], rounds: int = 7) -> float:
    work()
    seconds = []
    for _ in range(rounds):
        before = time.process_time()
        work()
        seconds.append(time.process_time() - before)
    return 1e6 * median(seconds)


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}"))
