"""The simulator: CPU seconds (user + system, getrusage) of this process, everything warm, the median of some rounds.

``sim.{robot,human,robot_robot,human_robot}.w{1,16}_depth_fps`` are cells of ``h3data bench sim`` (small home, two objects,
nav, skinned): frames per second by the clock with the 16 worlds on all cores, and ``_cpu_ms`` the CPU time of a frame.
``sim.social_nav.depth_frames_per_cpu_s`` is a recorded episode (expert, contact, recording) and then, step
by step, posing robot and skinned person and drawing the robot's arm camera: what a loop with a policy that sees would cost.
"""

from __future__ import annotations

import resource
from collections.abc import Callable
from dataclasses import replace
from statistics import median

import numpy as np

from h3data.bodies import load_humanoid, load_robot
from h3data.replay import Replay
from h3data.replay.cameras import camera_track
from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.machine.bench import Bench, measure, process_pool
from sim_kinematic.agents.arm_tuck import draw_arms
from sim_kinematic.agents.manipulation import grip_objects, move_arms, robot_hands
from sim_kinematic.agents.stands import discs_fit
from sim_kinematic.motion.gait import walk_humans
from sim_kinematic.motion.spec import HOME_BASE, HOME_WALKER, NATURAL_WALKER, ArmSpec, BaseSpec, SocialNavSpec
from sim_kinematic.motion.state import HumanState, RobotState, WorldState
from sim_kinematic.motion.step import drive_robots
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.social_nav import SocialNav

Emit = Callable[[str, float, str], None]
EPISODES, RUNS = 4, 3


def run(emit: Emit) -> None:
    """Emit ``sim.state.*``, ``sim.arm.*``, ``sim.social_nav.*`` and the cells of the paper's benchmark."""
    home = build_home(HomeSpec(preset="small", seed=1))
    free = FreeSpace.from_scene(home)
    emit("sim.state.w1_steps_per_s", _state_steps(free, worlds=1, steps=20_000), "steps/s")
    emit("sim.state.w16_steps_per_s", 16 * _state_steps(free, worlds=16, steps=10_000), "steps/s")
    emit("sim.state.w1024_env_steps_per_cpu_s", 1024 * _state_steps(free, worlds=1024, steps=300), "steps/s")
    habitat = BaseSpec(slide="habitat")
    emit("sim.state.habitat_slide_w1024_env_steps_per_cpu_s", 1024 * _state_steps(free, 1024, 20, habitat), "steps/s")
    emit("sim.arm.w1_steps_per_s", _arm_steps(worlds=1, steps=2000), "steps/s")
    emit("sim.arm.w1024_env_steps_per_cpu_s", 1024 * _arm_steps(worlds=1024, steps=50), "steps/s")
    # collisions do not end these episodes: all have the same number of steps; people walk as the paper's, as in earlier figures
    spec = SocialNavSpec(end_on_collision=False, human=HOME_WALKER)
    worlds = [SocialNav().episode(home, seed=seed, spec=spec, free=free) for seed in range(EPISODES)]
    recordings = [simulate(SocialNav(), world) for world in worlds]
    seconds = median(cpu_s(lambda w=world: simulate(SocialNav(), w)) for world in worlds)
    emit("sim.social_nav.steps_per_cpu_s", spec.max_steps / seconds, "steps/s")
    natural = [replace(world, spec=replace(spec, human=NATURAL_WALKER)) for world in worlds]
    natural_s = median(cpu_s(lambda w=world: simulate(SocialNav(), w)) for world in natural)
    emit("sim.social_nav.natural_steps_per_cpu_s", spec.max_steps / natural_s, "steps/s")
    replay = Replay(recordings[0])
    track, steps = camera_track(replay, "robot_arm"), range(0, len(replay), 5)

    def draw() -> None:
        for _ in replay.frames([track], steps, outputs=("depth",)):
            pass

    draw()
    frame_s = median(cpu_s(draw) for _ in range(3)) / len(steps)
    size = f"{track.camera.width}x{track.camera.height}"
    assert size == "224x171", size
    emit("sim.social_nav.depth_frames_per_cpu_s", 1 / (frame_s + seconds / spec.max_steps), "frames/s")
    bench = Bench("sim", runs=RUNS)
    with process_pool(bench.processes()) as pool:
        for cell in bench.cells():
            row = measure(cell, pool, runs=bench.runs, steps=bench.steps)
            emit(f"sim.{cell.agents}.w{cell.worlds}_depth_fps", row["fps_mean"], "frames/s")
            emit(f"sim.{cell.agents}.w{cell.worlds}_depth_cpu_ms", row["cpu_ms_per_frame"], "ms")


def _state_steps(free: FreeSpace, worlds: int, steps: int, base: BaseSpec | None = None) -> float:
    """Return the steps per CPU second of all worlds: robots drive, humans walk and draw their arms in; nothing else."""
    spec = SocialNavSpec(robot=base or HOME_BASE, human=HOME_WALKER)
    rng = np.random.default_rng(0)
    robot, person, human = RobotState.zeros(worlds), HumanState.zeros(worlds), load_humanoid("female_0")
    person.xz[:] = free.sample(rng, worlds)
    for w in range(worlds):  # where they fit, as in every episode: one that begins inside a wall never gets out
        (place,), heading = free.sample(rng, 1), rng.uniform(-np.pi, np.pi)
        while not discs_fit(free, spec.robot, place, heading):
            (place,), heading = free.sample(rng, 1), rng.uniform(-np.pi, np.pi)
        robot.xz[w], robot.heading[w] = place, heading
    actions = rng.uniform(-1, 1, (64, worlds, 2))
    goals = np.stack([free.sample(rng, worlds) for _ in range(64)])

    def go(count: int) -> None:
        for k in range(count):
            walk_humans(person, goals[(k // 30) % 64], spec.human)
            draw_arms(person, free, human, spec.human.arms)
            drive_robots(robot, free, actions[(k // 10) % 64], spec.robot)

    go(10)
    return steps / median(cpu_s(lambda: go(steps)) for _ in range(5))


def _arm_steps(worlds: int, steps: int) -> float:
    """Return the steps per CPU second of all worlds: arms of 7 joints move, hands carry one of five objects."""
    robot, spec = load_robot("quad_arm"), ArmSpec()
    state = WorldState.zeros(worlds, joints=len(robot.joint_names), objects=5)
    own = state.robots[0]
    own.joints[:] = robot.rest
    state.object_pose[:, 0, :3] = robot_hands(own, robot)[:, :3, 3]
    action, grip = np.random.default_rng(0).uniform(-1, 1, (worlds, 7)), np.ones(worlds)

    def go(count: int) -> None:
        for _ in range(count):
            move_arms(own, robot, action, spec)
            grip_objects(state, robot_hands(own, robot), grip, spec)

    go(3)
    return steps / median(cpu_s(lambda: go(steps)) for _ in range(5))


def cpu_s(work: Callable[[], object]) -> float:
    """Return CPU seconds, user and system, of this process for ``work``."""
    before = resource.getrusage(resource.RUSAGE_SELF)
    work()
    after = resource.getrusage(resource.RUSAGE_SELF)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}"))
