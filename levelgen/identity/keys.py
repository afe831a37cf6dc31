"""A level is its id: the random keys of everything that belongs to one level.

Every random stream has a name here and a key of its own, derived from the level id alone, so that nothing about
a level depends on its neighbours, its work unit or its worker.
"""

from enum import IntEnum

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

SAMPLER_VERSION = 1  # raise it when the same id would give another level, or other random streams
GENERATOR = "threefry2x32"  # named, not JAX's default: the same numbers everywhere
ROOT_SEED = 0
MAX_LEVEL_ID = 2**31 - 1


class Stream(IntEnum):
    """What a level's random numbers are used for. The numbers are part of every result: never reuse one."""

    LEVEL = 0  # the sampler
    EXPERT = 1  # initial networks, exploration, minibatches
    EVALUATION = 2  # the record that labels the level


def level_key(level_id: Int[Array, ""] | int) -> Key[Array, ""]:
    """The key all of a level's streams derive from.

    `level_id` is 0 .. MAX_LEVEL_ID; it may be traced, and mapped with `jax.vmap`.
    """
    root = jax.random.key(ROOT_SEED, impl=GENERATOR)
    return jax.random.fold_in(jax.random.fold_in(root, SAMPLER_VERSION), jnp.asarray(level_id, jnp.uint32))


def key_for(level_id: Int[Array, ""] | int, stream: Stream) -> Key[Array, ""]:
    """The key of one named stream of a level."""
    return jax.random.fold_in(level_key(level_id), int(stream))
