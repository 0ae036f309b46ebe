"""Each door to other programs from the wheel alone, in an environment with its extra and nothing else (make check-doors).

An environment is a copy of one that holds the wheels of h3data and of its kernels, with what the door's extra brings. The files
that the commands read are made here; the commands know nothing of this checkout.

    python -m tests.product.check_doors .venv-doors dist          # or some of them: ... .venv-doors dist remote usd
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.paths import ROOT
from tests.worlds.test_procthor import DATABASE_OF_OURS, house

SHORT = "--episodes 1 --max-steps 30 --workers 1"
BENCHMARK = """
format = 1
name = "doors"
version = 1
about = "Two short episodes."
task = "social_nav"
scenes = ["small"]
episodes = 2
overrides = { max_steps = 60 }
metrics = ["S", "F", "TD"]
rank = "TD"
"""
LISTS = """
import json, pathlib
from h3data_pipelines.benchmark.definition import list_episodes, read_benchmark
folder = pathlib.Path("benchmark")
episodes = list(list_episodes(read_benchmark(folder).jobs()))
(folder / "episodes.json").write_text(json.dumps({"format": 1, "episodes": episodes}))
"""
DATASET_ENV = """
from h3data.envs import DatasetEnv
env = DatasetEnv("demos", episodes="recorded")
observation, _ = env.reset(seed=0)
print(sorted(observation), env.step(env.action_space.sample())[1:3])
"""
SCAN_3D = """
import h3data
env = h3data.make("wander", scenes="small:1", observations=("lidar_3d",))
print(env.reset(seed=3)[0]["lidar_3d"].shape)
"""
GROOT_SERVER = """
import sys, numpy, zmq
from h3data_remote.wire import GROOT
socket = zmq.Context().socket(zmq.REP)
socket.bind(f"tcp://127.0.0.1:{sys.argv[1]}")
while True:
    asked = GROOT.unpack(socket.recv())["endpoint"]
    known = {"get_action": [{"base": numpy.tile([0.5, 0.1], (1, 8, 1)).astype("float32")}, {}], "ping": {"status": "ok"}}
    socket.send(GROOT.pack(known.get(asked, {})))
"""
MINARI = """
import minari
from minari.dataset.minari_dataset import MinariDataset
print(MinariDataset("walks-v0/data").total_episodes)
"""


@dataclass(frozen=True)
class Door:
    """A door: what works with its extra, and what is said without it."""

    extra: str
    """Empty: it needs none."""
    works: tuple[Sequence[str] | str, ...]
    """Commands of h3data, as text, or words of Python's command line."""
    refused: tuple[str | Sequence[str], ...] = ()
    """Commands that need the extra."""
    servers: Mapping[int, Sequence[str] | str] = field(default_factory=dict)
    """Commands that run meanwhile, by the port on which they listen."""


DOORS: Mapping[str, Door] = {
    "lerobot": Door(
        extra="",
        works=("export ds --to lerobot --camera robot_arm_rgb@64x48 -o demos", "info demos"),
    ),
    "env": Door(
        extra="env",
        works=("export ds --to lerobot --camera robot_arm_rgb@64x48 -o demos --force", ("-c", DATASET_ENV)),
        refused=(("-c", DATASET_ENV),),
    ),
    "minari": Door(
        extra="minari",
        works=("export ds --to minari -o walks-v0", ("-c", MINARI)),
        refused=("export ds --to minari -o no-v0",),
    ),
    "remote": Door(
        extra="remote",
        works=(
            f"generate social_nav --scenes small:3 {SHORT} --policy ws://127.0.0.1:18731 -o ws",
            "replay ws#0 --verify",
            "evaluate social_nav --scenes small:3 --episodes 1 --max-steps 30 --policies ws://127.0.0.1:18731 -o evaluated",
            f"generate social_nav --scenes small:3 {SHORT} --policy zmq://127.0.0.1:18732 -o zmq",
            "replay zmq#0 --verify",
        ),
        refused=(
            f"generate social_nav --scenes small:3 {SHORT} --policy ws://127.0.0.1:18731 -o no",
            f"generate social_nav --scenes small:3 {SHORT} --policy zmq://127.0.0.1:18732 -o no",
            "serve --policy heuristic_expert --port 18733",
        ),
        servers={18731: "serve --policy heuristic_expert --port 18731", 18732: ("-c", GROOT_SERVER, "18732")},
    ),
    "benchmark": Door(
        extra="",
        works=(
            ("-c", LISTS),
            "benchmark run benchmark --policies heuristic_expert,stand_still -o result",
            "benchmark verify result --benchmark benchmark",
            "benchmark table result --benchmark benchmark -o board.html",
            "benchmark table --benchmark h3-social-nav@1",
        ),
    ),
    "ros": Door(
        extra="ros",
        works=(
            "export ds#0 --to rosbag2 --camera robot_arm --lidar 360 -o bag",
            "import bag -o from_bag",
            "metrics from_bag/bag.mcap --profile social",
            "replay from_bag/bag.mcap --verify",
        ),
        refused=("export ds#0 --to rosbag2 -o no", "import bag -o no"),
    ),
    "mjcf": Door(
        extra="mjcf",
        works=(
            "robots show barrow/barrow.xml -o barrow.png",
            f"generate wander --robot barrow/barrow.xml {SHORT} -o driven",
            "replay driven#0 --verify",
        ),
        refused=("robots show barrow/barrow.xml -o no.png",),
    ),
    "usd": Door(
        extra="usd",
        works=(
            "scenes export small:3 --to usd -o home.usdz",
            "scenes show home.usdz -o home.png",
            f"generate social_nav --scenes home.usdz {SHORT} -o in_usd",
            # a home that has been read is kept, and opens without the extra
            ("-c", "import shutil; shutil.copy('home.usdz', 'unread.usdz')"),
        ),
        refused=("scenes export small:3 --to usd -o no.usdz", "scenes show unread.usdz -o no.png"),
    ),
    "procthor": Door(
        extra="",
        works=("scenes show house.json -o house.png", f"generate wander --scenes house.json {SHORT} -o in_house"),
    ),
    "lidar": Door(
        extra="",
        works=(f"generate wander {SHORT} --sensors lidar --mcap -o scans", "view scans#0 -o scans.html"),
    ),
    "rays": Door(
        extra="rays",
        works=(
            f"generate wander {SHORT} --sensors lidar_3d --mcap -o clouds",
            "replay clouds/mcap/000000.mcap --verify",
        ),
        refused=(f"generate wander {SHORT} --sensors lidar_3d --mcap -o no",),
    ),
}


def main(environments: Path, wheels: Path, chosen: Sequence[str]) -> int:
    """Tries the doors, prints a line for each command, and returns how many went wrong."""
    (wheel,) = wheels.resolve().glob("h3data-*.whl")
    work = environments.resolve() / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    (work / "house.json").write_text(json.dumps(house()))
    (work / "asset-database.json").write_text(json.dumps(DATABASE_OF_OURS))
    shutil.copytree(ROOT / "tests" / "data" / "mjcf", work / "barrow")
    (work / "benchmark").mkdir()
    (work / "benchmark" / "benchmark.toml").write_text(BENCHMARK)
    environments = environments.resolve()
    base, faults = environments / "base", 0
    run(base, f"generate social_nav --scenes small:3 --seed 5 {SHORT} -o ds", work)
    for name in chosen or DOORS:
        door = DOORS[name]
        print(f"{name}: the wheel with {f'the extra {door.extra}' if door.extra else 'no extra'}")
        there = base
        if door.extra:
            there = environments / name
            with_extra(base, there, f"h3data[{door.extra}] @ {wheel.as_uri()}", environments / "tool" / "bin" / "uv")
        with serving(there, door.servers, work):
            for command in door.works:
                faults += tell(command, *run(there, command, work), expected=None)
        for command in door.refused:
            faults += tell(command, *run(base, command, work), expected=f"h3data[{door.extra}]")
    print(f"{faults} wrong")
    return faults


def with_extra(base: Path, there: Path, requirement: str, uv: Path) -> None:
    """Fills ``there`` with links to the files of ``base``, and what one requirement brings beside them."""
    shutil.rmtree(there, ignore_errors=True)
    shutil.copytree(base, there, symlinks=True, copy_function=os.link)
    install = [uv, "pip", "install", "-q", "--python", there / "bin" / "python", "-c", ROOT / "constraints.txt"]
    subprocess.run([*install, "--reinstall-package", "h3data", requirement], check=True)


def run(environment: Path, command: Sequence[str] | str, work: Path) -> tuple[int, str]:
    """Exit code and output of a command."""
    done = subprocess.run(words(environment, command), cwd=work, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def words(environment: Path, command: Sequence[str] | str) -> list[str]:
    python = str(environment.resolve() / "bin" / "python")
    return [python, "-P", *(("-m", "h3data_pipelines.cli", *command.split()) if isinstance(command, str) else command)]


@contextmanager
def serving(environment: Path, servers: Mapping[int, Sequence[str] | str], work: Path) -> Iterator[None]:
    """Runs servers until the end, from the moment at which all of them listen."""
    import socket

    running = [
        subprocess.Popen(words(environment, each), cwd=work, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for each in servers.values()
    ]
    try:
        for port in servers:
            for _ in range(600):
                with socket.socket() as probe:
                    if not probe.connect_ex(("127.0.0.1", port)):
                        break
                time.sleep(0.1)
        yield
    finally:
        for each in running:
            each.terminate()
            each.wait()


def tell(command: Sequence[str] | str, code: int, output: str, *, expected: str | None) -> int:
    """Prints whether a command did what it should, and returns 1 if not: it works, or one line names what is missing."""
    said = [line for line in output.splitlines() if line.strip()]
    if expected is None:
        right = code == 0
    else:
        naming = [line for line in said if expected in line]
        right, said = code != 0 and len(naming) == 1, naming or said
    shown = command if isinstance(command, str) else "python -c ..."
    print(
        f"  {'ok   ' if right else 'WRONG'} {shown}"
        + ("" if expected is None and right else f"\n          {said[-1:]}")
    )
    if not right:
        print(output[-3000:])
    return not right


if __name__ == "__main__":
    sys.exit(bool(main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])))
