"""Script for docs/pictures/ros.jpg: tracks of people and a map of a robot after their import as a recording.

The tracks and the map are those of one of our own episodes, written as a table of places and as an occupancy map.

python -m bake.sheets.ros docs/pictures/ros.jpg
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import h3data
from h3data.recording import Recording
from h3data.render.image_files import write_jpg
from h3data.replay import CameraTrack, Replay, camera_at
from h3data.scene import FreeSpace, load_scene
from h3data_crowds.crowd_nav import CrowdNav

ROSTER = ("robot", "human", "human", "human", "human")
EVERY, CELL_M = 3, 0.05
SHARE = 0.45
CAMERAS = ("orbit", "robot/third_person")


def write_tracks(episode: Recording, folder: Path) -> None:
    """Write tracks.csv (t, id, x, y), map.pgm and map.yaml, in the frame of ROS: x and -z of ours."""
    lines = ["t,id,x,y"]
    for step in range(0, len(episode), EVERY):
        for k, agent in enumerate(episode.agents):
            x, _, z = episode.columns[f"agent_{k}.base_pose"][step, :3].tolist()
            lines.append(f"{step / 30:.4f},{agent.name},{x:.4f},{-z:.4f}")
    (folder / "tracks.csv").write_text("\n".join(lines) + "\n")
    free = FreeSpace.from_scene(load_scene(episode.attachments["scene.glb"]))
    low = free.origin - 0.2
    columns, rows = np.ceil((np.array(free.sdf.shape) * free.cell_m + 0.4) / CELL_M).astype(int)
    x, z = np.meshgrid(low[0] + (np.arange(columns) + 0.5) * CELL_M, low[1] + (np.arange(rows) + 0.5) * CELL_M)
    cells = np.where(free.signed_distance(np.stack([x, z], -1)) > 0, 254, 0).astype(np.uint8)
    (folder / "map.pgm").write_bytes(f"P5 {columns} {rows} 255\n".encode() + cells.tobytes())
    origin = f"[{low[0]}, {-(low[1] + rows * CELL_M)}, 0.0]"
    told = (
        f"image: map.pgm\nresolution: {CELL_M}\norigin: {origin}\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    (folder / "map.yaml").write_text(told)


def main(out: str) -> None:
    """Play an episode, write its tracks, import them, and write the picture."""
    episode = h3data.simulate(CrowdNav, "small:1", roster=ROSTER, agents={"robot": "mpc"}, seed=5)
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_tracks(episode, folder)
        h3data.import_(folder / "tracks.csv", folder / "rec", robot="robot", map=folder / "map.yaml", force=True)
        recording = h3data.open(next((folder / "rec").rglob("*.mcap")))
        replay, step = Replay(recording), int(SHARE * len(recording))
        pictures = []
        for camera in CAMERAS:
            seen_from = camera_at(replay, camera, step)
            track = CameraTrack(camera=seen_from, poses=seen_from.pose[None])
            pictures.append(next(iter(replay.frames([track], [step], outputs=("rgb",))))[1][0]["rgb"])
    height = max(each.shape[0] for each in pictures)
    padded = [np.pad(e, ((0, height - len(e)), (0, 0), (0, 0)), constant_values=255) for e in pictures]
    write_jpg(out, np.hstack(padded))


if __name__ == "__main__":
    main(*sys.argv[1:])
