"""Pictures of people who walk, frame by frame, for the documentation.

docs/pictures/planted.jpg: a person starts, stops, walks a curve and turns; own_walk.jpg: the same for somebody who
walks by a motion file.

    python -m bake.people.motion_sheet docs/pictures/planted.jpg
    python -m bake.people.motion_sheet docs/pictures/own_walk.jpg own       # as our own walk, an arm held out
    python -m bake.people.motion_sheet out/walk.png walk.bvh

Rows are those of `ROWS`, or of `WALK_ROWS`. Every third frame is shown, 1/10 s apart.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import JOINT_INDEX, Humanoid, load_humanoid
from h3data.bodies.people.planted_gait import planted_states, pose_planted
from h3data.geometry import Array, ground_pose, quat_from_axis_angle, quat_multiply
from h3data.render.image_files import write_image
from h3data.render.sheets.people_sheet import lined_up
from h3data_motion.clip import Motion, in_start_frame
from h3data_motion.files import save_motion

FRAMES, EVERY, WIDTH = 12, 3, 1920
SPACING_M = 1.15
OWN, WALKER, ARM_DEG = "own", "female_2", 62.0
"""Name of our own walk, the body that walks as a motion file does, and the angle of the left arm held out [deg]."""
Track = tuple[Array, Array]
"""Speeds [m/s] and turning rates [rad/s], each [T]."""


def start(speed: float, acceleration: float) -> Track:
    """Return the track of a person who starts walking."""
    steps = FRAMES * EVERY + 6
    ahead = np.minimum(np.maximum(np.arange(steps) - 6, 0) * acceleration / 30, speed)
    return ahead, np.zeros(steps)


def stop(speed: float, acceleration: float) -> Track:
    """Return the track of a person who walks steadily and stops."""
    ahead = np.concatenate([np.minimum(np.arange(90) * 1.5 / 30, speed), speed - np.arange(1, 60) * acceleration / 30])
    ahead = np.maximum(ahead, 0.0)[: 90 + FRAMES * EVERY - 6]
    return ahead, np.zeros(len(ahead))


def curve(speed: float, turn: float) -> Track:
    """Return the track of a person who walks a quarter of a circle."""
    ahead = np.minimum(np.arange(60 + FRAMES * EVERY) * 1.5 / 30, speed)
    return ahead, np.where(np.arange(len(ahead)) > 66, turn, 0.0)


def turn(rate: float) -> Track:
    """Return the track of a person who turns on the spot."""
    steps = FRAMES * EVERY
    return np.zeros(steps), np.where((np.arange(steps) > 4) & (np.arange(steps) < 34), rate, 0.0)


ROWS: dict[str, Callable[[], Track]] = {
    "start 1.3 m/s": lambda: start(1.3, 1.5),
    "stop 1.3 m/s": lambda: stop(1.3, 1.5),
    "curve": lambda: curve(1.2, 1.0),
    "turn 1.6 rad/s": lambda: turn(1.6),
    "start 2.5 m/s at once": lambda: start(2.5, 1e9),
    "stop 2.5 m/s at once": lambda: stop(2.5, 1e9),
}


def steady(speed: float) -> Track:
    """Return the track of a steady walk."""
    ahead = np.minimum(np.arange(60 + FRAMES * EVERY) * 1.1 / 30, speed)
    return ahead, 0 * ahead


WALK_ROWS = (start(1.3, 1.1), steady(1.3), stop(1.3, 1.1), curve(1.2, 1.0), turn(1.6), steady(0.6))


def own_walk(speed: float = 1.2, fps: float = 60.0, seconds: float = 4.0) -> Motion:
    """Return the walk of male_1, whose left arm is held out to the side."""
    body, count = load_humanoid("male_1"), round(seconds * fps)
    way = np.arange(count) * speed / fps
    quats, pelvis = body.walk_pose(np.full(count, speed), way / body.stride_m(speed))
    out = quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), np.radians(ARM_DEG))
    arm = JOINT_INDEX["left_shoulder"]
    quats[:, arm] = quat_multiply(np.tile(out, (count, 1)), quats[:, arm])
    pelvis = pelvis + np.stack([way, 0 * way, 0 * way], -1)
    return in_start_frame(Motion(name=OWN, fps=fps, quats=quats, pelvis=pelvis, leg_m=body.gaits.legs.length))


def row_picture(body: Humanoid, track: Track, *, look: float = 0.0) -> NDArray[np.uint8]:
    """Return the last frames of a track side by side, RGB [H, W, 3]."""
    speed, turning = track
    heading = np.cumsum(turning) / 30
    xz = np.cumsum(np.stack([speed * np.cos(heading), -speed * np.sin(heading)], -1), axis=0) / 30
    states = planted_states(body.gait_tables, ground_pose(xz, heading))
    rows = np.arange(len(states))[-FRAMES * EVERY :][::EVERY]
    poses = pose_planted(body.gait_tables, states)
    pictures = []
    for k in rows:
        seen = [(body, poses[0][k : k + 1], poses[1][k : k + 1])]
        turned = look + float(heading[k] - heading[rows[0]])
        pictures.append(lined_up(seen, turned, False, 1, WIDTH // FRAMES, spacing=SPACING_M))
    return np.concatenate(pictures, axis=1)


def main(target: str, motion: str = "") -> None:
    """Write the picture of a person who walks, by a motion file if one is given."""
    with tempfile.TemporaryDirectory() as folder:
        if motion == OWN:
            motion = str(Path(folder) / "own.npz")
            save_motion(own_walk(), motion)
        body = load_humanoid(f"{WALKER}+{motion}" if motion else "neutral_0")
    tracks = WALK_ROWS if motion else [track() for track in ROWS.values()]
    write_image(Path(target), np.concatenate([row_picture(body, track) for track in tracks]))


if __name__ == "__main__":
    main(*sys.argv[1:])
