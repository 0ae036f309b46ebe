"""Frame loop that renders recordings into files on all cores, and trajectories over top-down images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.progress import progress
from h3data.replay import CameraTrack, Replay
from h3data_pipelines.outputs import Target, ToPicture

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from h3data.render import Camera, Output
    from h3data.render.overlay import Color
    from h3data.replay.stage import FrameBackend

AGENT_COLORS: dict[str, Color] = {"robot": (255, 176, 32), "human": (64, 150, 255)}
TRAJECTORY_STRIDE = 6
"""Number of steps between the points of a trajectory in a picture (0.2 s)."""
DEPTH_RANGE_M = (0.0, 10.0)


def render_files(
    replay: Replay,
    views: Sequence[tuple[CameraTrack, Sequence[Target]]],
    *,
    steps: range,
    threads: int = 2,
    annotate: bool = True,
    samples: Literal[1, 4] = 1,
    description: str = "render",
    frame_done: Callable[[], object] | None = None,
    backend: FrameBackend = "cpu",
) -> None:
    """Render ``steps`` from every camera into its targets.

    ``threads`` threads pose, render and prepare frames (colour maps, PNG and FFV1 encoding); each H.264 or AV1 video
    has one additional encoder thread. Only a few frames are processed at a time, so memory stays constant. The files do
    not depend on the number of threads, and they get their final names only when complete.

    If ``frame_done`` is given, it is called after each frame; otherwise a progress bar with ``description`` is shown.
    """
    from h3data.replay.stage import WORLDS, chosen_backend

    # a GPU draws many steps at once, and the next ones while these are encoded; one thread of x264 is slower than the GPU
    queue_length, encoder_threads = (WORLDS, 3) if chosen_backend(backend) == "gpu" else (4, 1)
    outputs: list[Output] = list(dict.fromkeys(target.output for _, targets in views for target in targets))
    fps = frames_per_second(replay, steps)
    with ExitStack() as stack:
        sinks, encoders, writes = [], [], []
        for n, (track, targets) in enumerate(views):
            for target in targets:
                picture = _picture(replay, track, target, steps[0], annotate=annotate)
                sink = stack.enter_context(target.open(track.camera, fps, picture, encoder_threads=encoder_threads))
                sinks.append((n, target.output, sink))
                if target.colored:
                    encoders.append(stack.enter_context(_InOrder(sink.write, queue_length)))
                # what is encoded when it is prepared need not wake a thread, which takes 0.1 ms
                writes.append(encoders[-1].submit if target.colored else sink.write)

        def prepare(step: int, pictures: list[dict[str, NDArray[Any]]]) -> list[Any]:
            return [sink.prepare(pictures[n][output], step) for n, output, sink in sinks]

        frames = replay.stage.frames(
            [track for track, _ in views],
            steps,
            outputs=outputs,
            samples=samples,
            threads=threads,
            then=prepare,
            backend=backend,
        )
        shown = progress(frames, total=len(steps), desc=description, unit="frame") if frame_done is None else frames
        for _, prepared in shown:
            for write, frame in zip(writes, prepared, strict=True):
                write(frame)
            if frame_done is not None:
                frame_done()
        for encoder in encoders:
            encoder.finish()


class _InOrder:
    """A thread that applies ``work`` to items in the order of submission, with a bounded queue."""

    def __init__(self, work: Callable[[Any], None], queue_length: int) -> None:
        self._work, self._queue_length = work, queue_length
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="h3data-encode")
        self._pending: list[Future[None]] = []

    def submit(self, item: Any) -> None:
        """Queue an item, waiting while the queue is full; raise what ``work`` raised for an earlier item."""
        while len(self._pending) >= self._queue_length:
            self._pending.pop(0).result()
        self._pending.append(self._pool.submit(self._work, item))

    def finish(self) -> None:
        """Wait until all items are done; raise what ``work`` raised."""
        while self._pending:
            self._pending.pop(0).result()

    def __enter__(self) -> _InOrder:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)


def frames_per_second(replay: Replay, steps: range) -> float:
    """Return the frame rate for ``steps`` in real time [Hz], but at least 1, because players reject lower rates."""
    times = replay.recording.columns["time_ns"]
    return max(1e9 / float(np.median(np.diff(times))) / steps.step, 1.0) if len(times) > 1 else 30.0


def _picture(replay: Replay, track: CameraTrack, target: Target, first: int, *, annotate: bool) -> ToPicture:
    """Return the conversion from a rendered image to the stored one."""
    from h3data.render import depth_to_rgb, instance_to_rgb
    from h3data.render.image_files import depth_to_mm, stored_ids
    from h3data_pipelines.pictures.depth_scale import draw_depth_scale

    if target.output == "rgb" and annotate and track.camera.name == "top_down":

        def with_trajectories(image: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
            draw_trajectories(image, replay, track, step)
            return image

        return with_trajectories
    if target.output == "rgb":
        return lambda image, _: image
    if target.output == "depth" and target.colored:
        stage = replay.stage
        (view,) = stage.render(stage.renderer(), first, [track.at(first)], outputs=("depth",))
        near, far = depth_range(view["depth"])

        def with_scale(image: NDArray[np.float32], _: int) -> NDArray[np.uint8]:
            picture = depth_to_rgb(image, near, far)
            if annotate:
                draw_depth_scale(picture, near, far)
            return picture

        return with_scale
    if target.output == "depth":
        return lambda image, _: depth_to_mm(image)
    return lambda image, _: instance_to_rgb(image) if target.colored else stored_ids(image)


def depth_range(depth: NDArray[np.float32]) -> tuple[float, float]:
    """Return the nearest and the farthest depth of a depth video's colour scale [m].

    The scale is 0 to 10 m, so that videos are comparable. If the median depth is larger, as for cameras high above a
    home, the scale spans the depths of the image instead.
    """
    hits = depth[depth > 0]
    if not len(hits) or np.median(hits) <= DEPTH_RANGE_M[1]:
        return DEPTH_RANGE_M
    near, far = np.percentile(hits, (0.5, 99.5))
    return float(near), float(max(far, near + 0.5))


def draw_trajectories(image: NDArray[np.uint8], replay: Replay, track: CameraTrack, step: int) -> None:
    """Draw each agent's trajectory up to ``step`` and its name on ``image`` [H, W, 3], in place."""
    from h3data.render.overlay import draw_polyline

    camera = track.at(step)
    for index, agent in enumerate(replay.recording.agents):
        base = replay.recording.agent_column(index, "base_pose")[: step + 1, :3].astype(np.float64)
        base = base[np.isfinite(base).all(-1)]
        if not len(base):
            continue
        color = AGENT_COLORS[agent.kind]
        line = base[::TRAJECTORY_STRIDE] + np.array([0.0, 0.03, 0.0])
        draw_polyline(image, camera, np.concatenate([line, base[-1:]]), color=color, thickness=2)
        above = base[-1] - camera.pose[:3, 1] * 0.55  # the camera's y axis points down in the image
        draw_label(image, camera, above, agent.name, color=color, scale=0.6)


def draw_label(
    image: NDArray[np.uint8], camera: Camera, point: ArrayLike, text: str, color: Color, *, scale: float = 0.45
) -> None:
    """Write ``text`` centred above a world point [3] [m], with a dark outline, unless it is behind the camera."""
    import cv2

    from h3data.render.overlay import pixel_of

    at = pixel_of(image, camera, point)
    if at is None:
        return
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    origin = (at[0] - width // 2, at[1] - 6)
    # the same text twice, first thicker and dark: it can be read on any background
    for rim, paint in ((3, (20, 20, 20)), (1, color)):
        cv2.putText(image, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, paint, rim, cv2.LINE_AA)
