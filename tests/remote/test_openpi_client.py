"""openpi's own client and codec, in an environment of their own: it drives our server, and ours asks a server in its codec."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from h3data_remote.wire import OPENPI
from sim_kinematic.tasks.resume import verify
from tests.paths import ROOT
from tests.remote.scripted_server import steer
from tests.remote.test_policy import played
from tests.remote.test_serving import FOLLOW, GPS, served

pytestmark = pytest.mark.slow
HERE = Path(__file__).parent / "openpi_client"
ENVIRONMENT = Path(os.environ.get("OPENPI_CLIENT", ROOT / ".venv-openpi"))


@pytest.fixture(scope="module")
def python() -> Path:
    """Python of the environment, which is made where it is not there."""
    found = ENVIRONMENT / "bin" / "python"
    look = [found, "-c", "import openpi_client"]
    if not found.exists() or subprocess.run(look, capture_output=True, check=False).returncode:
        subprocess.run([sys.executable, "-m", "venv", ENVIRONMENT], check=True)
        install = [found, "-m", "pip", "install", "-q", "--disable-pip-version-check", "-r", HERE / "requirements.txt"]
        done = subprocess.run(install, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"openpi-client cannot be installed here: {done.stderr.strip().splitlines()[-1]}")
    return found


@pytest.fixture
def fake_openpi(python: Path) -> Iterator[str]:
    """Address of a server in openpi's codec."""
    command = [python, HERE / "client.py", "serve"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield f"ws://127.0.0.1:{int(process.stdout.readline())}"
        process.kill()


def test_its_client_drives_our_server(python: Path) -> None:
    with served(FOLLOW, adapter=GPS) as address:
        command = [python, HERE / "client.py", "drive", address.rpartition(":")[2]]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    told = json.loads(done.stdout)
    expected = [steer(np.array([3.0, 0.02 * k], np.float32)) for k in range(8)]
    assert np.allclose(told["actions"], expected)
    own = told["metadata"]["h3data"]["adapter"]
    assert own["observation"]["humanoid_gps"]["sensor"] == "humanoid_gps"
    assert "lacks: humanoid_gps" in told["fault"]


def test_we_are_moved_by_a_server_in_its_codec(fake_openpi: str) -> None:
    recording = played(f"{fake_openpi}?adapter=openpi", steps=23)
    (remote,) = recording.episode.info["remote"]
    assert (remote["calls"], remote["metadata"]) == (5, {"name": "fake pi", "scale": 0.5})
    assert recording.columns["agent_0.action"].any()
    assert verify(recording).difference is None


def test_both_write_the_same_bytes(python: Path) -> None:
    done = subprocess.run([python, HERE / "client.py", "pack"], capture_output=True, text=True, check=True)
    theirs = bytes.fromhex(done.stdout)
    message = OPENPI.unpack(theirs)
    assert message["observation/image"].shape == (224, 224, 3)
    assert OPENPI.pack(message) == theirs
