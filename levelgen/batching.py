"""Batches of lanes in a few fixed sizes: a compiled program serves one lane count, and compiling takes seconds.

A batch with fewer lanes than its program is padded with copies of its last lane.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

LANES = 64  # in a batch of replays
BATCHES = (16, 64, 256)  # levels per batch: one program for each of these, not one for each count
LANES_ON_ACCELERATOR = 32_768  # enough to keep an accelerator busy

T = TypeVar("T")


def blocks(count: int, size: int = LANES) -> Iterator[np.ndarray]:
    """Yield the lane indices of each batch of `size`; the last batch is padded with its last index."""
    for first in range(0, count, size):
        yield np.minimum(np.arange(first, first + size), count - 1)


def by_blocks(program: Callable[[np.ndarray], T], count: int, size: int = LANES) -> T:
    """Call a program with the lanes of each batch, at least one; return what it returns for all `count`, on the host.

    Args:
        program: returns arrays whose last axis has the lanes that it is called with.
        count: number of lanes, from 1 on.
        size: lanes per batch.
    """
    parts = [jax.device_get(program(lanes)) for lanes in blocks(count, size)]
    return jax.tree.map(lambda *xs: np.concatenate(xs, -1)[..., :count], *parts)


def block_size(count: int, most: int) -> int:
    """Return the smallest of BATCHES and `most` that has room for `count` levels, or `most` if none has."""
    return min((size for size in (*BATCHES, most) if count <= size <= most), default=most)


def at_once(lanes: int, in_cache: int) -> int:
    """Return the number of items per program call, each of `lanes` lanes; `in_cache`: lanes that fit a core's cache."""
    return max(1, (in_cache if jax.default_backend() == "cpu" else LANES_ON_ACCELERATOR) // lanes)


def take(tree: T, lanes: np.ndarray | slice) -> T:
    """Select these lanes from every array; in slices, numpy arrays are views."""

    def select(x: Any) -> Any:
        # `np.take` is three times as fast as an index, but would first copy an array of another layout
        if isinstance(x, np.ndarray) and x.flags.c_contiguous and not isinstance(lanes, slice):
            return np.take(x, lanes, -1)
        return x[..., lanes]

    return jax.tree.map(select, tree)


def stacked(trees: Iterable[T]) -> T:
    """Join trees of equal structure, at least one, along a new first axis, on the host."""
    return jax.tree.map(lambda *xs: np.stack(xs), *trees)


def repeat(tree: T, lanes: int) -> T:
    """Copy each level into `lanes` neighbouring lanes."""
    return jax.tree.map(lambda x: jnp.repeat(x, lanes, axis=-1), tree)


def split_lanes(tree: T, lanes: int) -> T:
    """Cut arrays [..., lane] into parts of `lanes` neighbouring lanes: [part, ..., lane]."""
    cut = lambda x: x.reshape(*x.shape[:-1], x.shape[-1] // lanes, lanes)
    return jax.tree.map(lambda x: jnp.moveaxis(cut(x), -2, 0), tree)


def merge_lanes(tree: T) -> T:
    """Join arrays [part, ..., lane] to [..., lane], the inverse of `split_lanes`."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], x.shape[0] * x.shape[-1]), tree)


def merge_steps(tree: T) -> T:
    """Join arrays [step, ..., lane] to [..., lane], each old lane's steps side by side; numpy arrays stay numpy's."""
    last = lambda x: x.transpose(*range(1, x.ndim), 0)
    return jax.tree.map(lambda x: last(x).reshape(*x.shape[1:-1], x.shape[0] * x.shape[-1]), tree)
