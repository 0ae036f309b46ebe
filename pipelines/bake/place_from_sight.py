"""Trial of ``place`` without path and pictures in one home, on a CPU core: how often it succeeds by update.

python -m bake.place_from_sight OUT.jsonl 0.25

The number is the share of worlds in which the teacher acts (`SkillSettings.demonstrations`); docs/skills.md has the results.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

from h3data_training.ppo import Learner, schedule
from h3data_training.skills.episodes import make_skill_bank
from h3data_training.skills.settings import skill_recipe
from h3data_training.skills.worlds import ActionRepeatSkills

UPDATES = 100


def main(file: Path, demonstrations: float) -> None:
    """Train the policy and write a row for each update."""
    import torch

    torch.set_num_threads(1)
    settings = replace(
        skill_recipe("tiny", "place"),
        scenes="small:1",
        observations=("target_sensor", "resting_sensor", "arm_joints", "is_holding"),
        worlds=128,
        epochs=3,
        minibatches=4,
        rate=8e-4,
        demonstrations=demonstrations,
    )
    bank = make_skill_bank(settings, seed=0, workers=1)
    learner = Learner(settings, ActionRepeatSkills(settings, bank, device="cpu"), seed=0)
    with file.open("w") as out:
        for update in range(UPDATES):
            row = learner.update(schedule(settings, update / UPDATES, update))
            told = {name: round(row[name], 4) for name in ("succeeded", "failed", "ended", "holding")}
            out.write(json.dumps({"update": update, "cpu_s": round(time.process_time(), 1), **told}) + "\n")
            out.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]))
