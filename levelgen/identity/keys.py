"""Random keys of a level, all derived from its id.

Every random stream has a name here and its own key, derived from the level id alone, so that nothing about a level
depends on its neighbours, its work unit or its worker.
"""

from collections.abc import Callable
from enum import IntEnum
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import define_prng_impl, threefry_prng_impl
from jaxtyping import Array, Int, Key
from numpy.typing import ArrayLike

SAMPLER_VERSION = 2  # of the sampler's arithmetic: increment if a change alters any bit of the level of any id
STREAMS = 1  # folded into the root key for all keys of levels
SEEDS = 0x5EED  # folded into the root key for all keys of seeds
ROOT_KEY = (0, 0)  # the key's words; to a seed, JAX would add `jax_random_seed_offset`
MAX_LEVEL_ID = 2**31 - 1  # fits into 32 bits, signed or unsigned
FRESH_BITS = 30  # of an id drawn at random, which keeps it below the ids of levels that policies are measured on


def _pinned(draw: Callable[..., Any]) -> Callable[..., Any]:
    """Run a function of JAX's generator as if `jax_threefry_partitionable` were True, the default since JAX 0.5."""

    @wraps(draw)
    def drawn(*arguments: Any) -> Any:
        with jax.threefry_partitionable(True):
            return draw(*arguments)

    return drawn


# Keys carry their generator, so every draw from one is pinned, even in a caller's own `jax.jit`
GENERATOR = define_prng_impl(
    key_shape=threefry_prng_impl.key_shape,
    seed=_pinned(threefry_prng_impl.seed),
    split=_pinned(threefry_prng_impl.split),
    random_bits=_pinned(threefry_prng_impl.random_bits),
    fold_in=_pinned(threefry_prng_impl.fold_in),
    name="threefry2x32_partitionable",
    tag="fry",
)


class Stream(IntEnum):
    """Uses of a level's random numbers. Every result depends on these values: never reuse one."""

    LEVEL = 0  # the sampler
    EXPERT = 1  # initial networks, exploration, minibatches
    EVALUATION = 2  # the record that labels the level
    SCOUT = 3  # reserved: random play before training, in earlier versions
    SEARCH = 4  # exploration of a search
    PORTABILITY = 5  # the perturbed starts from which witnesses are replayed
    SUCCESS_RATE = 6  # attempts of an expert whose training has ended
    POLICY = 7  # attempts of a policy for all levels, when it is evaluated


def level_id_array(level_ids: ArrayLike) -> Int[np.ndarray, " level"]:
    """Validate level ids; return them as int32 on the host.

    Raises:
        ValueError: they are not a list of integers, or one is not 0 .. MAX_LEVEL_ID.
    """
    ids = np.asarray(level_ids)
    if ids.ndim != 1 or (len(ids) and not np.issubdtype(ids.dtype, np.integer)):
        raise ValueError(f"level ids must be a list of integers, but these are {ids.dtype} of shape {ids.shape}")
    if len(ids) and not 0 <= ids.min() <= ids.max() <= MAX_LEVEL_ID:
        raise ValueError(f"level ids run from {ids.min()} to {ids.max()}, but must be within 0 to {MAX_LEVEL_ID}")
    return ids.astype(np.int32)


def key_for(level_id: Int[Array, ""] | int, stream: Stream) -> Key[Array, ""]:
    """Return the key of one named stream of a level.

    `level_id` is 0 .. MAX_LEVEL_ID; it may be traced, and mapped with `jax.vmap`.
    """
    level_key = jax.random.fold_in(jax.random.fold_in(_root(), STREAMS), level_id)
    return jax.random.fold_in(level_key, int(stream))


def key_of_seed(seed: Int[Array, ""] | int) -> Key[Array, ""]:
    """Return a key that belongs to no level, such as that of a network's initial weights; `seed` is 0 or more."""
    return jax.random.fold_in(jax.random.fold_in(_root(), SEEDS), seed)


def _root() -> Key[Array, ""]:
    return jax.random.wrap_key_data(jnp.array(ROOT_KEY, jnp.uint32), impl=GENERATOR)
