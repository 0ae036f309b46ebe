"""A motion file of your own as an activity: somebody dances, then reads; another person and a robot pass.

python examples/dance.py out/dance         # dance.bvh, episode.mcap, dance.png; then the same by the command line:
h3data generate wander --scenes medium2:1 --agents robot,human:female_1+dance=out/dance/dance.bvh,human \
    --partner orca+sofa_0:dance:9+sofa_0:read:6,orca --set max_steps=900 --spawn-distance 1 --episodes 1 --mcap -o out/dance/ds
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np

import h3data
from h3data.geometry import heading_from_quat
from h3data.recording import Recording, write_mcap
from h3data.render.image_files import write_png
from h3data.replay import Replay, camera_track
from h3data.scene.open import named_scenes, open_free_space
from sim_kinematic.tasks.resume import verify

SCENE, FPS, SECONDS = "medium2:1", 30, 4.0
BONES = (
    ("Hips", "", (0, 92, 0)),
    ("Spine", "Hips", (0, 12, 0)),
    ("Spine1", "Spine", (0, 14, 0)),
    ("Spine2", "Spine1", (0, 14, 0)),
    ("Neck", "Spine2", (0, 14, 0)),
    ("Head", "Neck", (0, 10, 0)),
    *((f"{side}Shoulder", "Spine2", (4 * x, 10, 0)) for side, x in (("Left", 1), ("Right", -1))),
    *((f"{side}Arm", f"{side}Shoulder", (13 * x, 0, 0)) for side, x in (("Left", 1), ("Right", -1))),
    *((f"{side}ForeArm", f"{side}Arm", (27 * x, 0, 0)) for side, x in (("Left", 1), ("Right", -1))),
    *((f"{side}Hand", f"{side}ForeArm", (25 * x, 0, 0)) for side, x in (("Left", 1), ("Right", -1))),
    *((f"{side}UpLeg", "Hips", (9 * x, -4, 0)) for side, x in (("Left", 1), ("Right", -1))),
    *((f"{side}Leg", f"{side}UpLeg", (0, -41, 0)) for side, x in (("Left", 1), ("Right", -1))),
    *((f"{side}Foot", f"{side}Leg", (0, -40, 0)) for side, x in (("Left", 1), ("Right", -1))),
    *((f"{side}ToeBase", f"{side}Foot", (0, -6, 12)) for side, x in (("Left", 1), ("Right", -1))),
)
"""Joints of the figure: name, parent and offset [cm]."""


def angles(joint: str, t: float) -> tuple[float, float, float]:
    """Return the rotations about z, x and y of a joint [deg] at a time [s]."""
    beat, side = math.sin(2 * math.pi * t), 1 if joint.startswith("Left") else -1
    knee = 14 + 10 * math.cos(4 * math.pi * t)
    name = joint.removeprefix("Left").removeprefix("Right")
    return {
        "UpLeg": (0.0, -knee, 0.0),
        "Leg": (0.0, 2 * knee, 0.0),
        "Foot": (0.0, -knee, 0.0),
        "Spine": (6 * beat, 4.0, 10 * beat),
        "Spine2": (-4 * beat, 0.0, 8 * beat),
        "Head": (4 * beat, 0.0, -12 * beat),
        "Arm": (side * (-15 + 35 * side * beat), 0.0, side * -35.0),
        "ForeArm": (side * 25.0, 0.0, side * -60.0),
    }.get(name, (0.0, 0.0, 0.0))


def write_bvh(path: Path) -> None:
    """Write the dance as a BVH file."""

    def joint(name: str, offset: tuple[int, int, int], depth: int) -> list[str]:
        pad, kids = "  " * depth, [bone for bone in BONES if bone[1] == name]
        place = "6 Xposition Yposition Zposition" if not depth else "3"
        lines = [f"{pad}{'JOINT' if depth else 'ROOT'} {name}", f"{pad}{{"]
        lines.append(f"{pad}  OFFSET {' '.join(map(str, offset))}")
        lines.append(f"{pad}  CHANNELS {place} Zrotation Xrotation Yrotation")
        order.append(name)
        for kid in kids:
            lines += joint(kid[0], kid[2], depth + 1)
        if not kids:
            lines += [f"{pad}  End Site", f"{pad}  {{", f"{pad}    OFFSET 0 0 6", f"{pad}  }}"]
        return [*lines, f"{pad}}}"]

    order: list[str] = []
    lines = ["HIERARCHY", *joint("Hips", (0, 0, 0), 0), "MOTION", f"Frames: {round(SECONDS * FPS) + 1}"]
    lines.append(f"Frame Time: {1 / FPS:.6f}")
    for k in range(round(SECONDS * FPS) + 1):
        t = k / FPS
        bend = math.radians(-angles("LeftUpLeg", t)[1])
        # the ankles stay where they are, below the hips
        values = [3 * math.sin(2 * math.pi * t), 91 - 81 * (1 - math.cos(bend)), 0.0]
        values += [value for name in order for value in angles(name, t)]
        lines.append(" ".join(f"{value:.4f}" for value in values))
    path.write_text("\n".join(lines) + "\n")


def play(dance: Path) -> Recording:
    """Simulate half a minute."""
    return h3data.simulate(
        "wander",
        SCENE,
        roster=["robot", f"female_1+dance={dance}", "male_2"],
        agents={"human_1": "orca+sofa_0:dance:9+sofa_0:read:6", "human_2": "orca"},
        seed=3,
        max_steps=900,
        spawn_distance_m=1.0,
    )


def main(out: str) -> None:
    """Write the motion, simulate and verify an episode with it, and draw twelve moments of the dance."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    write_bvh(folder / "dance.bvh")
    recording = play(folder / "dance.bvh")
    write_mcap(recording, folder / "episode.mcap", overwrite=True)
    print("verified" if verify(recording).difference is None else "differs")
    begin = next(event.step for event in recording.events if event.kind == "performs")
    x, y, z, *turn = recording.columns["agent_1.base_pose"][begin].astype(float).tolist()
    # from where there is most room between camera and person
    free = open_free_space(named_scenes(SCENE)[0].source, 0.25, 1.41)
    ahead = heading_from_quat(np.array(turn)) + np.linspace(-1.2, 1.2, 13)
    line = np.linspace(0.4, 2.4, 11)[:, None, None] * np.stack([np.cos(ahead), -np.sin(ahead)], 1) + (x, z)
    ex, ez = line[-1, int(np.argmax(free.signed_distance(line.reshape(-1, 2)).reshape(11, 13).min(0)))].tolist()
    (folder / "camera.toml").write_text(
        f"eye = [{ex:.2f}, {y + 1.5:.2f}, {ez:.2f}]\ntarget = [{x:.2f}, {y + 0.85:.2f}, {z:.2f}]\nhfov_deg = 60\n"
    )
    replay = Replay(recording)
    track = camera_track(replay, str(folder / "camera.toml")).resized(320, 320)
    steps = [begin + k for k in (0, 4, 8, 12, 17, 22, 27, 32, 98, 106, 112, 118)]
    frames = [outputs["rgb"] for _, (outputs,) in replay.frames([track], steps, samples=4)]
    write_png(folder / "dance.png", np.vstack([np.hstack(frames[k : k + 6]) for k in (0, 6)]))


if __name__ == "__main__":
    main(*sys.argv[1:])
