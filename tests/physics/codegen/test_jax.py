"""JAX traces the step to the primitives and parameters that physics/codegen/lower.py supports."""

import dataclasses
import functools
from collections.abc import Iterator

import jax
import pytest
from jax.extend import core

from levelproof.physics.block import Inputs
from levelproof.physics.buffers import buffers_like
from levelproof.physics.codegen.buffers import LANES
from levelproof.physics.step import block_buffers, trace
from levelproof.physics.types import Params, Size
from tests.physics.worlds import scattered

SIZE = Size(polygons=6, circles=3, joints=4, thrusters=2)  # one of everything
PARAMETERS: dict[str, set[str]] = {
    **{name: set() for name in ("abs", "add", "and", "div", "eq", "floor", "ge", "gt", "le", "lt", "max", "min")},
    **{name: set() for name in ("ne", "neg", "not", "or", "select_n", "sign", "square", "sub")},
    **{name: {"axes"} for name in ("reduce_and", "reduce_max", "reduce_min", "reduce_or")},
    "broadcast_in_dim": {"broadcast_dimensions", "shape", "sharding"},
    "concatenate": {"dimension"},
    "cond": {"branches"},
    "convert_element_type": {"new_dtype", "sharding", "weak_type"},
    "get": {"tree"},
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
CHANGED = (
    f"JAX {jax.__version__} {{}}. Read what changed, mend physics/codegen/lower.py, then write it down here: "
    "a parameter that nobody reads can change what a primitive means."
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
def step_equations() -> list[core.JaxprEqn]:
    given = buffers_like(Inputs(*scattered(SIZE, LANES)))
    return list(equations(trace(block_buffers(SIZE, Params(), True, given), Params()).jaxpr))


def test_step_uses_exactly_the_known_primitives() -> None:
    used = {equation.primitive.name for equation in step_equations()}
    new, unused = used - set(PARAMETERS), set(PARAMETERS) - used
    assert not new, CHANGED.format(f"uses new primitives in the step: {sorted(new)}")
    assert not unused, CHANGED.format(f"no longer uses the primitives {sorted(unused)}")


@pytest.mark.parametrize("name", PARAMETERS)
def test_primitive_has_the_expected_parameters(name: str) -> None:
    for equation in step_equations():
        if equation.primitive.name == name:
            message = CHANGED.format(f"gives {name} the parameters {sorted(equation.params)}")
            assert set(equation.params) == PARAMETERS[name], message


def test_unread_parameters_have_their_defaults() -> None:
    """Parameters that `lower` ignores must have their default values."""
    for equation in step_equations():
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
    """By one indexer of integers, scalars, and slices with start, size and stride."""
    for equation in step_equations():
        if equation.primitive.name in ("get", "swap"):
            operands = equation.invars[1 + (equation.primitive.name == "swap") :]
            transforms = jax.tree.unflatten(equation.params["tree"], operands)
            assert len(transforms) <= 1
            for index in transforms[0].indices if transforms else ():
                if dataclasses.is_dataclass(index):
                    names = [field.name for field in dataclasses.fields(index)]
                    assert names == ["start", "size", "stride"], CHANGED.format(f"slices by {names}")
