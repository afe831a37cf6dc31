"""What the solver moves: positions and velocities of all bodies; and the choice of a body that differs by lane.

Everything that one kernel should touch together lies in one array: XLA's CPU backend makes a kernel for every array
it writes, and computes anew in each what they share.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from physics.types import Model


class Motion(NamedTuple):
    position: Float[Array, "body 2 lane"]
    velocity: Float[Array, "body 3 lane"]  # x, y, angular


def inverse_masses(model: Model) -> Float[Array, "body 3 lane"]:
    """What turns an impulse (x, y, angular) into a change of velocity."""
    return jnp.stack([model.inverse_mass, model.inverse_mass, model.inverse_inertia], axis=1)


def select(x: Float[Array, "body lane"], body: Int[Array, " lane"]) -> Float[Array, " lane"]:
    """x[body[lane], lane] as a chain of selects: a gather would leave the vector units."""
    chosen = x[0]
    for b in range(1, x.shape[0]):
        chosen = jnp.where(body == b, x[b], chosen)
    return chosen


def one_hot(body: Int[Array, "*thing lane"], bodies: int) -> Bool[Array, "*thing body lane"]:
    return body[..., None, :] == jnp.arange(bodies, dtype=body.dtype)[:, None]


def pick(held: Bool[Array, "body lane"], x: Float[Array, "body row lane"]) -> Float[Array, "row lane"]:
    """The rows of the one body that is held."""
    return jnp.where(held[:, None], x, 0.0).sum(0)


def incidence(bodies: int, index: Sequence[int]) -> Float[np.ndarray, "body row"]:
    """Matrix that adds row i to body index[i]. A product with it is a fast kernel, and adds in a fixed order."""
    return (np.arange(bodies)[:, None] == np.asarray(index)).astype(np.float32)
