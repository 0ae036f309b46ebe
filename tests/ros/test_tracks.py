"""Files of tracks of people, made up in the form of each data set, and what is said of those that are ambiguous."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import H3DataError
from h3data.formats import ImportRequest, detect
from h3data.geometry import heading_from_quat
from h3data.metrics.registry import measure
from h3data_pipelines.cli import main
from h3data_ros.track_import import read_tracks
from h3data_ros.track_recording import headings_of_motion
from h3data_ros.transforms import at_times


def place(person: int, row: int, step_s: float) -> tuple[float, float]:
    """They walk along x at 1.25 m/s, 1.1 m apart."""
    return 1.0 + 1.25 * step_s * row, 1.1 * person


def csv(head: str = "time,id,x,y", rows: int = 40) -> str:
    lines = [
        f"{k / 10},{name},{place(i, k, 0.1)[0]},{place(i, k, 0.1)[1]}"
        for k in range(rows)
        for i, name in enumerate("rab")
    ]
    return "\n".join([head, *lines] if head else lines) + "\n"


def obsmat() -> str:
    row = "  {f:.7e}   {i:.7e}   {x:.7e}   0.0000000e+00   {y:.7e}   1.0e+00   0.0e+00   0.0e+00\n"
    places = [(780 + 6 * k, i, *place(i, k, 0.4)) for k in range(20) for i in range(3)]
    return "".join(row.format(f=f, i=i, x=x, y=y) for f, i, x, y in places)


def trajnet(fps: str = ', "fps": 2.5') -> str:
    scene = f'{{"scene": {{"id": 0, "p": 1, "s": 0, "e": 190{fps}}}}}\n'
    places = [(10 * k, i, *place(i, k, 0.4)) for k in range(20) for i in range(3)]
    return scene + "".join(f'{{"track": {{"f": {f}, "p": {i}, "x": {x}, "y": {y}}}}}\n' for f, i, x, y in places)


def magni() -> str:
    bodies = ["Helmet_1", "Helmet_2", "DARKO_Robot", "LO1"]
    head = ["Frame", "Time", *(f"{b} - {m} {a}" for b in bodies for m in (1, 2) for a in "XYZ")]
    lines = ["FILE_ID,made_up", "N_FRAMES,200", ",".join(head)]
    for k in range(200):
        row = [str(k), f"{k / 100}"]
        for i in range(len(bodies)):
            x, y = place(i, k, 0.01)
            gone = i == 1 and 50 <= k < 150
            row += (
                [""] * 6
                if gone
                else [f"{1000 * x - 50}", f"{1000 * y}", "1700", f"{1000 * x + 50}", f"{1000 * y}", "1700"]
            )
        lines.append(",".join(row))
    return "\n".join(lines) + "\n"


def atc() -> str:
    rows = []
    for k in range(60):
        for i in range(2):
            t = k * 0.04 + i * 0.013
            x, y = 1000 + 1250 * t, 1100 * i
            rows.append(f"{1350000000 + t:.3f},{9000 + i},{x:.0f},{y:.0f},1700,1250,0.0,0.0\n")
    return "".join(rows)


FILES: dict[str, tuple[Callable[[], str], ImportRequest, str, int, float]] = {
    "table.csv": (csv, ImportRequest(robot="r"), "table", 40, 10),
    "named.csv": (
        lambda: csv("a;b;c;d").replace(",", ";"),
        ImportRequest(columns=("t=a", "id=b", "x=c", "y=d")),
        "table",
        40,
        10,
    ),
    "bare.csv": (lambda: csv(""), ImportRequest(columns=("t", "id", "x", "y")), "table", 40, 10),
    "obsmat.txt": (obsmat, ImportRequest(rate=15), "ETH/UCY obsmat", 20, 2.5),
    "frames.txt": (
        lambda: "".join(
            f"{10 * k}\t{i}.0\t{place(i, k, 0.4)[0]}\t{place(i, k, 0.4)[1]}\n" for k in range(20) for i in range(3)
        ),
        ImportRequest(rate=25),
        "frame id x y",
        20,
        2.5,
    ),
    "trajnet.ndjson": (trajnet, ImportRequest(), "TrajNet++", 20, 2.5),
    "magni.csv": (magni, ImportRequest(robot="DARKO_Robot"), "THÖR-MAGNI", 200, 100),
    "atc.csv": (atc, ImportRequest(hz=25), "ATC", 60, 25),
}


@pytest.mark.parametrize("name", FILES)
def test_each_kind_of_file(name: str, tmp_path: Path) -> None:
    make, request, layout, rows, rate = FILES[name]
    path = tmp_path / name
    path.write_text(make(), encoding="utf-8")
    assert detect(path).name == "tracks"
    recording = read_tracks(path, tracks=request)
    assert recording.episode.info["source"]["layout"] == layout
    assert abs(len(recording) - rows) <= 1
    assert recording.episode.info["imported"]["rate_hz"] == pytest.approx(rate, rel=0.01)
    seconds = recording.columns["time_ns"] * 1e-9
    for number in range(len(recording.agents)):
        pose = recording.columns[f"agent_{number}.base_pose"]
        known = np.isfinite(pose[:, 0])
        assert known.sum() > 5
        np.testing.assert_allclose(pose[known, 0], 1.0 + 1.25 * seconds[known], atol=2e-3)
        np.testing.assert_allclose(heading_from_quat(pose[known, 3:]), 0, atol=1e-3)
    if request.robot:
        assert recording.agents[0].kind == "robot"
        assert measure(recording, "social").values["V_mean"] == pytest.approx(1.25, abs=0.01)
    else:
        assert measure(recording, "field").values["V_mean"] == pytest.approx(1.25, abs=0.01)


def test_people_who_leave_are_away(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(magni(), encoding="utf-8")
    recording = read_tracks(tmp_path / "m.csv", tracks=ImportRequest(robot="DARKO_Robot"))
    assert [agent.name for agent in recording.agents] == ["DARKO_Robot", "Helmet_1", "Helmet_2"]
    away = np.isnan(recording.columns["agent_2.base_pose"][:, 0])
    assert away[50:150].all()
    assert not away[:50].any()
    assert any("LO1" in warning for warning in recording.episode.info["warnings"])


HOSTILE: dict[str, tuple[str, ImportRequest, str]] = {
    "empty": ("", ImportRequest(), "H3-ROS-039"),
    "only a head": ("t,id,x,y\n", ImportRequest(), "H3-ROS-040"),
    "no meaning": (csv(), ImportRequest(columns=("q=time",)), "H3-ROS-041"),
    "no column": (csv(), ImportRequest(columns=("t=nothing",)), "H3-ROS-041"),
    "too few names": (csv(), ImportRequest(columns=("t", "id")), "H3-ROS-042"),
    "without names": (csv("").replace(",", ",0,"), ImportRequest(), "H3-ROS-043"),
    "unknown names": (csv("u,v,w,z"), ImportRequest(), "H3-ROS-044"),
    "cut off": (csv()[:-9], ImportRequest(), "H3-ROS-045"),
    "words": (csv().replace("1.125", "about one"), ImportRequest(), "H3-ROS-046"),
    "damaged lines": (trajnet() + '{"track": {"f": 3}}\n', ImportRequest(), "H3-ROS-047"),
    "no helmets": (magni().replace("Helmet", "Hat"), ImportRequest(), "H3-ROS-049"),
    "a topic": (csv(), ImportRequest(people="/people"), "H3-ROS-050"),
    "nobody": (csv(), ImportRequest(robot="nobody"), "H3-ROS-053"),
    "a rate of 0": (obsmat(), ImportRequest(rate=0), "H3-ROS-054"),
    "frames": (obsmat(), ImportRequest(), "H3-ROS-055"),
    "frames of TrajNet": (trajnet(""), ImportRequest(), "H3-ROS-055"),
    "nanoseconds": (csv().rstrip().replace("\n", "\n17000000000000000"), ImportRequest(), "H3-ROS-056"),
    "milliseconds": ("t,id,x,y\n" + "".join(f"{100 * k},a,{k / 10},0\n" for k in range(20)), ImportRequest(), "H3-ROS-057"),
    "times that differ": (atc(), ImportRequest(), "H3-ROS-058"),
    "millimetres": (
        "t,id,x,y\n" + "".join(f"{k / 10},{p},{100 * k},0\n" for k in range(20) for p in "abc"), ImportRequest(), "H3-ROS-010"
    ),
    "all NaN": ("t,id,x,y\n0,a,nan,nan\n1,a,nan,nan\n", ImportRequest(), "H3-ROS-011"),
    "furlongs": (csv(), ImportRequest(unit="furlong"), "H3-ROS-062"),
    "a goal in words": (csv(), ImportRequest(goal="kitchen"), "H3-ROS-009"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_wrong_is_said_in_a_sentence(name: str, tmp_path: Path) -> None:
    text, request, code = HOSTILE[name]
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    with pytest.raises(H3DataError, match=code) as caught:
        read_tracks(tmp_path / "t.csv", tracks=request)
    assert "\n" not in str(caught.value)


def test_a_track_that_jumps_becomes_two_people(tmp_path: Path) -> None:
    rows = [(k / 10, "a", k / 10 + (20 if k >= 10 else 0)) for k in range(20)] + [(k / 10, "b", 5.0) for k in range(20)]
    (tmp_path / "t.csv").write_text("t,id,x,y\n" + "".join(f"{t},{p},{x},0\n" for t, p, x in rows))
    recording = read_tracks(tmp_path / "t.csv", tracks=ImportRequest())
    assert {agent.name for agent in recording.agents} == {"a", "a_2", "b"}
    assert any("jump" in warning for warning in recording.episode.info["warnings"])
    pose = recording.columns["agent_0.base_pose"][:, 0]
    assert np.isnan(pose[10:]).all()


def test_times_that_come_twice_and_in_any_order(tmp_path: Path) -> None:
    lines = csv().splitlines()
    mixed = [lines[0], *np.random.default_rng(1).permutation(lines[1:]).tolist(), lines[5]]
    for name, text in (("a.csv", csv()), ("b.csv", "\n".join(mixed))):
        (tmp_path / name).write_text(text)
    a, b = (read_tracks(tmp_path / name, tracks=ImportRequest(robot="r")) for name in ("a.csv", "b.csv"))
    np.testing.assert_array_equal(a.columns["agent_0.base_pose"], b.columns["agent_0.base_pose"])
    assert "twice" in str(b.episode.info["warnings"])


def test_places_far_away_keep_their_millimetres(tmp_path: Path) -> None:
    rows = "".join(f"{k / 10},{p},{500000 + k / 8},{6000000 + i}\n" for k in range(20) for i, p in enumerate("ra"))
    (tmp_path / "utm.csv").write_text("t,id,x,y\n" + rows)
    recording = read_tracks(tmp_path / "utm.csv", tracks=ImportRequest(robot="r"))
    assert recording.episode.info["imported"]["offset_m"][0] == pytest.approx(500001, abs=1)
    np.testing.assert_allclose(np.diff(recording.columns["agent_0.base_pose"][:, 0]), 0.125, atol=1e-6)


@given(st.lists(st.integers(0, 10**7), min_size=2, max_size=12, unique=True), st.integers(0, 10**7))
def test_poses_between_observations_lie_between_them(times: list[int], gap: int) -> None:
    stamps = np.sort(np.array(times, np.int64))
    poses = np.zeros((len(stamps), 7))
    poses[:, 0], poses[:, 6] = stamps, 1
    asked = np.arange(stamps[0] - 5, stamps[-1] + 5, max((stamps[-1] - stamps[0]) // 50, 1))
    found = at_times(stamps, poses, asked, gap)
    known = np.isfinite(found[:, 0])
    np.testing.assert_allclose(found[known, 0], asked[known], rtol=1e-9)
    np.testing.assert_array_equal(at_times(stamps, poses, stamps, gap), poses)
    after = np.clip(np.searchsorted(stamps, asked), 1, len(stamps) - 1)
    near = (stamps[after] - stamps[after - 1] <= gap) & (asked >= stamps[0]) & (asked <= stamps[-1])
    assert (known == (near | np.isin(asked, stamps))).all()


def test_headings_hold_where_one_stands() -> None:
    x = np.concatenate([np.linspace(0, 2, 20), np.full(20, 2.0)])
    headings = headings_of_motion(np.arange(40) * 100_000_000, np.stack([x, -x], axis=1))
    np.testing.assert_allclose(headings, np.pi / 4, atol=1e-6)


def test_the_command_imports_tracks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "t.csv").write_text(csv())
    assert main(["import", str(tmp_path / "t.csv"), "--robot", "r", "-o", str(tmp_path / "rec")]) == 0
    assert main(["metrics", str(tmp_path / "rec" / "t.csv.mcap"), "--profile", "social"]) == 0
    assert main(["validate", str(tmp_path / "rec" / "t.csv.mcap")]) == 0, capsys.readouterr().out
