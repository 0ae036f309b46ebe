"""The documentation site in Chromium without a window: no code block and no page is wider than its place."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.paths import DOCS
from tests.play.test_browser import CHROMIUM, WEB, missing_browser

pytest.importorskip("sphinx", reason="needs the extra docs")
_MISSING = missing_browser()
pytestmark = [pytest.mark.browser, pytest.mark.skipif(bool(_MISSING), reason=_MISSING or "nothing is missing")]


def test_code_blocks_fit_their_column_on_a_laptop_and_a_phone(tmp_path: Path) -> None:
    site = tmp_path / "site"
    build = [sys.executable, "-m", "sphinx", "-q", "-b", "html", "-D", "nb_execution_mode=off", str(DOCS), str(site)]
    subprocess.run(build, check=True, timeout=500)
    pages = [page for page in sorted(site.rglob("*.html")) if page.stem not in ("genindex", "search", "py-modindex")]
    measure = ["node", str(WEB / "test" / "browser" / "site.mjs"), *map(str, pages)]
    environment = {**os.environ, "CHROMIUM": str(CHROMIUM)}
    done = subprocess.run(measure, capture_output=True, text=True, timeout=500, env=environment, check=True)
    found = json.loads(done.stdout)
    assert found["blocks"] > 400
    assert found["cut"] == []
