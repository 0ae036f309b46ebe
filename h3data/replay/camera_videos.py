"""Videos of an episode from named cameras, rendered for datasets: `h3data.recording.DatasetWriter.add` copies them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.rigid_parts import PeopleStyle
from h3data.errors import InputError
from h3data.recording import Recording
from h3data.recording.parquet.moments import QUANTILES, Moments
from h3data.recording.parquet.videos import EpisodeVideo, VideoFeature
from h3data.render import VideoWriter
from h3data.render.light.sources import LightMode
from h3data.replay import CameraTrack, Replay, camera_track
from h3data.replay.cameras import split_size
from h3data.replay.stage import FrameBackend

KEY_FRAMES = 10
"""Number of frames from one key frame to the next. Reading a random frame in training takes 1.7 ms at 640x480, 4.8 ms
with a value of 30, and 0.7 ms with a value of 2, for which files are 1.5 times as large."""


def render_videos(
    recording: Recording,
    cameras: Sequence[str],
    folder: Path,
    *,
    steps: int | None = None,
    threads: int = 1,
    assets: Sequence[Path] = (),
    people: PeopleStyle = "skin",
    stand_ins: bool = False,
    light: LightMode = "baked",
    backend: FrameBackend = "cpu",
    progress: Callable[[Iterable[Any], int], Iterable[Any]] = lambda frames, total: frames,
) -> list[EpisodeVideo]:
    """Render the first ``steps`` steps (default: all) from each camera into ``folder``, ``<camera>.mp4``.

    The same recording gives the same bytes, with any number of threads. Memory does not grow with its length.

    Args:
        recording: The episode; without steps there are no videos.
        cameras: Names as in ``h3data rerender``, or camera files. Only their colours are stored.
        folder: Existing folder for the files.
        steps: Number of steps.
        threads: Number of threads that render.
        assets: Folders below which recorded asset files are searched.
        people: Appearance of people: ``skin``, ``capsules`` or ``bones``.
        stand_ins: True to replace missing assets by plain ones, as in `Replay`.
        light: ``flat`` or ``baked`` (`h3data.render.light`).
        backend: Back end that renders (`h3data.replay.stage.chosen_backend`).
        progress: Function that wraps the iterable of frames.

    Raises:
        InputError: there is no such camera, or two have the same name.
    """
    count = len(recording) if steps is None else steps
    if not count:
        return []
    replay = Replay(recording, assets=assets, people=people, light=light, stand_ins=stand_ins)
    tracks, fps = camera_tracks(replay, cameras), round(1e9 / max(recording.episode.dt_ns, 1))
    with ExitStack() as stack:
        writers = [
            stack.enter_context(
                VideoWriter(
                    folder / f"{track.camera.name}.mp4",
                    track.camera.width,
                    track.camera.height,
                    fps,
                    # a mean PSNR of 36 dB at 224x172 and 41 dB at 640x480, most of it lost with the colours' resolution
                    crf=20,
                    key_frames=KEY_FRAMES,
                )
            )
            for track in tracks
        ]
        histograms = np.zeros((len(tracks), 3, 256), np.int64)

        def prepare(step: int, images: list[dict[str, NDArray[Any]]]) -> list[Any]:
            # in the thread that rendered: the conversion to YUV and the histogram, number of pixels of each value [3, 256]
            rgbs = [image["rgb"] for image in images]
            counted = [np.stack([np.bincount(rgb[..., c].ravel(), minlength=256) for c in range(3)]) for rgb in rgbs]
            return [(writer.planes(rgb), counts) for writer, rgb, counts in zip(writers, rgbs, counted, strict=True)]

        frames = replay.stage.frames(
            tracks, range(count), outputs=("rgb",), threads=threads, then=prepare, backend=backend
        )
        for _, prepared in progress(frames, count):
            for writer, total, (planes, histogram) in zip(writers, histograms, prepared, strict=True):
                writer.write_planes(planes)
                total += histogram
    return [
        EpisodeVideo(
            feature=VideoFeature(
                camera=track.camera.name,
                # the writer pads odd sides by a pixel, since 4:2:0 has one colour for 2x2 pixels
                width=writer.width + writer.width % 2,
                height=writer.height + writer.height % 2,
            ),
            path=writer.path,
            length=count,
            fps=fps,
            moments=_moments(histogram),
        )
        for track, writer, histogram in zip(tracks, writers, histograms, strict=True)
    ]


def camera_tracks(replay: Replay, cameras: Sequence[str]) -> list[CameraTrack]:
    """Return the tracks of cameras by name or file.

    Raises:
        InputError: there is no such camera, two have the same name, or a camera has no colour images.
    """
    tracks = []
    for name in cameras:
        try:
            tracks.append(camera_track(replay, name))
            _, size = split_size(name)
        except InputError as error:
            if name.rpartition("_")[2].rpartition(".")[2] in ("depth", "instance", "semantic"):
                raise InputError(
                    f"Videos of a dataset hold colours: 8 bits and lossy compression would ruin depth and ids. Hint: h3data "
                    f"rerender --outputs depth,instance --format data stores them without loss. {error}",
                    code="H3-EXPORT-002",
                ) from None
            raise
        # a policy that learns from padded pictures must not be shown others later
        if size is not None and any(side % 2 for side in size):
            raise InputError(
                f"Videos have even sides, and a policy must be shown what they hold: expected an even width and height, "
                f"got {name}.",
                code="H3-EXPORT-038",
            )
    names = [track.camera.name for track in tracks]
    if len(set(names)) < len(names):
        raise InputError(f"Expected each camera once, got: {', '.join(names)}.", code="H3-EXPORT-001")
    return tracks


def _moments(histogram: NDArray[np.int64]) -> Moments:
    """Return moments of the channels in 0..1, as LeRobot decodes them, from the histogram of all their pixels."""
    # 256 counts for each channel instead of the pixels of a whole video
    values, counts = np.arange(256) / 255.0, histogram.astype(np.float64)
    total = counts.sum(1)
    # exact for 8-bit pixels: the histogram holds all that the pixels do, except their places
    mean = counts @ values / total
    m2 = (counts * (values - mean[:, None]) ** 2).sum(1)
    present = histogram > 0
    reached = np.cumsum(counts, 1)[None] >= np.array(list(QUANTILES.values()))[:, None, None] * total[:, None]
    low, high = values[present.argmax(1)], values[255 - present[:, ::-1].argmax(1)]
    return Moments(total, mean, m2, low, high, values[reached.argmax(2)])
