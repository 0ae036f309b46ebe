"""Pictures where the package of rays is not installed."""

from __future__ import annotations

import pytest

from h3data.errors import InputError
from h3data.render import Light, Renderer, fisheye
from h3data.render.renderer import ENGINES
from tests.rays.test_rays import box_room


def test_perspective_pictures_need_no_rays_and_others_name_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    with_rays = Renderer(box_room())
    monkeypatch.setattr(type(ENGINES), "missing", lambda self: {"rays": "h3data_rays"})
    monkeypatch.setattr("h3data.plugins._is_there", lambda reference: False)
    plain = Renderer(box_room())
    assert type(plain._engine) is not type(with_rays._engine)
    with pytest.raises(InputError, match=r"(?s)h3data_rays.*H3-RENDER-\d+"):
        plain.render(fisheye(32, 32), outputs=("depth",))
    for options in ({"backend": "rays"}, {"light": Light(shadow_rays=4)}):
        with pytest.raises(InputError, match="H3-FILE-010"):
            Renderer(box_room(), **options)
