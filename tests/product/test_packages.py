"""Each package above the simulator can be left out: what needs it says so, and everything else works."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.paths import ROOT

PLACES = {
    "h3data": ".",
    "sim_kinematic": ".",
    "h3data_homes": "pipelines",
    "h3data_pipelines": "pipelines",
    "h3data_training": "pipelines",
    "h3data_remote": "pipelines",
    "h3data_play": "viewers",
    "h3data_studies": "viewers",
    "h3data_viewers": "viewers",
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


def run_without(package: str, tree: Path, commands: list[list[str]]) -> dict[str, tuple[int, str]]:
    """Exit codes and output of commands in an installation that has all packages but one."""
    for name, place in PLACES.items():
        if name != package:
            (tree / name).symlink_to(ROOT / place / name)
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
        ("h3data_viewers", {"view", "report"}),
        ("h3data_play", {"play", "study"}),
        ("h3data_studies", {"study"}),
        ("h3data_training", {"train"}),
        ("h3data_remote", {"serve"}),
    ],
)
def test_a_package_that_is_not_there_costs_only_its_commands(package: str, lost: set[str], tmp_path: Path) -> None:
    others = [w for w in ("demo", "generate", "evaluate", "metrics", "view", "report", "docs", "play") if w not in lost]
    asked = [["--help"], *([word, "--help"] for word in others), *([word] for word in sorted(lost))]
    said = run_without(package, tmp_path, asked)
    assert all(said[f"{word} --help"][0] == 0 for word in others)
    listed = said["--help"][1]
    for word in ("view", "report", "play", "study", "train", "serve"):
        assert (f"\n  {word} " in listed) is (word not in lost)
    for word in lost:
        assert said[word][0] == 2
        assert package in said[word][1]


def test_learning_on_a_device_names_the_package_that_has_it(tmp_path: Path) -> None:
    script = SCRIPT.replace("said = {}", "import h3data\nfrom h3data.errors import InputError\nsaid = {}").replace(
        "for words in commands:",
        "try:\n    h3data.make('social_nav', scenes='small:1', device='cpu')\n"
        "except InputError as error:\n    said['make'] = [2, str(error)]\nfor words in commands:",
    )
    for name, place in PLACES.items():
        if name != "h3data_training":
            (tmp_path / name).symlink_to(ROOT / place / name)
    done = subprocess.run(
        [sys.executable, "-P", "-c", script, str(ROOT), str(tmp_path), "[]"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "h3data_training" in json.loads(done.stdout.splitlines()[-1])["make"][1]


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
