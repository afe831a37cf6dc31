"""Decisions from uniform random numbers: lanes last, no branches.

Every decision has its own number in [0, 1), a named field of a NamedTuple of draws. The reference instead splits a key
for every decision and branches; the distribution is the same, the levels for a given seed are not.
"""

from collections.abc import Sequence
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key


def draw_uniforms(keys: Key[Array, " lane"], shapes: Sequence[tuple[Any, tuple[int, ...]]]) -> list[Any]:
    """Return, for each (NamedTuple, shape), one with uniform numbers [*shape, lane], all from one draw per lane."""
    counts = [len(kind._fields) * prod(shape) for kind, shape in shapes]
    numbers = jax.vmap(lambda key: jax.random.uniform(key, (sum(counts),)), out_axes=-1)(keys)
    draws, start = [], 0
    for (kind, shape), count in zip(shapes, counts, strict=True):
        draws.append(kind(*numbers[start : start + count].reshape(len(kind._fields), *shape, len(keys))))
        start += count
    return draws


def pick(weights: Float[Array, "choice #lane"], u: Float[Array, " lane"]) -> Int[Array, " lane"]:
    """Choose an index with probability proportional to its weight; 0 if all weights are zero.

    Counts the cumulated weights below (1 - u) times the total: u = 0 is possible, u = 1 is not.
    """
    upper = jnp.cumsum(weights, 0)
    return (upper < upper[-1] * (1 - u)).sum(0)


def choose(weights: Float[Array, "choice lane"], u: Float[Array, " lane"]) -> Bool[Array, "choice lane"]:
    """Choose as `pick`; return one-hot."""
    return jnp.arange(len(weights))[:, None] == pick(weights, u)


def first_of_two(a: Array, b: Array, u: Float[Array, " lane"], chance_of_b: float = 0.5) -> Bool[Array, " lane"]:
    """Choose among two options that are possible where True; return whether a is chosen. If neither is, a."""
    return ~b | (a & (u >= chance_of_b))


def between(u: Array, low: Array | float, high: Array | float) -> Array:
    """Scale a uniform number to [low, high)."""
    return low + u * (high - low)


def first_free(taken: Bool[Array, "row lane"]) -> Bool[Array, "row lane"]:
    """Return the first row that is not taken, one-hot; all False if there is none."""
    return ~taken & (jnp.cumsum(~taken, 0) == 1)


def at(x: Array, chosen: Bool[Array, "row lane"]) -> Array:
    """Return the chosen row of x [row, ..., lane]; zeros where no row is chosen."""
    spread = chosen.reshape(len(chosen), *[1] * (x.ndim - 2), chosen.shape[-1])
    if x.dtype == bool:
        return (x & spread).any(0)
    return jnp.where(spread, x, jnp.zeros((), x.dtype)).sum(0)


def put(x: Array, chosen: Bool[Array, "row lane"], value: Array | float) -> Array:
    """Return x [row, ..., lane] with `value` [..., lane] in the chosen row."""
    spread = chosen.reshape(len(chosen), *[1] * (x.ndim - 2), chosen.shape[-1])
    return jnp.where(spread, jnp.asarray(value, x.dtype), x)
