# pyright: strict
"""Simulates, trains, measures and looks at episodes, as a user of h3data writes it."""

from pathlib import Path

import h3data
from h3data.bodies import Robot, load_robot
from h3data.policies import Velocity


class TurnAround:
    """A policy of one's own."""

    def act(self, view: object) -> Velocity:
        return Velocity(0.0, 1.0)


robot: Robot = load_robot("lift_arm")
home: h3data.Scene = h3data.load_scene("small:3")
recording = h3data.simulate(
    "social_nav", home, agents={"robot": TurnAround()}, robot=robot, max_steps=90, spawn_distance_m=2.0
)
print(recording.episode.scene, len(recording), h3data.measure(recording).values["S"])

env = h3data.make("social_nav", ["small:1", home], observations=["egomotion"], robot=robot)
observation, info = env.reset(seed=0)
worlds = h3data.make("social_nav", num_envs=4, depth_size=(64, 48))
print(env.action_space, worlds.num_envs)

made = h3data.generate(
    "wander",
    Path("out"),
    episodes=2,
    agents=["human", robot],
    policies=[TurnAround],
    cameras=["third_person"],
    overrides={"max_steps": 40},
)
dataset: h3data.Dataset = h3data.load_dataset("out")
result = h3data.evaluate("social_nav", "table", policies=["stand_still", TurnAround], episodes=2, save_recordings=True)
rendered = h3data.rerender(
    "out#0", "videos", cameras="top_down", outputs=["rgb", "depth"], size=(320, 240), steps=range(10)
)
picture = h3data.render_frame(dataset[0], camera="top_down")["rgb"]
report: Path = h3data.view("out#0", out=Path("view.html"))
print(made.metrics.to_text(), result.to_text(), rendered.files, picture.shape, report.name)
