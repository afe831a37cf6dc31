"""From lanes to `vmap`: turn a function of lanes into a function of a single environment, without losing speed.

JAX cannot add a mapped axis to a function that works on all lanes at once (the physics step is one call of machine
code). A custom rule for `jax.vmap` turns the mapped axis into lanes instead; nested maps, also around a loop, merge
into one axis of lanes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Int

from levelproof.levelgen.batching import merge_lanes, split_lanes

OnLanes = Callable[[Any, Int[Array, " lane"], Any], Any]


def single(on_lanes: OnLanes) -> Callable[[Any, Int[Array, ""] | int, Any], Any]:
    """Turn a function of lanes into a function of one environment that `jax.vmap` maps efficiently.

    `on_lanes(table, index, inputs)` has lanes last in `index`, in every array of `inputs` and in its result. All lanes
    share the table; `index` chooses each lane's entry on the last axis of the table's arrays. The returned function
    has the same arguments and result without the lane axis.
    """
    merged = custom_vmap(on_lanes)

    @merged.def_vmap
    def as_lanes(batch: int, is_mapped: Any, table: Any, index: Array, inputs: Any) -> tuple[Any, Any]:
        lanes = index.shape[-1]
        merge = lambda x, mapped: merge_lanes(x if mapped else jnp.broadcast_to(x, (batch, *x.shape)))
        table_mapped, index_mapped, inputs_mapped = is_mapped
        index = merge(index, index_mapped)
        if any(jax.tree.leaves(table_mapped)):
            rows = jax.tree.leaves(table)[0].shape[-1]
            table = jax.tree.map(merge, table, table_mapped)
            index = index + rows * jnp.repeat(jnp.arange(batch, dtype=index.dtype), lanes)
        result = split_lanes(merged(table, index, jax.tree.map(merge, inputs, inputs_mapped)), lanes)
        return result, jax.tree.map(lambda _: True, result)

    def of_one(table: Any, index: Int[Array, ""] | int, inputs: Any) -> Any:
        result = merged(table, jnp.asarray(index)[None], jax.tree.map(lambda x: jnp.asarray(x)[..., None], inputs))
        return jax.tree.map(lambda x: x[..., 0], result)

    return of_one
