"""Output files of a camera: videos for viewing, lossless videos, or numbered pictures."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, get_args

from numpy.typing import NDArray

from h3data.errors import InputError

if TYPE_CHECKING:
    from h3data.commands.command import BackendOption
    from h3data.render import Camera, Output, VideoWriter

Form = Literal["h264", "av1", "ffv1", "png"]
Format = Literal["mp4", "av1", "png", "data"]
ToPicture = Callable[[NDArray[Any], int], NDArray[Any]]
"""Function that converts the rendered image of a step to the stored one."""

OutputName = Literal["rgb", "depth", "instance", "semantic"]
OUTPUTS: tuple[OutputName, ...] = get_args(OutputName)
_FORMS: Mapping[Format, tuple[Form, Form, Form]] = {
    "mp4": ("h264", "h264", "h264"),
    "av1": ("av1", "av1", "av1"),
    "png": ("png", "png", "png"),
    "data": ("h264", "ffv1", "png"),
}
"""Forms of colours, depth and ids."""
_SUFFIXES = {"h264": ".mp4", "av1": ".mp4", "ffv1": ".mkv", "png": ""}


@dataclass(frozen=True)
class Target:
    """Output of one camera with its file, or its folder for numbered pictures."""

    output: Output
    form: Form
    path: Path

    @classmethod
    def named(cls, folder: Path, stem: str, camera: str, output: Output, format: Format) -> Target:
        """Return the target ``<folder>/<stem>.<camera>.<output>`` with the suffix of its format."""
        form = _FORMS[format][min(OUTPUTS.index(output), 2)]
        return cls(output, form, folder / f"{stem}.{camera}.{output}{_SUFFIXES[form]}")

    @property
    def colored(self) -> bool:
        """Return whether depth and ids are stored as colours."""
        return self.form in ("h264", "av1")

    @property
    def meaning(self) -> str:
        """Meaning of the stored values."""
        if self.output == "rgb":
            return "sRGB"
        if self.colored:
            return "colours of depth, to look at" if self.output == "depth" else "one colour for each id, to look at"
        return "z-depth in millimetres, 0 = nothing hit" if self.output == "depth" else "id + 1, 0 = nothing hit"

    def open(
        self, camera: Camera, fps: float, picture: ToPicture, *, encoder_threads: int = 1
    ) -> AbstractContextManager[Sink]:
        """Provide a sink for the frames, whose file gets its final name at the end of the block unless an error occurs.

        ``encoder_threads`` is the number of threads of an H.264 encoder, on which the bytes of the file depend.
        """
        if self.form == "png":
            return _open_folder(self.path, picture, ids=self.output in ("instance", "semantic"))
        return _open_video(self, camera, fps, picture, encoder_threads)


class Sink(Protocol):
    """Storage of frames in two steps, preparation and writing."""

    def prepare(self, image: NDArray[Any], step: int) -> Any:
        """Return a frame prepared for `write`; this part of the work can run in any thread and any order."""
        ...

    def write(self, frame: Any) -> None:
        """Store a frame; called in the order of frames."""
        ...


@dataclass(frozen=True)
class _VideoSink:
    writer: VideoWriter
    picture: ToPicture

    def prepare(self, image: NDArray[Any], step: int) -> NDArray[Any]:
        return self.writer.planes(self.picture(image, step))

    def write(self, frame: NDArray[Any]) -> None:
        self.writer.write_planes(frame)


@contextmanager
def _open_video(target: Target, camera: Camera, fps: float, picture: ToPicture, encoder_threads: int) -> Iterator[Sink]:
    from h3data.render import VideoWriter

    assert target.form != "png"
    size = camera.width, camera.height
    with VideoWriter(target.path, *size, fps, codec=target.form, threads=encoder_threads) as writer:
        yield _VideoSink(writer, picture)


@dataclass(frozen=True)
class _FolderSink:
    folder: Path
    picture: ToPicture
    ids: bool

    def prepare(self, image: NDArray[Any], step: int) -> None:
        from h3data.render.image_files import png_bytes
        from h3data_pipelines.pictures.id_png import id_png_bytes

        encoded = (id_png_bytes if self.ids else png_bytes)(self.picture(image, step))
        # under its name at once: the folder has its own name only when it is complete
        with open(f"{self.folder}/{step:06d}.png", "wb") as file:
            file.write(encoded)

    def write(self, frame: None) -> None:
        pass


@contextmanager
def _open_folder(target: Path, picture: ToPicture, *, ids: bool) -> Iterator[Sink]:
    """Yield a folder of pictures that gets the name ``target`` when it is complete, replacing older pictures."""
    part = target.with_name(target.name + ".part")
    for folder in (part, target):
        others = [p for p in folder.glob("*") if not re.fullmatch(r"\d{6,}\.png(\.part)?", p.name)]
        if others:
            raise InputError(
                f"The output folder holds files that are not numbered pictures. Move them away: {others[0]}",
                code="H3-OPTION-066",
            )
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        yield _FolderSink(part, picture, ids)
    except OSError:
        raise
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    if target.exists():
        shutil.rmtree(target)
    part.rename(target)


def check_backend(backend: BackendOption) -> None:
    """Raise an `InputError` if the back end is ``gpu`` and there is no GPU."""
    if backend != "cpu":
        from h3data.replay.stage import chosen_backend

        chosen_backend(backend)
