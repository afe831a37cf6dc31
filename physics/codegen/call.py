"""From a function of references to one of arrays: machine code on a CPU, or plain XLA operations on all lanes at once.

A kernel's function takes four trees of references: arguments, lookup tables, results, scratch memory. Arguments and
results have lanes; tables are numpy arrays without.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cache, wraps
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from levelproof.physics.codegen.buffers import LANES, Buffer
from levelproof.physics.codegen.compile import COMPILING, register, write
from levelproof.physics.codegen.kept import cached_by_sources

T = TypeVar("T")
R = TypeVar("R")
Body = Callable[[Any, Any, Any, Any], None]  # body(arguments, tables, results, scratch), trees of references


def by_platform(as_machine_code: Callable[[T], R], on_all_lanes: Callable[[T], R], given: T) -> R:
    """Call `as_machine_code` in a program for a CPU, else `on_all_lanes`."""
    if jax.default_backend() == "cpu":
        return as_machine_code(given)
    return jax.lax.platform_dependent(given, cpu=as_machine_code, default=on_all_lanes)


@dataclass(frozen=True)
class Kernel:
    """A function of a block of lanes, and the buffers that it reads, fills and works in."""

    body: Body
    arguments: Any  # a tree of Buffers; the first has lanes
    tables: Any  # a tree of numpy arrays
    results: Any  # a tree of Buffers
    scratch: Any  # a tree of Buffers

    @property
    def buffers(self) -> tuple[Any, Any, Any, Any]:
        """Buffers of arguments, tables, results and scratch memory."""
        tables = jax.tree.map(lambda x: Buffer(x.shape, str(x.dtype), lanes=False), self.tables)
        return self.arguments, tables, self.results, self.scratch

    def trace(self) -> Any:
        """Trace the kernel of a block to a jaxpr that takes one reference for each leaf of `buffers`."""

        def kernel(*arrays):
            self.body(*jax.tree.map(jax.new_ref, arrays))

        # Under `jax.shard_map`, JAX would add equations that move arrays between the mesh's devices. Under
        # `jax.disable_jit`, loops would be unrolled, and the long code be kept for other processes. The strict modes
        # of promotion refuse the kernels' code.
        with (
            jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())),
            jax.disable_jit(False),
            jax.numpy_dtype_promotion("standard"),
            jax.numpy_rank_promotion("allow"),
        ):
            return jax.make_jaxpr(kernel)(*jax.tree.map(Buffer.array, self.buffers))

    def compiled(self, request: str, sources: Sequence[Path]) -> "Compiled":
        """Compile the kernel, for `compiled_once`.

        `request` and the files in the folders `sources` must determine its code.

        Raises:
            NotImplementedError: the kernel uses a feature that `lower` does not support.
        """
        reads, tables, results, scratch = map(jax.tree.leaves, self.buffers)
        text = lambda: write(self.trace(), [*reads, *tables], results, scratch).encode()
        name = register(cached_by_sources(f"{self.buffers!r} {request}", text, sources).decode())
        return Compiled(name, self.arguments, self.tables, self.results, sum(buffer.bytes for buffer in scratch))

    def on_all_lanes(self, arguments: Any, lanes: int, dtype: Any = jnp.float32) -> Any:
        """Run the kernel as XLA operations on all lanes: slow on a CPU, but anywhere and in any precision.

        Raises:
            ValueError, TypeError: as `require_fit`.
        """
        require_fit(arguments, self.arguments, {lanes}, str(jnp.dtype(dtype)))
        is_float = lambda x: x.dtype == jnp.float32

        def empty(buffer: Buffer):
            array = buffer.array(lanes)
            return jax.new_ref(jnp.zeros(array.shape, dtype if is_float(array) else array.dtype))

        table = lambda x: jax.new_ref(jnp.asarray(x, dtype if is_float(x) else x.dtype))
        results = jax.tree.map(empty, self.results)
        self.body(
            jax.tree.map(jax.new_ref, arguments),
            jax.tree.map(table, self.tables),
            results,
            jax.tree.map(empty, self.scratch),
        )
        return jax.tree.map(lambda ref: ref[...], results)


def require_fit(
    arguments: Any, buffers: Any, lanes: Collection[int], float_dtype: str = "float32", what: str = "here"
) -> None:
    """Check each array's shape and dtype against its buffer.

    Args:
        arguments: a tree of arrays.
        buffers: the tree of their Buffers.
        lanes: accepted numbers of lanes; errors name the largest.
        float_dtype: required dtype of arrays whose buffers are float32.
        what: phrase by which errors name the worlds that the buffers are for.

    Raises:
        ValueError: an array's shape differs.
        TypeError: an array's dtype differs.
    """

    def check(path: Any, x: Any, buffer: Buffer) -> None:
        name = jax.tree_util.keystr(path).lstrip(".") or "the argument"
        if x.shape not in [buffer.array(count).shape for count in lanes]:
            raise ValueError(
                f"{name} has shape {x.shape}, but must be {buffer.array(max(lanes)).shape} {what}: give arrays of one "
                "size, with the lanes last"
            )
        wanted = float_dtype if buffer.dtype == "float32" else buffer.dtype
        if (dtype := str(jax.dtypes.canonicalize_dtype(x.dtype))) != wanted:
            raise TypeError(f"{name} is {dtype}, but must be {wanted}: convert it")

    jax.tree_util.tree_map_with_path(check, arguments, buffers)


def compiled_once(make: Callable[..., "Compiled"]) -> Callable[..., "Compiled"]:
    """Decorate a function that compiles a kernel: calls with equal arguments compile it once, whatever the thread.

    The lock is held around the cache, too: two threads that miss it together would compile twice.
    """
    kept = cache(make)

    @wraps(make)
    def compiled(*arguments: Any) -> Compiled:
        with COMPILING:
            return kept(*arguments)

    compiled.forget = kept.cache_clear  # pyright: ignore[reportAttributeAccessIssue]
    return compiled


@dataclass(frozen=True)
class Compiled:
    """A kernel's machine code, registered with XLA."""

    name: str
    arguments: Any
    tables: Any
    results: Any
    scratch_bytes: int

    def __call__(self, arguments: Any, lanes: int) -> Any:
        """Run on arrays with `lanes` lanes each, in blocks of LANES; the last block is padded.

        Raises:
            ValueError, TypeError: as `require_fit`; machine code itself checks no bounds.
        """
        require_fit(arguments, self.arguments, {lanes})
        missing = -lanes % LANES
        pad = lambda x: jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, missing)], mode="edge")
        arguments = jax.tree.map(pad, arguments) if missing else arguments
        shapes = [buffer.array(lanes + missing) for buffer in jax.tree.leaves(self.results)]
        call = jax.ffi.ffi_call(self.name, [*shapes, jax.ShapeDtypeStruct((self.scratch_bytes,), np.uint8)])
        *results, _ = call(*jax.tree.leaves(arguments), *jax.tree.leaves(self.tables))
        results = [x[..., :lanes] for x in results] if missing else results
        return jax.tree.unflatten(jax.tree.structure(self.results), results)
