"""New levels in the lanes whose episodes ended: in any one step they are few.

Sampling or copying levels in all lanes, then selecting, would take one to several times as long as the step itself.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from levelproof.physics.codegen.buffers import LANES

T = TypeVar("T")


def renewed(
    done: Bool[Array, " lane"], level_ids: Int[Array, " lane"], begin: Callable[[Int[Array, " lane"]], T], before: T
) -> T:
    """Return `before` (arrays, lanes last) with `begin(level_ids)` in the lanes that are done.

    Gathers the lanes that are done and begins them in blocks of LANES, as the sampler's kernel does; the other lanes
    cost next to nothing, and the last block begins up to LANES - 1 levels in vain.
    """
    count = done.shape[-1]
    (waiting,) = jnp.nonzero(done, size=-(-count // LANES) * LANES, fill_value=count)
    blocks = (done.sum(dtype=jnp.int32) + LANES - 1) // LANES

    def begin_block(i: Int[Array, ""], now: T) -> T:
        lanes = jax.lax.dynamic_slice_in_dim(waiting, i * LANES, LANES)
        fresh = begin(level_ids.at[lanes].get(mode="clip"))
        return jax.tree.map(lambda x, new: x.at[..., lanes].set(new, mode="drop"), now, fresh)

    return jax.lax.fori_loop(0, blocks, begin_block, before)
