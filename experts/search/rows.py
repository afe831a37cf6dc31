"""Exact conversion of states to rows of floats and back."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from levelproof.physics.types import State


def to_rows(state: State) -> Float[Array, "lane word"]:
    """Pack each lane's state into one row."""
    lanes = state.rotation.shape[-1]
    return jnp.concatenate([x.reshape(-1, lanes).astype(jnp.float32) for x in jax.tree.leaves(state)]).T


def from_rows(rows: Float[Array, "lane word"], like: State) -> State:
    """Unpack states from rows; `like` has their shapes and dtypes, with any number of lanes."""
    leaves, first, words = [], 0, rows.T
    for x in jax.tree.leaves(like):
        count = x[..., 0].size
        leaves.append(words[first : first + count].reshape(*x.shape[:-1], words.shape[-1]).astype(x.dtype))
        first += count
    return jax.tree.unflatten(jax.tree.structure(like), leaves)
