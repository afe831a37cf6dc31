"""Lanes that go through a network together.

The activations of many lanes do not fit a core's cache, and each layer then waits for memory: the gradient of 1,024
lanes takes two (`s`) to four times (`l`) as long at once as in chunks.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from levelproof.levelgen.batching import merge_lanes, split_lanes
from levelproof.physics.types import FIXED_POLYGONS, Size

ENTITIES = 1536  # of all lanes of a chunk; measured on a core with 1 MiB of cache, at widths of 48 and 64
T = TypeVar("T")
P = TypeVar("P")


def lanes_at_once(size: Size, lanes: int) -> int:
    """Return the number of lanes of a chunk, a divisor of `lanes`.

    On a CPU, the largest divisor that fits the cache; if it is under about a quarter of what fits, or on a GPU: all.
    """
    if jax.default_backend() != "cpu":
        return lanes
    entities = size.polygons - FIXED_POLYGONS + 1 + size.circles + size.joints + size.thrusters
    most = max(ENTITIES // entities, 1)
    return next((few for few in range(most, most // 4, -1) if lanes % few == 0), lanes)


def chunk_by_chunk(function: Callable[[Any], T], tree: Any, lanes: int) -> T:
    """Apply a function of arrays [..., lane] to one chunk of `lanes` after another, and join what it returns."""
    return merge_lanes(jax.lax.map(function, split_lanes(tree, lanes)))


def mean_gradient(loss: Callable[[P, Any], tuple[Array, T]], params: P, chunks: Any) -> tuple[P, T]:
    """Return a loss's gradient, and what else it returns, one chunk after another; both are means over the chunks.

    Args:
        loss: of parameters and a chunk.
        params: the parameters.
        chunks: all chunks, of equal numbers of lanes, chunk axis first.
    """
    differentiate = jax.value_and_grad(loss, has_aux=True)

    def add(total: Any, chunk: Any) -> tuple[Any, None]:
        (_, further), gradient = differentiate(params, chunk)
        return jax.tree.map(jnp.add, total, (gradient, further)), None

    first = jax.tree.map(lambda x: x[0], chunks)
    zeros = jax.tree.map(jnp.zeros_like, (params, jax.eval_shape(loss, params, first)[1]))
    total, _ = jax.lax.scan(add, zeros, chunks)
    return jax.tree.map(lambda x: x / len(jax.tree.leaves(chunks)[0]), total)
