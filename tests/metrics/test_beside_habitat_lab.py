"""Our counts against outputs of the real habitat-lab (`SocialNavStats`), on its own trajectories.

Its row 0 is the state after reset, which it counts as step 1; given as a row of a recording like any other, all counts
must agree exactly.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from h3data.geometry import ground_pose
from h3data.metrics import measure
from h3data.metrics.paper.encounter import Thresholds, encounter_series
from h3data.recording.records import STEP_NS, Agent, Episode, Recording
from tests.paths import REFERENCE

FOLDER = REFERENCE / "socialnav"
FILES = sorted(FOLDER.glob("[0-9]*.npz"))
pytestmark = pytest.mark.skipif(not FILES, reason=f"real habitat-lab reference files are not on this machine: {FOLDER}")


def load(path: Path) -> tuple[Recording, dict[str, np.ndarray], dict[str, float]]:
    with np.load(path) as file:
        data = dict(file)
    names = json.loads(path.with_suffix(".json").read_text())["stats_columns"]

    def pose(who: str) -> np.ndarray:
        at = data[f"in_{who}_base_pos"]
        return ground_pose(at[:, [0, 2]], data[f"in_{who}_yaw"], at[:, 1]).astype(np.float32)

    oracle = data["min_step"][-1]
    info = {"max_steps": 1500, "oracle_min_steps": int(oracle) if np.isfinite(oracle) else None}
    recording = Recording(
        episode=Episode(uid=path.stem, episode_id=path.stem, task="social_nav", scene="flat", info=info),
        agents=(Agent(name="robot", kind="robot"), Agent(name="human", kind="human")),
        columns={
            "time_ns": np.arange(len(data["geodesic"])) * STEP_NS,
            "agent_0.base_pose": pose("robot"),
            "agent_1.base_pose": pose("human"),
            "metrics.collision": data["in_did_collide"],
            "metrics.geodesic_agents": data["geodesic"].astype(np.float32),
        },
    )
    return recording, data, dict(zip(names, data["stats"][-1], strict=True))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_the_real_code_agrees(path):
    recording, data, real = load(path)
    ours = measure(recording)
    v = ours.values
    assert v["S"] == real["has_found_human"]
    assert v["TD"] == pytest.approx(real["avg_robot_to_human_dis_over_epi"], abs=1e-5)
    assert v["CR"] == float(data["in_did_collide"].any())
    if v["S"]:
        assert ours.encounter_row + 1 == real["frist_ecnounter_steps"]
        assert v["FD"] == pytest.approx(real["avg_robot_to_human_after_encounter_dis_over_epi"], abs=1e-5)
    else:
        assert np.isnan(v["FD"])
        assert real["avg_robot_to_human_after_encounter_dis_over_epi"] == 0, "Habitat's reading, not ours"
    if np.isfinite(data["min_step"][-1]):
        assert v["SPS"] == pytest.approx(real["first_encounter_spl"], abs=1e-12)
        assert v["F"] == pytest.approx(real["follow_human_steps_ratio_after_frist_encounter"], abs=1e-12)


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_counts_agree_with_the_real_thresholds(path):
    """Its yield is below one 'unit' = 0.25 m/s; backup and yield together do not depend on its rounding noise."""
    recording, data, real = load(path)
    c = recording.columns
    got = encounter_series(
        c["agent_0.base_pose"],
        c["agent_1.base_pose"],
        c["metrics.geodesic_agents"],
        c["time_ns"],
        thresholds=Thresholds(yield_m_s=0.25),
    )
    assert got["found"].sum() == real["follow_human_steps_after_frist_encounter"]
    assert (got["backs_up"] | got["yields"]).sum() == data["backup_count"][-1] + data["yield_count"][-1]


def test_the_files_hold_every_case():
    """Guards the tests above: without found, lost, colliding and yielding episodes they would show little."""
    seen = [measure(load(path)[0]).values for path in FILES]
    assert {v["S"] for v in seen} == {0.0, 1.0}
    assert {v["CR"] for v in seen} == {0.0, 1.0}
    assert max(v["BYR"] for v in seen) > 0.3
    assert sum(v["SPS"] > 0 for v in seen) >= 2
