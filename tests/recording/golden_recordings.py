"""Writes the stored recording of an older format version: 1.3, at commit cd1147a.

``python tests/recording/golden_recordings.py VERSION COMMIT``, run from the repository's root, checks the commit out beside,
lets its code write one log and one dataset of `recording()`, and packs both. Never write one again with newer code: the
tests compare with what the code of that time wrote.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).parents[1] / "data" / "recordings"


def recording() -> Any:
    """Twelve steps with exact numbers, so that any machine makes the same."""
    from h3data.recording import Agent, AssetRef, Body, Episode, Event, Recording, SkillSpan

    steps = np.arange(12)

    def ramp(*shape: int) -> np.ndarray:
        return (np.arange(12 * int(np.prod(shape)), dtype=np.float32) / 8 - 16).reshape(12, *shape)

    columns = {
        "time_ns": steps * 33_333_333 + 33_333_333,
        "object_pose": ramp(2, 7),
        "agent_0.base_pose": ramp(7),
        "agent_0.joint_pos": ramp(3),
        "agent_0.grasp_body": np.where(steps > 5, 1, -1).astype(np.int32),
        "agent_0.action": ramp(2),
        "agent_1.base_pose": ramp(7)[::-1].copy(),
        "metrics.dist_agents": ramp(),
        "metrics.collision": steps % 3 == 0,
        "sim.leg": steps.astype(np.uint16),
        "state_hash": steps.astype(np.uint64) * np.uint64(0x1555_5555_5555_5555),
    }
    columns["object_pose"][:3, 1] = np.nan
    return Recording(
        episode=Episode(
            uid="golden",
            episode_id="g0",
            task="social_nav",
            scene="home",
            seed=7,
            schema_version="as written",
            info={"spec": {"a": 0.5}, "list": [1, None]},
        ),
        assets=(AssetRef(name="box", uri="primitive:box", color=(1, 2, 3)),),
        bodies=tuple(Body(name=f"box {i}", asset="box", pose=ramp(7)[i], moving=i) for i in range(2)),
        agents=(Agent(name="robot", kind="robot", joint_names=("a", "b", "c")), Agent(name="human", kind="human")),
        columns=columns,
        skills=(SkillSpan(agent=0, name="find", start_step=0, end_step=6, outcome="failed", reason="lost"),),
        events=(Event(step=3, agent=1, kind="collision", target="robot", detail="0.1 m"),),
        attachments={"note.txt": b"golden"},
    )


def write(folder: Path) -> None:
    """With whatever h3data is imported."""
    from h3data.recording import DatasetWriter, write_mcap

    write_mcap(recording(), folder / "log.mcap")
    with DatasetWriter(folder / "dataset") as writer:
        writer.add(recording())


def main(version: str, commit: str) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        tree, out = Path(temporary) / "tree", Path(temporary) / "out"
        out.mkdir()
        subprocess.run(["git", "worktree", "add", "--detach", tree, commit], check=True)
        try:
            paths = [str(tree), str(Path(__file__).parent)]
            code = f"import sys; sys.path[:0] = {paths}; from golden_recordings import *; write(Path({str(out)!r}))"
            subprocess.run([sys.executable, "-c", code], check=True, cwd=tree)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], check=True)
        with zipfile.ZipFile(FOLDER / f"{version}.zip", "w", zipfile.ZIP_DEFLATED) as packed:
            for path in sorted(p for p in out.rglob("*") if p.is_file()):
                packed.writestr(
                    zipfile.ZipInfo(path.relative_to(out).as_posix()), path.read_bytes(), zipfile.ZIP_DEFLATED
                )


if __name__ == "__main__":
    main(*sys.argv[1:])
