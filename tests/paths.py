"""Folders that tests read."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "tests" / "data"
EXAMPLES = ROOT / "examples"
DOCS = ROOT / "docs"

REAL = ROOT.parent / "shared" / "real"
"""Real Habitat files, which are not part of the repository."""
HABITAT_SIM = REAL / "habitat-sim"
TEST_ASSETS = HABITAT_SIM / "data" / "test_assets"
REFERENCE = REAL / "habitat-lab" / "reference"
