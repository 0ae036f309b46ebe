"""Scenes made ready to be drawn: everything that an instance says is in the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from h3data.render import Renderer
from h3data.render.sheets.scene_map import plan_picture, render_scene
from h3data_homes import HomeSpec, build_home


@pytest.mark.parametrize("cut_above_y", [None, 1.0])
def test_semantic_ids_of_instances_are_drawn(cut_above_y: float | None) -> None:
    home = build_home(HomeSpec(preset="small", seed=15))
    numbered = replace(home, instances=tuple(replace(i, semantic_id=100 + k) for k, i in enumerate(home.instances)))
    _, camera = plan_picture(home, pixels_per_m=20)
    drawn = render_scene(numbered, cut_above_y=cut_above_y)
    view = Renderer(drawn).render(camera, outputs=("semantic", "instance"))
    wanted = {i.name: i.semantic_id for i in numbered.instances}
    seen = np.unique(view["instance"][view["instance"] >= 0])
    assert len(seen) > 20
    for index in seen:
        assert set(view["semantic"][view["instance"] == index]) == {wanted[drawn.instances[index].name]}
