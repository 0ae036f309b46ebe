"""Strips of moments of a rearrangement episode: each moment is a picture and a plan with the paths until then."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import Array
from h3data.progress import progress
from h3data.recording import Recording
from h3data.render.camera import Camera
from h3data.render.overlay import Color, draw_polyline, pixel_of
from h3data.replay.cameras import camera_at
from h3data.replay.records import CameraTrack
from h3data.replay.replay import Replay

MOST = 8
"""Largest number of moments in a strip; if there are more, the strip has the first and the last ones."""
MOVES_MPS, OVER_S = 0.2, 0.5
"""Speed [m/s] above which an agent counts as moving, averaged over the time [s] before and after."""
PASSING_M = 4.0
"""Distance below which moving agents count as crossing [m]."""
COLORS = ((214, 92, 20), (30, 96, 200), (40, 150, 90), (160, 60, 170))
"""Colours of the agents' paths, by the number of the agent."""
PAPER, INK, RIM = (250, 250, 248), (30, 30, 36), (255, 255, 255)
WIDTH_PX, VIEW_PX, PLAN_PX = 360, 270, 320
"""Sizes of a panel [px]: its width, the height of its picture, and the largest height of its plan."""
LABEL_PX, GAP_PX = 46, 8
SAID = {"pick": "picks", "place": "places"}


@dataclass(frozen=True, kw_only=True)
class KeyFrame:
    """Moment of an episode that a strip shows."""

    step: int
    text: str
    """Caption, such as ``robot picks mug_0``."""
    agents: tuple[int, ...]
    """Numbers of the agents that act; the camera follows the first."""


def moments_of(recording: Recording) -> list[KeyFrame]:
    """Return every pick and place of an episode, and the moment at which two agents cross, in order of time."""
    found = [
        KeyFrame(step=e.step, text=f"{_name(recording, e.agent)} {SAID[e.kind]} {e.target}", agents=(e.agent,))
        for e in recording.events
        if e.kind in SAID and e.agent >= 0
    ]
    crossing = crossing_of(recording)
    if crossing is not None:
        found.append(crossing)
    found.sort(key=lambda moment: moment.step)
    # the first and the last moments tell how an episode began and ended
    return found if len(found) <= MOST else found[: MOST // 2] + found[-MOST // 2 :]


def crossing_of(recording: Recording) -> KeyFrame | None:
    """Return the moment at which two moving agents pass closest; None if they are never within `PASSING_M`."""
    positions = [_positions(recording, k)[:, [0, 2]] for k in range(len(recording.agents))]
    moves = [_moves(xz, recording.episode.dt_ns / 1e9) for xz in positions]
    nearest: list[tuple[float, int, int, int]] = []
    for a, b in combinations(range(len(positions)), 2):
        apart = np.linalg.norm(positions[a] - positions[b], axis=1)
        # two who stand beside each other are always near, and cross nobody
        apart[~(moves[a] & moves[b])] = np.inf
        if len(apart):
            step = int(np.argmin(apart))
            nearest.append((float(apart[step]), step, a, b))
    distance, step, a, b = min(nearest, default=(np.inf, 0, 0, 0))
    if distance > PASSING_M:
        return None
    names = f"{_name(recording, a)} and {_name(recording, b)}"
    return KeyFrame(step=step, text=f"{names} cross, {distance:.1f} m", agents=(a, b))


def episode_strip(replay: Replay) -> NDArray[np.uint8]:
    """Return the moments of a recorded episode side by side, RGB [H, W, 3].

    Each moment has its time and caption at the top, a picture from a camera that follows the agent in the middle, and
    the plan with the paths of all agents until then at the bottom.

    Raises:
        InputError: nothing was picked or placed, or no scene was recorded.
    """
    moments = moments_of(replay.recording)
    if not moments:
        raise InputError(
            "Expected an episode in which something is picked or placed, or two agents cross: there is none.",
            code="H3-REPLAY-031",
        )
    if replay.scene is None:
        raise InputError("A strip needs the scene, and this recording has none.", code="H3-REPLAY-032")
    plan, camera = _plan(replay)
    paths = [_positions(replay.recording, k) for k in range(len(replay.recording.agents))]
    panels = []
    for moment in progress(moments, desc="draw", unit="moment", leave=False):
        drawn = plan.copy()
        for k, path in enumerate(paths):
            draw_polyline(drawn, camera, path[: moment.step + 1], COLORS[k % len(COLORS)], 2)
        for k, path in enumerate(paths):
            if np.isfinite(path[moment.step]).all():
                draw_circle(drawn, camera, path[moment.step], RIM, radius_px=8)
                draw_circle(drawn, camera, path[moment.step], COLORS[k % len(COLORS)], radius_px=6)
                if k in moment.agents:
                    draw_circle(drawn, camera, path[moment.step], INK, radius_px=11, thickness=2)
        panels.append(_panel(replay, moment, drawn))
    gap = np.full((panels[0].shape[0], GAP_PX, 3), PAPER, np.uint8)
    row = [part for panel in panels for part in (panel, gap)][:-1]
    strip = np.concatenate(row, axis=1)
    return np.concatenate([strip, _key(replay.recording, strip.shape[1])])


# --- parts of a panel ---------------------------------------------------------------------------------------------------
def _plan(replay: Replay) -> tuple[NDArray[np.uint8], Camera]:
    """Return the plan, pale so that paths stand out, at most as wide as a panel; and its camera."""
    from h3data.render.sheets.scene_map import plan_picture

    scene = replay.scene
    assert scene is not None
    floor_y = scene.rooms[0].floor_y if scene.rooms else float(scene.bounds[0][1])
    low, high = scene.bounds
    if scene.rooms:
        rectangles = np.concatenate([np.asarray(r.rectangles, np.float64) for r in scene.rooms])
        span = rectangles[:, 2:].max(0) - rectangles[:, :2].min(0)
    else:
        span = (high - low)[[0, 2]]
    # a scene of a single point still has a plan
    across, deep = np.maximum(span, 1.0) + 1.1  # the plan has a margin
    image, camera = plan_picture(scene, pixels_per_m=float(min(WIDTH_PX / across, PLAN_PX / deep)), floor_y=floor_y)
    grey = image.mean(-1, keepdims=True)
    return np.ascontiguousarray((0.40 * image + 0.15 * grey + 0.45 * 255).astype(np.uint8)), camera


def _panel(replay: Replay, moment: KeyFrame, plan: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return time and caption, the view of a camera that follows the agent, a gap, and the plan: RGB [H, W, 3]."""
    label = np.full((LABEL_PX, WIDTH_PX, 3), PAPER, np.uint8)
    _write(label, f"{moment.step * replay.recording.episode.dt_ns / 1e9:.1f} s", (4, 17), 0.5)
    _write(label, moment.text, (4, 37), 0.5)
    below = np.full((GAP_PX + plan.shape[0], WIDTH_PX, 3), PAPER, np.uint8)
    width = min(plan.shape[1], WIDTH_PX)
    left = (WIDTH_PX - width) // 2
    below[GAP_PX:, left : left + width] = plan[:, :width]
    return np.concatenate([label, _view(replay, moment), below])


def _view(replay: Replay, moment: KeyFrame) -> NDArray[np.uint8]:
    leader = replay.recording.agents[moment.agents[0]].name
    camera = camera_at(replay, f"{leader}/third_person", moment.step).resized(WIDTH_PX, VIEW_PX)
    track = CameraTrack(camera=camera, poses=camera.pose[None])
    return next(iter(replay.frames([track], [moment.step], samples=4)))[1][0]["rgb"]


def _key(recording: Recording, width: int) -> NDArray[np.uint8]:
    """Return the names of all agents beside the colours of their paths, as a row below the panels."""
    import cv2

    out, at = np.full((30, width, 3), PAPER, np.uint8), 10
    for k in range(len(recording.agents)):
        cv2.line(out, (at, 15), (at + 24, 15), COLORS[k % len(COLORS)], 3, cv2.LINE_AA)
        at += 32 + _write(out, _name(recording, k), (at + 32, 20), 0.45) + 20
    return out


def _write(image: NDArray[np.uint8], text: str, at: tuple[int, int], scale: float) -> int:
    """Write text with its baseline at a pixel, smaller where it would not fit; return its width."""
    import cv2

    (wide, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    scale *= min(1.0, (image.shape[1] - at[0] - 2) / max(wide, 1))
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1, cv2.LINE_AA)
    return wide


# --- agents -------------------------------------------------------------------------------------------------------------
def _name(recording: Recording, agent: int) -> str:
    name = recording.agents[agent].name
    return "person" if name == "human" else name


def _positions(recording: Recording, agent: int) -> Array:
    """Return the places of an agent, [T, 3] [m]."""
    return recording.agent_column(agent, "base_pose")[:, :3].astype(np.float64)


def _moves(xz: Array, dt: float) -> NDArray[np.bool_]:
    """Return whether an agent moves, [T], by its displacement [T, 2] around each step; ``dt`` [s] is the time of a step."""
    # over a second, so that an agent who sways on the spot does not count as moving
    steps, reach = np.arange(len(xz)), max(round(OVER_S / dt), 1)
    before, after = np.maximum(steps - reach, 0), np.minimum(steps + reach, len(xz) - 1)
    moved = np.linalg.norm(xz[after] - xz[before], axis=1)
    return moved > MOVES_MPS * np.maximum(after - before, 1) * dt


def draw_circle(
    image: NDArray[np.uint8], camera: Camera, point: ArrayLike, color: Color, *, radius_px: int = 5, thickness: int = -1
) -> None:
    """Draw a dot (``thickness`` -1) or circle at a world point [3] [m], unless it is behind the camera."""
    import cv2

    at = pixel_of(image, camera, point)
    if at is not None:
        cv2.circle(image, at, radius_px, color, thickness, cv2.LINE_AA)
