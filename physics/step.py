"""One physics step of every lane: machine code on a CPU, XLA operations elsewhere.

Both come from one source, `physics.engine.step_block`, a function of references to the arrays of a block of lanes;
tests compare the two.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from levelproof.physics.block import Block, Inputs, Scratch
from levelproof.physics.bounds import require_32_bits
from levelproof.physics.buffers import buffers_like, buffers_of
from levelproof.physics.codegen.call import Compiled, Kernel, by_platform, compiled_once, require_fit
from levelproof.physics.engine import STAGES, Stage, step_block
from levelproof.physics.pairs import Table, table_of
from levelproof.physics.types import DEFAULT_PARAMS, Manifold, Model, Params, Size, State

ENGINE_VERSION = 1  # of the step's arithmetic: increment if a change alters the next state of any world
SOURCES = Path(__file__).parent  # the kernel and its compiler


def step(
    model: Model,
    state: State,
    motor: Float[Array, "joint lane"],
    thrust: Float[Array, "thruster lane"],
    params: Params = DEFAULT_PARAMS,
    with_contacts: bool = True,
) -> tuple[State, Any]:
    """Advance every lane by `params.dt`.

    Args:
        model: constants of each lane's level.
        state: the worlds before the step.
        motor: control of each joint's motor, in [-1, 1].
        thrust: control of each thruster, in [0, 1].
        params: constants of the engine.
        with_contacts: whether to return the contacts; `State.contact_active` says in any case which were active.

    Returns:
        The worlds after the step, and the contacts found at its start: a Manifold, or None unless `with_contacts`.

    Raises:
        ValueError: an array's shape differs from its annotation for the model's size; or `jax_enable_x64` is on, and
            the states are float32.
        TypeError: an array's dtype differs from its annotation.
        NotImplementedError: the CPU is neither x86-64 nor AArch64.
    """
    inputs = Inputs(model, state, motor, thrust)
    if jax.dtypes.canonicalize_dtype(state.position.dtype) != jnp.float32:
        return on_all_lanes(inputs, params, with_contacts)
    require_32_bits()
    return by_platform(
        lambda inputs: as_machine_code(inputs, params, with_contacts),
        lambda inputs: on_all_lanes(inputs, params, with_contacts),
        inputs,
    )


def on_all_lanes(inputs: Inputs, params: Params, with_contacts: bool) -> tuple[State, Any]:
    """Step with XLA operations, all lanes as one block: slow on a CPU, but runs anywhere and in any precision."""
    dtype = jax.dtypes.canonicalize_dtype(inputs.before.position.dtype)
    inputs, lanes = as_annotated(inputs, str(dtype))
    return kernel_of(inputs.model.size, params, with_contacts, buffers_like(inputs)).on_all_lanes(inputs, lanes, dtype)


def as_machine_code(
    inputs: Inputs, params: Params, with_contacts: bool, stages: tuple[Stage, ...] = STAGES
) -> tuple[State, Any]:
    """Step with machine code for this CPU, in blocks of LANES lanes; the last block is padded.

    Fewer `stages` take less time and leave results unwritten: this measures what each stage costs.
    """
    inputs, lanes = as_annotated(inputs)
    return _compiled(inputs.model.size, params, with_contacts, buffers_like(inputs), stages)(inputs, lanes)


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
    require_fit(inputs, buffers_of(Inputs, size), {1, lanes}, float_dtype, f"in worlds of {size}")
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], lanes)), inputs), lanes


@compiled_once
def _compiled(size: Size, params: Params, with_contacts: bool, inputs: Inputs, stages: tuple[Stage, ...]) -> Compiled:
    named = repr((params, [(stage.__module__, stage.__qualname__) for stage in stages]))
    return kernel_of(size, params, with_contacts, inputs, stages).compiled(named, [SOURCES])


def kernel_of(
    size: Size, params: Params, with_contacts: bool, inputs: Inputs, stages: tuple[Stage, ...] = STAGES
) -> Kernel:
    """Return the step of a block; `inputs` are buffers. Its results are a State, and a Manifold or None."""

    def body(read: Inputs, table: Table, results: tuple[State, Manifold | None], scratch: Scratch) -> None:
        step_block(Block(table, read, *results, scratch), params, stages)

    results = inputs.before, buffers_of(Manifold, size) if with_contacts else None
    return Kernel(body, inputs, table_of(size, params.faithful_padding), results, buffers_of(Scratch, size))
