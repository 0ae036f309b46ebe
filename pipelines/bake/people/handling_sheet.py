"""Pictures of a person who handles objects, frame by frame, for the documentation.

docs/pictures/handling.jpg: a person picks an object, carries it and places it in a home; corridor.jpg: a person turns
round in a corridor and walks on; hand_over.jpg: a person gives an object to a robot.

    python -m bake.people.handling_sheet docs/pictures/handling.jpg
    python -m bake.people.handling_sheet docs/pictures/corridor.jpg corridor
    python -m bake.people.handling_sheet docs/pictures/hand_over.jpg hand_over

All rows of the first picture are from one simulated episode of rearrangement with a robot, seen from where the line of
sight is free: the first pick and its hand close up; carrying past the robot; the sharpest turn while walking in a
narrow place; placing, and its hand. Those of the second are from one minute of a person and a robot who wander: the
turn, and where the robot is nearest. In the third a person is controlled from outside: walking up to the robot, giving,
and both hands close up.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import h3data
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import Array, heading_direction, heading_from_quat, wrap_angle
from h3data.recording import Recording
from h3data.render import look_at, pinhole
from h3data.render.image_files import write_jpg
from h3data.replay.replay import Replay
from h3data.replay.sight import Fan, Sight, reach_of
from h3data.scene import FreeSpace
from sim_kinematic.agents.driven.commands import HandOver, PersonCommand, Pick
from sim_kinematic.agents.skills import Action
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.policies.policy import External
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.wander import Wander

FRAMES, WIDTH, ROW_PX = 12, 1440, 184
HOME, SEED = "small:1", 3
PERSON, MIDDLE_M, TALL_M, CLOSE_M = 1, 0.92, 2.1, 0.5
BOOM_M, YAWS, ELEVATIONS_DEG = 2.6, 36, (8.0, 20.0, 35.0)
HIDDEN = ("ceiling",)
AFTER_STEPS = 120
"""Number of steps of the hand-over and after it."""
WALKS_M, SIDE_RAD = 0.4, 0.8
"""Distance per second of a person who walks [m], and direction of the camera of hands, relative to the person's [rad]."""


class Stage:
    """Frames of a recording from directions with a free line of sight."""

    def __init__(self, replay: Replay) -> None:
        self.replay = replay
        self.base = replay.recording.agent_column(PERSON, "base_pose").astype(np.float64)
        self.heading = heading_from_quat(self.base[:, 3:])
        self._sight = Sight(replay, hidden_layers=HIDDEN)
        flat = heading_direction(np.arange(YAWS) * 2 * np.pi / YAWS)
        flat = np.stack([flat[:, 0], np.zeros(YAWS), flat[:, -1]], axis=1)
        tilts = np.radians(ELEVATIONS_DEG)
        self._rays = np.concatenate([flat * np.cos(t) + [0, np.sin(t), 0] for t in tilts])
        self._fan = Fan(self._sight, self._rays)
        self._renderer = replay.stage.renderer()

    def offset(self, steps: NDArray[np.intp], points: Array, toward: float) -> Array:
        """Return the camera offset [3] from points [T, 3] with free lines of sight, near direction ``toward`` [rad]."""
        free = np.full(len(self._rays), BOOM_M)
        for step, point in zip(steps, points, strict=True):
            self._sight.at(int(step))
            free = np.minimum(free, self._fan.free(self._sight.around(point, reach_of(BOOM_M)), BOOM_M))
        yaw = np.arctan2(-self._rays[:, 2], self._rays[:, 0])
        best = int(np.argmax(np.minimum(free, BOOM_M) + 0.6 * np.cos(yaw - toward)))
        return self._rays[best] * max(float(free[best]), 0.5)

    def row(
        self, steps: NDArray[np.intp], toward: float, *, joint: str = "", beside: Array | None = None
    ) -> NDArray[np.uint8]:
        """Return frames side by side, with the camera on the person, a joint, or halfway to ``beside`` [3]."""
        points = self.base[steps, :3] + [0, MIDDLE_M, 0]
        if beside is not None:
            points = (points + beside) / 2
        if joint:
            points = self.replay.joint_matrices(PERSON, steps)[:, JOINT_INDEX[joint], :3, 3]
        offset = self.offset(steps, points, toward)
        # a camera that is nearer has a wider lens, so that people are equally tall in all rows
        high = CLOSE_M if joint else TALL_M
        width = WIDTH // FRAMES
        hfov = np.degrees(2 * np.arctan(high / 2 * width / ROW_PX / np.linalg.norm(offset)))
        frames = []
        for step, point in zip(steps, points, strict=True):
            camera = pinhole(width, ROW_PX, hfov_deg=hfov, pose=look_at(point + offset, point), hidden_layers=HIDDEN)
            frames.append(
                self.replay.stage.render(self._renderer, int(step), [camera], outputs=("rgb",), samples=4)[0]["rgb"]
            )
        return np.concatenate(frames, axis=1)


def around(step: int, every: int, length: int, *, before: float = 0.5) -> NDArray[np.intp]:
    """Return `FRAMES` steps that are ``every`` apart, of which a share ``before`` lies before ``step``."""
    first = step - round(before * FRAMES * every)
    return np.clip(first + np.arange(FRAMES) * every, 0, length - 1)


def corridor() -> NDArray[np.uint8]:
    """Return the picture of a person who turns round in a corridor."""
    home = h3data.build_home(h3data.HomeSpec(preset="medium", seed=3))
    recording = h3data.simulate(Wander, home, roster="robot,female_1", seed=1, max_steps=1800)
    stage, length = Stage(Replay(recording)), len(recording)
    xz = stage.base[:, [0, 2]]
    halls = np.concatenate([room.rectangles for room in home.rooms if room.category == "hall"])
    inside = np.any(np.all((xz[:, None] >= halls[:, :2]) & (xz[:, None] <= halls[:, 2:]), axis=-1), axis=1)
    turned = np.abs(wrap_angle(stage.heading[60:] - stage.heading[:-60]))
    turn = 30 + int(np.argmax(turned * inside[30:-30]))
    robot = recording.agent_column(0, "base_pose")[:, [0, 2]]
    nearest = int(np.argmin(np.where(inside, np.hypot(*(robot - xz).T), np.inf)))
    moments = ((turn, 6), (nearest, 8))
    return np.concatenate([stage.row(around(at, every, length), float(stage.heading[at])) for at, every in moments])


def handling() -> NDArray[np.uint8]:
    """Return the picture of an episode of rearrangement."""
    recording = h3data.simulate(Rearrange, HOME, seed=SEED, rules="natural")
    replay, length = Replay(recording), len(recording)
    stage = Stage(replay)
    spans = [s for s in recording.skills if s.agent == PERSON and s.outcome in ("done", "running")]
    pick = next(s for s in spans if s.name == "pick")
    place = next(s for s in spans if s.name == "place" and s.start_step > pick.end_step)
    free = FreeSpace.from_scene(h3data.open(HOME), radius_m=0.1, height_m=1.41)
    xz = stage.base[:, [0, 2]]
    turned = np.abs(wrap_angle(stage.heading[30:] - stage.heading[:-30]))
    walks = np.hypot(*(xz[30:] - xz[:-30]).T) > WALKS_M
    turn = 15 + int(np.argmax(turned * walks / np.maximum(free.signed_distance(xz)[15:-15], 0.2)))
    robot = recording.agent_column(0, "base_pose")[:, [0, 2]]
    carried = np.arange(pick.end_step, place.start_step)
    nearest = int(carried[np.argmin(np.hypot(*(robot - xz)[carried].T))])
    picks, places = (np.linspace(s.start_step, s.end_step, FRAMES).round().astype(np.intp) for s in (pick, place))
    rows = []
    for steps in (picks, places):
        side = float(stage.heading[steps[0]]) - SIDE_RAD
        rows.append([stage.row(steps, side), stage.row(steps, side, joint="right_wrist")])
    walking = [stage.row(around(step, 4, length), float(stage.heading[step])) for step in (nearest, turn)]
    return np.concatenate([*rows[0], *walking, *rows[1]])


def handed_over() -> Recording:
    """Return a recording of a person who gives the first object to a robot at rest."""
    session = h3data.session(Rearrange, HOME, seed=SEED, agents={"person": External(), "robot": "still"})
    play: Any = session.play  # a person who is driven has more than the interface of a session
    person, robot = play.team.people[0], play.team.actors[0]
    for choice in (Action("nav_to_object", 0), Pick(0)):
        session.act("person", choice)
        session.step()
        while not session.waiting:
            session.step()
    stand = person.stand_for(robot.hand_pose[:3])
    for corner in (*person.free.path(person.xz, stand[:2])[1:], None):
        while True:
            gap = np.zeros(2) if corner is None else corner - person.xz
            left = float(wrap_angle((stand[2] if corner is None else math.atan2(-gap[1], gap[0])) - person.heading))
            far = math.hypot(gap[0], gap[1])
            if far < 0.01 and (corner is not None or abs(left) < 0.01):
                break
            ahead = 0.0 if abs(left) > 0.1 and far > 0.05 else min(1.0, far / person.spec.speed_mps / STEP_S)
            turn = 0.0 if corner is not None and far < 0.05 else left / person.spec.turn_rad_s / STEP_S
            session.act("person", PersonCommand(ahead, float(np.clip(turn, -1.0, 1.0))))
            session.step()
    session.act("person", HandOver(0))
    for _ in range(AFTER_STEPS):
        session.step()
    return session.close()


def hand_over() -> NDArray[np.uint8]:
    """Return the picture of a hand-over."""
    recording = handed_over()
    stage = Stage(Replay(recording))
    gives = next(s for s in recording.skills if s.name == "hand_over")
    ahead = float(stage.heading[gives.start_step])
    robot = recording.agent_column(0, "base_pose")[gives.start_step, :3] + [0, 0.7, 0]
    comes = np.linspace(gives.start_step - 50, gives.start_step, FRAMES).round().astype(np.intp)
    steps = np.linspace(gives.start_step, gives.end_step, FRAMES).round().astype(np.intp)
    near = np.linspace(gives.start_step + 0.3 * (gives.end_step - gives.start_step), gives.end_step - 20, FRAMES)
    return np.concatenate(
        [
            stage.row(comes, ahead + SIDE_RAD),
            stage.row(steps, ahead + np.pi / 2, beside=robot),
            stage.row(near.round().astype(np.intp), ahead - SIDE_RAD, joint="right_wrist"),
        ]
    )


SHEETS = {"handling": handling, "corridor": corridor, "hand_over": hand_over}


def main(target: str, sheet: str = "handling") -> None:
    """Write one of the pictures, which ``sheet`` names."""
    write_jpg(Path(target), SHEETS[sheet](), quality=75)


if __name__ == "__main__":
    main(*sys.argv[1:])
