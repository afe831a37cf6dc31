"""2D vectors with the lanes last, and selection of rows.

A vector is a pair (x, y) of arrays, so that every operation stays a dense loop over lanes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Vec(NamedTuple):
    """x and y components, each [..., lane]."""

    x: Array
    y: Array

    def __add__(self, other: "Vec") -> "Vec":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Vec(self.x + other.x, self.y + other.y)

    def __sub__(self, other: "Vec") -> "Vec":
        return Vec(self.x - other.x, self.y - other.y)

    def __neg__(self) -> "Vec":
        return Vec(-self.x, -self.y)

    def scale(self, s) -> "Vec":
        return Vec(s * self.x, s * self.y)

    def dot(self, other: "Vec") -> Array:
        return self.x * other.x + self.y * other.y

    def cross(self, other: "Vec") -> Array:
        return self.x * other.y - self.y * other.x

    def norm(self) -> Array:
        return jnp.sqrt(self.x * self.x + self.y * self.y)

    def rotate(self, cos: Array, sin: Array) -> "Vec":
        return Vec(cos * self.x - sin * self.y, sin * self.x + cos * self.y)

    def unrotate(self, cos: Array, sin: Array) -> "Vec":
        return Vec(cos * self.x + sin * self.y, cos * self.y - sin * self.x)

    def map(self, f) -> "Vec":
        return Vec(f(self.x), f(self.y))


def spin(angular_velocity: Array, r: Vec) -> Vec:
    """Return w x r: the velocity, from rotation alone, of a point at r from a body's centre."""
    return Vec(-angular_velocity * r.y, angular_velocity * r.x)


def vec(x: Array) -> Vec:
    """Split [..., 2, lane] into components [..., lane]."""
    return Vec(x[..., 0, :], x[..., 1, :])


def unvec(v: Vec) -> Array:
    """Stack components [..., lane] into [..., 2, lane]."""
    return jnp.stack([v.x, v.y], axis=-2)


def where(condition: Array, a: Vec, b: Vec) -> Vec:
    return Vec(jnp.where(condition, a.x, b.x), jnp.where(condition, a.y, b.y))


def nonzero(x: Array) -> Array:
    """Replace 0 by 1, for a safe divisor (Jax2D `zero_to_one`)."""
    return jnp.where(x == 0, jnp.ones_like(x), x)


def rows(x: Array, index: Sequence[int]) -> Array:
    """Return x[index] for a static index, as slices and broadcasts: XLA's CPU gather is slow."""
    if not index:
        return x[:0]
    pieces, start = [], 0
    while start < len(index):
        stop = start + 1
        step = index[stop] - index[start] if stop < len(index) else 1
        if step not in (0, 1):
            step = 1
        while stop < len(index) and index[stop] - index[stop - 1] == step:
            stop += 1
        first, count = index[start], stop - start
        if step == 1:
            pieces.append(x[first : first + count])
        else:
            pieces.append(jnp.broadcast_to(x[first : first + 1], (count, *x.shape[1:])))
        start = stop
    return pieces[0] if len(pieces) == 1 else jnp.concatenate(pieces)


def select(x: Float[Array, "choice *row lane"], index: Int[Array, " lane"]) -> Float[Array, "*row lane"]:
    """Return x[index[lane], ..., lane] for an index in bounds.

    Gathers from flat x, since XLA would transpose an x that is not flat.
    """
    lanes = max(x.shape[-1], index.shape[-1])  # either may have a single lane, which broadcasts
    x = jnp.broadcast_to(x, (*x.shape[:-1], lanes))
    within = jnp.arange(x[0].size, dtype=jnp.int32).reshape(x.shape[1:])
    return x.reshape(-1).at[index * x[0].size + within].get(mode="promise_in_bounds")
