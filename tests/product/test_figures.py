"""Figures in README and docs are those of the benchmarks, the policies, the tests and the constants that they tell of."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import h3data
from h3data.formats import source_file
from h3data.mesh import gltf_primitives, images, png
from h3data_habitat import limits
from h3data_habitat.gfx import keyframes
from h3data_pipelines.cli import main
from tests.paths import DOCS, ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
UNITS = "GPU minutes|minutes|seconds|steps/s|frames/s|ms|MiB|GiB|MB|GB|%"
ROW = re.compile(r"^\| .+ \| ([^|]+) \| `([a-z_]+\.[\w.{},]+)` \|$", re.MULTILINE)
"""A row of a table of speed: the figure, and the line of `make bench` that prints it."""


def speeds(text: str) -> dict[str, str]:
    return {line: figure for figure, line in ROW.findall(text)}


def lines_of(name: str) -> list[str]:
    """``a.w{1,16}_fps`` as two names."""
    before, _, rest = name.partition("{")
    choices, _, after = rest.partition("}")
    return [f"{before}{choice}{after}" for choice in choices.split(",")]


def number(text: str) -> float:
    """``71 M env-steps/s`` as 71,000,000."""
    found = re.match(r"([\d,.]+)( M\b)?", text.strip())
    assert found, text
    return float(found[1].replace(",", "")) * (1e6 if found[2] else 1)


def stored_figures() -> dict[str, float]:
    """The newest value of each line in the results of `make bench` that are kept."""
    found: dict[str, float] = {}
    for path in sorted((ROOT / "benchmarks" / "results").glob("*.json")):
        figures = json.loads(path.read_text(encoding="utf-8")).get("figures", {})
        found |= {
            line: figure["value"] for line, figure in figures.items() if isinstance(figure, dict) and "value" in figure
        }
    return found


def test_speeds_of_the_readme_are_those_of_the_page_of_all_figures() -> None:
    shown, whole = speeds(README), speeds((DOCS / "benchmark.md").read_text(encoding="utf-8"))
    assert len(shown) > 4
    assert shown == {line: whole.get(line) for line in shown}


def test_speeds_whose_runs_are_kept_are_those_of_the_runs() -> None:
    stored, compared = stored_figures(), 0
    for name, figure in speeds((DOCS / "benchmark.md").read_text(encoding="utf-8")).items():
        lines = lines_of(name)
        for line, part in zip(lines, figure.split(" / "), strict=False):
            if line in stored:
                assert abs(number(part) / stored[line] - 1) < 0.01, (
                    f"{line}: {part}, but the kept run has {stored[line]}"
                )
                compared += 1
    assert compared >= 4


def stages(card: dict) -> list[dict]:
    """Stages of training of a policy, the last one first."""
    found = [card["training"]]
    while parent := found[-1].get("parent"):
        found.append(parent)
    return found


def test_the_training_of_the_included_policy_is_that_of_its_card() -> None:
    with np.load(ROOT / "datasets" / "policies" / "end_to_end.npz") as file:
        trained = stages(json.loads(str(file["card"])))
    minutes = round(sum(stage["seconds"] * stage.get("processes", 1) for stage in trained) / 60)
    counts = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
    assert f"by `h3data train` in {minutes} GPU minutes ({counts[len(trained)]} stages)" in " ".join(README.split())
    decisions = " + ".join(f"{stage['decisions'] / 1e6:.0f}" for stage in reversed(trained))
    page = (DOCS / "training.md").read_text(encoding="utf-8")
    assert f"| `end_to_end`, seed 90 | {minutes} GPU minutes | {decisions} M |" in page


def test_the_readme_has_no_other_figure_with_a_unit() -> None:
    """A new one gets a line of a benchmark, a row of the table, or a test here."""
    prose = "\n".join(line for line in README.splitlines() if not line.startswith("|"))
    found = re.findall(rf"\d[\d,.]*(?: [MG])? ?(?:{UNITS})\b", re.sub(r"```.*?```", "", prose, flags=re.DOTALL))
    assert found == ["134 GPU minutes"]


def test_the_readme_and_the_first_page_show_the_same_metrics_of_the_demo() -> None:
    shown = [
        {line[:7].strip(): line[7:].split()[0] for line in re.findall(r"^[A-Z]+ +[01]\.\d{3} .*$", text, re.MULTILINE)}
        for text in (README, (DOCS / "index.md").read_text(encoding="utf-8"))
    ]
    assert list(shown[0]) == ["S", "SPS", "F", "CR"]
    assert shown[0] == shown[1]


@pytest.mark.slow
def test_the_metrics_of_the_readme_are_those_of_the_demo(tmp_path: Path) -> None:
    assert main(["demo", "-o", str(tmp_path), "--light", "flat", "--size", "64x48", "--quiet"]) == 0
    metrics = str(h3data.measure(h3data.open(tmp_path / "episode.mcap", h3data.Recording)))
    rows = [line.split() for line in re.findall(r"^[A-Z]+ +[01]\.\d{3} .*$", README, re.MULTILINE)]
    assert len(rows) == 4
    for name, value, *_ in rows:
        assert re.search(rf"^{name} +{re.escape(value)} ", metrics, re.MULTILINE), (
            f"{name} is not {value} in\n{metrics}"
        )


def test_the_version_of_the_readme_is_that_of_the_package() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"\nVersion {version.rpartition('.')[0]}. " in README


def test_limits_in_the_docs_are_those_of_the_code() -> None:
    reading = " ".join((DOCS / "import.md").read_text(encoding="utf-8").split())
    exponents = [f"10^{len(str(limit)) - 1}" for limit in (limits.MAX_STEPS, limits.MAX_BODIES)]
    assert f"more than {exponents[0]} steps, {exponents[1]} instances or assets, {limits.MAX_AGENTS} agents" in reading
    assert f"a keyframe of more than {keyframes.KEYFRAME_BYTES >> 20} MiB" in reading
    assert f"tracks of more than {limits.MAX_TRACK_VALUES * 4 >> 20} MiB" in reading
    assert (
        f"unpack to more than {source_file.UNPACKED_BYTES >> 20} MiB and {source_file.UNPACKED_RATIO} times their size"
        in reading
    )
    meshes = " ".join((DOCS / "meshes.md").read_text(encoding="utf-8").split())
    assert f"at most {images.MAX_SIDE_PX} texels per side" in meshes
    assert f"Images larger than {int(png.MAX_PX**0.5)} x {int(png.MAX_PX**0.5)}, and files" in meshes
    assert f"more than {gltf_primitives.MAX_TRIANGLES // 10**6} million triangles, are not read" in meshes


def test_the_memory_of_long_replays_is_what_their_test_allows() -> None:
    from tests.habitat.gfx.test_streaming import MOST_MIB

    assert f"recording within {MOST_MIB} MiB of memory" in (DOCS / "import.md").read_text(encoding="utf-8")
