"""What is drawn onto pictures."""

from __future__ import annotations

import numpy as np

from h3data.render.colors import depth_to_rgb
from h3data_pipelines.pictures.depth_scale import draw_depth_scale


def test_a_depth_picture_gets_a_bar_of_its_colours_from_near_to_far() -> None:
    picture = depth_to_rgb(np.full((171, 224), 5.0), 0, 10)
    before = picture.copy()
    draw_depth_scale(picture, 0.0, 10.0)
    changed = (picture != before).any(-1)
    rows, columns = np.flatnonzero(changed.any(1)), np.flatnonzero(changed.any(0))
    assert rows[0] > 171 * 0.75
    assert columns[-1] < 224 * 0.4
    long = columns[-1] + 1 - 3 - 4
    bar = picture[171 - 4 - 2, 4 : 4 + long]
    want = depth_to_rgb(np.linspace(1e-3, 10, long)[None], 0, 10)[0]
    np.testing.assert_array_equal(bar, want)
    assert (bar[0] != bar[-1]).any()


def test_its_numbers_can_be_read_on_any_picture() -> None:
    picture = np.full((171, 224, 3), 255, np.uint8)
    draw_depth_scale(picture, 0.0, 10.0)
    plate = picture[171 - 4 - 7 - 16 : 171 - 4 - 7 - 3, 2 : 4 + 64]
    assert (plate == 20).all(-1).mean() > 0.6, "a dark plate"
    white = (plate > 150).all(-1)
    letters = np.flatnonzero(white.any(1))
    assert letters[-1] - letters[0] + 1 >= 9, "letters that are large enough"


def test_tiny_pictures_keep_all_their_pixels() -> None:
    picture = np.zeros((32, 48, 3), np.uint8)
    draw_depth_scale(picture, 0.0, 10.0)
    assert not picture.any()
