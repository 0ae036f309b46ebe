"""What ``import h3data`` costs and exports."""

import subprocess
import sys

import pytest

import h3data

HEAVY = ("torch", "rerun", "trimesh", "cv2", "av", "fcl", "numba", "pyarrow", "scipy", "shapely")


def test_importing_h3data_is_light() -> None:
    script = "import sys, h3data; print([m for m in sys.argv[1:] if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", script, *HEAVY], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


@pytest.mark.parametrize("name", h3data.__all__)
def test_every_public_name_exists(name: str) -> None:
    assert getattr(h3data, name).__doc__


def test_unknown_names_list_what_there_is() -> None:
    with pytest.raises(AttributeError, match=r"It has: Dataset, .*render_frame"):
        _ = h3data.zzz
    with pytest.raises(AttributeError, match=r"no attribute 'mesure'\. Did you mean 'measure'\?$"):
        _ = h3data.mesure
