"""Whole steps in a large furnished home, and whether they stay as fast: the protocol of ``h3data bench sim``.

``sim.whole_step.*`` is one step of a robot and a person with FCL contact and one depth image of the robot's arm camera
(224x171), home of 370 k triangles; ``w16_fps`` on two processes. ``sim.long_run_ratio`` is how fast the same 1,000 steps are
in a world that has done many others in between, by CPU time, over how fast they were when it was new:

    python -m benchmarks.sim_whole 100000  # so many in between; `make bench` takes 2,000

``sim.skin_ratio.{human,human_robot}`` is the CPU time of a step with skinned people over that of one in which they are rigid
capsules, in the paper's protocol (``h3data bench sim --agents human,human_robot --bodies all``).
``sim.skin_ratio.social_nav`` is the same for an episode in which the robot finds the person and follows them, with the arm
camera's depth and the ids for the detector (224x171). ``sim.skin_ratio.social_nav_in_view`` is the share of its measured steps
that show the person.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from time import process_time

import h3data
from h3data_pipelines.machine.bench import measure, process_pool
from h3data_pipelines.machine.bench_protocol import BenchmarkWorlds, Cell
from sim_kinematic.sensing.agent_pictures import AgentPictures
from sim_kinematic.sensing.camera_sensor import StateRenderer

Emit = Callable[[str, float, str], None]
RUNS, STEPS, PROCESSES = 3, 210, 2
COMPARED, BETWEEN = 1000, 2000


def run(emit: Emit, between: int = BETWEEN) -> None:
    """Emit ``sim.whole_step.*`` and ``sim.long_run_ratio``."""
    with process_pool(PROCESSES) as pool:
        for worlds in (1, 16):
            cell = Cell(home="large", pictures="arm", worlds=worlds)
            row = measure(cell, pool, runs=RUNS, steps=STEPS if worlds == 1 else STEPS // 5)
            emit(f"sim.whole_step.w{worlds}_fps", row["fps_mean"], "frames/s")
            emit(f"sim.whole_step.w{worlds}_cpu_ms", row["cpu_ms_per_frame"], "ms")
    emit("sim.long_run_ratio", long_run_ratio(between), "x")
    for agents in ("human", "human_robot"):
        emit(f"sim.skin_ratio.{agents}", skin_ratio(Cell(agents=agents)), "x")
    ratio, in_view = skin_ratio_in_view()
    emit("sim.skin_ratio.social_nav", ratio, "x")
    emit("sim.skin_ratio.social_nav_in_view", in_view, "share")


def skin_ratio(cell: Cell) -> float:
    """Return CPU time of the steps of a cell over that of the same steps with people as rigid capsules, the median of
    pairs.
    """
    skinned, bones = BenchmarkWorlds(cell), BenchmarkWorlds(replace(cell, skinned=False))
    for worlds in (skinned, bones):
        worlds.run(0, steps=40)  # compiles, fills caches
    return median(skinned.run(k).cpu_s / bones.run(k).cpu_s for k in range(2 * RUNS))


def skin_ratio_in_view() -> tuple[float, float]:
    """Return the skin ratio for whole steps next to a person in view, and the share of these steps that show them."""
    session = h3data.session("social_nav", scenes="small:1", seed=4, agents={"robot": "rollout_expert"})
    bodies = [member.body for member in session.episode.roster]
    own = AgentPictures(bodies[0], ("arm_depth", "humanoid_detector"), agent=0)
    rendered = {skinned: StateRenderer(session.episode.scene, bodies, skinned=skinned) for skinned in (True, False)}
    spent, steps, shown = {None: 0.0, True: 0.0, False: 0.0}, 0, 0
    met = False
    while not session.ended:
        begun = process_time()
        session.step()
        step_s = process_time() - begun
        pictures = {}
        for skinned, renderer in rendered.items():
            begun = process_time()
            renderer.pose(session.play.world.state, floor=session.play.world.floors[0])
            pictures[skinned] = own.take(renderer)
            if met:
                spent[skinned] += process_time() - begun
        if met:
            spent[None] += step_s
            steps, shown = steps + 1, shown + int(pictures[True]["humanoid_detector"][0, 0] > 0)
        met = met or bool(pictures[True]["humanoid_detector"][0, 0] > 0)
    session.close()
    return (spent[None] + spent[True]) / (spent[None] + spent[False]), shown / max(steps, 1)


def long_run_ratio(between: int) -> float:
    """Return the speed of 1,000 steps after ``between`` others over the speed of the same ones before them, robot and
    person.
    """
    worlds = BenchmarkWorlds(Cell())
    worlds.run(0, steps=100)  # compiles, fills caches
    first = worlds.run(1, steps=COMPARED).cpu_s
    worlds.run(2, steps=between)
    return first / worlds.run(1, steps=COMPARED).cpu_s


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True), *map(int, sys.argv[1:]))
