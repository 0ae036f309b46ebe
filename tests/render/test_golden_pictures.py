"""Small pictures of a built-in home, kept as PNG and compared by tolerance.
Renew: python -m tests.render.test_golden_pictures"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from h3data.render import (
    Camera,
    Renderer,
    depth_to_rgb,
    fisheye,
    instance_to_rgb,
    look_at,
    orthographic,
    pinhole,
    write_png,
)
from h3data.render.sheets.scene_map import render_scene
from h3data_homes import HomeSpec, build_home
from tests.paths import DATA

GOLDEN = DATA / "golden"
EYE = look_at([1.0, 1.5, 1.0], [4.0, 0.7, 3.2])
CAMERAS = {
    "eye": pinhole(120, 90, hfov_deg=80, pose=EYE),
    "plan": orthographic(
        120, 96, width_m=12.5, pose=look_at([5.0, 9, 4.2], [5.0, 0, 4.2], up=(0, 0, -1)), hidden_layers=("ceiling",)
    ),
    "fisheye": fisheye(90, 90, hfov_deg=185, pose=EYE),
}
KINDS = ("rgb", "depth", "instance", "normal")


def pictures(camera: Camera, kinds: tuple[str, ...]) -> dict[str, NDArray[np.uint8]]:
    renderer = Renderer(render_scene(build_home(HomeSpec(preset="small", seed=15))))
    seen = renderer.render(camera, outputs=kinds, samples=4)  # type: ignore[arg-type]
    show = {
        "rgb": lambda a: a,
        "depth": lambda a: depth_to_rgb(a, 0.5, 9.0),
        "instance": instance_to_rgb,
        "normal": lambda a: np.rint(127.5 * (a + 1)).astype(np.uint8),
    }
    return {kind: show[kind](seen[kind]) for kind in kinds}


@pytest.mark.parametrize("name", list(CAMERAS))
def test_pictures_are_those_that_were_looked_at(name):
    import cv2

    kinds = KINDS
    if not CAMERAS[name].is_planar:
        try:
            import embreex  # noqa: F401
        except ImportError:
            kinds = ("rgb",)
    for kind, picture in pictures(CAMERAS[name], kinds).items():
        golden = cv2.imread(str(GOLDEN / f"{name}.{kind}.png"))
        assert golden is not None, f"no golden picture {name}.{kind}.png"
        far_off = np.abs(picture.astype(int) - golden[..., ::-1]).max(-1) > 6
        assert far_off.mean() < 0.005, f"{name}.{kind}: {far_off.mean():.4f} of the pixels differ"


if __name__ == "__main__":
    GOLDEN.mkdir(parents=True, exist_ok=True)
    for camera_name, camera in CAMERAS.items():
        for output, image in pictures(camera, KINDS).items():
            write_png(GOLDEN / f"{camera_name}.{output}.png", image)
