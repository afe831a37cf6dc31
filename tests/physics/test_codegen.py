"""Machine code against XLA: each primitive that a kernel can use on all kinds of numbers, loops, branches, memory.

Bit for bit, but for three things that IEEE 754 or XLA leave open: which NaN it is; the sign of a zero that max, min
and clamp choose between two zeros; and numbers below 1.2e-38, which XLA's threads take for zero in arithmetic, and
which operations that only choose (max, min, clamp, sign) may hand on as they are.
"""

import functools
import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from physics.codegen import compile as compile_module
from physics.lanes import LANES
from physics.rooms import Room
from physics.step import step
from tests.physics.both_ways import digest, worlds
from tests.physics.kernels import Kernel, same_bits

ROOT = Path(__file__).parents[2]
SMALLEST = np.finfo(np.float32).tiny
some = settings(max_examples=40, deadline=None)

AWKWARD = np.float32(
    [0, -0.0, 1, -1, np.inf, -np.inf, np.nan, SMALLEST, -1e-40, 3e38, -3e38, 0.5, 1.5, -2.5, 2**31, 7.25]
)
AWKWARD_INTS = np.int32([0, 1, -1, 2, -2, 3, 7, -7, 16, 255, 2**24 + 1, 2**30, 2**31 - 1, -(2**31), 1 - 2**31, -255])
floats, ints = st.floats(width=32), st.integers(-(2**31), 2**31 - 1)


def rows(elements: st.SearchStrategy, dtype: Any, count: int = 3) -> st.SearchStrategy[np.ndarray]:
    """[count, lane], of one block."""
    numbers = st.lists(elements, min_size=count * LANES, max_size=count * LANES)
    return numbers.map(lambda x: np.array(x, dtype).reshape(count, LANES))


def every_pair(x: np.ndarray) -> np.ndarray:
    """[3, lane]: all pairs of some numbers, and a third."""
    a, b = (grid.reshape(-1) for grid in np.meshgrid(x, x))
    return np.stack([a, b, np.roll(a, 5)])


def table(functions: dict[str, Callable], of: str, to: str) -> Kernel:
    """A kernel that computes functions of three rows of numbers, one row of results each."""

    def body(x, out):
        for i, f in enumerate(functions.values()):
            out[i] = f(x[0], x[1], x[2])

    return Kernel(body, [Room((3,), of)], [Room((len(functions),), to)])


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
    **{f"power {n}": functools.partial(lambda x, *_, n: lax.integer_pow(x, n), n=n) for n in (-3, -1, 0, 1, 2, 5, 7)},
    "select_n": lambda x, y, z: lax.select_n(x < y, y, z),
    "where": lambda x, y, z: jnp.where(x == y, 1.0, z),
}
CHOSEN = {
    "max": lambda x, y, _: jnp.maximum(x, y),
    "min": lambda x, y, _: jnp.minimum(x, y),
    "clip": lambda x, *_: jnp.clip(x, -1.5, 2.0),
    "clamp": lambda x, y, z: lax.clamp(y, x, z),
    "clamp between numbers": lambda x, *_: lax.clamp(jnp.float32(-1), x, jnp.float32(1)),
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
    "div": lambda x, y, _: lax.div(x, y),
    "rem": lambda x, y, _: lax.rem(x, y),
    "floor_divide": lambda x, y, _: x // y,
    "remainder": lambda x, y, _: x % y,
    "max": lambda x, y, _: jnp.maximum(x, y),
    "min": lambda x, y, _: jnp.minimum(x, y),
    "clamp": lambda x, y, z: lax.clamp(y, x, z),
    "neg": lambda x, *_: -x,
    "abs": lambda x, *_: jnp.abs(x),
    "sign": lambda x, *_: jnp.sign(x),
    "square": lambda x, *_: jnp.square(x),
    "power": lambda x, *_: x**5,
    "and": lambda x, y, _: x & y,
    "or": lambda x, y, _: x | y,
    "xor": lambda x, y, _: x ^ y,
    "not": lambda x, *_: ~x,
    "select_n": lambda x, y, z: lax.select_n(x < y, y, z),
    "reduce_sum": lambda *xs: jnp.stack(xs).sum(0),
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
    """Every elementwise primitive, of every dtype it is for."""

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

    def test_awkward_floats(self) -> None:
        self.check_floats(every_pair(AWKWARD))

    def test_awkward_integers(self) -> None:
        self.check_integers(every_pair(AWKWARD_INTS))

    def test_bools(self) -> None:
        self.check(self.BOOLS, np.arange(3 * LANES).reshape(3, LANES) // np.array([[1], [2], [4]]) % 2 == 1)

    @some
    @given(rows(floats, np.float32))
    def test_floats(self, x) -> None:
        self.check_floats(x)

    @some
    @given(rows(ints | st.integers(-4, 4), np.int32))
    def test_integers(self, x) -> None:
        self.check_integers(x)

    def test_a_sum_adds_in_order(self) -> None:
        kernel = Kernel(lambda x, out: out.__setitem__(0, x[...].sum(0)), [Room((5,))], [Room((1,))])
        x = np.random.default_rng(1).normal(size=(5, 4 * LANES)).astype(np.float32)
        self.check(kernel, x)


class TestConversions:
    @staticmethod
    @functools.cache
    def kernel(of: str, to: str) -> Kernel:
        return table({"convert": lambda x, *_: x.astype(to)}, of, to)

    @pytest.mark.parametrize("to", ["float32", "int32", "bool"])
    def test_floats(self, to: str) -> None:
        """Beyond the integers there is the last of them, and 0 for NaN."""
        edges = np.float32([2**31 - 128, 2**31, -(2**31), -(2**31) - 256, 1e10, 0.99, -0.99, 1.5])
        x = every_pair(np.concatenate([AWKWARD, edges, -edges]))
        TestNumbers.check(self.kernel("float32", to), x)

    @pytest.mark.parametrize("to", ["float32", "int32", "bool"])
    @pytest.mark.parametrize("of", ["int32", "bool"])
    def test_integers_and_bools(self, of: str, to: str) -> None:
        x = every_pair(AWKWARD_INTS)
        TestNumbers.check(self.kernel(of, to), x if of == "int32" else x > 0)

    @some
    @given(rows(floats, np.float32))
    def test_any_float_to_an_integer(self, x) -> None:
        TestNumbers.check(self.kernel("float32", "int32"), x)


def shape_cases() -> dict[str, Callable]:
    """name -> function of x [6, lane] floats and n [4, lane] integers."""
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
        "squeeze and expand": lambda x, n: jnp.expand_dims(x[2:3].squeeze(0), (0, 1)),
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
        "a function with its own rule": lambda x, n: jax.nn.relu(x),
    }


@pytest.mark.parametrize("name", shape_cases())
def test_shapes(name: str) -> None:
    case = shape_cases()[name]
    x = np.random.default_rng(2).uniform(-1, 1, (6, 2 * LANES)).astype(np.float32)
    n = np.random.default_rng(3).integers(-9, 9, (4, 2 * LANES), np.int32)
    like = jax.eval_shape(case, x[:, :LANES], n[:, :LANES])

    def body(x, n, out):
        out[...] = case(x[...], n[...])

    kernel = Kernel(body, [Room((6,)), Room((4,), "int32")], [Room(like.shape[:-1], str(like.dtype))])
    same_bits(kernel.as_machine_code(x, n), kernel.as_xla(x, n))


class TestMemory:
    """References: rows by number, known before or only at run time; arrays without lanes."""

    ARGUMENTS = (Room((5,)), Room((3, 4), "int32"), Room((4,)), Room((7,), "int32", lanes=False))

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
        out[number[0]] = x[number[1]] - y[number[2] % 4]  # rows known at run time
        out[-1] = y[-2] + x[1:4:2][1]
        out[1:3] = y[2:] - 1
        out[number[3]] += y[0]
        out[number[4]] -= jax.ref.swap(out, 1, y[3])
        jax.ref.addupdate(out, 3, x[0])
        whole[...] = n[...]
        whole[1, number[5] % 4] = n[number[0] % 3, 2] * 2
        whole[number[2] % 3, 1:] = n[0, :3]
        jax.ref.addupdate(whole, (2, 0), n[1, 1])
        flags[0] = x[0] < 0
        flags[1] = flags[0] | (y[1] > 0)
        flags[0] ^= flags[1]
        notes[number[6]] = number[0] + 1
        notes[0] = notes[number[6]] * 2
        work[number[0]] = x[2]
        work[...] = work[...] * 2
        counts[0] = number[1] - notes[0]
        counts[1] = jnp.int32(5)
        out[0] = work[number[0]] + notes[0]

    RESULTS = (Room((5,)), Room((3, 4), "int32"), Room((2,), "bool"), Room((2,), "int32", lanes=False))
    SCRATCH = (Room((5,)), Room((3,), "int32", lanes=False))

    @settings(max_examples=20, deadline=None)
    @given(st.tuples(*[st.integers(0, 4)] * 6, st.integers(0, 2)))
    def test_rows_by_number(self, numbers) -> None:
        given = self.arguments(list(numbers))
        same_bits(self.kernel().as_machine_code(*given), self.kernel().as_xla(*given))

    @staticmethod
    @functools.cache
    def kernel() -> Kernel:
        return Kernel(TestMemory.body, TestMemory.ARGUMENTS, TestMemory.RESULTS, TestMemory.SCRATCH)


class TestControl:
    """Loops and branches, in each other."""

    @staticmethod
    def body(x, number, out, found):
        rows, count = x[...], number[0]
        out[...] = jnp.zeros((9, LANES))

        def grow(i, carry):  # carries of all kinds, lanes and none
            total, product, lanes, even = carry
            total = total + x[i]
            return total, product * 2 + i, jnp.where(total > 0, i, lanes), ~even

        start = (jnp.zeros_like(rows[0]), jnp.int32(1), lax.iota(jnp.int32, LANES), jnp.bool_(True))
        fixed = lax.fori_loop(0, 4, grow, start)  # of known length: a scan
        until = lax.fori_loop(number[1], count, grow, start)  # of unknown length
        out[0] = fixed[0] + jnp.where(fixed[3], 1.0, -1.0)
        out[1] = until[0] + until[1].astype(jnp.float32)
        found[0], found[1] = fixed[2] + fixed[1], until[2] + until[1]

        def halve(carry):
            x, steps = carry
            return x * 0.5, steps + 1

        halved, steps = lax.while_loop(lambda carry: jnp.any(jnp.abs(carry[0]) > 0.5), halve, (rows[1], 0))
        out[2] = halved
        found[2] = jnp.full((LANES,), steps)

        def branch(k):
            def deeper():
                out[3] = rows[k]
                return jnp.where(rows[k] > 0, k, -k), jnp.int32(k)

            return lambda: lax.cond(count > 3, deeper, lambda: (jnp.zeros(LANES, jnp.int32), number[1]))

        lanes, one = lax.switch(number[2], [branch(k) for k in range(3)])
        found[3] = lanes + one

        def rows_after(i, _):  # writes inside a branch inside a loop inside a loop
            def write(j, _):
                lax.cond((i + j) % 3 == number[2], lambda: out.__setitem__(4 + j, out[4 + j] + x[i]), lambda: None)

            lax.fori_loop(i, count, write, None)

        lax.fori_loop(0, 4, rows_after, None)

    KERNEL = Kernel(body, [Room((5,)), Room((3,), "int32", lanes=False)], [Room((9,)), Room((4,), "int32")])

    @settings(max_examples=30, deadline=None)
    @given(rows(st.floats(-8, 8, width=32), np.float32, 5), st.tuples(*[st.integers(0, 5)] * 2, st.integers(0, 2)))
    def test_loops_and_branches(self, x, numbers) -> None:
        given = x, np.array(numbers, np.int32)
        same_bits(self.KERNEL.as_machine_code(*given), self.KERNEL.as_xla(*given))


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
    "transpose": lambda x, n: jnp.swapaxes(x.reshape(2, 2, LANES), 0, 1),
    "gather": lambda x, n: x[jnp.where(jnp.any(x > 0), jnp.array([1, 2]), 3)],
    "dynamic_slice": lambda x, n: lax.dynamic_slice_in_dim(x, jnp.any(x > 0).astype(int), 2),
    "shift_left": lambda x, n: (n << 1).astype(jnp.float32),
    "dot_general": lambda x, n: jnp.ones((3, 4), jnp.float32) @ x,
    "reduce": lambda x, n: lax.reduce(x, np.float32(0), lambda a, b: a + 2 * b, (0,)),
    "rem of float32": lambda x, n: lax.rem(x, x[:1]),
    "reduce_sum of float32 over lanes": lambda x, n: x.sum(1),
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
    """What a kernel cannot use is named when it is compiled."""

    @pytest.mark.parametrize("name", REFUSED)
    def test_what_a_kernel_cannot_compute(self, name: str) -> None:
        compute = REFUSED[name]

        def body(x, n, out):
            out[0] = jnp.zeros(LANES) + jnp.max(compute(x[...], n[...]))

        kernel = Kernel(body, [Room((4,)), Room((4,), "int32")], [Room((1,))])
        with pytest.raises(NotImplementedError, match=rf"\b{name}\b"):
            kernel.as_machine_code(np.zeros((4, LANES), np.float32), np.zeros((4, LANES), np.int32))

    @pytest.mark.parametrize(
        ("name", "write"),
        [
            ("index its lanes", lambda x, n, _: x.__setitem__((0, 3), 1.0)),
            ("index its lanes", lambda x, n, _: x.__setitem__((0, slice(0, 8)), jnp.zeros(8))),
            ("index 4 rows", lambda x, n, _: x.__setitem__(n[:2], x[:2])),
            ("part of a reference", lambda x, n, _: x.at[1:3].__setitem__(0, x[0])),
            ("number by number", lambda x, n, _: n.__setitem__(slice(None), jnp.int32(x[0]))),
        ],
    )
    def test_what_a_kernel_cannot_write(self, name: str, write: Callable) -> None:
        kernel = Kernel(write, [Room((4,)), Room((LANES,), "int32", lanes=False)], [Room((1,))])
        with pytest.raises(NotImplementedError, match=name):
            kernel.as_machine_code(np.zeros((4, LANES), np.float32), np.zeros(LANES, np.int32))


class TestStep:
    """The whole step: machine code and XLA's operations make the same bits of the one source."""

    X86 = platform.machine() in ("x86_64", "AMD64")  # elsewhere XLA cannot be kept from contracting

    @pytest.mark.parametrize(
        "name",
        [
            "s",
            *[
                pytest.param(name, marks=pytest.mark.slow)
                for name in ("m", "l", "6,0,2,1", "6,3,0,1", "6,3,2,0", "4,1,0,0", "5,0,0,0", "8,8,8,4")
            ],
        ],
    )
    def test_both_ways_are_one(self, name: str) -> None:
        command = [sys.executable, "-m", "tests.physics.both_ways", name]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr[-2000:]
        said = json.loads(done.stdout)[name]
        assert said["touching"] > 0.1
        least = 1.0 if self.X86 else 0.0
        assert min(said["alike"].values()) >= least, said["alike"]
        assert said["alike"]["State.contact_active"] >= 0.99
        assert said["digest"] == digest(here(name)), "another process, under other flags of XLA, got other bits"


def here(name: str):
    return jax.jit(lambda given: step(*given))(worlds(name))


def test_threads_may_compile_the_same_kernel_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the work units of one worker do; XLA takes a name only once."""
    compiled, compiling = [], compile_module._machine_code

    def slowly(text: str) -> object:
        compiled.append(text)
        time.sleep(1)  # for the other threads to come, too
        return compiling(text)

    def kernel(x, out):
        out_ref, x_ref = jax.new_ref(out), jax.new_ref(x)
        out_ref[...] = x_ref[...] + 1234

    monkeypatch.setattr(compile_module, "_machine_code", slowly)
    room, row = Room((1,), "float32"), jnp.zeros((1, LANES))
    jaxpr = jax.make_jaxpr(kernel)(row, row)
    with ThreadPoolExecutor(4) as threads:
        names = set(threads.map(lambda _: compile_module.compile_kernel(jaxpr, [room], [room], []), range(4)))
    assert len(names) == len(compiled) == 1
