"""Counter-based random numbers for many worlds or steps at once, as torch integers on any device.

They equal those of `sim_kinematic.motion.randomness` in every bit: Philox 4x64 with 10 rounds (Salmon et al., "Parallel
random numbers: as easy as 1, 2, 3", 2011).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import torch
from torch import Tensor

_LOW = 0xFFFFFFFF
_MULTIPLIERS = (0xD2E7470EE14C6C93, 0xCA5A826395121157)
_WEYL = (0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B)
_ROUNDS = 10


def keys(seeds: Sequence[int], stream: str, *, device: torch.device | str, world: int = 0) -> Tensor:
    """Return the keys int64 [W, 2] of the generators of ``seeds`` [W] for one purpose (``stream``) in each world."""
    digest = hashlib.blake2b(f"{stream}/{world}".encode(), digest_size=8).digest()
    second = _signed(int.from_bytes(digest, "little"))
    return torch.tensor([[_signed(seed), second] for seed in seeds], dtype=torch.int64, device=device).reshape(-1, 2)


def random(key: Tensor, step: Tensor, count: int) -> Tensor:
    """Return ``count`` random numbers in [0, 1) of generators with keys [W, 2] at ``step`` [W], float64 [W, count]."""
    return ((bits(key, step, count) >> 11) & (2**53 - 1)).double() * 2.0**-53


def bits(key: Tensor, step: Tensor, count: int) -> Tensor:
    """Return the first ``count`` times 64 random bits of each world, int64 [W, count]."""
    blocks = []
    for block in range(-(-count // 4)):
        # NumPy counts up before it draws
        words = [torch.full_like(step, block + 1), torch.zeros_like(step), step, torch.zeros_like(step)]
        blocks.append(torch.stack(_philox(words, [key[:, 0], key[:, 1]]), -1))
    return torch.cat(blocks, -1)[:, :count]


def _philox(words: list[Tensor], key: list[Tensor]) -> list[Tensor]:
    for _ in range(_ROUNDS):
        high0, low0 = _multiply(words[0], _MULTIPLIERS[0])
        high1, low1 = _multiply(words[2], _MULTIPLIERS[1])
        words = [high1 ^ words[1] ^ key[0], low1, high0 ^ words[3] ^ key[1], low0]
        key = [k + _signed(w) for k, w in zip(key, _WEYL, strict=True)]
    return words


def _multiply(a: Tensor, b: int) -> tuple[Tensor, Tensor]:
    """Return the upper and the lower 64 bits of an unsigned product, both held in int64."""
    a0, a1, b0, b1 = a & _LOW, _upper(a), b & _LOW, b >> 32
    middle = a1 * b0 + _upper(a0 * b0)
    cross = a0 * b1 + (middle & _LOW)
    return a1 * b1 + _upper(middle) + _upper(cross), a * _signed(b)


def _upper(a: Tensor) -> Tensor:
    return (a >> 32) & _LOW


def _signed(number: int) -> int:
    """Return an unsigned number of 64 bits as torch holds it."""
    return (number + 2**63) % 2**64 - 2**63
