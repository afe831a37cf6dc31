"""Uniform random numbers of a level, and decisions from them: lanes last, no branches.

Every decision has its own number in [0, 1), a named field of a NamedTuple of draws. The reference instead splits a key
for every decision and branches; the distribution is the same, the levels for a given seed are not. Keys and numbers
are those of `jax.random` with Threefry-2x32 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011) and
`jax_threefry_partitionable`; integers have 32 bits, and their sign means nothing here.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.identity.keys import ROOT_KEY, STREAMS, Stream
from levelproof.physics.lanes import Ref, Scalar, each

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = 0x1BD11BDA
AT_ONCE = 4  # numbers drawn together: the processor works on one while it waits for another
ONE = np.float32(1).view(np.int32).item()  # sign and exponent of 1.0
FRACTION = 23  # bits of a float32's fraction

Word = Int[Array, "*row lane"]  # 32 bits


class StreamKey(NamedTuple):
    """A Threefry key of each lane."""

    first: Word
    second: Word


def stream_key(level_id: Int[Array, " lane"], stream: Stream) -> StreamKey:
    """Return the key that `levelgen.identity.keys.key_for` makes."""
    key = StreamKey(*(jnp.full_like(level_id, word) for word in ROOT_KEY))
    for number in (STREAMS, level_id, int(stream)):
        key = StreamKey(*_threefry(key, jnp.zeros_like(level_id), jnp.broadcast_to(number, level_id.shape)))
    return key


def _threefry(key: StreamKey, high: Word, low: Word) -> tuple[Word, Word]:
    """Encrypt a counter of 64 bits in 20 rounds."""
    keys = (*key, key.first ^ key.second ^ PARITY)
    high, low = high + keys[0], low + keys[1]
    for group in range(5):
        for distance in ROTATIONS[group % 2]:
            high = high + low
            low = jax.lax.shift_left(low, _full(low, distance)) | jax.lax.shift_right_logical(
                low, _full(low, 32 - distance)
            )
            low = low ^ high
        high, low = high + keys[(group + 1) % 3], low + keys[(group + 2) % 3] + (group + 1)
    return high, low


def _full(like: Word, number: int) -> Word:
    return jnp.full_like(like, number)


def uniform(key: StreamKey, index: Int[Array, "*row lane"]) -> Float[Array, "*row lane"]:
    """Return the level's random numbers at these indices: `jax.random.uniform(key, (count,))[index]`."""
    high, low = _threefry(key, jnp.zeros_like(index), index)
    bits = jax.lax.shift_right_logical(high ^ low, _full(index, 32 - FRACTION)) | ONE
    return jax.lax.bitcast_convert_type(bits, jnp.float32) - 1.0


def draw(key: StreamKey, numbers: Ref) -> None:
    """Fill all rows of `numbers`, a multiple of AT_ONCE, with the level's numbers 0, 1, 2, ..."""

    def some(k):
        first = jnp.zeros_like(key.first) + k * AT_ONCE
        drawn = uniform(key, jnp.stack([first + i for i in range(AT_ONCE)]))
        for i in range(AT_ONCE):
            numbers[k * AT_ONCE + i] = drawn[i]

    each(numbers.shape[0] // AT_ONCE, some)


def pick(weights: Sequence[Float[Array, "#lane"] | float], u: Float[Array, " lane"]) -> Int[Array, " lane"]:
    """Choose an index with probability proportional to its weight; 0 if all weights are zero.

    Counts the cumulative weights below (1 - u) times the total: u = 0 is possible, u = 1 is not.
    """
    total, upper = jnp.zeros_like(u), []
    for weight in weights:
        total = total + weight
        upper.append(total)
    chosen = jnp.zeros_like(u, jnp.int32)
    for bound in upper:
        chosen += bound < total * (1 - u)
    return chosen


def pick_row(upper: Ref, first: int, last: int, u: Float[Array, " lane"]) -> Int[Array, " lane"]:
    """Choose one of the rows first .. last - 1 as `pick` does, from their cumulative weights in `upper`."""
    bound = upper[last - 1] * (1 - u)
    count = lambda i, below: below + (upper[i] < bound)
    return jax.lax.fori_loop(first, last, count, jnp.full_like(u, first, jnp.int32))


def cumulate(upper: Ref, first: int, last: int, weight: Callable[[Scalar], Float[Array, " lane"]]) -> None:
    """Write the cumulative weights of the rows first .. last - 1."""

    def add(i, total):
        upper[i] = total = total + weight(i)
        return total

    jax.lax.fori_loop(first, last, add, jnp.zeros(upper.shape[-1], jnp.float32))


def first_of_two(a: Array, b: Array, u: Float[Array, " lane"], chance_of_b: float = 0.5) -> Bool[Array, " lane"]:
    """Choose one of two options, each possible where True; return whether a is chosen, as it is if neither is possible.

    If both are possible, b is chosen with `chance_of_b`.
    """
    return ~b | (a & (u >= chance_of_b))


def between(u: Array, low: Array | float, high: Array | float) -> Array:
    """Scale a uniform number to [low, high)."""
    return low + u * (high - low)
