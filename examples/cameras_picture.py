"""One idea: one recording, eight cameras, every output. Usage: python examples/cameras_picture.py EPISODE.mcap OUT.jpg [STEP]

Needs the extra ``rays`` (fisheye, equirectangular, shadows).
"""

import sys

import cv2
import numpy as np

import h3data
from h3data.render import (
    Camera,
    Light,
    Renderer,
    depth_to_rgb,
    equirectangular,
    fisheye,
    instance_to_rgb,
    write_png,
)
from h3data.render.image_files import write_jpg
from h3data.replay import camera_track
from h3data.replay.stage import Stage
from h3data_pipelines.pictures.boxes import draw_boxes, visible_boxes
from h3data_pipelines.pictures.flow import flow_to_rgb, optical_flow

NAMES = ("third_person", "robot_arm", "human_head", "orbit", "top_down", "top_down_orthographic")
OUTPUTS = ("rgb", "depth", "instance", "semantic", "normal", "triangle")
WIDTH, MOST_HEIGHT, LABEL, PAPER = 236, 200, 16, (250, 250, 248)

if len(sys.argv) < 3:
    sys.exit(__doc__)
replay = h3data.Replay(h3data.open(sys.argv[1]), detail=True)
step = int(sys.argv[3]) if len(sys.argv) > 3 else len(replay) // 2
stage = Stage(replay)
renderer = Renderer(stage.scene, light=Light(shadow_rays=16), threads=2)
tracks = {name: camera_track(replay, name) for name in NAMES}


def cameras_at(step: int) -> list[Camera]:
    cameras = [track.at(step) for track in tracks.values()]
    eye = cameras[0].pose
    hidden = ("ceiling",)
    around = fisheye(480, 480, hfov_deg=185, name="fisheye", pose=eye, hidden_layers=hidden)
    return [*cameras, around, equirectangular(640, name="equirectangular", pose=eye, hidden_layers=hidden)]


before, after = cameras_at(step), cameras_at(step + 3)
stage.render(renderer, step + 3, after[:1], outputs=("depth",))
poses_after = renderer.poses()
stage.render(renderer, step, before[:1], outputs=("depth",))
body_of_id = np.array([drawable.agent for drawable in replay.drawables])  # the parts of each agent, nothing else
agents = [agent.name for agent in replay.recording.agents]


def row(camera: Camera, camera_after: Camera) -> list[np.ndarray]:
    seen = renderer.render(camera, outputs=OUTPUTS, samples=4)
    hits = seen["depth"][seen["depth"] > 0]
    near, far = np.percentile(hits, (1, 99)) if len(hits) else (0, 1)
    flow = optical_flow(stage.scene, seen, camera, renderer.poses(), camera_after, poses_after)
    boxed = seen["rgb"].copy()
    found = visible_boxes(seen["instance"], groups=body_of_id)
    draw_boxes(boxed, found.boxes, [agents[k] for k in found.ids], instance_to_rgb(found.ids + 3))
    normals = np.where(seen["depth"][..., None] > 0, 127.5 * (seen["normal"] + 1), 18).astype(np.uint8)
    depth = depth_to_rgb(seen["depth"], near, max(far, near + 0.1))
    semantic = instance_to_rgb(seen["semantic"])
    return [seen["rgb"], boxed, depth, instance_to_rgb(seen["instance"]), semantic, normals, flow_to_rgb(flow)]


def tile(image: np.ndarray, label: str) -> np.ndarray:
    scale = min(WIDTH / image.shape[1], MOST_HEIGHT / image.shape[0])
    width, height = round(image.shape[1] * scale), round(image.shape[0] * scale)
    x, y = (WIDTH - width) // 2, LABEL
    out = np.full((LABEL + height + 4, WIDTH + 4, 3), PAPER, np.uint8)
    out[y : y + height, x : x + width] = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    cv2.putText(out, label, (3, LABEL - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (30, 30, 36), 1, cv2.LINE_AA)
    return out


kinds = ("rgb", "boxes of agents", "depth", "instance", "semantic", "normal", "flow, 0.1 s")
rows = []
for camera, camera_after in zip(before, after, strict=True):
    pictures = row(camera, camera_after)
    rows.append([tile(image, f"{camera.name}: {kind}") for image, kind in zip(pictures, kinds, strict=True)])
    if len(sys.argv) > 4:  # a folder for the pictures in full size
        for image, kind in zip(pictures, kinds, strict=True):
            write_png(f"{sys.argv[4]}/{camera.name}.{kind.split()[0].strip(',')}.png", image)
write_jpg(sys.argv[2], np.concatenate([np.concatenate(line, axis=1) for line in rows]), quality=88)
