"""Replay of recordings: poses at any step, cameras, and images.

- `replay`: `Replay`; `posed_recording`: its poses, with `link_poses` for robots; `stage`: its images; `records`: its
data
- `cameras`: cameras by name, among them `third_person` (with `sight`); `camera_files`: cameras from TOML and JSON files
- `recorded_robots`: checks that the files of recorded robots have not changed
"""

from h3data.replay.cameras import camera_at, camera_names, camera_track
from h3data.replay.records import CameraTrack, Drawable, State
from h3data.replay.replay import Replay

__all__ = ["CameraTrack", "Drawable", "Replay", "State", "camera_at", "camera_names", "camera_track"]
