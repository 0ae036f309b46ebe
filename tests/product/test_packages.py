"""Each package above the simulator can be left out: what needs it says so, and everything else works.

An installation is a folder with the packages, all but one, and a process that finds them there and nowhere else. They are those
of this checkout or, where H3DATA_SITE names the folder, of an unpacked wheel with its entry points (`make test-packages`). The
packages that they depend on are those of this environment, so what this leaves open is whether pip finds them.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from h3data_pipelines.cli import main
from tests.paths import ROOT

SITE = os.environ.get("H3DATA_SITE")
"""Folder of an unpacked wheel; None: the packages of this checkout are used."""
PLACES = {
    "h3data": ".",
    "sim_kinematic": ".",
    "h3data_habitat": "pipelines",
    "h3data_exporters": "pipelines",
    "h3data_gpu": "pipelines",
    "h3data_homes": "pipelines",
    "h3data_light": "pipelines",
    "h3data_meshes": "pipelines",
    "h3data_motion": "pipelines",
    "h3data_worlds": "pipelines",
    "h3data_pipelines": "pipelines",
    "h3data_training": "pipelines",
    "h3data_rays": "pipelines",
    "h3data_remote": "pipelines",
    "h3data_crowds": "pipelines",
    "h3data_language": "pipelines",
    "h3data_llm": "pipelines",
    "h3data_ros": "pipelines",
    "h3data_social": "pipelines",
    "h3data_play": "viewers",
    "h3data_studies": "viewers",
    "h3data_viewers": "viewers",
    "h3data_kernels": "pipelines",  # a wheel of its own, so that nothing is compiled here
}
SCRIPT = """
import contextlib, io, json, sys
root, tree, commands = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
here = [p for p in sys.path if not p.startswith(root) or "site-packages" in p or "/.venv" in p]
sys.path[:] = [tree, *here]
from h3data_pipelines.cli import main
said = {}
for words in commands:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as stop:
            code = stop.code or 0
    said[" ".join(words)] = [code, out.getvalue() + err.getvalue()]
print(json.dumps(said))
"""


def install_without(package: str, tree: Path) -> None:
    """Fills ``tree`` with links to all packages but one."""
    for name, place in PLACES.items():
        if name != package:
            (tree / name).symlink_to(
                ROOT / place / name if SITE is None or name == "h3data_kernels" else Path(SITE, name)
            )
    for metadata in Path(SITE).glob("h3data-*.dist-info") if SITE is not None else ():
        (tree / metadata.name).symlink_to(metadata)


def run_without(package: str, tree: Path, commands: list[list[str]]) -> dict[str, tuple[int, str]]:
    """Exit codes and output of commands in an installation that has all packages but one."""
    install_without(package, tree)
    done = subprocess.run(
        [sys.executable, "-P", "-c", SCRIPT, str(ROOT), str(tree), json.dumps(commands)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return {words: (code, text) for words, (code, text) in json.loads(done.stdout.splitlines()[-1]).items()}


@pytest.mark.parametrize(
    ("package", "lost"),
    [
        ("h3data_play", {"play", "study"}),
        pytest.param("h3data_viewers", {"view", "report"}, marks=pytest.mark.slow),
        pytest.param("h3data_studies", {"study"}, marks=pytest.mark.slow),
        pytest.param("h3data_training", {"train"}, marks=pytest.mark.slow),
        pytest.param("h3data_motion", {"motion"}, marks=pytest.mark.slow),
        pytest.param("h3data_remote", {"serve"}, marks=pytest.mark.slow),
        pytest.param("h3data_language", {"language"}, marks=pytest.mark.slow),
        pytest.param("h3data_llm", {"llm"}, marks=pytest.mark.slow),
    ],
)
def test_a_package_that_is_not_there_costs_only_its_commands(package: str, lost: set[str], tmp_path: Path) -> None:
    others = [w for w in ("demo", "generate", "evaluate", "metrics", "view", "report", "docs", "play") if w not in lost]
    asked = [["--help"], *([word, "--help"] for word in others), *([word] for word in sorted(lost))]
    said = run_without(package, tmp_path, asked)
    assert all(said[f"{word} --help"][0] == 0 for word in others)
    listed = said["--help"][1]
    for word in ("view", "report", "play", "study", "train", "motion", "serve", "language", "llm"):
        assert (f"\n  {word} " in listed) is (word not in lost)
    for word in lost:
        assert said[word][0] == 2
        assert package in said[word][1]


CALLS = [
    ("h3data_training", "import h3data; h3data.make('social_nav', scenes='small:1', device='cpu')"),
    ("h3data_habitat", "from sim_kinematic.motion.step import SLIDES; SLIDES.get('habitat')"),
    ("h3data_crowds", "import h3data; h3data.make('crowd_nav', scenes='small:1')"),
    ("h3data_worlds", "import h3data.bodies as b; b.guess_robot_settings(b.load_robot('quad_arm').file)"),
    ("h3data_rays", "from h3data.render.renderer import ENGINES; ENGINES.get('rays')"),
    ("h3data_social", "from h3data.metrics.registry import find_profile; find_profile('social')"),
    ("h3data_gpu", "from h3data.replay.stage import chosen_backend; chosen_backend('auto'); chosen_backend('gpu')"),
    ("h3data_light", "from h3data.render.light.sources import BAKERS; BAKERS.get('baked')"),
    ("h3data_training", "from h3data.envs import DatasetEnv"),
    ("h3data_homes", "from h3data.scenes import HomeSpec"),
    ("h3data_homes", "from h3data import HomeSpec"),
    (
        "h3data_llm",
        "import h3data; h3data.session('rearrange', 'small:1', agents={'robot': 'llm:http://127.0.0.1:1/v1?model=m'})",
    ),
    (
        "h3data_language",
        "import h3data; h3data.session('rearrange', 'small:1', agents={'robot': 'llm:http://127.0.0.1:1/v1?model=m'})",
    ),
    ("h3data_viewers", "import h3data; h3data.report"),
]
"""Packages, and what is refused in Python without them."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "call"), [CALLS[0], *(pytest.param(*each, marks=pytest.mark.slow) for each in CALLS[1:])]
)
def test_a_call_names_the_package_that_it_needs(package: str, call: str, tmp_path: Path) -> None:
    script = SCRIPT.replace(
        "for words in commands:",
        "from h3data.errors import H3DataError\n"
        f"try:\n    {call}\n"
        "except H3DataError as error:\n    said['call'] = [error.code, str(error)]\nfor words in commands:",
    )
    install_without(package, tmp_path)
    done = subprocess.run(
        [sys.executable, "-P", "-c", script, str(ROOT), str(tmp_path), "[]"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    code, text = json.loads(done.stdout.splitlines()[-1])["call"]
    assert code
    assert package in text


@pytest.mark.slow
def test_what_makes_homes_names_their_package_and_leaves_no_folder(tmp_path: Path) -> None:
    tree, out = tmp_path / "tree", str(tmp_path / "out")
    tree.mkdir()
    helped = ["demo", "generate", "evaluate", "metrics", "view", "report", "docs", "play", "study", "train", "scenes"]
    refused = [
        ["demo", "-o", out],
        ["generate", "social_nav", "--scenes", "small:1", "-o", out],
        ["generate", "social_nav", "--scenes", "h3-homes/test#0", "-o", out],
        ["scenes", "list"],
        ["scenes", "validate", "small:1"],
    ]
    said = run_without("h3data_homes", tree, [["--help"], *([w, "--help"] for w in helped), *refused])
    assert all(said[f"{word} --help"][0] == 0 and f"\n  {word} " in said["--help"][1] for word in helped)
    for words in refused:
        code, text = said[" ".join(words)]
        assert code == 2
        assert text.count("h3data_homes") == 1, "said once, not for each scene of a set"
    assert not Path(out).exists()


@pytest.mark.slow
def test_what_writes_files_of_viewers_names_their_package(tmp_path: Path) -> None:
    tree, out = tmp_path / "tree", tmp_path / "demo"
    tree.mkdir()
    commands = [["demo", "-o", str(out)], ["study", "report", str(tmp_path)]]
    said = run_without("h3data_viewers", tree, [*commands, ["study", "report", "--help"]])
    for words in commands:
        code, text = said[" ".join(words)]
        assert code == 2
        assert "h3data_viewers" in text
    assert not out.exists()
    assert said["study report --help"][0] == 0


@pytest.mark.slow
def test_files_of_habitat_name_their_package(tmp_path: Path) -> None:
    tree, out = tmp_path / "tree", tmp_path / "out"
    tree.mkdir()
    replay, motion, mesh = (tmp_path / name for name in ("a.gfx_replay.json", "walk.pkl", "a.navmesh"))
    replay.write_text('{"keyframes": []}')
    motion.write_bytes(pickle.dumps({"walk_motion": {}}))
    mesh.write_bytes(b"TESM")
    refused = [
        ["import", str(replay), "-o", str(out)],
        ["import", str(tmp_path), "-o", str(out)],
        ["motion", "import", str(motion), "-o", str(out)],
        ["info", str(mesh)],
        ["metrics", str(out), "--profile", "habitat"],
        ["export", str(out), "--to", "gfx-replay", "-o", str(out)],
    ]
    said = run_without("h3data_habitat", tree, [["metrics", "list"], *refused])
    assert said["metrics list"][0] == 0
    for words in refused:
        code, text = said[" ".join(words)]
        assert code == 2, f"{words}: {text}"
        assert "h3data_habitat" in text, f"{words}: {text}"
    assert not out.exists()


@pytest.mark.slow
def test_exports_name_their_package(tmp_path: Path) -> None:
    tree, out = tmp_path / "tree", tmp_path / "out"
    tree.mkdir()
    refused = [["export", str(out), "--to", name, "-o", str(out)] for name in ("gltf", "csv", "lerobot")]
    said = run_without("h3data_exporters", tree, [["metrics", "list"], ["export", "--help"], *refused])
    assert said["metrics list"][0] == said["export --help"][0] == 0
    for words in refused:
        code, text = said[" ".join(words)]
        assert code == 2
        assert "h3data_exporters" in text, f"{words}: {text}"


PLAYED = "--episodes 1 --max-steps 20 --workers 1"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a home, a dataset played in it, its gfx-replay, a file of its episodes and a motion file of Habitat."""
    here = tmp_path_factory.mktemp("files")
    for command in (
        f"scenes export small:3 --to glb -o {here}",
        f"generate social_nav --scenes {here}/home_small_3.glb {PLAYED} --save-episodes {here}/episodes.json.gz -o {here}/ds",
        f"export {here}/ds#0 --to gfx-replay -o {here}/walk.gfx_replay.json",
    ):
        assert main(command.split()) == 0
    (here / "walk.pkl").write_bytes(pickle.dumps({"walk_motion": {}}))
    return here


NEEDING = {
    "h3data_habitat": (
        "import {files}/walk.gfx_replay.json -o {out}/imported",
        "metrics {files}/ds --profile habitat --workers 1",
        "export {files}/ds#0 --to gfx-replay -o {out}/again.gfx_replay.json",
        "export {files}/ds#0 --to habitat-episodes -o {out}/episodes",
        "info {files}/episodes.json.gz",
        "generate social_nav --episodes-file {files}/episodes.json.gz --workers 1 -o {out}/of_file",
        "scenes export {files}/home_small_3.glb -o {out}/dataset",
        "motion import {files}/walk.pkl -o {out}/motions",
        "view {files}/ds#0 --stand-ins -o {out}/plain.rrd",
    ),
    "h3data_gpu": ("rerender {files}/ds#0 --camera robot_arm --backend gpu -o {out}/device",),
    "h3data_homes": ("scenes show small:1 -o {out}/plan.png",),
    "h3data_viewers": ("view {files}/ds#0 -o {out}/walk.rrd", "report {files}/ds -o {out}/report.html"),
    "h3data_play": (),
    "h3data_studies": (),
    "h3data_training": (),
}
"""Commands that need a package and end by themselves; the commands of the last three run on, and are refused above."""
NEED_MORE = (
    "motion import",
    "export {files}/ds#0 --to habitat-episodes",
    "rerender {files}/ds#0 --camera robot_arm --backend gpu",
    "view {files}/ds#0 --stand-ins",
)
"""Beginnings of commands that also need a whole file, another task, a GPU or a second package, and so are only refused."""


@pytest.mark.slow
@pytest.mark.parametrize("package", NEEDING)
def test_work_is_done_without_a_package(package: str, files: Path, tmp_path: Path) -> None:
    tree, out = tmp_path / "tree", tmp_path / "out"
    tree.mkdir()
    works = [
        f"generate social_nav --scenes {files}/home_small_3.glb {PLAYED} -o {out}/ds",
        f"info {files}/ds#0",
        f"metrics {files}/ds --workers 1",
        "metrics list",
        f"validate {files}/ds",
        f"replay {files}/ds#0 --verify",
        f"rerender {files}/ds#0 --camera robot_arm --size 64x48 --workers 1 -o {out}/pictures",
        f"export {files}/ds#0 --to csv -o {out}/tables",
        f"scenes show {files}/home_small_3.glb -o {out}/home.png",
    ]
    others = (words for other, commands in NEEDING.items() if other != package for words in commands)
    works += [words.format(files=files, out=out) for words in others if not words.startswith(NEED_MORE)]
    refused = [words.format(files=files, out=out) for words in NEEDING[package]]
    said = run_without(package, tree, [words.split() for words in (*works, *refused)])
    for words in works:
        assert said[words][0] == 0, f"{words}: {said[words][1]}"
    for words in refused:
        assert said[words][0] == 2, f"{words}: {said[words][1]}"
        assert package in said[words][1], f"{words}: {said[words][1]}"
