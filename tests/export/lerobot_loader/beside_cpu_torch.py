"""Lets lerobot 0.4.4 run beside the CPU build of torch: the operators that its torchvision declares, and a reader of videos
that torchvision has dropped.

``python beside_cpu_torch.py lerobot_train ARGUMENTS`` runs a command of lerobot.
"""

from __future__ import annotations

import importlib
import sys

import torch

# torchvision's operators need the CUDA build of torch, and so does torchcodec; lerobot imports the first for pictures.
_operators = torch.library.Library("torchvision", "DEF")
for _name in ("nms", "qnms"):
    _operators.define(f"{_name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

import torchvision  # noqa: E402


class VideoReader:
    """torchvision's reader of that name with the backend pyav, which lerobot calls and torchvision has dropped since 0.26."""

    def __init__(self, path: str, stream: str) -> None:
        import av

        assert stream == "video"
        self.container = av.open(path)
        self._frames = self.container.decode(video=0)

    def seek(self, time_s: float, keyframes_only: bool = False) -> VideoReader:
        self.container.seek(int(time_s * 1e6), any_frame=not keyframes_only)
        self._frames = self.container.decode(video=0)
        return self

    def __iter__(self) -> VideoReader:
        return self

    def __next__(self) -> dict[str, object]:
        frame = next(self._frames)
        picture = torch.from_numpy(frame.to_ndarray(format="rgb24")).permute(2, 0, 1)
        return {"data": picture, "pts": float(frame.pts * frame.time_base)}


if not hasattr(torchvision.io, "VideoReader"):
    torchvision.io.VideoReader = VideoReader
    torchvision.set_video_backend = lambda backend: None

if __name__ == "__main__":
    sys.argv = sys.argv[1:]
    importlib.import_module(f"lerobot.scripts.{sys.argv[0]}").main()
