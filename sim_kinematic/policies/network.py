"""Small neural network in a file, with named observations as input, for ``--policy weights:FILE``.

The file is an npz of plain arrays (`save_network` lists them). It has no pickle and no code, so nothing in it is
executed when it is read. PyTorch is not needed; `from_torch` converts a network that was trained there.
"""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import FormatError, InputError
from h3data.files import part_file

FILE_FORMAT = "h3data.network/1"
HINT = "Hint: h3data train writes one, or sim_kinematic.policies.network.save_network."
RUN_POLICY = "policy.npz"
"""Name of the policy file in the folder of a training run."""
PLANES = ".planes"
"""Suffix of the name of a float32 array that is stored as planes of its bytes (`from_planes`)."""
MAX_BYTES = 256 << 20
"""Total size of arrays above which a file is refused [bytes]."""
Activation = Literal["tanh", "relu"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Network:
    """A multi-layer perceptron: ``W_n f(... f(W_1 (x - mean) / scale + b_1) ...) + b_n``, in float32."""

    task: str
    """Task of the policy: ``social_nav`` or ``rearrange``."""
    observations: tuple[str, ...]
    """Names of the observations that make up the input, which are concatenated in this order."""
    weights: tuple[NDArray[np.float32], ...]
    """Weights of each layer, [out, in], as in `torch.nn.Linear`."""
    biases: tuple[NDArray[np.float32], ...]
    """Biases of each layer, [out]."""
    activation: Activation = "tanh"
    """Activation function between layers; the last layer has none."""
    mean: NDArray[np.float32] = field(default_factory=lambda: np.zeros(1, np.float32))
    """Numbers that are subtracted from the inputs, [in] or [1]."""
    scale: NDArray[np.float32] = field(default_factory=lambda: np.ones(1, np.float32))
    """Positive numbers by which the inputs are divided after the subtraction of ``mean``, [in] or [1]."""

    def __post_init__(self) -> None:
        # here and not in the readers of files, so that networks made by hand or by training are checked too
        faults = self._faults()
        if faults:
            raise InputError(f"These layers make no network: {'; '.join(faults)}.", code="H3-POLICY-025")

    @property
    def inputs(self) -> int:
        """Length of the input."""
        return self.weights[0].shape[1]

    @property
    def outputs(self) -> int:
        """Length of the output."""
        return len(self.biases[-1])

    @property
    def digest(self) -> str:
        """SHA-256 of everything that determines the network's behaviour."""
        found = sha256(repr((self.task, self.observations, self.activation)).encode())
        for array in (*self.weights, *self.biases, self.mean, self.scale):
            found.update(repr(array.shape).encode() + array.tobytes())
        return found.hexdigest()

    def __call__(self, x: ArrayLike) -> NDArray[np.float32]:
        """Return outputs [..., out] for inputs [..., in].

        Raises:
            InputError: The input has another length.
        """
        y = np.asarray(x, np.float32)
        if y.shape[-1:] != (self.inputs,):
            raise InputError(
                f"The network takes {self.inputs} numbers, got an input of shape {list(y.shape)}.", code="H3-POLICY-026"
            )
        # no warnings: a result that is not finite tells the caller
        with np.errstate(over="ignore", invalid="ignore"):
            y = (y - self.mean) / self.scale
            for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
                y = y @ weight.T + bias
                if k + 1 < len(self.weights):
                    y = np.tanh(y) if self.activation == "tanh" else np.maximum(y, 0.0)
        return y

    def __repr__(self) -> str:
        sizes = " - ".join(str(n) for n in (self.inputs, *(len(b) for b in self.biases)))
        return f"Network({self.task}, {', '.join(self.observations)}: {sizes}, {self.activation})"

    def _faults(self) -> list[str]:
        """Return parts of a network that do not fit together, in words."""
        faults: list[str] = []
        if self.activation not in get_args(Activation):
            faults.append(f"the activation is {self.activation!r}, expected one of {', '.join(get_args(Activation))}")
        if not self.observations:
            faults.append("it has no observations")
        if not self.weights or len(self.weights) != len(self.biases):
            return [
                *faults,
                f"{len(self.weights)} weights and {len(self.biases)} biases, expected as many, at least one",
            ]
        # from layer to layer: the outputs of one are the inputs of the next
        # -1 fits no layer: all faults are collected, and none raises here
        width = self.weights[0].shape[1] if self.weights[0].ndim == 2 else -1
        for name in ("mean", "scale"):
            shape = getattr(self, name).shape
            if shape not in ((1,), (width,)):
                faults.append(f"{name} has the shape {list(shape)}, expected [1] or [{width}]")
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if weight.ndim != 2 or bias.ndim != 1 or weight.shape != (len(bias), width) or not weight.size:
                faults.append(
                    f"layer {k} has weights {list(weight.shape)} and biases {list(bias.shape)} for {width} inputs"
                )
            width = bias.shape[0] if bias.ndim else -1
        arrays = (*self.weights, *self.biases, self.mean, self.scale)
        if any(a.dtype != np.float32 for a in arrays):
            faults.append("all arrays must be float32")
        elif not all(np.isfinite(a).all() for a in arrays) or not (self.scale > 0).all():
            faults.append("all numbers must be finite, and the scale positive")
        return faults


# --- PyTorch ------------------------------------------------------------------------------------------------------------
def from_torch(
    layers: Iterable[Any],
    *,
    task: str,
    observations: Iterable[str],
    mean: ArrayLike = (0.0,),
    scale: ArrayLike = (1.0,),
) -> Network:
    """Return the network of a `torch.nn.Sequential` of `Linear` layers with `Tanh` or `ReLU` between them.

    Raises:
        InputError: The module has other layers.
    """
    from torch import nn

    listed = list(layers)
    linear, between = listed[::2], listed[1::2]
    kinds = {type(layer) for layer in between}
    if (
        not all(isinstance(a, nn.Linear) for a in linear)
        or len(linear) != len(between) + 1
        or len(kinds) > 1
        or not (kinds <= {nn.Tanh, nn.ReLU})
    ):
        names = [type(layer).__name__ for layer in listed]
        raise InputError(
            f"Expected Linear layers with Tanh, or with ReLU, between them; got {', '.join(names) or 'none'}.",
            code="H3-POLICY-023",
        )

    def plain(tensor: Any) -> NDArray[np.float32]:
        return tensor.detach().cpu().numpy().astype(np.float32)

    weights = tuple(plain(a.weight) for a in linear)
    biases = tuple(
        np.zeros(len(w), np.float32) if a.bias is None else plain(a.bias) for a, w in zip(linear, weights, strict=True)
    )
    return Network(
        task=task,
        observations=tuple(observations),
        weights=weights,
        biases=biases,
        # one layer has nothing behind it, so its name of an activation makes no difference
        activation="relu" if kinds == {nn.ReLU} else "tanh",
        mean=np.asarray(mean, np.float32),
        scale=np.asarray(scale, np.float32),
    )


# --- files --------------------------------------------------------------------------------------------------------------
def save_network(network: Network, path: str | Path) -> None:
    """Write a network as an npz file, which either appears complete or not at all.

    Its entries are ``format``, ``task``, ``activation``, ``observations``, ``mean``, ``scale``, ``weight_0``,
    ``bias_0``, ``weight_1`` and so on.
    """
    arrays: dict[str, NDArray[Any]] = {
        "format": np.array(FILE_FORMAT),
        "task": np.array(network.task),
        "activation": np.array(network.activation),
        "observations": np.array(network.observations),
        "mean": network.mean,
        "scale": network.scale,
    }
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        arrays |= {f"weight_{k}": weight, f"bias_{k}": bias}
    with part_file(path) as part, part.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def load_network(path: str | Path) -> Network:
    """Return the network in a file that `save_network` wrote.

    Raises:
        InputError: There is no such file.
        FormatError: The file is not a file of weights, is damaged, or its layers do not fit together.
    """
    found, data = read_arrays(Path(path))
    if found != FILE_FORMAT:
        raise FormatError(
            f"Expected a file of weights ({FILE_FORMAT}), got {found}. {HINT} File: {path}", code="H3-POLICY-024"
        )
    return network_from(data, path)


def network_from(data: Mapping[str, NDArray[Any]], path: str | Path) -> Network:
    """Return the network in the arrays of a file of weights.

    Raises:
        FormatError: An array is missing, or the layers do not fit together.
    """
    count = sum(name.startswith("weight_") for name in data)
    try:
        return Network(
            task=_word(data["task"]),
            activation=_word(data["activation"]),  # type: ignore[arg-type]
            observations=tuple(_word(name) for name in np.atleast_1d(data["observations"])),
            mean=data["mean"],
            scale=data["scale"],
            weights=tuple(data[f"weight_{k}"] for k in range(count)),
            biases=tuple(data[f"bias_{k}"] for k in range(count)),
        )
    except KeyError as fault:
        raise FormatError(f"The file of weights lacks the array {fault}. File: {path}", code="H3-POLICY-027") from None
    except InputError as fault:
        raise FormatError(f"{fault} File: {path}", code=fault.code) from None


def read_arrays(path: Path) -> tuple[str, dict[str, NDArray[Any]]]:
    """Return the format and the arrays of a file of weights.

    Raises:
        InputError: There is no such file.
        FormatError: The file is not a file of weights, is too large, or is damaged.
    """
    try:
        # before anything is unpacked: a small file may unpack to any size
        with zipfile.ZipFile(path) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
        if size > MAX_BYTES:
            raise FormatError(
                f"Expected at most {MAX_BYTES >> 20} MiB of weights, got {size >> 20} MiB. File: {path}",
                code="H3-POLICY-028",
            )
        # pickles would run code of whoever made the file
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in file.files}
        if not all(isinstance(array, np.ndarray) for array in data.values()):
            raise ValueError("it holds files that are no arrays")
        data = {n.removesuffix(PLANES): from_planes(a) if n.endswith(PLANES) else a for n, a in data.items()}
    except (FileNotFoundError, IsADirectoryError):
        if (path / RUN_POLICY).is_file():
            raise InputError(
                f"Expected a file of weights, this is the folder of a training run. Hint: weights:{path / RUN_POLICY}",
                code="H3-POLICY-031",
            ) from None
        raise InputError(f"Expected a file of weights, found none. {HINT} File: {path}", code="H3-POLICY-029") from None
    except (
        # what zipfile, zlib and numpy raise for damaged files and files of another kind; numpy tokenizes headers
        ValueError,
        OSError,
        EOFError,
        MemoryError,
        RuntimeError,
        zipfile.BadZipFile,
        zlib.error,
        tokenize.TokenError,
    ) as fault:
        raise FormatError(
            f"Expected a file of weights ({FILE_FORMAT}), this is none ({fault}). {HINT} File: {path}",
            code="H3-POLICY-030",
        ) from None
    return _word(data.get("format", np.array("another npz file"))), data


def from_planes(planes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the float32 array [...] in planes of bytes [4, ...]: first bytes of all numbers, then second bytes.

    Raises:
        ValueError: The array is not uint8 [4, ...].
    """
    if planes.dtype != np.uint8 or planes.shape[:1] != (4,):
        raise ValueError(f"planes of bytes are uint8 [4, ...], got {planes.dtype} {list(planes.shape)}")
    return np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view("<f4")[..., 0].astype(np.float32, copy=False)


def _word(array: NDArray[Any]) -> str:
    """Return a text that is stored as an array; a description of the array if it is none, which no known word equals."""
    return str(array) if array.ndim == 0 and array.dtype.kind == "U" else f"an array {array.dtype} {list(array.shape)}"
