"""How a kernel is written: for a block of lanes, over references to arrays whose last axis are the lanes.

A reference reads and writes rows: `ref[i]` is a row of lanes, i a number that may be known only at run time. What
differs between lanes is computed in all of them and selected; what no lane needs is skipped. The same source becomes
machine code (`physics.codegen`), or plain XLA operations on all lanes at once.

Whether something is skipped depends on the other lanes, so computing it must change nothing in a lane that does not
need it. Select what is added there, for 0 times infinity is not 0; let a lane's own condition decide, not a guess that
the computation would find nothing; and let no result show the sign of a zero, for -0 + 0 is 0.
"""

import functools
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

NOBODY = -1  # instead of a body's number

Scalar = Int[Array, ""] | int


class Rows(Protocol):
    """An array, or a reference to one, of which a kernel reads rows."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> np.dtype: ...

    def __getitem__(self, index: Any, /) -> Array: ...


class Ref(Rows, Protocol):
    """A reference to an array (`jax.Ref`), of which a kernel reads and writes rows."""

    def __setitem__(self, index: Any, value: ArrayLike, /) -> None: ...


def each(count: Scalar, do: Callable[[Any], None], first: Scalar = 0) -> None:
    """do(i) for i = first, ..., count - 1."""
    if isinstance(count, int) and isinstance(first, int) and first >= count:
        return  # not even traced: there may be no row to speak of

    def body(i, _):
        do(i)

    jax.lax.fori_loop(first, count, body, None)


def when(condition: Bool[Array, ""], do: Callable[[], None]) -> None:
    """do() if the condition holds."""
    jax.lax.cond(condition, do, lambda: None)


def anywhere(condition: Bool[Array, " lane"]) -> Bool[Array, ""]:
    """Whether it holds in any lane."""
    return jnp.any(condition)


def pick(
    count: int, read: Callable[[Any], Array], a: Int[Array, " lane"], b: Int[Array, " lane"]
) -> tuple[Array, Array]:
    """read(a[lane])[..., lane] and read(b[lane])[..., lane], of `count` rows, where the number differs by lane."""

    def look(i, found):
        def choose():
            row = read(i)
            return tuple(jnp.where(number == i, row, x) for number, x in zip((a, b), found, strict=True))

        return jax.lax.cond(anywhere((a == i) | (b == i)), choose, lambda: found)

    first = read(0)
    return jax.lax.fori_loop(1, count, look, (first, first))


def spread(ref: Ref, *changes: tuple[Int[Array, " lane"], Float[Array, "row lane"]], first: int = 0) -> None:
    """ref[number[lane], ..., lane] += change, for each (number, change); numbers below `first`, NOBODY
    among them, are left alone."""

    def add(i):
        here = [number == i for number, _ in changes]

        def change():
            ref[i] += sum(jnp.where(mine, change, 0.0) for mine, (_, change) in zip(here, changes, strict=True))

        when(anywhere(functools.reduce(jnp.logical_or, here)), change)

    each(ref.shape[0], add, first=first)
