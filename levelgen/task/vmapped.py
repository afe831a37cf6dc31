"""From lanes to `vmap`: a function of lanes becomes one of a single environment, without losing its speed.

What works on all lanes at once (the physics step is one call of machine code) cannot be mapped by JAX over an axis
of its own. Here `jax.vmap` is told what to do instead: the mapped axis becomes lanes. Mapped again, or mapped around
a loop, the axes merge into one axis of lanes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Int

OnLanes = Callable[[Any, Int[Array, " lane"], Any], Any]


def single(on_lanes: OnLanes) -> Callable[[Any, Int[Array, ""] | int, Any], Any]:
    """The function of one environment that a function of lanes amounts to.

    `on_lanes(table, index, given)` has lanes last in `index`, in every array of `given` and in its result. The table
    is shared by all lanes; its arrays have rows to choose from on their last axis, and `index` chooses a lane's own.
    The result takes and gives the same without the axis of lanes.
    """
    merged = custom_vmap(on_lanes)

    @merged.def_vmap
    def as_lanes(batch: int, is_mapped: Any, table: Any, index: Array, given: Any) -> tuple[Any, Any]:
        lanes = index.shape[-1]
        merge = lambda x, mapped: _merge(x if mapped else jnp.broadcast_to(x, (batch, *x.shape)))
        table_mapped, index_mapped, given_mapped = is_mapped
        index = merge(index, index_mapped)
        if any(jax.tree.leaves(table_mapped)):
            rows = jax.tree.leaves(table)[0].shape[-1]
            table = jax.tree.map(merge, table, table_mapped)
            index = index + rows * jnp.repeat(jnp.arange(batch, dtype=index.dtype), lanes)
        result = merged(table, index, jax.tree.map(merge, given, given_mapped))
        result = jax.tree.map(lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], batch, lanes), -2, 0), result)
        return result, jax.tree.map(lambda _: True, result)

    def of_one(table: Any, index: Int[Array, ""] | int, given: Any) -> Any:
        result = merged(table, jnp.asarray(index)[None], jax.tree.map(lambda x: jnp.asarray(x)[..., None], given))
        return jax.tree.map(lambda x: x[..., 0], result)

    return of_one


def _merge(x: Array) -> Array:
    """[batch, ..., lane] -> [..., batch * lane]."""
    return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], x.shape[0] * x.shape[-1])
