"""Command ``h3data study fit``: the statistical analysis of studies with people."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from h3data.commands.command import FailedOption, ForceFlag, JsonFlag, Outcome, StepsModelOption, claim_file, write_text
from h3data.errors import InputError


@dataclass(frozen=True)
class StudyFit:
    """Estimate the means of a study's conditions with mixed models, and their pairwise differences.

    Recordings state their participant and condition (h3data import --manifest). As in Habitat 3.0, steps to success get
    a Poisson model with random intercepts of participants and scenes, and 0/1 metrics get a binomial model. RE is the
    ratio of the means.

    Examples:
        h3data study fit rec/
        h3data study fit rec/ --model observation --failed limit -o study.json
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """.mcap files, datasets, and folders that contain these."""
    profile: str | None = None
    """Metrics profile (default: that of the recordings' task)."""
    model: StepsModelOption = "auto"
    failed: FailedOption = "leave-out"
    no_scenes: bool = False
    """Leave out the random intercepts of scenes."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Also write the analysis to this .json file."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Fit the models and return means and differences."""
        import json

        from h3data.metrics import find_profile, measure_files
        from h3data_studies.analysis import StudyModel, analyse_study

        if not self.recordings:
            raise InputError("Expected at least one recording (.mcap) or dataset.", code="H3-METRIC-002")
        if self.out is not None:
            claim_file(self.out, force=self.force, suffix=".json")
        table = measure_files(self.recordings, self.profile)
        groups = ("participant",) if self.no_scenes else ("participant", "scene")
        analysis = analyse_study(
            table.episodes,
            find_profile(self.profile or table.profile, table.episodes[0].task),
            StudyModel(steps=self.model, failed=self.failed, random=groups),
        )
        if self.out is not None:
            write_text(self.out, json.dumps(analysis.to_dict(), indent=2) + "\n")
        return Outcome(text=analysis.to_text(), data=analysis.to_dict())
