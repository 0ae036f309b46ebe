"""The paper's speed benchmark: random steps of one or two agents in W worlds, each with a depth image per agent (paper,
section 3 and appendix, benchmarking; spec/habitat.md 7)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np

from h3data.bodies import load_humanoid, load_robot
from h3data.errors import InputError
from h3data.geometry import pose_to_matrix
from h3data.render import Renderer, RenderInstance, RenderScene
from h3data.scene import FreeSpace, HomeSpec, Mesh, Scene, build_home
from h3data.scene.records import instance_matrix
from sim_kinematic.arm_contact import ArmContact
from sim_kinematic.benchmark_agents import Action, Agent, HumanAgent, RobotAgent, cameras_of
from sim_kinematic.collision import AgentContact, MovingShapes, collide
from sim_kinematic.contact import clear_of_furniture
from sim_kinematic.spec import SocialNavSpec
from sim_kinematic.state import NOBODY, WorldState

Agents = Literal["robot", "human", "robot_robot", "human_robot"]
STEPS, UNTIMED = 300, 10
"""Steps of a run, and how many of the first are not timed."""
ROBOT, HUMAN, HOME_SEED = "quad_arm", "female_0", 1


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One cell of the benchmark's table."""

    home: str = "small"
    """Preset of the home: small, medium or large, with the areas and rooms of the paper's three scenes."""
    objects: int = 2
    """Things that can be taken; what else lies about stays, fixed."""
    agents: Agents = "human_robot"
    worlds: int = 1
    action: Action = "nav"
    skinned: bool = True

    @property
    def image_px(self) -> int:
        """Width and height of the depth images: 128 of one agent, 256 of each of two."""
        return 256 if self.agents in ("robot_robot", "human_robot") else 128


class Run(NamedTuple):
    """What the timed steps of one run took."""

    wall_s: float
    cpu_s: float
    """User and system time of the whole process."""


class BenchmarkWorlds:
    """W worlds of a cell in one process."""

    def __init__(self, cell: Cell, *, worlds: int | None = None, backend: Literal["cpu", "gpu"] = "cpu") -> None:
        """``worlds``: fewer than the cell has, where several processes share them."""
        self.cell, self.worlds = cell, cell.worlds if worlds is None else worlds
        self.home, self.free = _home(cell.home)
        loose = [i for i in self.home.instances if i.motion != "static" and len(self.home.assets[i.asset].mesh.faces)]
        if not 1 <= cell.objects <= len(loose):
            raise InputError(f"The {cell.home} home has 1 to {len(loose)} objects, got {cell.objects}.")
        self._loose = loose[: cell.objects]
        self.agents = self._make_agents()
        self._touching = self._contact()
        robots = [a for a in self.agents if isinstance(a, RobotAgent)]
        self._arm = ArmContact(self.home, robots[0].robot) if robots and cell.action == "pick" else None
        self.renderer = self._renderer(backend)
        self.touched = np.zeros(self.worlds, np.bool_)
        """Whether the two agents touch, [W], after the last step."""
        self.arm_touches = 0
        """Contacts of arms with the home in the last step, all worlds."""

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
                agents.append(HumanAgent(human, self.free, self.state, number=number, skinned=self.cell.skinned))
            else:
                agents.append(RobotAgent(robot, self.free, self.state, number=number, is_clear=is_clear))
        return agents

    def _renderer(self, backend: Literal["cpu", "gpu"]) -> Renderer:
        meshes: list[Mesh] = []
        instances: list[RenderInstance] = []
        assets: dict[str, int] = {}
        moved: dict[str, int] = {}
        for name, asset in self.home.assets.items():
            if len(asset.mesh.faces):
                assets[name] = len(meshes)
                meshes.append(asset.mesh)
        for i in self.home.instances:
            if i.asset in assets:
                moved[i.name] = len(instances)
                instances.append(RenderInstance(assets[i.asset], instance_matrix(i), layer=i.layer, name=i.name))
        self._objects = [moved[i.name] for i in self._loose]
        self._scales = np.array([i.scale for i in self._loose], np.float64).reshape(-1, 1, 3)
        deformable: list[int] = []
        for agent in self.agents:
            drawn = agent.drawn(len(meshes), len(instances))
            meshes += drawn.meshes
            instances += drawn.instances
            deformable += drawn.deformable
        scene = RenderScene(meshes, instances, deformable=tuple(deformable))
        return Renderer(scene, backend=backend, worlds=self.worlds)

    def _contact(self) -> Callable[[int], bool]:
        """Whether the two agents touch in a world, by FCL."""
        robots = [agent for agent in self.agents if isinstance(agent, RobotAgent)]
        humans = [agent for agent in self.agents if isinstance(agent, HumanAgent)]
        if len(robots) == 2:
            shapes = [MovingShapes(robot.shapes) for robot in robots]

            def robots_touch(world: int) -> bool:
                for moving, robot in zip(shapes, robots, strict=True):
                    moving.set_transforms(robot.shape_frames[world])
                return collide(*shapes)

            return robots_touch
        if robots and humans:
            pair = AgentContact(robots[0].shapes, *humans[0].capsules)

            def touch(world: int) -> bool:
                start, end = humans[0].capsule_ends
                pair.update(robots[0].shape_frames[world], start[world], end[world])
                return pair.collides()

            return touch
        return lambda world: False

    # --- running ----------------------------------------------------------------------------------------------------------
    def reset(self, rng: np.random.Generator) -> None:
        """Everybody at random free places, the objects where they lie in the home."""
        self.state.object_pose[:] = [i.pose for i in self._loose]
        self.state.held_by[:] = NOBODY
        for agent in self.agents:
            agent.reset(rng)

    def sample(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Random actions of each agent in all worlds."""
        return [agent.sample(rng, self.cell.action) for agent in self.agents]

    def step(self, actions: list[np.ndarray]) -> Any:
        """One step of all worlds: actions, contact, one depth image of each agent [agents * W, H, W']."""
        for agent, values in zip(self.agents, actions, strict=True):
            agent.step(self.cell.action, values)
        self.touched = np.array([self._touching(w) for w in range(self.worlds)])
        if self._arm is not None:
            robots = [agent for agent in self.agents if isinstance(agent, RobotAgent)]
            self.arm_touches = sum(
                len(self._arm.touches(base, joints))
                for robot in robots
                for base, joints in zip(robot.base, robot.own.joints, strict=True)
            )
        return self.render(("depth",))["depth"]

    def render(self, outputs: tuple[Any, ...]) -> dict[str, Any]:
        """What each agent sees in each world, by output, [agents * W, H, W', ...]: all worlds of the first agent come first."""
        objects = pose_to_matrix(self.state.object_pose)
        objects[..., :3, :3] *= self._scales
        cameras, eyes = cameras_of(self.agents, self.cell.image_px)
        for agent in self.agents:
            agent.show(self.renderer, cameras[0].fx, eyes)
        for w in range(self.worlds):
            self.renderer.set_transforms(self._objects, objects[w], world=w)
        worlds = list(range(self.worlds)) * len(self.agents)
        return self.renderer.render_batch(cameras, worlds=worlds, outputs=outputs)

    def run(self, seed: int, *, steps: int = STEPS, untimed: int = UNTIMED) -> Run:
        """Time ``steps`` random steps but the first ``untimed``. Sampling actions is not timed, nor is the reset."""
        if not 0 <= untimed < steps:
            raise InputError(
                f"Expected more than {untimed} steps, since the first {untimed} are not timed; got {steps}."
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
    home = build_home(HomeSpec(preset=preset, seed=HOME_SEED))  # pyright: ignore[reportArgumentType] - checked there
    return home, FreeSpace.from_scene(home, radius_m=spec.agent_radius_m, height_m=spec.agent_height_m)
