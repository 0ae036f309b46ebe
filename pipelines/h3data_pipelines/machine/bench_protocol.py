"""Protocol of the paper's speed benchmark: random steps of one or two agents in W worlds, with a depth image per agent.

The protocol is described in the paper (section 3 and appendix, benchmarking; spec/habitat.md 7).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np

from h3data.bodies import load_humanoid, load_robot
from h3data.errors import InputError
from h3data.render import pinhole
from h3data.scene import FreeSpace, Scene
from h3data.scene.open import named_scenes, open_scene
from h3data_pipelines.machine.arm_contact import ArmContact
from h3data_pipelines.machine.bench_agents import Action, Agent, HumanAgent, RobotAgent
from sim_kinematic.contact import AgentContacts
from sim_kinematic.contact.clearance import clear_of_furniture
from sim_kinematic.contact.frames import body_shapes, shape_frames
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.motion.state import NOBODY, WorldState
from sim_kinematic.sensing.camera_sensor import StateRenderer

Agents = Literal["robot", "human", "robot_robot", "human_robot"]
STEPS, UNTIMED = 300, 10
"""Number of steps of a run, and number of the first steps that are not timed."""
ROBOT, HUMAN, HOME_SEED = "quad_arm", "female_0", 1
CAMERA, HFOV_DEG = "robot_arm", 90.0
"""Robot camera, mounted on the arm, and field of view of square pictures; the camera of a person is between the
eyes.
"""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Setting of the benchmark, which is one row of its table."""

    home: str = "small"
    """Preset of the home: small, medium or large, with the areas and rooms of the paper's three scenes."""
    objects: int = 2
    """Number of objects that can be taken; the other objects cannot be moved."""
    agents: Agents = "human_robot"
    worlds: int = 1
    action: Action = "nav"
    skinned: bool = True
    pictures: Literal["each", "arm"] = "each"
    """Pictures of each step: a square picture for each agent as in the paper, or one of the first robot's arm
    camera, 224x171.
    """

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the depth images [pixels]; in the paper 128 for one agent, 256 for each of two."""
        if self.pictures == "arm":
            camera = load_robot(ROBOT).camera(CAMERA)
            return camera.width, camera.height
        return (256, 256) if self.agents in ("robot_robot", "human_robot") else (128, 128)


class Run(NamedTuple):
    """Times of the steps of one run."""

    wall_s: float
    cpu_s: float
    """User and system time of the whole process [s]."""


class BenchmarkWorlds:
    """W worlds of a cell in one process."""

    def __init__(self, cell: Cell, *, worlds: int | None = None, backend: Literal["cpu", "gpu"] = "cpu") -> None:
        """Create the worlds of a cell, or only ``worlds`` of them if several processes share the cell."""
        self.cell, self.worlds = cell, cell.worlds if worlds is None else worlds
        self.home, self.free = _home(cell.home)
        loose = [i for i in self.home.instances if i.motion != "static" and len(self.home.assets[i.asset].mesh.faces)]
        if not 1 <= cell.objects <= len(loose):
            raise InputError(
                f"The {cell.home} home has 1 to {len(loose)} objects, got {cell.objects}.", code="H3-OPTION-017"
            )
        if cell.pictures == "arm" and "robot" not in cell.agents:
            raise InputError(f"There is no arm camera: nobody of {cell.agents} is a robot.", code="H3-OPTION-018")
        self._loose = loose[: cell.objects]
        self.agents = self._make_agents()
        self._contact = AgentContacts(*(body_shapes(agent.body) for agent in self.agents))
        robots = [a for a in self.agents if isinstance(a, RobotAgent)]
        self._arm = ArmContact(self.home, robots[0].body) if robots and cell.action == "pick" else None
        self.drawn = StateRenderer(
            self.home,
            [agent.body for agent in self._in_order()],
            worlds=self.worlds,
            skinned=cell.skinned,
            objects=[i.name for i in self._loose],
            backend=backend,
        )
        self.renderer = self.drawn.renderer
        self.touched = np.zeros(self.worlds, np.bool_)
        """True if the two agents touch, [W], after the last step."""
        self.arm_touches = 0
        """Number of contacts of arms with the home in the last step, all worlds."""

    def _make_agents(self) -> list[Agent]:
        robot, human = load_robot(ROBOT), load_humanoid(HUMAN)
        is_clear = clear_of_furniture(self.home, robot)
        kinds = self.cell.agents.split("_")
        robots, people = kinds.count("robot"), kinds.count("human")
        self.state = WorldState.zeros(
            self.worlds, robots=robots, people=people, joints=len(robot.joint_names), objects=len(self._loose)
        )
        numbers = {"robot": iter(range(robots)), "human": iter(range(robots, robots + people))}
        agents: list[Agent] = []
        for kind in kinds:
            number = next(numbers[kind])
            if kind == "human":
                agents.append(HumanAgent(human, self.free, self.state, number=number))
            else:
                agents.append(RobotAgent(robot, self.free, self.state, number=number, is_clear=is_clear))
        return agents

    # --- running ----------------------------------------------------------------------------------------------------------
    def reset(self, rng: np.random.Generator) -> None:
        """Place all agents at random free positions, and the objects at their positions in the home."""
        self.state.object_pose[:] = [i.pose for i in self._loose]
        self.state.held_by[:] = NOBODY
        for agent in self.agents:
            agent.reset(rng)

    def sample(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Sample actions of each agent in all worlds."""
        return [agent.sample(rng, self.cell.action) for agent in self.agents]

    def step(self, actions: list[np.ndarray]) -> Any:
        """Advance all worlds by one step: actions, contact, one depth image of each agent [agents * W, H, W']."""
        for agent, values in zip(self.agents, actions, strict=True):
            agent.step(self.cell.action, values)
        if len(self.agents) > 1:
            frames = [shape_frames(agent.body, agent.frames) for agent in self.agents]
            for w in range(self.worlds):
                for k, of in enumerate(frames):
                    self._contact.update(k, of[w])
                self.touched[w] = bool(self._contact.touching())
        if self._arm is not None:
            robots = [agent for agent in self.agents if isinstance(agent, RobotAgent)]
            self.arm_touches = sum(
                len(self._arm.touches(base, joints))
                for robot in robots
                for base, joints in zip(robot.base, robot.own.joints, strict=True)
            )
        return self.render(("depth",))["depth"]

    def render(self, outputs: tuple[Any, ...]) -> dict[str, Any]:
        """Render the view of each agent (or arm camera) in each world, as images [agents * W, H, W', ...] by output.

        All worlds of the first agent come first.
        """
        self.drawn.pose(self.state, frames=[agent.frames for agent in self._in_order()])
        if self.cell.pictures == "arm":
            return self.drawn.picture(self.drawn.cameras(CAMERA), outputs)
        cameras = [
            pinhole(*self.cell.image_size, hfov_deg=HFOV_DEG, near=camera.near, pose=camera.pose)
            for agent in self.agents
            for camera in self.drawn.cameras(CAMERA, agent=agent.number)
        ]
        return self.drawn.picture(cameras, outputs)

    def _in_order(self) -> list[Agent]:
        """Return the agents in the order of their numbers."""
        return sorted(self.agents, key=lambda agent: agent.number)

    def run(self, seed: int, *, steps: int = STEPS, untimed: int = UNTIMED) -> Run:
        """Measure the time of ``steps`` random steps after the first ``untimed``, without sampling and resets."""
        if not 0 <= untimed < steps:
            raise InputError(
                f"Expected more than {untimed} steps, since the first {untimed} are not timed; got {steps}.",
                code="H3-OPTION-019",
            )
        rng = np.random.default_rng(seed)
        self.reset(rng)
        wall = cpu = 0.0
        for k in range(steps):
            actions = self.sample(rng)
            before, cpu_before = time.perf_counter(), time.process_time()
            self.step(actions)
            self._finish()
            if k >= untimed:
                wall += time.perf_counter() - before
                cpu += time.process_time() - cpu_before
        return Run(wall, cpu)

    def _finish(self) -> None:
        """Wait for the device: a picture counts when it is there."""
        if self.renderer.backend == "gpu":
            import torch

            torch.cuda.synchronize()


@lru_cache(maxsize=3)
def _home(preset: str) -> tuple[Scene, FreeSpace]:
    spec = SocialNavSpec()
    home = open_scene(named_scenes(f"{preset}:{HOME_SEED}")[0].source)
    return home, FreeSpace.from_scene(home, radius_m=spec.agent_radius_m, height_m=spec.agent_height_m)
