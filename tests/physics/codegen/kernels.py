"""Small kernels, run as machine code and as XLA operations."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st

from levelproof.physics.codegen.buffers import LANES, Buffer
from levelproof.physics.codegen.compile import register, write

Arrays = Sequence[np.ndarray]


def rows(elements: st.SearchStrategy, dtype: Any, count: int = 3) -> st.SearchStrategy[np.ndarray]:
    """Draw rows [count, lane] of one block."""
    numbers = st.lists(elements, min_size=count * LANES, max_size=count * LANES)
    return numbers.map(lambda x: np.array(x, dtype).reshape(count, LANES))


class Kernel:
    """A kernel `body(*references)` with its arguments, results and scratch memory; the first argument has lanes."""

    def __init__(
        self,
        body: Callable[..., None],
        arguments: Sequence[Buffer],
        results: Sequence[Buffer],
        scratch: Sequence[Buffer] = (),
    ) -> None:
        self.body, self.arguments, self.results, self.scratch = body, arguments, results, scratch

    @functools.cached_property
    def _name(self) -> str:
        """Name of the kernel, compiled as `physics.step` compiles the step."""

        def kernel(*arrays):
            self.body(*map(jax.new_ref, arrays))

        jaxpr = jax.make_jaxpr(kernel)(*map(Buffer.array, [*self.arguments, *self.results, *self.scratch]))
        return register(write(jaxpr, self.arguments, self.results, self.scratch))

    def as_machine_code(self, *arguments: np.ndarray) -> list[np.ndarray]:
        """Run the kernel as machine code on arguments of one or more blocks of lanes."""
        return [np.asarray(x) for x in self._machine_code(arguments)[:-1]]

    @functools.cached_property
    def _machine_code(self) -> Any:
        def call(arguments):
            shapes = [buffer.array(arguments[0].shape[-1]) for buffer in self.results]
            workspace = jax.ShapeDtypeStruct((sum(buffer.bytes for buffer in self.scratch),), np.uint8)
            return jax.ffi.ffi_call(self._name, [*shapes, workspace])(*arguments)

        return jax.jit(call)

    def as_xla(self, *arguments: np.ndarray) -> list[np.ndarray]:
        """Run the kernel as XLA operations, block after block."""
        blocks = []
        for first in range(0, arguments[0].shape[-1], LANES):
            block = [
                x[..., first : first + LANES] if buffer.lanes else x
                for x, buffer in zip(arguments, self.arguments, strict=True)
            ]
            blocks.append([np.asarray(x) for x in self._xla(block)])
        return [
            np.concatenate([block[i] for block in blocks], -1) if buffer.lanes else blocks[-1][i]
            for i, buffer in enumerate(self.results)
        ]

    @functools.cached_property
    def _xla(self) -> Any:
        def run(block):
            given = [jax.new_ref(jnp.asarray(x)) for x in block]
            filled, scratch = (
                [jax.new_ref(jnp.zeros(buffer.array().shape, buffer.dtype)) for buffer in buffers]
                for buffers in (self.results, self.scratch)
            )
            self.body(*given, *filled, *scratch)
            return [ref[...] for ref in filled]

        return jax.jit(run)


def same_bits(ours: Arrays, theirs: Arrays, zeros: bool = True) -> None:
    """Assert equal bits; all NaN count as equal. `zeros`: whether the sign of zeros counts."""
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(a, b)
        if zeros and a.dtype == np.float32:
            np.testing.assert_array_equal(np.signbit(a) & ~np.isnan(a), np.signbit(b) & ~np.isnan(b))
