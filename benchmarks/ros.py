"""Bags of ROS 2 out and in: CPU seconds of this process, everything warm, the least of three rounds."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from h3data.formats import ImportRequest
from h3data.metrics.registry import measure
from h3data.scene import FreeSpace
from h3data.scene.scene_file import load_scene
from h3data_ros.bag_export import write_rosbag2
from h3data_ros.bag_import import read_rosbag2
from h3data_ros.occupancy import map_of, scene_of_map

STEPS = 600
LOG_S, PEOPLE = 600.0, 20
"""Length [s] of the log of a robot, and how many people it tracks, ten times a second."""
PATHS = 400


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit ``ros.*``: a bag of `STEPS` steps out and in, a log of `LOG_S` in, paths in the map of a home and in the
    home.
    """
    from tests.ros import bags
    from tests.ros.recordings import crossing

    recording = crossing(STEPS)
    with tempfile.TemporaryDirectory() as folder:
        bag, log = Path(folder) / "bag", Path(folder) / "log"

        def export() -> None:
            shutil.rmtree(bag, ignore_errors=True)
            write_rosbag2(recording, bag)

        emit("ros.export_600_steps_cpu_s", _least_s(export), "s")
        emit("ros.read_600_steps_cpu_s", _least_s(lambda: read_rosbag2(bag, tracks=ImportRequest())), "s")
        bags.real_robot(log, seconds=LOG_S, count=PEOPLE, storage="mcap")
        emit("ros.import_10_min_20_people_cpu_s", _least_s(lambda: read_rosbag2(log, tracks=ImportRequest())), "s")
        imported = read_rosbag2(log, tracks=ImportRequest())
        emit("ros.measure_10_min_20_people_cpu_s", _least_s(lambda: measure(imported, "social")), "s")
    home = load_scene(recording.attachments["scene.glb"])
    free = FreeSpace.from_scene(home)
    again = FreeSpace.from_scene(scene_of_map(map_of(free), "map"), cache=False)
    starts, ends = (free.sample(np.random.default_rng(seed), PATHS) for seed in (1, 2))
    lengths, found = free.geodesic(starts, ends), again.geodesic(starts, ends)
    far = lengths > 1.0
    emit("ros.map_paths_found_ratio", float(np.isfinite(found).mean()), "ratio")
    errors = np.abs(found[far] / lengths[far] - 1)
    for name, share in (("median", 50), ("p95", 95), ("max", 100)):
        emit(f"ros.map_path_length_error_{name}", float(np.nanpercentile(errors, share)), "ratio")


def _least_s(work: Callable[[], object]) -> float:
    taken = []
    for _ in range(3):
        begun = time.process_time()
        work()
        taken.append(time.process_time() - begun)
    return min(taken)


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.4g} {unit}"))
