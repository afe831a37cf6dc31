"""Machine code against XLA, bit for bit: loops, branches, calls, memory; and what a kernel cannot do."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax
from jax.extend import core, linear_util

from levelproof.physics.codegen import call
from levelproof.physics.codegen.buffers import LANES, Buffer
from tests.physics.codegen.kernels import Kernel, rows, same_bits


class TestMemory:
    """References: rows by index, constant or known only at run time; arrays without lanes."""

    ARGUMENTS = (Buffer((5,)), Buffer((3, 4), "int32"), Buffer((4,)), Buffer((7,), "int32", lanes=False))

    @staticmethod
    def arguments(numbers: list[int]) -> list[np.ndarray]:
        random = np.random.default_rng(4)
        return [
            random.normal(size=(5, 3 * LANES)).astype(np.float32),
            random.integers(-9, 9, (3, 4, 3 * LANES), np.int32),
            random.normal(size=(4, 3 * LANES)).astype(np.float32),
            np.array(numbers, np.int32),
        ]

    @staticmethod
    def body(x, n, y, number, out, whole, flags, counts, work, notes):
        out[...] = x[...]
        out[number[0]] = x[number[1]] - y[number[2] & 3]  # rows known at run time
        out[-1] = y[-2] + x[1:4:2][1]
        out[1:3] = y[2:] - 1
        out[number[3]] += y[0]
        out[number[4]] -= jax.ref.swap(out, 1, y[3])
        out[3] += x[0]
        whole[...] = n[...]
        whole[1, number[5] & 3] = n[jnp.minimum(number[0], 2), 2] * 2
        whole[jnp.minimum(number[2], 2), 1:] = n[0, :3]
        whole[2, 0] += n[1, 1]
        flags[0] = x[0] < 0
        flags[1] = flags[0] | (y[1] > 0)
        flags[0] = flags[0] != flags[1]
        notes[number[6]] = number[0] + 1
        notes[0] = notes[number[6]] * 2
        work[number[0]] = x[2]
        work[...] = work[...] * 2
        counts[0] = number[1] - notes[0]
        counts[1] = jnp.int32(5)
        out[0] = work[number[0]] + notes[0]

    RESULTS = (Buffer((5,)), Buffer((3, 4), "int32"), Buffer((2,), "bool"), Buffer((2,), "int32", lanes=False))
    SCRATCH = (Buffer((5,)), Buffer((3,), "int32", lanes=False))

    @settings(max_examples=20, deadline=None)
    @given(st.tuples(*[st.integers(0, 4)] * 6, st.integers(0, 2)))
    def test_kernel_indexes_rows_as_xla_does(self, numbers) -> None:
        given = self.arguments(list(numbers))
        same_bits(self.kernel().as_machine_code(*given), self.kernel().as_xla(*given))

    @staticmethod
    @functools.cache
    def kernel() -> Kernel:
        return Kernel(TestMemory.body, TestMemory.ARGUMENTS, TestMemory.RESULTS, TestMemory.SCRATCH)


class TestControl:
    """Nested loops and branches."""

    @staticmethod
    def body(x, number, out, integers):
        rows, count = x[...], number[0]
        out[...] = jnp.zeros((9, LANES))

        def grow(i, carry):  # carries of all dtypes, with and without lanes
            total, product, lanes, even = carry
            total = total + x[i]
            return total, product * 2 + i, jnp.where(total > 0, i, lanes), ~even

        start = (jnp.zeros_like(rows[0]), jnp.int32(1), lax.iota(jnp.int32, LANES), jnp.bool_(True))
        fixed = lax.fori_loop(0, 4, grow, start)  # of known length: a scan
        until = lax.fori_loop(number[1], count, grow, start)  # of unknown length
        out[0] = fixed[0] + jnp.where(fixed[3], 1.0, -1.0)
        out[1] = until[0] + until[1].astype(jnp.float32)
        integers[0], integers[1] = fixed[2] + fixed[1], until[2] + until[1]

        def halve(carry):
            x, steps = carry
            return x * 0.5, steps + 1

        halved, steps = lax.while_loop(lambda carry: jnp.any(jnp.abs(carry[0]) > 0.5), halve, (rows[1], 0))
        out[2] = halved
        integers[2] = jnp.full((LANES,), steps)

        def branch(k):
            def deeper():
                out[3] = rows[k]
                return jnp.where(rows[k] > 0, k, -k), jnp.int32(k)

            return lambda: lax.cond(count > 3, deeper, lambda: (jnp.zeros(LANES, jnp.int32), number[1]))

        lanes, one = lax.cond(number[2] == 0, branch(0), lambda: lax.cond(number[2] == 1, branch(1), branch(2)))
        integers[3] = lanes + one

        def rows_after(i, _):  # writes inside a branch inside a loop inside a loop
            def write(j, _):
                lax.cond((i + j) & 3 == number[2], lambda: out.__setitem__(4 + j, out[4 + j] + x[i]), lambda: None)

            lax.fori_loop(i, count, write, None)

        lax.fori_loop(0, 4, rows_after, None)

    KERNEL = Kernel(body, [Buffer((5,)), Buffer((3,), "int32", lanes=False)], [Buffer((9,)), Buffer((4,), "int32")])

    @settings(max_examples=30, deadline=None)
    @given(rows(st.floats(-8, 8, width=32), np.float32, 5), st.tuples(*[st.integers(0, 5)] * 2, st.integers(0, 2)))
    def test_loops_and_branches_equal_xla(self, x, numbers) -> None:
        given = x, np.array(numbers, np.int32)
        same_bits(self.KERNEL.as_machine_code(*given), self.KERNEL.as_xla(*given))


def test_closed_call_is_inlined() -> None:
    """JAX wraps functions that it has already traced in `closed_call`."""
    double = jax.make_jaxpr(lambda x: x * 2 + 1)(jax.ShapeDtypeStruct((LANES,), np.float32))

    def body(x, out):
        function = linear_util.wrap_init(core.jaxpr_as_fun(double), debug_info=double.jaxpr.debug_info)
        (out[0],) = core.primitives.closed_call_p.bind(x[0], subfuns=(function,))

    kernel, x = Kernel(body, [Buffer((1,))], [Buffer((1,))]), np.arange(LANES, dtype=np.float32)[None]
    same_bits(kernel.as_machine_code(x), [x * 2 + 1])


REFUSED: dict[str, Callable] = {
    "exp": lambda x, n: jnp.exp(x),
    "sin": lambda x, n: jnp.sin(x),
    "tanh": lambda x, n: jnp.tanh(x),
    "pow": lambda x, n: x ** x[0],
    "rsqrt": lambda x, n: lax.rsqrt(x),
    "is_finite": lambda x, n: jnp.where(jnp.isfinite(x), x, 0.0),
    "argmax": lambda x, n: x.argmax(0).astype(jnp.float32),
    "cumsum": lambda x, n: jnp.cumsum(x, 0),
    "sort": lambda x, n: jnp.sort(x, 0),
    "custom_jvp_call": lambda x, n: jax.nn.relu(x),
    "clamp": lambda x, n: lax.clamp(n, n, n).astype(jnp.float32),
    "reduce_sum": lambda x, n: x.sum(0),
    "convert int32 to bool": lambda x, n: jnp.where(n[0].astype(bool), x, 0.0),
    "transpose": lambda x, n: jnp.swapaxes(x.reshape(2, 2, LANES), 0, 1),
    "gather": lambda x, n: x[jnp.where(jnp.any(x > 0), jnp.array([1, 2]), 3)],
    "dynamic_slice": lambda x, n: lax.dynamic_slice_in_dim(x, jnp.any(x > 0).astype(int), 2),
    "shifts by a constant": lambda x, n: lax.shift_left(n, jnp.full_like(n, 32)).astype(jnp.float32),
    "only shifts by a constant": lambda x, n: lax.shift_left(n, n).astype(jnp.float32),
    "to the power of -2": lambda x, n: x**-2,
    "dot_general": lambda x, n: jnp.ones((3, 4), jnp.float32) @ x,
    "reduce": lambda x, n: lax.reduce(x, np.float32(0), lambda a, b: a + 2 * b, (0,)),
    "div of int32": lambda x, n: lax.div(n, n[:1]).astype(jnp.float32),
    "reduce_max of int32 over lanes": lambda x, n: n.max(1).astype(jnp.float32),
    "select_n by int32": lambda x, n: lax.select_n(n, x, x, -x),
    "float16": lambda x, n: x.astype(jnp.float16).astype(jnp.float32),
    "uint8": lambda x, n: n.astype(jnp.uint8).astype(jnp.float32),
    "rounds halves to even": lambda x, n: lax.round(x),
    "slice its lanes": lambda x, n: x[:, :4].max(1),
    "reshape its lanes": lambda x, n: x.reshape(-1),
    "broadcast lanes": lambda x, n: x[0][:, None] + jnp.zeros((LANES, 3)),
    "new_ref": lambda x, n: jax.new_ref(x)[0],
    "scan over sequences": lambda x, n: lax.scan(lambda c, row: (c + row, c), x[0], x)[1],
    "a kernel cannot scan": lambda x, n: lax.scan(lambda c, _: (c + 1, c), x[0], None, length=4)[1],
}


class TestRefused:
    """Unsupported features are named at compile time."""

    @pytest.mark.parametrize("name", REFUSED)
    def test_lower_refuses_unsupported_computations(self, name: str) -> None:
        compute = REFUSED[name]

        def body(x, n, out):
            out[0] = jnp.zeros(LANES) + jnp.max(compute(x[...], n[...]))

        kernel = Kernel(body, [Buffer((4,)), Buffer((4,), "int32")], [Buffer((1,))])
        with pytest.raises(NotImplementedError, match=rf"\b{name}\b"):
            kernel.as_machine_code(np.zeros((4, LANES), np.float32), np.zeros((4, LANES), np.int32))

    @pytest.mark.parametrize(
        ("name", "write"),
        [
            ("index its lanes", lambda x, n, _: x.__setitem__((0, 3), 1.0)),
            ("index its lanes", lambda x, n, _: x.__setitem__((0, slice(0, 8)), jnp.zeros(8))),
            ("index 4 rows", lambda x, n, _: x.__setitem__(n[:2], x[:2])),
            ("part of a reference", lambda x, n, _: x.at[1:3].__setitem__(0, x[0])),
            ("element by element", lambda x, n, _: n.__setitem__(slice(None), (x[0] > 0).astype(jnp.int32))),
        ],
    )
    def test_lower_refuses_unsupported_writes(self, name: str, write: Callable) -> None:
        kernel = Kernel(write, [Buffer((4,)), Buffer((LANES,), "int32", lanes=False)], [Buffer((1,))])
        with pytest.raises(NotImplementedError, match=name):
            kernel.as_machine_code(np.zeros((4, LANES), np.float32), np.zeros(LANES, np.int32))


def test_kernel_is_traced_under_standard_promotion() -> None:
    def body(x, table, out, scratch):
        out[...] = x[...] + x[0] * (x[0] > 0)

    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        assert call.Kernel(body, Buffer((4,)), (), Buffer((4,)), ()).trace().eqns
