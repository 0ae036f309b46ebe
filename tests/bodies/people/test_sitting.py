"""Sitting down: contact with the seat and the floor, for all bodies."""

import numpy as np
import pytest

from benchmarks.sitting import HEIGHTS_M, figures_of
from h3data.bodies import humanoid_names, load_humanoid
from h3data.bodies.people.sitting import sitting_on
from h3data.errors import InputError

OF_TODDLER_M = 0.36
"""Highest seat on which the smallest body reaches the floor."""


@pytest.mark.parametrize("name", humanoid_names())
def test_contact(name: str) -> None:
    body, most = load_humanoid(name), 0
    for height in HEIGHTS_M:
        try:
            figures = figures_of(sitting_on(body, height))
        except InputError:  # too high for the legs of this body: `most` says up to where it is not
            continue
        most = height
        assert figures["depth_m"] < 0.02, height
        assert figures["hips_m"] < 0.02, height
        assert figures["slide_m"] < 1e-3, height
        assert figures["joint_deg"] < 20, height
    assert most >= (OF_TODDLER_M if body.height_m < 1.25 else 0.42)


def test_begins_standing() -> None:
    body = load_humanoid("female_0")
    quats, pelvis = sitting_on(body, 0.45).pose(0.0)
    stand, place = body.clip_pose([0], [0.0], 0.0)
    np.testing.assert_allclose(np.abs(np.sum(quats * stand, -1)), 1, atol=1e-6)
    np.testing.assert_allclose(pelvis, place, atol=5e-3)


@pytest.mark.parametrize("height", [-1.0, 0.0, 1.2, np.nan, np.inf])
def test_no_such_seat(height: float) -> None:
    with pytest.raises(InputError) as caught:
        sitting_on(load_humanoid("male_0"), height)
    assert caught.value.code == "H3-BODY-178"
