"""Replay of recordings: poses of all objects at any step, and images from any camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

from numpy.typing import NDArray

from h3data.replay.posed_recording import PosedRecording
from h3data.replay.records import CameraTrack

if TYPE_CHECKING:
    from h3data.render import Output
    from h3data.replay.stage import FrameBackend, Stage


class Replay(PosedRecording):
    """Poses and images of a recording; see `PosedRecording` for the arguments."""

    @cached_property
    def stage(self) -> Stage:
        """Scene from which images are rendered, built at first use and shared by all threads."""
        from h3data.replay.stage import Stage

        return Stage(self)

    def frames(
        self,
        tracks: Sequence[CameraTrack],
        steps: Sequence[int],
        *,
        outputs: Sequence[Output] = ("rgb",),
        samples: Literal[1, 4] = 1,
        threads: int = 1,
        backend: FrameBackend = "cpu",
    ) -> Iterator[tuple[int, list[dict[str, NDArray[Any]]]]]:
        """Yield ``(step, [outputs of each camera])`` in the order of ``steps``.

        Only a few frames are rendered ahead, so memory does not grow with the length of the recording. The images do not
        depend on the number of ``threads``. ``backend`` is ``cpu``, ``gpu`` (h3data docs gpu), or ``auto``: a GPU if there
        is one.

        Raises:
            InputError: a step is outside the recording, or there is no GPU for ``gpu``.
        """
        for step in steps:
            if not 0 <= step < len(self):
                raise self._no_such_step(step)
        yield from self.stage.frames(tracks, steps, outputs=outputs, samples=samples, threads=threads, backend=backend)
