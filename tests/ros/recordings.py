"""A recording of a robot and two people with a home, made up without a simulator's help, so that it costs nothing."""

from __future__ import annotations

from functools import cache

import numpy as np

from h3data.bodies import load_humanoid, load_robot
from h3data.geometry import ground_pose
from h3data.recording.records import STEP_NS, Agent, AssetRef, Body, Episode, Event, Recording
from h3data.scene import FreeSpace
from h3data.scene.scene_file import scene_bytes
from h3data_homes.build import build_home
from h3data_homes.spec import HomeSpec
from h3data_motion.walk_synthesis import walk_columns


@cache
def crossing(steps: int = 60) -> Recording:
    """A robot that drives a path through a small home, near two people, one of whom is away for a while."""
    scene = build_home(HomeSpec(preset="small", seed=1))
    free = FreeSpace.from_scene(scene)
    path = free.path(*free.sample(np.random.default_rng(3), 2))
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    time_ns = (1 + np.arange(steps, dtype=np.int64)) * STEP_NS
    s = np.minimum(np.linspace(0, steps / 30, steps), along[-1])
    xz = np.stack([np.interp(s, along, path[:, k]) for k in (0, 1)], axis=1)
    turn = np.gradient(xz, axis=0)
    base = ground_pose(xz, np.arctan2(-turn[:, 1], turn[:, 0])).astype(np.float32)
    columns = {"time_ns": time_ns, "agent_0.base_pose": base}
    robot, body = load_robot("quad_arm"), load_humanoid("neutral_0")
    columns["agent_0.joint_pos"] = np.tile(robot.rest.astype(np.float32), (steps, 1))
    columns["agent_0.action"] = np.linspace(0, 0.4, 2 * steps, dtype=np.float32).reshape(steps, 2)
    for k in (1, 2):
        around = xz[-1] + 1.2 * np.stack([np.cos(s / 2 + 2 * k), np.sin(s / 2 + 2 * k)], axis=1)
        person = ground_pose(around, -(s / 2 + 2 * k) - np.pi / 2).astype(np.float32)
        columns |= {f"agent_{k}.{n}": v for n, v in walk_columns(body, person, time_ns).items()}
        if k == 2:
            person[steps // 4 : steps // 2] = np.nan
        columns[f"agent_{k}.base_pose"] = person
    gaps = [np.linalg.norm(columns[f"agent_{k}.base_pose"][:, [0, 2]] - xz, axis=1) for k in (1, 2)]
    columns["metrics.dist_agents"] = np.fmin(*gaps).astype(np.float32)
    columns["metrics.collision"] = np.asarray(columns["metrics.dist_agents"] < 0.5)
    columns["metrics.collision_people"] = np.stack([gap < 0.5 for gap in gaps], axis=1)
    columns["metrics.robot_contact"] = np.zeros(steps, np.bool_)
    columns["state_hash"] = np.arange(steps, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    people = tuple(
        Agent(name=f"human_{k}", kind="human", model="humanoid/neutral_0", motion_names=tuple(body.motion_names))
        for k in (1, 2)
    )
    return Recording(
        episode=Episode(
            uid="crossing",
            episode_id="crossing",
            task="wander",
            scene=scene.name,
            info={
                "goal": [float(v) for v in xz[-1]],
                "max_steps": steps,
                "spec": {"robot": {"max_speed_mps": 2.5, "max_turn_rad_s": 2.5}},
            },
        ),
        assets=tuple(AssetRef(name=name, uri=f"scene:{name}") for name in scene.assets),
        bodies=tuple(
            Body(
                name=i.name,
                asset=i.asset,
                pose=i.pose.astype(np.float32),
                scale=i.scale.astype(np.float32),
                layer=i.layer,
            )
            for i in scene.instances
        ),
        agents=(
            Agent(
                name="robot",
                kind="robot",
                model="robot/quad_arm",
                joint_names=tuple(robot.joint_names),
                action_names=("forward", "turn_left"),
            ),
            *people,
        ),
        columns=columns,
        events=(Event(step=3, agent=0, kind="seen", target="human_1"),),
        attachments={"scene.glb": scene_bytes(scene)},
    )
