"""The documentation site in Chromium without a window: pages fit their place, on paper too, and the search finds them."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import quote_plus

import pytest

from tests.paths import DOCS
from tests.play.test_browser import CHROMIUM, WEB, missing_browser

pytest.importorskip("sphinx", reason="needs the extra docs")
_MISSING = missing_browser()
pytestmark = [pytest.mark.browser, pytest.mark.skipif(bool(_MISSING), reason=_MISSING or "nothing is missing")]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    site = tmp_path_factory.mktemp("docs") / "site"
    build = [sys.executable, "-m", "sphinx", "-q", "-b", "html", "-D", "nb_execution_mode=off", str(DOCS), str(site)]
    subprocess.run(build, check=True, timeout=500)
    return site


def test_pages_fit_a_laptop_a_phone_and_paper(site: Path) -> None:
    pages = [page for page in sorted(site.rglob("*.html")) if page.stem not in ("genindex", "search", "py-modindex")]
    measure = ["node", str(WEB / "test" / "browser" / "site.mjs"), *map(str, pages)]
    environment = {**os.environ, "CHROMIUM": str(CHROMIUM)}
    done = subprocess.run(measure, capture_output=True, text=True, timeout=500, env=environment, check=True)
    found = json.loads(done.stdout)
    assert found["blocks"] > 400
    assert found["cut"] == []
    assert found["printed"] == []


@pytest.mark.parametrize(
    ("words", "page"),
    [
        ("rerender", "rerender.html"),
        ("metrics", "metrics.html"),
        ("install", "installation.html"),
        ("play", "play.html"),
        ("collision rate", "metrics.html"),
        ("H3-RECORDING-014", "errors.html"),
        ("render_frame", "reference/written/python/h3data.html"),
    ],
)
def test_search_finds_the_page_about_the_words_first(site: Path, words: str, page: str) -> None:
    address = f"{(site / 'search.html').as_uri()}?q={quote_plus(words)}"
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=6000", "--dump-dom"]
    done = subprocess.run([*command, address], capture_output=True, text=True, timeout=100, check=True)
    results = re.findall(r'<li[^>]*>\s*<a href="([^"?#]*)', done.stdout[done.stdout.index("search-results") :])
    assert results[0] == page
