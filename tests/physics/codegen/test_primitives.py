"""Machine code against XLA: each primitive that a kernel can use, on all kinds of numbers and shapes.

Bits are equal except where IEEE 754 or XLA leave a choice: which NaN results; the sign if max and min choose between
two zeros; and subnormal numbers, which XLA's threads take for zero in arithmetic, and which operations that only
choose (max, min, sign) may pass through.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from levelproof.physics.codegen.buffers import LANES, Buffer
from tests.physics.codegen.kernels import Kernel, rows, same_bits

SMALLEST = np.finfo(np.float32).tiny
some = settings(max_examples=40, deadline=None)

AWKWARD = np.float32(
    [0, -0.0, 1, -1, np.inf, -np.inf, np.nan, SMALLEST, -1e-40, 3e38, -3e38, 0.5, 1.5, -2.5, 2**31, 7.25]
)
AWKWARD_INTS = np.int32([0, 1, -1, 2, -2, 3, 7, -7, 16, 255, 2**24 + 1, 2**30, 2**31 - 1, -(2**31), 1 - 2**31, -255])
floats, ints = st.floats(width=32), st.integers(-(2**31), 2**31 - 1)


def every_pair(x: np.ndarray) -> np.ndarray:
    """Return [3, lane]: all pairs of some numbers, and a third number."""
    a, b = (grid.reshape(-1) for grid in np.meshgrid(x, x))
    return np.stack([a, b, np.roll(a, 5)])


def table(functions: dict[str, Callable], argument: str, result: str) -> Kernel:
    """Build a kernel that computes functions of three rows (dtype `argument`), one row (dtype `result`) each."""

    def body(x, out):
        for i, f in enumerate(functions.values()):
            out[i] = f(x[0], x[1], x[2])

    return Kernel(body, [Buffer((3,), argument)], [Buffer((len(functions),), result)])


def flush(x: np.ndarray) -> np.ndarray:
    return np.where(np.abs(x) < SMALLEST, np.copysign(np.float32(0), x), x)


EXACT = {
    "add": lambda x, y, _: x + y,
    "sub": lambda x, y, _: x - y,
    "mul": lambda x, y, _: x * y,
    "div": lambda x, y, _: x / y,
    "neg": lambda x, *_: -x,
    "abs": lambda x, *_: jnp.abs(x),
    "sqrt": lambda x, *_: jnp.sqrt(x),
    "floor": lambda x, *_: jnp.floor(x),
    "round": lambda x, *_: jnp.round(x),
    "square": lambda x, *_: jnp.square(x),
    "select_n": lambda x, y, z: lax.select_n(x < y, y, z),
    "where": lambda x, y, z: jnp.where(x == y, 1.0, z),
    "fourth power": lambda x, *_: x**4,
    "fifth power": lambda x, *_: x**5,
}
CHOSEN = {
    "max": lambda x, y, _: jnp.maximum(x, y),
    "min": lambda x, y, _: jnp.minimum(x, y),
    "clip": lambda x, *_: jnp.clip(x, -1.5, 2.0),
    "sign": lambda x, *_: jnp.sign(x),
    "reduce_max": lambda *xs: jnp.stack(xs).max(0),
    "reduce_min": lambda *xs: jnp.stack(xs).min(0),
}
COMPARED = {
    "eq": lambda x, y, _: x == y,
    "ne": lambda x, y, _: x != y,
    "lt": lambda x, y, _: x < y,
    "le": lambda x, y, _: x <= y,
    "gt": lambda x, y, _: x > y,
    "ge": lambda x, y, _: x >= y,
}
INTEGER = {
    "add": lambda x, y, _: x + y,
    "sub": lambda x, y, _: x - y,
    "mul": lambda x, y, _: x * y,
    "max": lambda x, y, _: jnp.maximum(x, y),
    "min": lambda x, y, _: jnp.minimum(x, y),
    "neg": lambda x, *_: -x,
    "square": lambda x, *_: jnp.square(x),
    "and": lambda x, y, _: x & y,
    "or": lambda x, y, _: x | y,
    "xor": lambda x, y, _: x ^ y,
    "shift left": lambda x, *_: lax.shift_left(x, jnp.full_like(x, 13)) | lax.shift_left(x, jnp.full_like(x, 31)),
    "shift right": lambda x, *_: lax.shift_right_logical(x, jnp.full_like(x, 1)),
    "not": lambda x, *_: ~x,
    "select_n": lambda x, y, z: lax.select_n(x < y, y, z),
    "reduce_max": lambda *xs: jnp.stack(xs).max(0),
    "reduce_min": lambda *xs: jnp.stack(xs).min(0),
    "reduce_and": lambda *xs: lax.reduce_and(jnp.stack(xs), (0,)),
    "reduce_or": lambda *xs: lax.reduce_or(jnp.stack(xs), (0,)),
}
LOGICAL = COMPARED | {
    "and": lambda x, y, _: x & y,
    "or": lambda x, y, _: x | y,
    "xor": lambda x, y, _: x ^ y,
    "not": lambda x, *_: ~x,
    "max": lambda x, y, _: jnp.maximum(x, y),
    "min": lambda x, y, _: jnp.minimum(x, y),
    "select_n": lambda *xs: lax.select_n(*xs),
    "any": lambda *xs: jnp.stack(xs).any(0),
    "all": lambda *xs: jnp.stack(xs).all(0),
    "largest": lambda *xs: jnp.stack(xs).max(0),
}


class TestNumbers:
    """Every elementwise primitive, for every dtype it supports."""

    EXACT_FLOATS = table(EXACT, "float32", "float32")
    CHOSEN_FLOATS = table(CHOSEN, "float32", "float32")
    COMPARED_FLOATS = table(COMPARED, "float32", "bool")
    INTEGERS = table(INTEGER, "int32", "int32")
    COMPARED_INTEGERS = table(COMPARED, "int32", "bool")
    BOOLS = table(LOGICAL, "bool", "bool")

    @staticmethod
    def check(kernel: Kernel, x: np.ndarray, **how: bool) -> None:
        same_bits(kernel.as_machine_code(x), kernel.as_xla(x), **how)

    def check_floats(self, x: np.ndarray) -> None:
        self.check(self.EXACT_FLOATS, x)
        ours, theirs = self.CHOSEN_FLOATS.as_machine_code(x), self.CHOSEN_FLOATS.as_xla(x)
        same_bits([flush(a) for a in ours], [flush(b) for b in theirs], zeros=False)
        self.check(self.COMPARED_FLOATS, x)

    def check_integers(self, x: np.ndarray) -> None:
        self.check(self.INTEGERS, x)
        self.check(self.COMPARED_INTEGERS, x)

    def test_awkward_floats_equal_xla(self) -> None:
        self.check_floats(every_pair(AWKWARD))

    def test_awkward_integers_equal_xla(self) -> None:
        self.check_integers(every_pair(AWKWARD_INTS))

    def test_bools_equal_xla(self) -> None:
        self.check(self.BOOLS, np.arange(3 * LANES).reshape(3, LANES) // np.array([[1], [2], [4]]) % 2 == 1)

    @some
    @given(rows(floats, np.float32))
    def test_random_floats_equal_xla(self, x) -> None:
        self.check_floats(x)

    @some
    @given(rows(ints | st.integers(-4, 4), np.int32))
    def test_random_integers_equal_xla(self, x) -> None:
        self.check_integers(x)


class TestConversions:
    @pytest.mark.parametrize(("source", "target"), [("int32", "float32"), ("bool", "float32"), ("bool", "int32")])
    def test_conversions_are_exact_or_to_the_nearest_float(self, source: str, target: str) -> None:
        x = every_pair(AWKWARD_INTS)
        TestNumbers.check(
            table({"convert": lambda x, *_: x.astype(target)}, source, target), x if source == "int32" else x > 0
        )

    def test_floats_are_cut_to_integers_as_by_xla(self) -> None:
        """Towards zero; NaN to 0; beyond the range to the nearest integer."""
        TestNumbers.check(
            table({"convert": lambda x, *_: x.astype(jnp.int32)}, "float32", "int32"), every_pair(AWKWARD)
        )

    @pytest.mark.parametrize(
        ("source", "target", "x"), [("int32", "float32", AWKWARD_INTS), ("float32", "int32", AWKWARD)]
    )
    def test_bits_are_read_as_another_type(self, source: str, target: str, x: np.ndarray) -> None:
        read = lambda x, *_: lax.bitcast_convert_type(x, jnp.dtype(target))
        kernel = table({"bits": read}, source, target)
        ours = kernel.as_machine_code(every_pair(x))[0][0]
        np.testing.assert_array_equal(ours.view(np.int32), every_pair(x)[0].view(np.int32))


def shape_cases() -> dict[str, Callable]:
    """Return {name: function of x [6, lane] floats and n [4, lane] integers}."""
    weights = np.arange(6, dtype=np.float32)
    by_lane = np.arange(LANES, dtype=np.float32) ** 2
    return {
        "a number in every lane": lambda x, n: jnp.full_like(x, 2.5),
        "a row for each": lambda x, n: x[0] + x,
        "a column": lambda x, n: x + jnp.arange(6, dtype=jnp.float32)[:, None],
        "both": lambda x, n: x[:, None, :] * x[None, :3, :],
        "a closed-over column": lambda x, n: x + weights[:, None],
        "closed-over lanes": lambda x, n: x + by_lane,
        "numbers of lanes": lambda x, n: x[:4] + lax.iota(jnp.int32, LANES),
        "numbers of rows": lambda x, n: lax.broadcasted_iota(jnp.int32, (3, LANES), 0) + n[0],
        "numbers of columns": lambda x, n: lax.broadcasted_iota(jnp.int32, (3, LANES), 1) + n[0],
        "reshape": lambda x, n: x.reshape(2, 3, LANES) + x.reshape(3, 2, LANES)[:2, :1],
        "squeeze": lambda x, n: x[2:3].squeeze(0)[None, None],
        "slice": lambda x, n: x[1:6:2] - x[:3],
        "concatenate": lambda x, n: jnp.concatenate([x[:2], n.astype(jnp.float32), jnp.zeros((1, LANES))]),
        "stack": lambda x, n: jnp.stack([x, -x], axis=1),
        "stack with nothing": lambda x, n: jnp.stack([jnp.zeros_like(x[0]), x[1], jnp.ones(LANES)]),
        "stack to lanes": lambda x, n: jnp.stack([jnp.int32(i * i) for i in range(LANES)]) + n,
        "roll": lambda x, n: jnp.roll(x, -1, axis=0),
        "unpack": lambda x, n: jnp.stack([*x][::-1]),
        "largest of each column": lambda x, n: x.reshape(2, 3, LANES).max(1),
        "smallest of all": lambda x, n: x.reshape(2, 3, LANES).min((0, 1))[None],
        "any lane": lambda x, n: jnp.where(jnp.any(x > 0.9, axis=1, keepdims=True), x, 0.0),
        "all of all": lambda x, n: jnp.where(jnp.all(x > -2), x, n[0]),
        "largest bool over lanes": lambda x, n: jnp.where((x[0] > 0.5).max(), x, 0.0),
        "smallest bool over lanes": lambda x, n: jnp.where((x[0] > 0.5).min(), x, 0.0),
        "select by a number": lambda x, n: jnp.where(jnp.bool_(True), x, -x),
        "a function": lambda x, n: jax.jit(lambda x, k: jnp.where(x > 0, x, k))(x, weights[2]),
    }


@pytest.mark.parametrize("name", shape_cases())
def test_shape_primitives_equal_xla(name: str) -> None:
    case = shape_cases()[name]
    x = np.random.default_rng(2).uniform(-1, 1, (6, 2 * LANES)).astype(np.float32)
    n = np.random.default_rng(3).integers(-9, 9, (4, 2 * LANES), np.int32)
    like = jax.eval_shape(case, x[:, :LANES], n[:, :LANES])

    def body(x, n, out):
        out[...] = case(x[...], n[...])

    kernel = Kernel(body, [Buffer((6,)), Buffer((4,), "int32")], [Buffer(like.shape[:-1], str(like.dtype))])
    same_bits(kernel.as_machine_code(x, n), kernel.as_xla(x, n))
