"""Lanes that go through a network together.

The activations of many lanes do not fit a core's cache, and each layer then waits for memory: the gradient of 1,024
lanes takes two (`s`) to four times (`l`) as long at once as in chunks.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from levelproof.physics.types import FIXED_POLYGONS, Size

ENTITIES = 1536  # of all lanes of a chunk; measured on a core with 1 MiB of cache, at widths of 48 and 64
T = TypeVar("T")


def lanes_at_once(size: Size, lanes: int) -> int:
    """Return the number of lanes of a chunk, a divisor of `lanes`.

    On a CPU these are few, unless no divisor is near to what fits the cache; then, and on a GPU, all.
    """
    if jax.default_backend() != "cpu":
        return lanes
    entities = size.polygons - FIXED_POLYGONS + 1 + size.circles + size.joints + size.thrusters
    most = max(ENTITIES // entities, 1)
    return next((few for few in range(most, most // 4, -1) if lanes % few == 0), lanes)


def in_chunks(tree: T, lanes: int) -> T:
    """Cut arrays [..., lane] into chunks of `lanes`: [chunk, ..., lane]."""
    cut = lambda x: x.reshape(*x.shape[:-1], x.shape[-1] // lanes, lanes)
    return jax.tree.map(lambda x: jnp.moveaxis(cut(x), -2, 0), tree)


def chunk_by_chunk(function: Callable[[Any], T], tree: Any, lanes: int) -> T:
    """Apply a function of arrays [..., lane] to one chunk of `lanes` after another, and join what it returns."""
    parts = jax.lax.map(function, in_chunks(tree, lanes))
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], len(x) * lanes), parts)
