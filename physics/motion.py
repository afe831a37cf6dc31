"""What the solver moves: positions and velocities of all bodies, and the choice of a body that differs by lane."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from physics.vector import Vec


class Motion(NamedTuple):
    """Components [body, lane]."""

    position: Vec
    velocity: Vec
    angular_velocity: Float[Array, "body lane"]


def select(x: Float[Array, "body lane"], body: Int[Array, " lane"]) -> Float[Array, " lane"]:
    """x[body[lane], lane] as a chain of selects: a gather would leave the vector units."""
    chosen = x[0]
    for b in range(1, x.shape[0]):
        chosen = jnp.where(body == b, x[b], chosen)
    return chosen


def spread(bodies: int, terms: Sequence[tuple[Int[Array, " lane"], Array]]) -> Float[Array, "body lane"]:
    """The sum over (body, value) of the value placed at the body's row."""
    return jnp.stack([sum(jnp.where(body == b, value, 0.0) for body, value in terms) for b in range(bodies)])


def add_rows(bodies: int, terms: Sequence[tuple[Sequence[int], Array]]) -> Float[Array, "body lane"]:
    """The sum over (index, x) of x[i] placed at row index[i], for static indices."""
    totals: list = [None] * bodies
    for index, x in terms:
        for i, body in enumerate(index):
            totals[body] = x[i] if totals[body] is None else totals[body] + x[i]
    zero = jnp.zeros_like(terms[0][1][0])
    return jnp.stack([zero if t is None else t for t in totals])
