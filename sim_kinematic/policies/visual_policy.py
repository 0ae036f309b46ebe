"""Recurrent network that maps pictures and numbers to commands of a robot, stored in a file of plain arrays.

The network is
``picture -> convolutions -> GRU(picture features, numbers, last action) -> two layers -> forward, turn``. For skills
that move the arm, the output also has the arm's joints and the grip. One small kernel evaluates it in a millisecond.
Its sums have a fixed order, so they give the same bits in every process. Those of PyTorch and NumPy's BLAS do not, as
their order depends on the number of threads; for so little work, threads would cost more than they save.
`h3data_training.networks` implements the same network in PyTorch, and tests/training/test_policy_files.py compares the
two.

The file is an npz of float32 arrays and one JSON text. It has no pickle and no code, so nothing in it is executed when
it is read.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data.files import part_file
from h3data.geometry import Array
from h3data.kernels import kernel
from h3data.render.light.sources import LightMode
from sim_kinematic.sensing.encodings import DETECTOR, OF_COMMANDS

FILE_FORMAT = "h3data.policy/1"
PATCH = 4
"""Side of the squares of pixels that become channels, so that the first convolution works on a 16th of the positions
[pixels]."""
PICTURES = {"arm_depth": 1, "arm_rgb": 3}
"""Number of planes of each picture that a network may observe, by name; a network observes at most one of them."""
STRIDES = (1, 2, 2)
"""Strides of the three convolutions, which are 3 x 3 with a margin of 1."""
BASE_ACTIONS, GRIP_ACTIONS = 2, 1
"""Number of values of an action that move the base, and number of values for the grip, if the arm's joints move."""


class PolicyCard(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Description of a policy, stored as text in its file, with its task, its inputs and its training."""

    task: str
    robot: str
    """Name of the robot's body in training."""
    observations: tuple[str, ...]
    picture_size: tuple[int, int] | None
    """Width and height of the picture, which are also those of the detector's picture [pixels]."""
    light: LightMode = "flat"
    """Light in the colours during training, which the policy also observes in play; files without this entry were
    trained in flat light."""
    hold: int
    """Number of steps of 1/30 s for which an action is held."""
    network: str = "cnn_gru"
    """Type of the network: ``cnn_gru``, ``resnet18_lstm`` (the paper's), or ``gru_chooser`` of rearrangement."""
    actions: int = BASE_ACTIONS
    """Length of an action: 2 for the base; skills that move the arm add its n joints and 1 for the grip."""
    agent: str = "robot"
    """Agent that the policy controls: ``robot`` or ``human``."""
    objects: int = 0
    """Number of objects of rearrangement that the policy supports."""
    primitives: bool = True
    """True if a robot of rearrangement may choose the primitive motions of navigation."""
    temperature: float = 1.0
    """Divisor of the scores of choices before one is sampled in play; below 1, better choices are sampled more often than in
    training."""
    training: dict[str, Any] = {}
    """Origin of the policy: recipe, seed, steps, hardware and versions."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CardedNetwork:
    """Recurrent network of a policy file: its weights, and the card that describes them."""

    card: PolicyCard
    arrays: Mapping[str, Array]
    """Weights and biases by name, as in the file."""

    @property
    def task(self) -> str:
        """Name of the task that the policy was trained for."""
        return self.card.task

    @property
    def observations(self) -> tuple[str, ...]:
        """Names of the observations that the policy needs."""
        return self.card.observations

    @property
    def sees(self) -> str | None:
        """Return which picture of `PICTURES` the policy observes; None if it observes none."""
        return picture_in(self.card.observations)

    def start(self) -> Array:
        """Return the recurrent state at the start of an episode, [H]."""
        return np.zeros(self.arrays["gru.weight_hh"].shape[1], np.float32)

    def _digest(self, about: tuple[Any, ...]) -> str:
        """Return SHA-256 (hex) of the weights and of the fields of the card that decide how they are used."""
        found = sha256(repr(about).encode())
        # sorted: the order of arrays in a file is not part of the policy
        for name, array in sorted(self.arrays.items()):
            found.update(f"{name}{array.shape}".encode() + array.tobytes())
        return found.hexdigest()

    @cached_property
    def _columns(self) -> dict[str, Array]:
        """Weights of the layers by name, transposed to [in, out]."""
        # [in, out] in memory too: the inner loop of `affine` runs along the outputs
        rows = {n: a.reshape(len(a), -1) for n, a in self.arrays.items() if ".weight" in n}
        return {n: np.ascontiguousarray(a.T, np.float32) for n, a in rows.items()}

    def _layer(self, name: str, x: Array, kind: str = "") -> Array:
        """Return outputs [out] or [n, out] of a linear layer for inputs [in] or [n, in]."""
        rows = np.ascontiguousarray(np.atleast_2d(x), np.float32)
        out = affine(rows, self._columns[f"{name}.weight{kind}"], self.arrays[f"{name}.bias{kind}"].astype(np.float32))
        return out if x.ndim == 2 else out[0]

    def _remember(self, x: Array, state: Array) -> Array:
        """Return the recurrent state [H] after an input [in], by the formulas of `torch.nn.GRU` (Cho et al. 2014)."""
        given, kept = self._layer("gru", x, "_ih"), self._layer("gru", state, "_hh")
        # torch stacks reset, update and new gate in this order
        (r, z, n), (kr, kz, kn) = np.split(given, 3), np.split(kept, 3)
        # the logistic function by tanh: exp would overflow for large inputs
        reset, update = 0.5 * (np.tanh(0.5 * (r + kr)) + 1), 0.5 * (np.tanh(0.5 * (z + kz)) + 1)
        # as in torch, the reset gate acts after the product with the state; in the paper before it
        return ((1 - update) * np.tanh(n + reset * kn) + update * state).astype(np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class VisualPolicy(CardedNetwork):
    """Network that maps a picture and numbers to commands of a robot.

    Its arrays are ``conv_0.weight`` [out, in, 3, 3], ``picture.weight`` [features, flat], ``gru.weight_ih`` [3 H, in],
    ``gru.weight_hh`` [3 H, H], ``act_0.weight``, ``act_1.weight`` [actions, n], and a bias for each.
    """

    kind: ClassVar[str] = "cnn_gru"

    def __post_init__(self) -> None:
        faults = _faults(type(self), self.card, self.arrays)
        if faults:
            raise InputError(f"These arrays make no policy: {'; '.join(faults)}.", code="H3-POLICY-007")

    @property
    def outputs(self) -> int:
        """Number of values in an action of the policy."""
        return self.card.actions

    @property
    def sees_colours(self) -> bool:
        """Return whether the policy observes colours, which depend on the light of the home."""
        return self.sees == "arm_rgb"

    def in_light(self, light: LightMode) -> Self:
        """Return a network with the same weights that sees its colours in another light.

        Raises:
            InputError: The network sees no colours.
        """
        if not self.sees_colours:
            raise InputError("The network sees no colours, so light makes no difference to it.", code="H3-POLICY-032")
        return replace(self, card=msgspec.structs.replace(self.card, light=light))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of everything that determines the policy's behaviour."""
        card = self.card
        about: tuple[Any, ...] = (card.task, card.observations, card.picture_size, card.hold)
        if card.network != "cnn_gru":
            about = (*about, card.network)
        # recordings name policies by their digests, so fields that cards had not from the start count only if they differ
        if self.sees_colours and card.light != "flat":
            about = (*about, card.light)
        return self._digest(about)

    def __call__(self, shown: Mapping[str, NDArray[Any]], last: Array, state: Array) -> tuple[Array, Array]:
        """Evaluate the policy for one step, and return the action and the next state.

        Args:
            shown: observations by name.
            last: last action [n], 0 at the start.
            state: recurrent state [H].

        Returns:
            The action [n] and the next state [H].

        Raises:
            InputError: an observation is missing or has another shape.
        """
        numbers = self._numbers(shown, last)
        x = numbers
        if self.sees:
            x = np.concatenate([picture_features(picture_of(self.card, shown), self._layer), numbers])
        state = self._remember(x, state)
        hidden = self._layer("act_0", np.concatenate([state, numbers]))
        # ELU, as in training; expm1 of large numbers would overflow in the branch that is not taken
        hidden = np.where(hidden > 0, hidden, np.expm1(np.minimum(hidden, 0)))
        return self._layer("act_1", hidden), state

    @classmethod
    def size_fault(cls, size: tuple[int, int]) -> str:
        """Return a text with the supported sizes of pictures if ``size`` is not one of them; otherwise empty."""
        fits = all(side % PATCH == 0 and PATCH <= side <= 1024 for side in size)
        return "" if fits else f"multiples of {PATCH} up to 1024"

    @classmethod
    def shapes(cls, card: PolicyCard, arrays: Mapping[str, Array]) -> dict[str, tuple[int, ...]]:
        """Return the shapes of all arrays by name; widths are those of the given arrays."""
        shapes, features = picture_shapes(card, arrays)
        numbers = number_count(card.observations, card.actions)
        state, wide = rows_in(arrays, "gru.weight_ih") // 3, rows_in(arrays, "act_0.weight")
        return shapes | {
            "gru.weight_ih": (3 * state, features + numbers),
            "gru.weight_hh": (3 * state, state),
            "gru.bias_ih": (3 * state,),
            "gru.bias_hh": (3 * state,),
            "act_0.weight": (wide, state + numbers),
            "act_0.bias": (wide,),
            "act_1.weight": (card.actions, wide),
            "act_1.bias": (card.actions,),
        }

    def _numbers(self, shown: Mapping[str, NDArray[Any]], last: Array) -> Array:
        """Return the encoded observations other than the picture, and the last action, one after the other, float32."""
        parts = []
        for name in self.observations:
            if name in PICTURES:
                continue
            encoding, (length, _) = OF_COMMANDS[name], lengths(name, self.card.actions)
            if name not in shown or np.shape(shown[name]) != (length,):
                got = list(np.shape(shown[name])) if name in shown else "none"
                raise InputError(f"Expected the observation {name} [{length}], got {got}.", code="H3-POLICY-036")
            parts.append(encoding.of(np, np.asarray(shown[name], encoding.dtype)))
        return np.concatenate([*parts, last]).astype(np.float32)


def picture_of(card: PolicyCard, shown: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return the picture [H, W, planes] among the observations of a policy.

    Raises:
        InputError: The picture is missing, or its size is not that on the card.
    """
    name = picture_in(card.observations)
    assert name
    assert card.picture_size
    # cards have the width first, arrays the height
    expected = (*card.picture_size[::-1], PICTURES[name])
    if name not in shown or shown[name].shape != expected:
        got = list(shown[name].shape) if name in shown else "none"
        raise InputError(f"Expected {name} {list(expected)}, got {got}.", code="H3-POLICY-033")
    return shown[name]


def picture_features(picture: NDArray[Any], layer: Callable[[str, Array], Array]) -> Array:
    """Return the features [F] of a picture [H, W, planes], computed by the named linear layers of a network."""
    height, width, planes = picture.shape
    # the root gives near surfaces more of the range of depths; float16, as the device stores pictures of whole rollouts
    seen = np.sqrt(picture.astype(np.float32)) if planes == 1 else picture.astype(np.float32) / np.float32(255)
    seen = seen.astype(np.float16).astype(np.float32)
    # channels are plane, row and column within a square, as in the network of training
    x = seen.reshape(height // PATCH, PATCH, width // PATCH, PATCH, planes).transpose(4, 1, 3, 0, 2)
    x = x.reshape(planes * PATCH * PATCH, height // PATCH, width // PATCH)
    for k, stride in enumerate(STRIDES):
        seen, shape = _windows(x, stride)
        x = np.maximum(layer(f"conv_{k}", seen), 0).T.reshape(-1, *shape)
    return np.maximum(layer("picture", x.ravel()), 0)


def picture_shapes(card: PolicyCard, arrays: Mapping[str, Array]) -> tuple[dict[str, tuple[int, ...]], int]:
    """Return the shapes of the arrays that turn a card's picture into features, by name, and the number of features."""
    picture = picture_in(card.observations)
    if picture is None:
        return {}, 0
    assert card.picture_size is not None
    shapes: dict[str, tuple[int, ...]] = {}
    last = PICTURES[picture] * PATCH * PATCH
    for k in range(len(STRIDES)):
        out = rows_in(arrays, f"conv_{k}.weight")
        shapes |= {f"conv_{k}.weight": (out, last, 3, 3), f"conv_{k}.bias": (out,)}
        last = out
    features = rows_in(arrays, "picture.weight")
    return shapes | {
        "picture.weight": (features, last * picture_length(card.picture_size)),
        "picture.bias": (features,),
    }, features


def _windows(x: Array, stride: int) -> tuple[Array, tuple[int, int]]:
    """Return windows of a 3 x 3 convolution over [in, H, W] with a margin of zeros, [H' W', 9 in]; and H', W'."""
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))[:, ::stride, ::stride]
    _, height, width, _, _ = windows.shape
    # channel, row, column: the order of flattened weights [out, in, 3, 3]
    return windows.transpose(1, 2, 0, 3, 4).reshape(height * width, -1), (height, width)


@kernel()
def affine(x: Array, columns: Array, bias: Array) -> Array:
    """Compute ``x @ columns + bias`` of [n, in], [in, out], [out], in float32; sums are in the order of the inputs."""
    out = np.empty((len(x), len(bias)), np.float32)
    for row in range(len(x)):
        out[row] = bias
        for k in range(x.shape[1]):
            factor = x[row, k]
            if factor != 0:  # half of what comes out of a rectifier
                for column in range(len(bias)):
                    out[row, column] += factor * columns[k, column]
    return out


def picture_in(observations: tuple[str, ...]) -> str | None:
    """Return which of `PICTURES` is among some observations; None if none is."""
    return next((name for name in observations if name in PICTURES), None)


def lengths(name: str, actions: int) -> tuple[int, int]:
    """Return the lengths of an observation and of its encoding, for a policy whose actions have ``actions`` numbers."""
    encoding = OF_COMMANDS[name]
    # an action with an arm has one number for each joint, from which the number of observed joints follows
    repeat = max(actions - BASE_ACTIONS - GRIP_ACTIONS, 0) if encoding.times == "joints" else 1
    return repeat * encoding.given, repeat * encoding.length


def number_count(observations: tuple[str, ...], actions: int = BASE_ACTIONS) -> int:
    """Return the total length of the encoded numbers and of the last action."""
    return sum(lengths(name, actions)[1] for name in observations if name not in PICTURES) + actions


def picture_length(size: tuple[int, int]) -> int:
    """Return the number of positions that remain after the convolutions of a picture (width, height) [pixels]."""
    width, height = (side // PATCH for side in size)
    for stride in STRIDES:
        # rounded up, as a window of 3 with a margin of 1 does
        width, height = -(-width // stride), -(-height // stride)
    return width * height


def _faults(kind: type[VisualPolicy], card: PolicyCard, arrays: Mapping[str, Array]) -> list[str]:
    """Return everything in a card and arrays that does not fit together, in words."""
    # one after the other: the shapes that arrays are compared with follow from a sound card
    if card.network != kind.kind:
        return [f"unknown network {card.network!r}, expected {kind.kind}"]
    known = (*PICTURES, *OF_COMMANDS)
    strangers = [n for n in card.observations if n not in known]
    if strangers:
        return [f"unknown observations {', '.join(strangers)}, there are {', '.join(known)}"]
    if not card.observations or len(set(card.observations)) != len(card.observations):
        return ["expected some observations, each once"]
    if set(PICTURES) <= set(card.observations):
        return [f"expected one picture, not {' and '.join(PICTURES)}"]
    if not BASE_ACTIONS <= card.actions <= 32:
        return [f"an action has {card.actions} numbers, expected {BASE_ACTIONS} to 32"]
    if not 1 <= card.hold <= 30:
        return [f"actions are held for {card.hold} steps, expected 1 to 30"]
    if {*PICTURES, DETECTOR} & set(card.observations):
        fault = "a width and a height" if card.picture_size is None else kind.size_fault(card.picture_size)
        if fault:
            return [f"the picture size is {card.picture_size}, expected {fault}"]
    return array_faults(arrays, kind.shapes(card, arrays))


def array_faults(arrays: Mapping[str, Array], shapes: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Return, in words, which arrays are missing, unknown, not finite, or of another type or shape than expected."""
    faults = [f"the array {name} is missing" for name in shapes if name not in arrays]
    faults += [f"unknown array {name}" for name in arrays if name not in shapes]
    for name, array in arrays.items():
        if name in shapes and array.shape != shapes[name]:
            faults.append(f"{name} has the shape {list(array.shape)}, expected {list(shapes[name])}")
        if array.dtype != np.float32:
            faults.append(f"{name} is {array.dtype}, expected float32")
        elif not np.isfinite(array).all():
            faults.append(f"{name} holds numbers that are not finite")
    return faults


def rows_in(arrays: Mapping[str, Array], name: str) -> int:
    """Return the number of rows of an array, or 0 if it is missing from a damaged file."""
    return arrays[name].shape[0] if name in arrays and arrays[name].ndim else 0


# --- files --------------------------------------------------------------------------------------------------------------
Kind = TypeVar("Kind", bound=CardedNetwork)


def save_policy(network: CardedNetwork, path: str | Path) -> None:
    """Write a policy as an npz file, which either appears complete or not at all.

    Its entries are ``format``, ``card`` (JSON) and the arrays.
    """
    text = {"format": np.array(FILE_FORMAT), "card": np.array(msgspec.json.encode(network.card).decode())}
    with part_file(path) as part, part.open("wb") as stream:
        np.savez(stream, **text, **network.arrays)  # type: ignore[arg-type]


def policy_from(
    data: Mapping[str, NDArray[Any]], path: str | Path, *, kind_of: Callable[[str], Callable[..., Kind]]
) -> Kind:
    """Return the policy in the arrays of a policy file.

    Args:
        data: Arrays by name.
        path: Path of the file, for messages.
        kind_of: Function that returns the class of networks for the name on a card.

    Raises:
        FormatError: The file is damaged, or its parts do not fit together.
    """
    try:
        card = msgspec.json.decode(str(data["card"]), type=PolicyCard)
        arrays = {n: a for n, a in data.items() if n not in ("format", "card")}
        return kind_of(card.network)(card=card, arrays=arrays)
    except KeyError as fault:
        raise FormatError(f"The policy file lacks the array {fault}. File: {path}", code="H3-POLICY-034") from None
    except (msgspec.MsgspecError, json.JSONDecodeError, UnicodeError) as fault:
        raise FormatError(
            f"The card of the policy file is malformed: {fault}. File: {path}", code="H3-POLICY-035"
        ) from None
    except InputError as fault:
        raise FormatError(f"{fault} File: {path}", code=fault.code) from None
