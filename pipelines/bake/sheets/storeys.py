"""Script for docs/pictures/storeys.jpg and stairs.jpg: a home with two storeys, and agents on its stairs by frame.

    PYTHONPATH=pipelines python -m bake.sheets.storeys docs/pictures

The first: cut open from the side, from above, and the stairs seen from both landings. The second: a person who goes up, one who
comes down, and a robot, seen through the wall of the stairwell; frames are 1/5 s (people) and 4/15 s (robot) apart.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from h3data.recording import Recording
from h3data.render import Renderer, RenderScene, pinhole
from h3data.render.camera import Camera, look_at
from h3data.render.image_files import write_jpg
from h3data.render.light.sources import sources_of
from h3data.render.sheets.scene_map import render_scene
from h3data.replay import Replay
from h3data.scene import FreeSpace, Room, Scene
from h3data_homes import HomeSpec, build_home
from h3data_light.bake import lit_scene
from h3data_pipelines.assets.scene_plan import scene_map
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.wander import Wander

SEED, WIDTH = 3, 1920
UPPER_M = 1.2
"""Margin between the range of heights in which people count as being on the stairs and the floors at both ends [m]."""


def stairs_of(scene: Scene) -> Room:
    """Return the room with the stairs."""
    return next(room for room in scene.rooms if room.ramp is not None)


def lit_renderer(scene: Scene) -> Renderer:
    """Return a renderer of a home in its baked light."""
    flat = render_scene(scene)
    fixed = {instance.name for instance in scene.static_instances}
    static = [k for k, instance in enumerate(flat.instances) if instance.name in fixed]
    lit = lit_scene(flat.meshes, flat.instances, static, sources_of(scene), name=scene.name)
    return Renderer(RenderScene(lit.meshes, lit.instances, mirrors=lit.mirrors), light=lit.light)


def cutaway(scene: Scene, width: int, height: int) -> Camera:
    """Return the home from above one side, without ceilings."""
    low, high = scene.bounds
    middle, span = (low + high) / 2, high - low
    eye = middle + np.array([-0.05 * span[0], 1.15 * span[0], 1.15 * span[0]])
    pose = look_at(eye, middle + np.array([0.3, -0.6, 0.2]))
    return pinhole(width, height, hfov_deg=44, pose=pose, name="cutaway", hidden_layers=("ceiling",))


def on_landing(scene: Scene, *, upper: bool, width: int, height: int) -> Camera:
    """Return the view of a person who stands on a landing and looks along the stairs."""
    room = stairs_of(scene)
    assert room.ramp is not None
    x0, z0, x1, z1 = room.rectangles[0].tolist()
    rises = room.ramp.end > room.ramp.start
    back = (z1 if upper == rises else z0) + (-0.12 if upper == rises else 0.12)
    there = room.ramp.start if upper else room.ramp.end
    floor, aim = (room.ramp.top_y, 0.6) if upper else (0.0, 1.5)
    middle = (x0 + x1) / 2
    pose = look_at(np.array([middle, floor + 1.6, back]), np.array([middle, aim, there]))
    return pinhole(width, height, hfov_deg=74, pose=pose, name="landing")


def home_sheet(scene: Scene) -> NDArray[np.uint8]:
    """Return cutaway, plan and both landings."""
    import cv2

    renderer, free = lit_renderer(scene), FreeSpace.from_scene(scene)
    views = [
        cutaway(scene, WIDTH, 900),
        on_landing(scene, upper=False, width=540, height=800),
        on_landing(scene, upper=True, width=540, height=800),
    ]
    images = [renderer.render(camera, outputs=("rgb",), samples=4)["rgb"] for camera in views]
    plan = scene_map(scene, free)
    scale = min((WIDTH - 1080) / plan.shape[1], 800 / plan.shape[0])
    plan = cv2.resize(plan, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    paper = np.full((800, WIDTH - 1080, 3), 251, np.uint8)
    top = (800 - plan.shape[0]) // 2
    left = (paper.shape[1] - plan.shape[1]) // 2
    paper[top : top + plan.shape[0], left : left + plan.shape[1]] = plan
    return np.vstack([images[0], np.hstack([images[1], paper, images[2]])])


def climbs(recording: Recording, agent: int) -> list[tuple[int, int, bool]]:
    """Return first and last step of each time that an agent takes the whole stairs, and whether upwards."""
    y = recording.agent_column(agent, "base_pose")[:, 1].astype(np.float64)
    on = np.diff(np.concatenate([[False], (y > 0.02) & (y < y.max() - 0.02), [False]]).astype(int))
    spans = zip(np.flatnonzero(on == 1), np.flatnonzero(on == -1), strict=True)
    return [(int(a), int(b), bool(y[b - 1] > y[a])) for a, b in spans if abs(y[b - 1] - y[a]) > 2.0]


def film(
    replay: Replay, agent: int, steps: Sequence[int], *, size: tuple[int, int], wide_m: float, aim_m: float
) -> NDArray[np.uint8]:
    """Return frames of an agent on the stairs from the side, the wall between cut away."""
    assert replay.scene is not None
    x1 = float(stairs_of(replay.scene).rectangles[0, 2])
    away, renderer = 8.0, replay.stage.renderer()
    base, frames = replay.recording.agent_column(agent, "base_pose"), []
    for step in steps:
        x, y, z = base[step, :3].astype(np.float64)
        eye, target = np.array([x1 + away, y + aim_m + 0.15, z]), np.array([x, y + aim_m, z])
        hfov = float(np.degrees(2 * np.arctan(wide_m / 2 / (away + x1 - x))))
        camera = pinhole(*size, hfov_deg=hfov, name="side", near=away + 0.08, pose=look_at(eye, target))
        frames.append(replay.stage.render(renderer, step, [camera], outputs=("rgb",), samples=4)[0]["rgb"])
    return np.hstack(frames)


def stairs_sheet(scene: Scene) -> NDArray[np.uint8]:
    """Return strips of two people and a robot."""
    task, rows = find_task(Wander), []
    spec = replace(task.usage.dataset_rules, max_steps=900)
    found: dict[str, NDArray[np.uint8]] = {}
    for seed in range(12):
        episode = task.episode(scene, seed=seed, agents="robot,human:female_1,human:male_2", spec=spec)
        recording = simulate(task, episode)
        replay = Replay(recording)
        for agent, member in enumerate(recording.agents):
            for first, last, up in climbs(recording, agent):
                kind = f"{member.kind} {'up' if up else 'down'}"
                if kind in found or kind == "robot down":
                    continue
                count, every, size, wide, aim = {
                    "human": (8, 6, (WIDTH // 8, 340), 1.4, 0.8),
                    "robot": (6, 8, (WIDTH // 6, 300), 1.9, 0.35),
                }[member.kind]
                start = first + max(0, (last - first - count * every) // 2)
                steps = range(start, start + count * every, every)
                found[kind] = film(replay, agent, steps, size=size, wide_m=wide, aim_m=aim)
        if len(found) == 3:
            break
    rows = [found[kind] for kind in ("human up", "human down", "robot up") if kind in found]
    return np.vstack(rows)


def main(folder: str) -> None:
    """Draw both pictures."""
    scene = build_home(HomeSpec(seed=SEED, generation=2, storeys=2))
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    write_jpg(out / "storeys.jpg", home_sheet(scene), quality=84)
    write_jpg(out / "stairs.jpg", stairs_sheet(scene), quality=84)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures")
