"""One physics step of every lane: machine code on a CPU, XLA operations elsewhere.

Both come from one source, `physics.engine.step_block`, a function of references to the arrays of a block of lanes;
tests compare the two.
"""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from levelproof.physics.block import Block, Inputs, Scratch
from levelproof.physics.buffers import buffers_like, buffers_of
from levelproof.physics.codegen.buffers import LANES, Buffer
from levelproof.physics.codegen.compile import COMPILING, register, write
from levelproof.physics.codegen.kept import cached_by_sources
from levelproof.physics.engine import STAGES, Stage, step_block
from levelproof.physics.pairs import table_of
from levelproof.physics.types import DEFAULT_PARAMS, Manifold, Model, Params, Size, State


def step(
    model: Model,
    state: State,
    motor: Float[Array, "joint lane"],
    thrust: Float[Array, "thruster lane"],
    params: Params = DEFAULT_PARAMS,
    seen: bool = True,
) -> tuple[State, Any]:
    """Advance every lane by `params.dt`.

    Args:
        model: constants of each lane's level.
        state: the worlds before the step.
        motor: control of each joint's motor, in [-1, 1].
        thrust: control of each thruster, in [0, 1].
        params: constants of the engine.
        seen: whether to return the contacts; `State.contact_active` says in any case which were active.

    Returns:
        The worlds after the step, and the contacts found at its start: a Manifold, or None unless `seen`.

    Raises:
        ValueError: an array's shape differs from its annotation for the model's size.
        TypeError: an array's dtype differs from its annotation.
    """
    inputs = Inputs(model, state, motor, thrust)
    if state.position.dtype != jnp.float32:
        return on_all_lanes(inputs, params, seen)
    if jax.default_backend() == "cpu":
        return as_machine_code(inputs, params, seen)
    ways = {"cpu": as_machine_code, "default": on_all_lanes}
    return jax.lax.platform_dependent(
        inputs, **{name: lambda inputs, way=way: way(inputs, params, seen) for name, way in ways.items()}
    )


def on_all_lanes(inputs: Inputs, params: Params, seen: bool) -> tuple[State, Any]:
    """Step with XLA operations, all lanes as one block: slow on a CPU, but runs anywhere and in any precision."""
    size, dtype = inputs.model.size, jax.dtypes.canonicalize_dtype(inputs.before.position.dtype)
    inputs, lanes = as_annotated(inputs, str(dtype))

    def empty(buffer: Buffer):
        array = buffer.array(lanes)
        return jax.new_ref(jnp.zeros(array.shape, dtype if array.dtype == jnp.float32 else array.dtype))

    table = jax.tree.map(jnp.asarray, table_of(size, params.faithful_padding))
    table = jax.tree.map(lambda x: jax.new_ref(x.astype(dtype) if x.dtype == jnp.float32 else x), table)
    read = jax.tree.map(jax.new_ref, inputs)
    after = jax.tree.map(lambda x: jax.new_ref(jnp.zeros_like(x)), inputs.before)
    contacts = jax.tree.map(empty, buffers_of(Manifold, size)) if seen else None
    step_block(Block(table, read, after, contacts, jax.tree.map(empty, buffers_of(Scratch, size))), params)
    return jax.tree.map(lambda ref: ref[...], (after, contacts))


def as_machine_code(
    inputs: Inputs, params: Params, seen: bool, stages: tuple[Stage, ...] = STAGES
) -> tuple[State, Any]:
    """Step with machine code for this CPU, in blocks of LANES lanes; the last block is padded.

    With fewer `stages` it takes less time and leaves results unwritten: for measuring what each stage costs.
    """
    inputs, lanes = as_annotated(inputs)  # the kernel trusts the annotated shapes and checks no bounds
    with COMPILING:
        name, outputs, scratch_bytes = _compiled(inputs.model.size, params, seen, buffers_like(inputs), stages)
    missing = -lanes % LANES
    pad = lambda x: jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, missing)], mode="edge")
    inputs = jax.tree.map(pad, inputs) if missing else inputs
    results = [buffer.array(lanes + missing) for buffer in jax.tree.leaves(outputs)]
    call = jax.ffi.ffi_call(name, [*results, jax.ShapeDtypeStruct((scratch_bytes,), np.uint8)])
    *results, _ = call(*jax.tree.leaves(inputs), *table_of(inputs.model.size, params.faithful_padding))
    results = [x[..., :lanes] for x in results] if missing else results
    return jax.tree.unflatten(jax.tree.structure(outputs), results)


def as_annotated(inputs: Inputs, float_dtype: str = "float32") -> tuple[Inputs, int]:
    """Check each array's shape and dtype against its annotation; return them with equal lanes, and the lane count.

    Args:
        inputs: inputs of a step; a single lane broadcasts.
        float_dtype: required dtype of arrays annotated as Float.

    Raises:
        ValueError: an array's shape differs.
        TypeError: an array's dtype differs.
    """
    size = inputs.model.size
    lanes = max(x.shape[-1] if x.shape else 1 for x in jax.tree.leaves(inputs))

    def fitted(path: Any, x: Any, buffer: Buffer) -> Any:
        name, shape = jax.tree_util.keystr(path).lstrip("."), (*buffer.shape, lanes)
        if x.shape[:-1] != buffer.shape or not x.shape or x.shape[-1] not in (1, lanes):
            raise ValueError(
                f"{name} has shape {x.shape}, but must be {shape} in worlds of {size}: give arrays of one size, "
                "with the lanes last"
            )
        wanted = float_dtype if buffer.dtype == "float32" else buffer.dtype
        if (dtype := str(jax.dtypes.canonicalize_dtype(x.dtype))) != wanted:
            raise TypeError(f"{name} is {dtype}, but must be {wanted}: convert it")
        return jnp.broadcast_to(x, shape)

    return jax.tree_util.tree_map_with_path(fitted, inputs, buffers_of(Inputs, size)), lanes


@cache
def _compiled(
    size: Size, params: Params, seen: bool, inputs: Inputs, stages: tuple[Stage, ...]
) -> tuple[str, Any, int]:
    """Compile a step; return its name for `jax.ffi.ffi_call`, its results' buffers and its scratch memory in bytes."""
    buffers = block_buffers(size, params, seen, inputs)
    reads, table, results, scratch = map(jax.tree.leaves, buffers)
    text = lambda: write(trace(buffers, params, stages), [*reads, *table], results, scratch).encode()
    request = repr((buffers, params, [(stage.__module__, stage.__qualname__) for stage in stages]))
    name = register(cached_by_sources(request, text).decode())
    return name, buffers[2], sum(buffer.bytes for buffer in scratch)


def block_buffers(size: Size, params: Params, seen: bool, inputs: Inputs) -> tuple[Inputs, Any, Any, Any]:
    """Return the buffers of a block's step: inputs, lookup tables, results, scratch memory."""
    table = jax.tree.map(lambda x: Buffer(x.shape, str(x.dtype), lanes=False), table_of(size, params.faithful_padding))
    results = inputs.before, buffers_of(Manifold, size) if seen else None
    return inputs, table, results, buffers_of(Scratch, size)


def trace(buffers: tuple[Inputs, Any, Any, Any], params: Params, stages: tuple[Stage, ...] = STAGES) -> Any:
    """Trace the step of a block to a jaxpr whose function takes one reference for each leaf of `block_buffers`."""

    def kernel(*arrays):
        inputs, table, (after, contacts), scratch = jax.tree.map(jax.new_ref, arrays)
        step_block(Block(table, inputs, after, contacts, scratch), params, stages)

    return jax.make_jaxpr(kernel)(*jax.tree.map(Buffer.array, buffers))
