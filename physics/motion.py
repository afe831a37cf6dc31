"""What the solver moves: positions and velocities of all bodies; and the choice of a body that differs by lane.

Everything that one kernel should touch together lies in one array: XLA's CPU backend makes a kernel for every array
it writes, and computes anew in each what they share.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from physics.types import Model
from physics.vector import gather, rows, stored

Bodies = tuple[int, ...] | Int[Array, "thing lane"]  # body numbers: the same in every lane, or not


class Motion(NamedTuple):
    position: Float[Array, "body 2 lane"]
    velocity: Float[Array, "body 3 lane"]  # x, y, angular


def inverse_masses(model: Model) -> Float[Array, "body 3 lane"]:
    """What turns an impulse (x, y, angular) into a change of velocity."""
    return jnp.stack([model.inverse_mass, model.inverse_mass, model.inverse_inertia], axis=1)


def select(x: Float[Array, "body *row lane"], body: Int[Array, " lane"]) -> Float[Array, "*row lane"]:
    """x[body[lane], ..., lane]."""
    return _along(x, body[None])[0]


def _along(x: Float[Array, "body *row lane"], body: Int[Array, "thing lane"]) -> Float[Array, "thing *row lane"]:
    lanes = max(x.shape[-1], body.shape[-1])  # either may be the same in all lanes
    x = jnp.broadcast_to(x, (*x.shape[:-1], lanes))
    return gather(x, jnp.broadcast_to(body, (len(body), lanes)))


def incidence(bodies: int, index: Sequence[int]) -> Float[np.ndarray, "body row"]:
    """Matrix that adds row i to body index[i]. A product with it is a fast kernel, and adds in a fixed order."""
    return (np.arange(bodies)[:, None] == np.asarray(index)).astype(np.float32)


def take(x: Float[Array, "body row lane"], body: Bodies) -> Float[Array, "thing row lane"]:
    """x[body], for bodies that are the same in every lane (a tuple), or not."""
    if isinstance(body, tuple):
        return rows(x, body)
    return _along(x, body)


def placed(bodies: int, body: Num[Array, " lane"], change: Float[Array, "row lane"]) -> Float[Array, "body row lane"]:
    """`change` at one body, zero at the others."""
    here = body == jnp.arange(bodies, dtype=body.dtype)[:, None]
    return jnp.where(here[:, None], change, 0.0)


def add(
    bodies: int, a: Bodies, on_a: Float[Array, "thing row lane"], b: Bodies, on_b: Float[Array, "thing row lane"]
) -> Float[Array, "body row lane"]:
    """What each body gets, if body a[i] gets on_a[i] and body b[i] gets on_b[i]."""
    each = jnp.concatenate([on_a, on_b])
    if isinstance(a, tuple) and isinstance(b, tuple):
        total = jnp.matmul(incidence(bodies, a + b), each.reshape(len(each), -1))
        return total.reshape(bodies, *each.shape[1:])
    number = jnp.concatenate([jnp.asarray(a), jnp.asarray(b)]).astype(each.dtype)[:, None]
    terms = (placed(bodies, x[-1], x[:-1]) for x in stored(jnp.concatenate([each, number], axis=1)))
    return functools.reduce(jnp.add, terms)
