"""The paper's network for training and play: ResNet18 for pictures (He et al. 2016), two layers of LSTM, a linear head.

As in Wijmans et al. 2019, the residual network is half as wide as the original, has group instead of batch norms, and gets the
picture in half its size. Its features are squeezed to about 2,048 numbers and then to 512.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from h3data.geometry import Array
from sim_kinematic.policies.visual_policy import (
    PICTURES,
    PolicyCard,
    VisualPolicy,
    number_count,
    picture_in,
    picture_of,
)

GROUPS = 16
"""Number of groups of a normalisation layer; numbers of planes are multiples of it."""
LAYERS = 2


class _Norm(nn.GroupNorm):
    """Group normalisation that keeps the precision of its input, with sums of 32 bits.

    Autocast would return 32 bits, which everything up to the next convolution would then have to read and write.
    """

    def forward(self, input: Tensor) -> Tensor:
        if input.dtype == torch.float32:
            return super().forward(input)
        with torch.autocast(input.device.type, enabled=False):
            return F.group_norm(
                input, self.num_groups, self.weight.to(input.dtype), self.bias.to(input.dtype), self.eps
            )


class _Block(nn.Module):
    """Residual block of two convolutions (He et al. 2016, section 3.3); a stride or other planes need a convolution to skip."""

    def __init__(self, given: int, planes: int, stride: int) -> None:
        super().__init__()
        self.conv_0 = nn.Conv2d(given, planes, 3, stride, 1, bias=False)
        self.norm_0 = _Norm(GROUPS, planes)
        self.conv_1 = nn.Conv2d(planes, planes, 3, 1, 1, bias=False)
        self.norm_1 = _Norm(GROUPS, planes)
        self.skip = nn.Conv2d(given, planes, 1, stride, bias=False) if stride > 1 or given != planes else None
        self.skip_norm = None if self.skip is None else _Norm(GROUPS, planes)

    def forward(self, x: Tensor) -> Tensor:
        inner = self.norm_1(self.conv_1(F.relu(self.norm_0(self.conv_0(x)))))
        if self.skip is not None and self.skip_norm is not None:
            x = self.skip_norm(self.skip(x))
        return F.relu(inner + x)


class ResNet18(nn.Module):
    """Residual network for pictures: [n, 1 or 3, H, W] -> features [n, F]."""

    def __init__(self, size: tuple[int, int], *, given: int, planes: int, features: int) -> None:
        """Make a network for pictures of a ``size`` (width, height) [pixels], with ``planes`` in the first stage."""
        super().__init__()
        self.first = nn.Conv2d(given, planes, 7, 2, 3, bias=False)
        self.norm = _Norm(GROUPS, planes)
        widths = [planes, planes, 2 * planes, 4 * planes, 8 * planes]
        self.blocks = nn.ModuleList(
            _Block(widths[k] if half == 0 else widths[k + 1], widths[k + 1], 2 if k and half == 0 else 1)
            for k in range(4)
            for half in range(2)
        )
        # positions that are left of a picture [pixels]:
        # halved once by the pooling of the input, which drops an odd row, and five times by layers with a margin, which keep it
        width, height = (side // 2 for side in size)
        for _ in range(5):
            width, height = -(-width // 2), -(-height // 2)
        places = width * height
        # planes of which a picture has about 2,048 values before the last layer, whatever its size
        squeezed = max(round(2048 / places), GROUPS)
        self.squeeze = nn.Conv2d(widths[-1], squeezed, 3, 1, 1, bias=False)
        self.squeeze_norm = _Norm(1, squeezed)
        self.out = nn.Linear(squeezed * places, features)

    def forward(self, x: Tensor) -> Tensor:
        """Return features [n, F] of pictures [n, 1 or 3, H, W]."""
        x = F.max_pool2d(F.relu(self.norm(self.first(F.avg_pool2d(x, 2)))), 3, 2, 1)
        for block in self.blocks:
            x = block(x)
        return F.relu(self.out(F.relu(self.squeeze_norm(self.squeeze(x))).flatten(1)))


class ResNetLSTM(nn.Module):
    """Network of the actor, whose state [n, S] has the states of all LSTM layers, one after the other."""

    def __init__(
        self,
        numbers: int,
        *,
        size: tuple[int, int] | None,
        given: int = 1,
        planes: int = 32,
        features: int = 512,
        hidden: int = 512,
    ) -> None:
        """Create a network for ``numbers`` values, and for pictures of a ``size`` (width, height) [pixels].

        If ``size`` is None, there are no pictures.
        """
        super().__init__()
        self.visual = None if size is None else ResNet18(size, given=given, planes=planes, features=features)
        self.lstm = nn.LSTM((0 if size is None else features) + numbers, hidden, LAYERS)
        self.act = nn.Linear(hidden, 2)
        self.state_length = 2 * LAYERS * hidden

    def features(self, pixels: Tensor | None, numbers: Tensor) -> Tensor:
        """Return the input of the recurrent layers, [n, F], for pictures [n, planes, H, W] and numbers [n, N]."""
        if self.visual is None or pixels is None:
            return numbers
        with torch.autocast(pixels.device.type, torch.bfloat16, enabled=pixels.is_cuda):
            # without autocast, weights of 32 bits take no pictures in half precision
            whole = pixels if pixels.is_cuda else pixels.float()
            seen = self.visual(whole.contiguous(memory_format=torch.channels_last))
        return torch.cat([seen.float(), numbers], -1)

    def remember(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the recurrent layers' outputs [T, n, H] for features [T, n, F], and the last state [n, S]."""
        # a state holds the h of all layers, then their c, and LSTM takes them layer by layer
        long, short = state.unflatten(1, (2 * LAYERS, -1)).transpose(0, 1).contiguous().chunk(2)
        out, (long, short) = self.lstm(x, (long, short))
        return out, torch.cat([long, short]).transpose(0, 1).flatten(1)

    def take(self, arrays: Mapping[str, Any]) -> None:
        """Replace all weights with arrays or tensors, by name."""
        with torch.no_grad():
            for name, tensor in self.named_parameters():
                tensor.copy_(torch.as_tensor(arrays[name]))


def pixels_of(picture: Tensor) -> Tensor:
    """Convert depth or uint8 colours [n, H, W, planes] to the network's input [n, planes, H, W] in half precision.

    Devices store the pictures of whole rollouts in this form.
    """
    seen = picture.float() if picture.shape[-1] == 1 else picture.float() / 255
    return seen.permute(0, 3, 1, 2).half()


class ResNetPolicy(VisualPolicy):
    """Policy in a file whose card names the ResNet-LSTM network, evaluated by PyTorch in one thread."""

    kind = "resnet18_lstm"

    def start(self) -> Array:
        """Return the recurrent state at the start of an episode [H]."""
        return np.zeros(2 * LAYERS * self.arrays["lstm.weight_hh_l0"].shape[1], np.float32)

    def __call__(self, shown: Mapping[str, NDArray[Any]], last: Array, state: Array) -> tuple[Array, Array]:
        """Return the action [n] and next state [H] for observations by name, the last action [n] and the state [H]."""
        numbers = torch.as_tensor(self._numbers(shown, last))[None]
        pixels = (
            pixels_of(torch.as_tensor(np.ascontiguousarray(picture_of(self.card, shown)))[None]) if self.sees else None
        )
        with torch.no_grad(), one_thread():
            x = self._net.features(pixels, numbers)
            out, after = self._net.remember(x[None], torch.as_tensor(state)[None])
            return self._net.act(out[0, 0]).numpy(), after[0].numpy()

    @cached_property
    def _net(self) -> ResNetLSTM:
        """Network with the weights of the file, made at the first evaluation."""
        net = _net(self.card, self.arrays)
        net.take(self.arrays)
        return net.eval()

    @classmethod
    def shapes(cls, card: PolicyCard, arrays: Mapping[str, Array]) -> dict[str, tuple[int, ...]]:
        """Return the shapes of all weights by name, for the sizes in a card."""
        # on the device "meta" a network has shapes and no numbers, so a card with huge sizes costs no memory
        with torch.device("meta"):
            net = _net(card, arrays)
        return {name: tuple(tensor.shape) for name, tensor in net.named_parameters()}

    @classmethod
    def size_fault(cls, size: tuple[int, int]) -> str:
        """Return a text with the supported sizes of pictures if ``size`` is not one of them; otherwise empty."""
        return "" if all(8 <= side <= 1024 for side in size) else "sides of 8 to 1024"


def _net(card: PolicyCard, arrays: Mapping[str, Array]) -> ResNetLSTM:
    """Return an untrained network with the widths of the arrays; for arrays that are missing, with the least widths."""

    def rows(name: str, other: int) -> int:
        return arrays[name].shape[0] if name in arrays and arrays[name].ndim else other

    sees = picture_in(card.observations)
    # whole groups: others make GroupNorm raise before the shapes can be compared
    planes = max(rows("visual.first.weight", GROUPS) // GROUPS, 1) * GROUPS
    return ResNetLSTM(
        number_count(card.observations),
        size=card.picture_size if sees else None,
        given=PICTURES[sees or "arm_depth"],
        planes=planes,
        features=max(rows("visual.out.weight", 1), 1),
        # an LSTM stacks the weights of its four gates
        hidden=max(rows("lstm.weight_hh_l0", 4) // 4, 1),
    )


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit PyTorch to one thread, so that sums have a fixed order and no threads wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
