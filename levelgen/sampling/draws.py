"""Decisions from uniform random numbers: lanes last, no branches.

Every decision has a number of its own, named in a NamedTuple of draws, in [0, 1).
"""

from collections.abc import Sequence
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key


def deal(keys: Key[Array, " lane"], hands: Sequence[tuple[Any, tuple[int, ...]]]) -> list[Any]:
    """For every (NamedTuple of draws, shape) one such tuple of uniform numbers [*shape, lane], from one draw a lane."""
    counts = [len(kind._fields) * prod(shape) for kind, shape in hands]
    numbers = jax.vmap(lambda key: jax.random.uniform(key, (sum(counts),)), out_axes=-1)(keys)
    dealt, start = [], 0
    for (kind, shape), count in zip(hands, counts, strict=True):
        dealt.append(kind(*numbers[start : start + count].reshape(len(kind._fields), *shape, len(keys))))
        start += count
    return dealt


def pick(weights: Float[Array, "choice #lane"], u: Float[Array, " lane"]) -> Int[Array, " lane"]:
    """A choice with probabilities in proportion to the weights; the first where all are zero."""
    upper = jnp.cumsum(weights, 0)
    return (upper < upper[-1] * (1 - u)).sum(0)


def choose(weights: Float[Array, "choice lane"], u: Float[Array, " lane"]) -> Bool[Array, "choice lane"]:
    """`pick` as one-hot."""
    return jnp.arange(len(weights))[:, None] == pick(weights, u)


def first_of_two(a: Array, b: Array, u: Float[Array, " lane"], chance_of_b: float = 0.5) -> Bool[Array, " lane"]:
    """Whether a is taken: a choice among those that are True; a where neither is."""
    return ~b | (a & (u >= chance_of_b))


def between(u: Array, low: Array | float, high: Array | float) -> Array:
    return low + u * (high - low)


def first_free(taken: Bool[Array, "row lane"]) -> Bool[Array, "row lane"]:
    """One-hot first row not taken; nothing where all are."""
    return ~taken & (jnp.cumsum(~taken, 0) == 1)


def at(x: Array, chosen: Bool[Array, "row lane"]) -> Array:
    """The chosen row of x [row, ..., lane], zero where none is."""
    spread = chosen.reshape(len(chosen), *[1] * (x.ndim - 2), chosen.shape[-1])
    if x.dtype == bool:
        return (x & spread).any(0)
    return jnp.where(spread, x, jnp.zeros((), x.dtype)).sum(0)


def put(x: Array, chosen: Bool[Array, "row lane"], value: Array | float) -> Array:
    """x [row, ..., lane] with `value` [..., lane] in the chosen row."""
    spread = chosen.reshape(len(chosen), *[1] * (x.ndim - 2), chosen.shape[-1])
    return jnp.where(spread, jnp.asarray(value, x.dtype), x)
