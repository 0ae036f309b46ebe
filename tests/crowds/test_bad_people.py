"""What users may type that no people can do: one sentence with a code, exit code 2, and other episodes go on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import h3data
from h3data_pipelines.cli import main

PEOPLE = "robot,human,human"
BAD: dict[str, tuple[list[str], str]] = {
    "a group of one": (["--agents", PEOPLE, "--partner", "orca+walk1,orca"], "H3-SIM-061"),
    "a reaction that nobody has": (["--agents", PEOPLE, "--partner", "orca+grumpy"], "H3-SIM-060"),
    "200 people in a small home": (["--agents", ",".join(["human"] * 200), "--partner", "orca"], "H3-SIM-021"),
    "people broader than the rooms": (
        ["--agents", PEOPLE, "--partner", "orca", "--set", "agent_radius_m=3"],
        "H3-SCENE-012",
    ),
}


# the others each play an episode, or search places for 200 people
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if "reaction" in name else pytest.mark.slow) for name in BAD]
)
def test_one_sentence_says_why(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options, code = BAD[name]
    assert (
        main(["generate", "wander", "--scenes", "small:1", *options, "--workers", "1", "-o", str(tmp_path / "ds")]) == 2
    )
    said = capsys.readouterr().err
    (line,) = [line for line in said.splitlines() if line.startswith("error: ")]
    assert f"[{code}]" in line
    assert "Traceback" not in said


def test_people_broader_than_a_door_are_named_with_the_rooms_that_are_closed_to_them() -> None:
    def refusals(**rules: Any) -> dict[int, str]:
        people = {"human": ["orca", "orca+morning"]}
        it = h3data.simulate("wander", "small:1", roster=PEOPLE, agents=people, seed=3, max_steps=3, **rules)
        return {e.agent: e.detail for e in it.events if e.kind == "refused" and e.step == 0}

    assert refusals() == {}
    closed = "is 1.00 m broad, and no free way of that width leads to bedroom, bathroom, hall."
    assert refusals(agent_radius_m=0.5) == {1: f"human_1 {closed}", 2: f"human_2 {closed}"}


@pytest.mark.slow
def test_people_broader_than_a_door_stay_in_their_room(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ds"
    options = [
        "--agents",
        PEOPLE,
        "--partner",
        "orca",
        "--set",
        "agent_radius_m=0.5",
        "--set",
        "max_steps=60",
        "--episodes",
        "1",
    ]
    assert (
        main(["generate", "wander", "--scenes", "small:1", *options, "--workers", "1", "--json", "-o", str(out)]) == 0
    )
    said: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert said["steps"] == 60


def test_tracks_that_jump_become_two_people_or_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def rows(jumps: str) -> str:
        """Three people who walk for 24 s; those whose names are in ``jumps`` are 30 m away every other time."""
        times = [(0.4 * k, 30 * (k % 2)) for k in range(60)]
        return "t,id,x,y\n" + "".join(
            f"{t:.1f},{p},{t + far * (p in jumps):.2f},{ord(p)}\n" for t, far in times for p in "abc"
        )

    (tmp_path / "all.csv").write_text(rows("ab"), encoding="utf-8")
    assert main(["import", str(tmp_path / "all.csv"), "-o", str(tmp_path / "rec")]) == 2
    assert "[H3-ROS-010]" in capsys.readouterr().err
    lines = rows("").splitlines()
    # from the 34th place on, the first person is 90 m and more away
    lines = lines[:100] + [line.replace(",a,", ",a,9") for line in lines[100:]]
    (tmp_path / "one.csv").write_text("\n".join(lines), encoding="utf-8")
    assert main(["import", str(tmp_path / "one.csv"), "-o", str(tmp_path / "rec")]) == 0
    assert "1 of 3 tracks jump and become several agents: a" in "".join(capsys.readouterr())
