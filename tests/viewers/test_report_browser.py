"""A report in Chromium: what only a browser can measure."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from h3data_viewers.html_report.report import make_report
from tests.play.test_browser import CHROMIUM, PLAYER_S, WEB, missing_browser
from tests.viewers.test_report import tidy, write

_MISSING = missing_browser()
pytestmark = [pytest.mark.browser, pytest.mark.skipif(bool(_MISSING), reason=_MISSING or "nothing is missing")]


def test_names_of_partners_over_heat_maps_are_whole(tmp_path: Path) -> None:
    recordings = [
        tidy(60, policy=policy, partner=partner)
        for policy in ("same_object", "complement")
        for partner in ("both", "object_1", "object_2")
    ]
    write(tmp_path / "e" / "recordings" / "000000", recordings)
    (tmp_path / "e" / "table.json").write_text(json.dumps({"job": {"task": "rearrange"}}))
    page = tmp_path / "report.html"
    page.write_text(make_report([tmp_path / "e"], pictures=0).html)
    command = ["node", str(WEB / "test" / "browser" / "report.mjs"), str(page), str(tmp_path / "heat")]
    environment = {**os.environ, "CHROMIUM": str(CHROMIUM)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=PLAYER_S, env=environment)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["heads"] > 3 * 6
    assert said["broken"] == []
    assert max(said["over"]) <= 0
