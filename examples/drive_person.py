"""One idea: control a person through a whole rearrangement episode, one command per step, while a robot helps.

python examples/drive_person.py out/driven.mcap
h3data replay out/driven.mcap --verify          # simulates it again from the recorded commands, bit for bit
"""

from __future__ import annotations

import sys

import numpy as np

import h3data
from h3data.geometry import wrap_angle
from h3data.policies import External, PersonCommand, Pick, Place

path = sys.argv[1] if len(sys.argv) > 1 else "out/driven.mcap"
session = h3data.session("rearrange", "small:3", agents={"person": External(), "robot": "still"}, record=path)
person, walker = session.play.team.people[0], session.episode.spec.human


def steer(forward_m: float, left_rad: float) -> None:
    """Play one step towards a place ahead, or turn towards a heading to the left, at the given distances."""
    turn = float(np.clip(left_rad * 30 / walker.turn_rad_s, -1, 1))
    forward = float(np.clip(forward_m * 30 / walker.speed_mps, 0, 1)) if abs(left_rad) < 0.1 else 0.0
    session.act("person", PersonCommand(forward, turn))
    session.step()


def walk_to(stand: np.ndarray) -> None:
    """Steer along the shortest path to ``(x, z, heading)``."""
    for corner in session.observe("person").free.path(person.xz, stand[:2])[1:]:
        while not session.ended and np.hypot(*(gap := corner - person.xz)) > 0.005:
            steer(float(np.hypot(*gap)), float(wrap_angle(np.arctan2(-gap[1], gap[0]) - person.heading)))
    while not session.ended and abs(left := float(wrap_angle(stand[2] - person.heading))) > 0.01:
        steer(0.0, left)


for target in session.episode.targets:
    for point, skill in ((target.start[:3], Pick(target.name)), (target.goal, Place(tuple(target.goal)))):
        walk_to(person.stand_for(point))
        assert session.refusal("person", skill) is None
        session.act("person", skill)
        session.step()
        while session.waiting == () and not session.ended:
            session.step()

recording = session.close()
print(f"{path}: {recording.episode.info['ended']} after {len(recording)} steps")
