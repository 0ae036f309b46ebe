"""Command ``h3data warmup``, which compiles all kernels in advance, in parallel."""

from __future__ import annotations

import json as jsonlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from h3data.commands.command import JsonFlag, Outcome
from h3data.errors import H3DataError
from h3data.kernels import compiled_count, compiled_files, shipped
from h3data.plugins import own_entries
from h3data.progress import QUIET, is_quiet
from h3data.terminal import counted
from h3data_pipelines.execution.processes import core_count


@dataclass(frozen=True)
class Warmup:
    """Compile all kernels now, on all cores, once per machine and version, so that later commands start at once.

    The package h3data-kernels contains most kernels in compiled form for Linux on x86-64; `h3data doctor` shows whether
    they are used.

    Examples:
        h3data warmup
        h3data warmup --json
    """

    json: JsonFlag = False

    def run(self) -> Outcome:
        """Compile the kernels in parallel and return how many there are and how long it took."""
        start, parts, files, came, compiled = time.perf_counter(), {}, {}, {}, 0
        _say(f"Compiling kernels on {counted(core_count(), 'core')}: about half a minute on two, once.\n")
        with ThreadPoolExecutor(core_count()) as pool:
            jobs = {pool.submit(_run_apart, name): name for name in WORK}
            for job in as_completed(jobs):
                report = job.result()
                parts[jobs[job]] = report
                compiled += report["compiled"]
                files |= report["files"]
                came |= report["shipped"]
                _say(f"  {jobs[job]:<11} {report['wall_s']:5.1f} s, {counted(report['compiled'], 'kernel')}\n")
        data: dict[str, Any] = {
            "compiled": compiled,
            "shipped": len(came),
            "kernels": len(files),
            "megabytes": round(sum(files.values()) / 1e6, 1),
            "folder": os.path.commonpath(files) if files else None,
            "wall_s": round(time.perf_counter() - start, 1),
            "parts": {name: {key: parts[name][key] for key in ("wall_s", "compiled")} for name in WORK},
        }
        made = f"Compiled {counted(compiled, 'kernel')}" if compiled else "There was nothing to compile"
        kept = f"{data['kernels']} kernels take {data['megabytes']} MB in {data['folder']}"
        told = [f"{made} ({data['wall_s']} s)."]
        if came:
            told.append(f"{counted(len(came), 'kernel')} came compiled, {round(sum(came.values()) / 1e6, 1)} MB.")
        if files or compiled:
            told.append(kept if files else "They cannot be kept here.")
        return Outcome(text=" ".join(told), data=data)


def _say(line: str) -> None:
    if not is_quiet():
        sys.stderr.write(line)


@contextmanager
def compiled_aside(names: Sequence[str]) -> Iterator[subprocess.Popen[str] | None]:
    """Compile the kernels of some programs of `WORK` in a separate process while the block runs.

    numba compiles in one thread of a process at a time. If this process needs a kernel that the other process is
    compiling, this process waits (`h3data.kernels`). If kernels are installed in compiled form
    (`h3data.kernels.shipped`), or those of pictures have been compiled before, no process is started and the block gets
    None.
    """
    from h3data.render.raster.raster import rasterise

    known = any(rasterise.__name__ in Path(file).name for file in compiled_files())
    if known or shipped.folders():
        yield None
        return
    aside = _start(names, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield aside
    finally:
        aside.terminate()
        aside.wait()


def _start(names: Sequence[str], **options: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", f"from {__name__} import run; run({list(names)!r})"]
    paths = os.pathsep.join(path for path in sys.path if path)  # the same packages, also where they are not installed
    return subprocess.Popen(command, env={**os.environ, "PYTHONPATH": paths, QUIET: "1"}, text=True, **options)


def _run_apart(name: str) -> dict[str, Any]:
    start = time.perf_counter()
    process = _start([name], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    report, errors = process.communicate()
    if process.returncode:
        raise H3DataError(
            f"Compiling the kernels of {name} failed: {(errors.strip().splitlines() or ['killed'])[-1]}",
            code="H3-MACHINE-019",
        )
    return jsonlib.loads(report) | {"wall_s": round(time.perf_counter() - start, 1)}


def run(names: Sequence[str]) -> None:
    """Run some programs of `WORK` in this process; print the kernels that were compiled and those that existed."""
    with TemporaryDirectory() as folder:
        os.environ["H3DATA_CACHE"] = folder  # so that what others have cached is computed here too
        for name in names:
            WORK[name]()
    report = {"compiled": compiled_count(), "files": compiled_files(), "shipped": shipped.loaded_files()}
    sys.stdout.write(jsonlib.dumps(report))


# --- work that needs every kernel once --------------------------------------------------------------------------------
def _pictures() -> None:
    from h3data.mesh.mesh import Mesh, Texture
    from h3data.render import Renderer, RenderInstance, RenderScene, VideoWriter, look_at, orthographic, pinhole
    from h3data.render.colors import depth_to_rgb, instance_to_rgb
    from h3data.render.image_files import depth_to_mm, stored_ids
    from h3data_pipelines.pictures.id_png import id_png_bytes

    texture = Texture(pixels=np.full((2, 2, 4), 255, np.uint8))
    triangle = Mesh(
        vertices=np.array([[-1, 0, -1], [1, 0, -1], [0, 0, 1]], np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
        colors=np.full((3, 3), 200, np.uint8),
        normals=np.tile(np.array([0, 1, 0], np.float32), (3, 1)),
        uv=np.zeros((3, 2), np.float32),
        textures=(texture,),
    )
    renderer = Renderer(RenderScene([triangle], [RenderInstance(0, np.eye(4))], deformable=[0]))
    renderer.set_vertices(0, triangle.vertices)
    above = look_at(np.array([0.0, 2.0, 0.1]), np.zeros(3))
    outputs = ("depth", "instance", "semantic", "triangle", "rgb", "normal")
    with TemporaryDirectory() as folder, VideoWriter(Path(folder) / "video.mp4", 16, 16) as video:
        for camera in (pinhole(16, 16, hfov_deg=60, pose=above), orthographic(16, 16, width_m=2.0, pose=above)):
            for samples in (1, 4):
                images = renderer.render(camera, outputs=outputs, samples=samples)
            video.write(images["rgb"])
            for convert in (depth_to_mm, lambda depth: depth_to_rgb(depth, 0.0, 10.0)):
                convert(images["depth"])
            for convert in (instance_to_rgb, lambda ids: id_png_bytes(stored_ids(ids))):
                convert(images["instance"])


def _light() -> None:
    from h3data.mesh.primitives import box_mesh
    from h3data.render import Renderer, RenderInstance, RenderScene, look_at, pinhole
    from h3data.render.light.sources import BAKERS, LightSources
    from h3data.render.shade.blockers import Blockers, blocker_rows

    box = box_mesh((1, 1, 1))
    BAKERS.get("baked")([box], [RenderInstance(0, np.eye(4))], [0], LightSources())
    up, ball = np.array([[0.0, 1, 0]]), np.array([[0.0, 1.2, 0, 0, 1.2, 0, 0.2]])
    rows = blocker_rows(ball, np.zeros(1, np.int64), up, np.ones(1), np.ones(1))
    renderer = Renderer(RenderScene([box], [RenderInstance(0, np.eye(4))]))
    renderer.set_blockers(Blockers(rows, np.array([[1, 1, 1, -1]], np.float32)))
    above = look_at(np.array([0.0, 3.0, 0.1]), np.zeros(3))
    renderer.render(pinhole(16, 16, hfov_deg=60, pose=above), outputs=("rgb",))


def _people() -> None:
    from h3data.bodies.people.humanoid_file import load_humanoid
    from h3data.bodies.people.planted_gait import planted_states, pose_planted
    from sim_kinematic.agents.roster import HUMAN_BODY

    tables = load_humanoid(HUMAN_BODY).gait_tables
    pose_planted(tables, planted_states(tables, np.array([[0.0, 0, 0, 0, 0, 0, 1]])))


def _task(name: str) -> Callable[[], None]:
    def play() -> None:
        from h3data.metrics import measure_many
        from h3data.replay import Replay, camera_track
        from h3data.scene.open import named_scenes, open_scene
        from sim_kinematic.tasks.episode import with_options
        from sim_kinematic.tasks.recorder import simulate
        from sim_kinematic.tasks.registry import find_task

        task = find_task(name)
        # agents that move about need no more kernels later; those with skills get to some of them after a minute
        steps = None if task.control.has_skills else 60
        spec = with_options(task.usage.dataset_rules or task.Spec(), max_steps=steps)  # None: those of the task
        recording = simulate(task, task.episode(open_scene(named_scenes("small:15")[0].source), spec=spec))
        measure_many([recording])
        replay = Replay(recording)
        stage = replay.stage
        stage.render(stage.renderer(), 0, [camera_track(replay, "top_down").at(0)], outputs=("rgb",))

    return play


WORK: dict[str, Callable[[], None]] = {
    **{name: _task(name) for name, of in own_entries("h3data.tasks").items() if of.startswith("sim_kinematic.")},
    "pictures": _pictures,
    "light": _light,
    "people": _people,
}
"""Programs that use every kernel, by their names in progress messages; each runs in a separate process."""
