"""The vocabulary of kernels: functions of a block of lanes, over references whose last axis is the lanes.

A reference reads and writes rows: `ref[i]` is a row of lanes, and the index i may be known only at run time. A kernel
computes in all lanes whatever some lane needs, then selects; it skips what no lane needs. The same source becomes
machine code (`levelproof.physics.codegen`), or plain XLA operations on all lanes at once.

Whether a computation is skipped depends on the other lanes, so running it must change nothing in a lane that does not
need it. Three rules follow. Select the addend instead of scaling it: 0 times infinity is not 0. Let the lane's own
condition decide, not the expectation that the computation would find nothing. Let no result depend on the sign of a
zero: -0 + 0 is 0.
"""

import functools
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

NOBODY = -1  # index that means "no body"

Scalar = Int[Array, ""] | int
T = TypeVar("T")


class Rows(Protocol):
    """An array, or a reference to one, whose rows a kernel reads."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> np.dtype: ...

    def __getitem__(self, index: Any, /) -> Array: ...


class Ref(Rows, Protocol):
    """A reference to an array (`jax.Ref`), whose rows a kernel reads and writes."""

    def __setitem__(self, index: Any, value: ArrayLike, /) -> None: ...


def each(stop: Scalar, do: Callable[[Any], None], first: Scalar = 0) -> None:
    """Call do(i) for i = first, ..., stop - 1."""
    if isinstance(stop, int) and isinstance(first, int) and first >= stop:
        return  # without tracing `do`: the arrays may have no rows

    def body(i, _):
        do(i)

    jax.lax.fori_loop(first, stop, body, None)


def when(condition: Bool[Array, ""], do: Callable[[], None]) -> None:
    """Call do() if the condition holds."""
    jax.lax.cond(condition, do, lambda: None)


def anywhere(condition: Bool[Array, " lane"]) -> Bool[Array, ""]:
    """Whether the condition holds in any lane."""
    return jnp.any(condition)


def gather_pair(
    count: int, read: Callable[[Any], Array], a: Int[Array, " lane"], b: Int[Array, " lane"]
) -> tuple[Array, Array]:
    """Gather two of `count` rows by indices that differ by lane: read(a[lane])[..., lane] and the same for b."""

    def visit(i, picked):
        def choose():
            row = read(i)
            return tuple(jnp.where(index == i, row, x) for index, x in zip((a, b), picked, strict=True))

        return jax.lax.cond(anywhere((a == i) | (b == i)), choose, lambda: picked)

    first = read(0)
    return jax.lax.fori_loop(1, count, visit, (first, first))


def gather(count: int, read: Callable[[Any], T], index: Int[Array, " lane"]) -> T:
    """Gather one of `count` rows, each a tree of arrays, by an index that differs by lane: read(index).

    Returns zeros in lanes whose index is not one of these rows, such as NOBODY.
    """

    def visit(i, picked):
        return jax.tree.map(lambda x, so_far: jnp.where(index == i, x, so_far), read(i), picked)

    return jax.lax.fori_loop(0, count, visit, jax.tree.map(jnp.zeros_like, read(0)))


def put(index: Int[Array, " lane"], *changes: tuple[Ref, Array | float], first: int = 0) -> None:
    """Scatter: ref[index[lane], ..., lane] = value for each (ref, value).

    Indices below `first`, NOBODY among them, change nothing.
    """

    def row(i):
        def write():
            for ref, value in changes:
                ref[i] = jnp.where(index == i, value, ref[i])

        when(anywhere(index == i), write)

    each(changes[0][0].shape[0], row, first=first)


def scatter_add(ref: Ref, *changes: tuple[Int[Array, " lane"], Float[Array, "row lane"]], first: int = 0) -> None:
    """Scatter-add: ref[index[lane], ..., lane] += change for each (index, change).

    Indices below `first`, NOBODY among them, change nothing.
    """

    def add(i):
        hits = [index == i for index, _ in changes]

        def change():
            ref[i] += sum(jnp.where(hit, change, 0.0) for hit, (_, change) in zip(hits, changes, strict=True))

        when(anywhere(functools.reduce(jnp.logical_or, hits)), change)

    each(ref.shape[0], add, first=first)
