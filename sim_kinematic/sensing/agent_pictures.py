"""Pictures among an agent's observations, whose names are the same in all tasks.

The pictures are depth and colours of each of the agent's cameras, the output of the humanoid detector on the arm's
camera, and 3-D laser scans.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.errors import InputError
from h3data.replay.cameras import MAX_SIDE_PX
from sim_kinematic.contact.frames import Body
from sim_kinematic.sensing.lidar import COLUMNS, LASERS, SCAN_M
from sim_kinematic.sensing.sensor import DETECTED_PIXELS, Detection, detect_humanoids

if TYPE_CHECKING:
    from h3data.render import Output
    from sim_kinematic.sensing.camera_sensor import StateRenderer

DETECTORS = {"humanoid_detector": "found", "humanoid_mask": "mask", "humanoid_box": "box"}
"""Names of the observations that are parts of a `Detection`."""
LIDAR_3D = "lidar_3d"
"""Name of the distances of a 3-D laser scanner on top of a robot
(`sim_kinematic.sensing.camera_sensor.StateRenderer.scans`)."""
ARM = "arm"
PREFIX = "robot_"


class Lens(NamedTuple):
    """Camera of a picture, and the size of the picture [pixels]."""

    camera: str
    width: int
    height: int


class Limits(NamedTuple):
    """Bounds, shape and dtype of an observation, as `gymnasium.spaces.Box` takes them."""

    low: NDArray[Any] | float
    high: NDArray[Any] | float
    shape: tuple[int, ...]
    dtype: type[np.float32] | type[np.uint8]


def picture_names(body: Body) -> tuple[str, ...]:
    """Return the names of the pictures that a body can observe.

    A robot has ``CAMERA_depth`` and ``CAMERA_rgb`` for each of its cameras ``robot_CAMERA``, the `DETECTORS` if there
    is a camera on its arm, and `LIDAR_3D`. A person has ``head_depth`` and ``head_rgb``, their own view.
    """
    if isinstance(body, Humanoid):
        return ("head_depth", "head_rgb")
    # robot_arm_rgb takes the colours beside robot_arm (`_lens`): together they are one camera here
    cameras = [c.name.removeprefix(PREFIX) for c in body.cameras if not c.name.endswith("_rgb")]
    names = [f"{camera}_{output}" for camera in cameras for output in ("depth", "rgb")]
    return (*names, *(DETECTORS if ARM in cameras else ()), LIDAR_3D)


def in_colour(name: str, body: Body) -> bool:
    """Return whether a picture of a body shows colours rather than depth or an output of the detector."""
    return name.endswith("_rgb") or name in body.camera_names


class AgentPictures:
    """Pictures that one agent observes."""

    def __init__(
        self,
        body: Body,
        names: Sequence[str],
        *,
        agent: int,
        depth_size: tuple[int, int] | None = None,
        rgb_size: tuple[int, int] | None = None,
        sizes: Mapping[str, tuple[int, int]] | None = None,
    ) -> None:
        """Select the pictures of one agent.

        Args:
            body: body of the agent.
            names: observations of the agent; those in `picture_names` and the body's cameras are pictures.
            agent: number of the agent in the state.
            depth_size: width and height of depth, masks and boxes [pixels]; None is each camera's own. The field of
                view does not change.
            rgb_size: width and height of colours [pixels]; None is each camera's own.
            sizes: width and height of single pictures by name [pixels], which override the two other sizes.

        Raises:
            InputError: A size is less than 1 x 1 or too large.
        """
        own = dict(sizes or {})
        for size in filter(None, (depth_size, rgb_size, *own.values())):
            if len(size) != 2 or not 1 <= min(size) <= max(size) <= MAX_SIDE_PX:
                raise InputError(
                    f"Expected a picture of 1 x 1 to {MAX_SIDE_PX} x {MAX_SIDE_PX} pixels (width, height), got {size}.",
                    code="H3-SIM-039",
                )
        known = (*picture_names(body), *body.camera_names)
        self.names = tuple(name for name in names if name in known)
        self._agent, self._body = agent, body
        self._lenses = {
            n: _lens(body, n, own.get(n, rgb_size if in_colour(n, body) else depth_size))
            for n in self.names
            if n != LIDAR_3D
        }
        self._detects_from = 0
        if set(DETECTORS) & set(self.names):
            arm = body.camera(PREFIX + ARM)
            lens = next(self._lenses[name] for name in self.names if name in DETECTORS)
            # a share of the picture: in a smaller picture a person shows fewer pixels
            self._detects_from = int(DETECTED_PIXELS * lens.width * lens.height / (arm.width * arm.height))

    @property
    def in_colour(self) -> bool:
        """Return whether one of the pictures shows colours, which depend on the light of the home."""
        return any(in_colour(name, self._body) for name in self.names)

    def limits(self, name: str) -> Limits:
        """Return the limits of a named picture in one world.

        Colours are uint8 [H, W, 3], the detector's flag is float32 [1], a 3-D scan is float32 [L, C] [m], and others
        are float32 [H, W, 1].
        """
        if name == LIDAR_3D:
            return Limits(0.0, SCAN_M, (LASERS, COLUMNS), np.float32)
        lens = self._lenses[name]
        if in_colour(name, self._body):
            return Limits(0, 255, (lens.height, lens.width, 3), np.uint8)
        return Limits(0.0, 1.0, (1,) if name == "humanoid_detector" else (lens.height, lens.width, 1), np.float32)

    def take(self, drawn: StateRenderer) -> dict[str, NDArray[Any]]:
        """Return the pictures of all worlds as last posed, [W, ...]; depth is in metres, 0 where nothing was hit."""
        from sim_kinematic.sensing.camera_sensor import CameraSensor

        # pictures of one lens are rendered at once: depth and detector of the arm share a pass
        outputs: dict[Lens, list[Output]] = {}
        for name, lens in self._lenses.items():
            outputs.setdefault(lens, []).append(self._output(name))
        seen = {}
        for lens, wanted in outputs.items():
            sensor = CameraSensor(
                camera=lens.camera,
                agent=self._agent,
                outputs=tuple(dict.fromkeys(wanted)),
                size=(lens.width, lens.height),
            )
            seen[lens] = sensor.observe(drawn)
        detected: dict[Lens, Detection] = {}
        pictures = {LIDAR_3D: drawn.scans(self._agent)} if LIDAR_3D in self.names else {}
        for name, lens in self._lenses.items():
            if name not in DETECTORS:
                picture = seen[lens][self._output(name)]
                pictures[name] = picture if in_colour(name, self._body) else picture[..., None]
                continue
            # the three observations of the detector are parts of one detection
            if lens not in detected:
                detected[lens] = detect_humanoids(seen[lens]["semantic"], more_than_pixels=self._detects_from)
            pictures[name] = getattr(detected[lens], DETECTORS[name])[..., None]
        return pictures

    def _output(self, name: str) -> Output:
        """Return the output of the renderer of which a picture is made."""
        if name in DETECTORS:
            return "semantic"
        return "rgb" if in_colour(name, self._body) else "depth"


def _lens(body: Body, name: str, size: tuple[int, int] | None) -> Lens:
    """Return the lens of a named picture, with the size of its camera if none is given."""
    camera = PREFIX + (ARM if name in DETECTORS else name.removesuffix("_depth"))
    if name in body.camera_names:
        camera = name
    elif name.endswith("_rgb") and camera not in body.camera_names:
        camera = camera.removesuffix("_rgb")
    own = body.camera(camera)
    return Lens(own.name, *(size or (own.width, own.height)))
