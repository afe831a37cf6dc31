"""JAX traces the step and the sampler to the primitives and parameters that physics/codegen/lower.py supports."""

import dataclasses
import functools
from collections.abc import Iterator

import jax
import pytest
from jax.extend import core

from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.sampler import kernel_of as sampler_of
from levelproof.physics.block import Inputs
from levelproof.physics.buffers import buffers_like
from levelproof.physics.codegen.buffers import LANES
from levelproof.physics.step import kernel_of
from levelproof.physics.types import Params, Size
from tests.physics.worlds import scattered

SIZE = Size(polygons=6, circles=3, joints=4, thrusters=2)  # one of everything
PARAMETERS: dict[str, set[str]] = {
    **{name: set() for name in ("abs", "add", "and", "div", "eq", "floor", "ge", "gt", "le", "lt", "max", "min")},
    **{name: set() for name in ("ne", "neg", "not", "or", "select_n", "sign", "square", "sub")},
    **{name: set() for name in ("shift_left", "shift_right_logical", "xor")},
    **{name: {"axes"} for name in ("reduce_and", "reduce_max", "reduce_min", "reduce_or")},
    "bitcast_convert_type": {"new_dtype"},
    "broadcast_in_dim": {"broadcast_dimensions", "shape", "sharding"},
    "concatenate": {"dimension"},
    "cond": {"branches"},
    "convert_element_type": {"new_dtype", "sharding", "weak_type"},
    "get": {"tree"},
    "integer_pow": {"y"},
    "iota": {"dimension", "dtype", "shape", "sharding"},
    "jit": {
        "compiler_options_kvs", "ctx_mesh", "donated_invars", "in_layouts", "in_shardings", "inline", "jaxpr",
        "keep_unused", "name", "out_layouts", "out_shardings",
    },
    "mul": {"out_dtype"},
    "new_ref": {"kind", "memory_space"},
    "round": {"rounding_method"},
    "scan": {"jaxpr", "length", "num_carry", "num_consts", "reverse", "unroll"},
    "slice": {"limit_indices", "start_indices", "strides"},
    "sqrt": {"accuracy"},
    "squeeze": {"dimensions"},
    "stack": {"axis"},
    "swap": {"tree"},
    "while": {"body_jaxpr", "body_nconsts", "cond_jaxpr", "cond_nconsts"},
}  # fmt: skip
SINCE = {"stack": (0, 10, 1)}  # primitives that older versions of JAX do without
CHANGED = (
    f"JAX {jax.__version__} {{}}. Read what changed, mend physics/codegen/lower.py, then write it down here: "
    "a parameter that lower.py does not read can change what a primitive means."
)


def equations(jaxpr: core.Jaxpr) -> Iterator[core.JaxprEqn]:
    """Yield the equations of a jaxpr and of all jaxprs within it."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda x: isinstance(x, core.Jaxpr | core.ClosedJaxpr)):
            if isinstance(inner, core.ClosedJaxpr):
                yield from equations(inner.jaxpr)
            elif isinstance(inner, core.Jaxpr):
                yield from equations(inner)


@functools.cache
def all_equations() -> list[core.JaxprEqn]:
    given = buffers_like(Inputs(*scattered(SIZE, LANES)))
    kernels = kernel_of(SIZE, Params(), True, given), sampler_of(SIZE, Distribution(small_world=0))
    return [equation for kernel in kernels for equation in equations(kernel.trace().jaxpr)]


def test_kernels_use_exactly_the_known_primitives() -> None:
    used = {equation.primitive.name for equation in all_equations()}
    to_come = {name for name, version in SINCE.items() if jax.__version_info__ < version}
    new, unused = used - set(PARAMETERS), set(PARAMETERS) - used - to_come
    assert not new, CHANGED.format(f"uses new primitives in a kernel: {sorted(new)}")
    assert not unused, CHANGED.format(f"no longer uses the primitives {sorted(unused)}")


@pytest.mark.parametrize("name", PARAMETERS)
def test_primitive_has_the_expected_parameters(name: str) -> None:
    for equation in all_equations():
        if equation.primitive.name == name:
            message = CHANGED.format(f"gives {name} the parameters {sorted(equation.params)}")
            assert set(equation.params) == PARAMETERS[name], message


def test_kernel_is_traced_alike_in_a_program_for_several_devices() -> None:
    """There, JAX would have arrays that the trace makes move between the devices."""
    kernel, traced = sampler_of(SIZE, Distribution(small_world=0)), []

    def program(x: jax.Array) -> jax.Array:
        traced.append(str(kernel.trace()))
        return x

    mesh, whole = jax.make_mesh((1,), ("cores",)), jax.sharding.PartitionSpec()
    jax.jit(jax.shard_map(program, mesh=mesh, in_specs=whole, out_specs=whole, check_vma=False))(0.0)
    assert traced[0] == str(kernel.trace())


def test_unread_parameters_have_their_defaults() -> None:
    """Parameters that `lower` ignores must have their default values."""
    for equation in all_equations():
        name, params = equation.primitive.name, equation.params
        are_defaults = (
            params.get("sharding") is None
            and params.get("accuracy") is None
            and params.get("out_dtype") is None
            and params.get("reverse", False) is False
            and params.get("memory_space") is None
        )
        assert are_defaults, CHANGED.format(f"makes {name} with {params}")


def test_references_are_indexed_as_lower_expects() -> None:
    """Each reference has one indexer of integers, scalars, and slices with start, size and stride."""
    for equation in all_equations():
        if equation.primitive.name in ("get", "swap"):
            operands = equation.invars[1 + (equation.primitive.name == "swap") :]
            transforms = jax.tree.unflatten(equation.params["tree"], operands)
            assert len(transforms) <= 1
            for index in transforms[0].indices if transforms else ():
                if dataclasses.is_dataclass(index):
                    names = [field.name for field in dataclasses.fields(index)]
                    assert names == ["start", "size", "stride"], CHANGED.format(f"slices by {names}")
