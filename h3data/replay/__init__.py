"""State of a recording at any step, posed bodies, cameras, frames."""

from h3data.replay.cameras import camera_at, camera_names, camera_track
from h3data.replay.follow import follow_camera
from h3data.replay.records import CameraTrack, Drawable, State
from h3data.replay.replay import Replay

__all__ = ["CameraTrack", "Drawable", "Replay", "State", "camera_at", "camera_names", "camera_track", "follow_camera"]
