"""Random numbers are a pure function of seed, stream, step and position. No state is saved.

An integer hash of the four gives 32 random bits. A lane gets the same numbers alone and among
others, evaluation cannot disturb training, and a resumed run needs nothing. Two samplers share
their action noise (common random numbers).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import IntEnum

import torch
from torch import Tensor

# Multipliers of the two rounds of C. Wellons' integer hash "lowbias32"; the second is the int32 of
# equal bits.
_FIRST, _SECOND = 0x21F0AAAD, 0xD35A2D97 - 2**32
_GOLDEN = 0x9E3779B9


class Stream(IntEnum):
    """Each use of random numbers has a stream of its own, independent of the others."""

    INIT = 0  # the network's weights
    WARM_UP = 1  # uniform random actions before learning starts
    ACTION = 2  # exploration
    DRAW = 3  # which items are replayed
    UNIFORM = 4  # the uniform draw for the threshold b, and for the actor's batch if it has one
    POLICY = 5  # actions of the actor's loss
    TARGET = 6  # actions of the critics' target
    PATH = 7  # actions at skipped states
    UNROLL = 8  # lengths of the geometric control
    SHUFFLE = 9  # the warm-up states whose criterion value stands for a state's
    PROBE = 10  # the states of the diagnostics
    CRITERION = 11  # initial weights and updates of a criterion that learns
    REDRAW = 12  # which items of a large batch the critics learn from


def lane_keys(seeds: Sequence[int]) -> Tensor:
    """Return the keys of all streams of the lanes with these seeds, int32 (L, streams, 2)."""
    return torch.tensor(
        [[_stream_key(seed, stream) for stream in Stream] for seed in seeds], dtype=torch.int32
    )


Numbers = dict[Stream, Tensor]
Wanted = dict[Stream, tuple[Callable[[Tensor, Sequence[int]], Tensor], Sequence[int]]]


def at_step(keys: Tensor, step: Tensor) -> Tensor:
    """Return the keys (..., 2) of streams at a step, an int32 tensor that broadcasts to them."""
    return _mix(_mix(keys + step) + keys.flip(-1))


def numbers(keys: Tensor, wanted: Wanted) -> Numbers:
    """Return the random numbers of one lane at one step, whose keys are (streams, 2).

    `wanted` gives a distribution and a shape for each stream.
    """
    return {stream: draw(keys[stream], shape) for stream, (draw, shape) in wanted.items()}


def bits(key: Tensor, count: int) -> Tensor:
    """Return random bits, int32 (count,), of a stream at a step, whose key is (2,).

    They are hashes of a sequence with a random start and a random odd stride (Steele et al. 2014,
    here with 32 bits).
    """
    # The key is sliced, not indexed. In compiled vmap, an int32 scalar of a lane that meets a large
    # Python integer is silently rounded through float32.
    position = torch.arange(count, dtype=torch.int32, device=key.device)
    return _mix(position * (key[1:] | 1) + key[:1])


def uniform(key: Tensor, shape: Sequence[int]) -> Tensor:
    """Return float32 numbers, uniform in the open interval (0, 1), with 2^23 values."""
    word = bits(key, math.prod(shape)).reshape(*shape)
    return ((word >> 9) & 0x7FFFFF).to(torch.float32) * 2.0**-23 + 2.0**-24


def uniform_double(key: Tensor, shape: Sequence[int]) -> Tensor:
    """Return float64 numbers, uniform in (0, 1), with 2^32 values.

    That is enough to draw from a million items without bias.
    """
    word = bits(key, math.prod(shape)).reshape(*shape).to(torch.int64) & 0xFFFFFFFF
    return word.to(torch.float64) * 2.0**-32 + 2.0**-33


def normal(key: Tensor, shape: Sequence[int]) -> Tensor:
    """Return standard normal float32 numbers, by Box and Muller's transform."""
    count = math.prod(shape)
    radius, angle = uniform(key, (2, (count + 1) // 2))
    phase = torch.arange(2, device=key.device)[:, None] * (0.5 * math.pi)  # cos(x - pi/2) = sin(x)
    pairs = torch.sqrt(-2.0 * torch.log(radius)) * torch.cos((2.0 * math.pi) * angle - phase)
    return pairs.flatten()[:count].reshape(*shape)


def hash_columns(key: Tensor, x: Tensor) -> Tensor:
    """Return random bits, int32 (B,), as a function of the key (2,) and the columns of x (O, B)."""
    words = (x.float() + 0.0).view(torch.int32)  # adding zero gives -0.0 the bits of 0.0
    code = _mix(words[0] + key[:1])
    for word in words[1:]:
        code = _mix(code + word)
    return _mix(code + key[1:])


def _mix(x: Tensor) -> Tensor:
    # The masks make the arithmetic shifts of int32 logical ones.
    x = (x ^ ((x >> 16) & 0xFFFF)) * _FIRST
    x = (x ^ ((x >> 15) & 0x1FFFF)) * _SECOND
    return x ^ ((x >> 15) & 0x1FFFF)


def _stream_key(seed: int, stream: int) -> tuple[int, int]:
    low = _mix_int(_mix_int(seed & 0xFFFFFFFF) + _GOLDEN * (stream + 1) + (seed >> 32))
    return _signed(low), _signed(_mix_int(low + _GOLDEN) ^ _mix_int(stream + 1))


def _mix_int(x: int) -> int:
    x &= 0xFFFFFFFF
    x = ((x ^ (x >> 16)) * _FIRST) & 0xFFFFFFFF
    x = ((x ^ (x >> 15)) * (_SECOND + 2**32)) & 0xFFFFFFFF
    return x ^ (x >> 15)


def _signed(x: int) -> int:
    return x - 2**32 if x >= 2**31 else x
