"""README and docs do what they say: their commands and Python blocks run as written, page by page, on small data.

Long jobs are cut short (`shortened`). Names that a page takes for granted come from `ASSUMED`, files of its own from `FILES`.
Pages that need a machine that tests do not have are in `NOT_RUN`, with the reason.
"""

from __future__ import annotations

import csv
import glob
import gzip
import importlib
import json
import os
import pickle
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.bodies import load_humanoid
from h3data_pipelines.cli import main
from tests.habitat.hitl.test_hostile_files import frame, session
from tests.habitat.hitl.test_session_metrics import tidied, user
from tests.hub_server import WRITER, served
from tests.motion.motion_writers import amass_arrays, bvh_text, walked
from tests.paths import DOCS, ROOT

pytestmark = pytest.mark.slow

BLOCK = re.compile(r"^ *```(python|bash|sh)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
NOT_RUN = {
    "extending.md": "test_extending.py runs it",
    "gpu.md": "needs a CUDA device; tests marked gpu run its calls",
    "index.md": "shows commands of README",
    "headset.md": "needs a headset; tests/play/test_browser.py plays in an emulated one",
    "play.md": "its commands wait for players; tests/play plays them",
    "remote-policies.md": "its commands need servers; tests/remote has them",
    "study.md": "its commands wait for participants; tests/studies takes part",
}
OPEN = 'import h3data\nrecording = h3data.open("episode.mcap")\n'
BODY = 'from h3data.bodies import load_humanoid\nbody = load_humanoid("male_1")\nimport numpy as np\ndistance = 0.4\n'
ABSENT = {
    "hssd-hab": "scenes of HSSD",
    "replica_cad": "ReplicaCAD",
    "s3://": "a bucket; tests/recording and tests/pipelines use a stand-in",
    "--executor ray": "a Ray cluster; tests/pipelines/test_ray.py has one",
    "h3data play": "waits for players; tests/play plays it",
    "bodies bake": "the extra bodies",
    "import supersuit": "SuperSuit; tests/sim/envs wraps environments by it where it is installed",
    "flat.navmesh": "a navmesh of Habitat; tests/habitat/navmesh runs these calls",
    "female_0_motion_data_smplx.pkl": "Habitat's motion of a person; tests/motion runs these calls",
    "run(person": "walking frames of its own; tests/sim run these calls",
}
"""Parts of commands and blocks that need what tests do not have."""
ASSUMED: dict[str, str] = {
    "README.md": 'import h3data\nh3data.export("ds#0", "my_session.gfx_replay.json", to="gfx-replay")\n',
    "bodies.md": OPEN + BODY + "base_pose = np.array([[0, 0, 0, 0, 0, 0, 1.0]])\n",
    "export.md": OPEN + "from h3data.replay import Replay\nreplay = Replay(recording)\n",
    "format.md": OPEN
    + "from h3data.recording import InputEvent, RecordingHeader, RecordingWriter\nfrom h3data.replay import Replay\n"
    + "header = RecordingHeader(episode=recording.episode, columns=recording.columns, agents=recording.agents,"
    + " bodies=recording.bodies, assets=recording.assets)\nrow = {k: v[:1] for k, v in recording.columns.items()}\n",
    "metrics.md": OPEN,
    "habitat-episodes.md": "import h3data\n",
    "learned-policies.md": "import torch\nfrom torch import nn\n",
    "reach.md": BODY
    + "base_pose = np.array([[0, 0, 0, 0, 0, 0, 1.0]])\ntargets = np.array([[0.4, 1.0, 0.2]])\n"
    + 'import h3data\nfrom h3data.scene import FreeSpace\nfree = FreeSpace.from_scene(h3data.open("small:3"))\n'
    + "a, b = free.sample(np.random.default_rng(0), 2)\n",
    "navigation.md": "import numpy as np\na, b = goal, points = np.array([[1.5, 1.5], [3.0, 2.0]])\n",
    "rendering.md": OPEN
    + "import numpy as np\nfrom h3data.replay import Replay\nmeshes = [d.mesh for d in Replay(recording).drawables]\n"
    + "pose = moved = np.eye(4)\neye, target = (3, 2, 3), (0, 1, 0)\nmoved = pose[None]\n"
    + "from h3data.render import pinhole\ncameras = [pinhole(64, 48, hfov_deg=60)] * 3\n"
    + "origins, directions = np.ones((4, 3)), np.eye(3)[[0, 1, 2, 0]]\n"
    + "robot_eye, person_head = np.ones((1, 3)), np.ones((1, 3)) * 2\n"
    + "mask = None\nfrom h3data.scenes import HomeSpec, build_home\nhome = build_home(HomeSpec(preset='small', seed=3))\n"
    + "from h3data.render.sheets.scene_map import render_scene\nflat = render_scene(home)\n"
    + "meshes, instances, static = flat.meshes, flat.instances, range(len(flat.instances))\n",
    "rerender.md": 'import h3data\nh3data.rerender("episode.mcap", "training", cameras=["robot_arm"], outputs=["rgb", "depth"],'
    + ' format="data", steps="0:9")\n',
    "rearrangement.md": "from sim_kinematic.policies.views import *\nAction = RearrangeView = object\n",
    "replay.md": OPEN + 'my_policy = "stand_still"\n',
    "statistics.md": 'episodes = {f"scene_{k}": [f"e{10 * k + j}" for j in range(80)] for k in range(8)}\n',
    "view.md": OPEN
    + 'other = recording\nh3data.rerender("ds#0", "v", cameras=["top_down"])\n'
    + 'import shutil\nshutil.move(next(iter(__import__("pathlib").Path("v").glob("*.mp4"))), "top_down.mp4")\n',
    "robots.md": "import h3data\n",
}


def hitl_sessions(here: Path) -> None:
    """Sessions of two people, and the log of another."""
    frames = [frame(k, task_percent_complete=0.5 if k < 8 else 1.0) for k in range(12)]
    for folder, name in (
        ("hitl_sessions/P01", "ann@example.org"),
        ("hitl_sessions/P02", "bob"),
        ("hitl_output", "ann"),
    ):
        (here / folder).mkdir(parents=True)
        with gzip.open(here / folder / "10.json.gz", "wt") as stream:
            json.dump(session(frames, users=[user(name)]), stream)
    with gzip.open(here / "session.0.pkl.gz", "wb") as stream:
        pickle.dump(tidied(), stream)
    shutil.copy(here / "session.0.pkl.gz", here / "hitl_sessions" / "P02" / "solo.0.pkl.gz")
    (table,) = re.findall(r"```csv\n(.*?)```", (DOCS / "import.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len({len(row) for row in csv.reader(table.splitlines())}) == 1
    (here / "sessions.csv").write_text(table)


def captures(here: Path) -> None:
    """Captured motion in two formats."""
    body = load_humanoid("female_1")
    (here / "mocap").mkdir()
    for folder in (here, here / "mocap"):
        (folder / "walk.bvh").write_text(bvh_text(body, walked(body), "cmu"))
        np.savez(folder / "dance.npz", **amass_arrays(walked(body, 1.0)))


def rearrangements(here: Path) -> None:
    """An episode file of Habitat, and a recording of rearrangement."""
    h3data.generate("rearrange", here / "tidy", episodes=1, seed=1)
    h3data.recording.write_mcap(h3data.open(f"{here / 'tidy'}#0", h3data.Recording), here / "rearranged.mcap")
    h3data.export(str(here / "tidy"), here / "habitat-episodes", to="habitat-episodes")
    (file,) = (here / "habitat-episodes").rglob("*.json.gz")
    shutil.copy(file, here / "social_rearrange.json.gz")


FILES: dict[str, Callable[[Path], None]] = {
    "import.md": hitl_sessions,
    "motion.md": captures,
    "habitat-episodes.md": rearrangements,
}


@pytest.fixture
def hub(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A stand-in for the Hugging Face Hub, for the page that needs one."""
    if request.node.callspec.params["page"].name != "sharing.md":
        yield
        return
    constants = pytest.importorskip("huggingface_hub.constants", reason='needs the extra: pip install "h3data[hub]"')
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)  # another protocol, with servers of its own
    with served() as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        monkeypatch.setenv("HF_TOKEN", WRITER)
        yield


def pages() -> list[Path]:
    written = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("tutorials/*.md"))]
    return [page for page in written if page.name not in NOT_RUN]


def lines_of(text: str) -> Iterator[str]:
    """Commands of a shell block; a loop over words gives its lines once for each word."""
    loop = re.compile(r"^for (\w+) in ([^;]+); do\n(.*?)^done$", re.MULTILINE | re.DOTALL)
    text = text.replace("\\\n", " ")
    text = loop.sub(lambda m: "".join(m[3].replace(f"${m[1]}", word) for word in m[2].split()), text)
    for line in text.splitlines():
        yield from re.split(r"&&|;(?=\s)", line.partition(" #")[0])


def expanded(word: str) -> list[str]:
    """A word as a shell gives it to a command: ``~`` and globs expanded."""
    word = os.path.expanduser(word)
    return sorted(glob.glob(word)) or [word]


def shortened(words: list[str]) -> list[str]:
    """A command that takes seconds instead of hours and does the same."""
    match words:
        case ["generate" | "evaluate", *_] if "--dry-run" in words:
            if "--save-episodes" in words:  # it draws them
                words = [*_without(words, "--episodes"), "--episodes", "5"]
        case ["generate" | "evaluate", *_]:
            episodes = {"generate": "5", "evaluate": "1"}[words[0]]
            words = [*_without(words, "--episodes", "--workers"), "--episodes", episodes]
            words += [] if {"rearrange", "skill"} & set(words) else ["--max-steps", "20"]
        case ["train", *_]:
            is_fast = (
                "fast" in words or "--warm-start" in words
            )  # later commands begin with what earlier ones have trained
            words = _without(
                words, "--recipe", "--device", "--minutes", "--stop-after", "--worlds", "--rollout", "--scenes"
            )
            words += ["--recipe", "fast"] if is_fast else []
            words += ["--scenes", "h3-homes/train#0", "--updates", "1"]
            words += [] if "rearrange" in words else ["--worlds", "8"]
        case ["demo", *_]:
            words = [*words, "--steps", "450"]
        case ["scenes", "validate" | "list", *_]:
            words = [*_without(words, "--homes"), "--homes", "1"] if "--homes" in words else words
            words = [re.sub(r"^(h3-homes/\w+)$", r"\1#0", word) for word in words]
    return words


def redirected(words: list[str]) -> tuple[list[str], Path | None]:
    """A command without ``> FILE``, and that file."""
    return (words[:-2], Path(words[-1])) if words[-2:-1] == [">"] else (words, None)


def _without(words: list[str], *options: str) -> list[str]:
    kept, skip = [], False
    for word in words:
        if not skip and word not in options:
            kept.append(word)
        skip = not skip and word in options
    return kept


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that pages name."""
    root = tmp_path_factory.mktemp("docs")
    h3data.generate("social_nav", root / "ds", episodes=5, homes=2, max_steps=240)
    recording = h3data.open(f"{root / 'ds'}#0", h3data.Recording)
    h3data.recording.write_mcap(recording, root / "episode.mcap")
    for name in ("a", "b", "run_a", "run_b"):
        shutil.copytree(root / "ds", root / name)
    (root / "recordings").mkdir()
    shutil.copy(root / "episode.mcap", root / "recordings")
    (root / "habitat").mkdir()
    return root


@pytest.mark.usefixtures("hub")
@pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")  # huggingface_hub's own
@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_page_runs_as_written(
    page: Path, stage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    here = tmp_path / "here"
    shutil.copytree(stage, here)
    monkeypatch.chdir(here)
    monkeypatch.setenv("HOME", str(here))
    cuda = importlib.import_module("torch").cuda.is_available()
    FILES.get(page.name, lambda here: None)(here)
    names: dict[str, Any] = {"__name__": "__main__", "__file__": str(here / "page.py")}
    exec(ASSUMED.get(page.name, ""), names)
    for kind, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        if kind == "python":
            if any(absent in text for absent in ABSENT):
                continue
            text = text if cuda else text.replace('device="cuda"', 'device="cpu"')
            exec(compile(text, page.name, "exec"), names)
            continue
        for line in lines_of(text):
            words, output = redirected([found for word in shlex.split(line) for found in expanded(word)])
            if words[:1] == ["h3data"] and not any(absent in line for absent in ABSENT):
                words = shortened(words[1:])
                if "-o" in words and words[0] in ("generate", "demo", "evaluate", "train"):
                    shutil.rmtree(words[words.index("-o") + 1], ignore_errors=True)
                capsys.readouterr()
                assert main(words) == 0, line
                if output:
                    output.write_text(capsys.readouterr().out)
