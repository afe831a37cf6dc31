"""Sine, cosine, angles and hyperbolic tangent against numpy's in double precision, as machine code and by XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.physics.codegen.buffers import LANES, Buffer
from levelproof.physics.trigonometry import angle_of, cos_sin, tanh
from tests.physics.codegen.kernels import Kernel

COUNT = 4096 * LANES


def _all_three(x, out):
    out[...] = jnp.stack([*cos_sin(x[0]), tanh(x[0])])


KERNEL = Kernel(_all_three, [Buffer((1,))], [Buffer((3,))])


_jitted = jax.jit(lambda x: jnp.stack([*cos_sin(x), tanh(x)]))


def by_xla(x: np.ndarray) -> np.ndarray:
    return np.asarray(_jitted(x))


def as_machine_code(x: np.ndarray) -> np.ndarray:
    """Return [cosine, sine, tanh; angle]; the number of angles must fill whole blocks."""
    return KERNEL.as_machine_code(x.reshape(1, -1))[0]


def units(ours: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return errors in units in the last place of the exact result."""
    return np.abs(ours - exact) / np.spacing(np.abs(exact.astype(np.float32))).astype(np.float64)


ways = pytest.mark.parametrize("way", [as_machine_code, by_xla])


class TestCosSin:
    @ways
    @pytest.mark.parametrize(
        ("largest", "error"), [(np.pi / 4, 1e-7), (10.0, 1e-7), (100.0, 1e-7), (8192.0, 1e-7), (1e5, 1e-6)]
    )
    def test_error_is_bounded(self, way, largest: float, error: float) -> None:
        """1e-7 is 1.7 units in the last place of 1."""
        x = np.random.default_rng(1).uniform(-largest, largest, COUNT).astype(np.float32)
        cos, sin, _ = way(x)
        np.testing.assert_allclose(cos, np.cos(x.astype(float)), rtol=0, atol=error)
        np.testing.assert_allclose(sin, np.sin(x.astype(float)), rtol=0, atol=error)

    @ways
    def test_error_in_units_in_the_last_place_is_bounded(self, way) -> None:
        """Two where the result is not small; more at its zeros, for lack of digits of pi in QUARTER_PARTS."""
        x = np.random.default_rng(2).uniform(-2 * np.pi, 2 * np.pi, COUNT).astype(np.float32)
        cos, sin, _ = way(x)
        for ours, exact in ((cos, np.cos(x.astype(float))), (sin, np.sin(x.astype(float)))):
            off = units(ours, exact)
            assert off[np.abs(exact) > 0.25].max() < 2
            assert off.max() < 20

    @ways
    @pytest.mark.parametrize("step", [np.pi / 4, np.pi / 2])
    def test_error_at_quadrant_borders_is_bounded(self, way, step: float) -> None:
        """At and beside every multiple of an eighth of a turn, where the quadrant may be rounded either way."""
        nearest = (np.arange(-8191, 8192) * step).astype(np.float32)
        beside = [np.nextafter(nearest, np.float32(towards)) for towards in (-np.inf, np.inf)]
        x = np.concatenate([nearest, *beside])
        x = np.resize(x[np.abs(x) <= 8192], COUNT)
        cos, sin, _ = way(x)
        np.testing.assert_allclose(cos, np.cos(x.astype(float)), rtol=0, atol=1e-7)
        np.testing.assert_allclose(sin, np.sin(x.astype(float)), rtol=0, atol=1e-7)

    @ways
    def test_symmetry_is_exact(self, way) -> None:
        x = np.random.default_rng(3).uniform(-1e4, 1e4, COUNT).astype(np.float32)
        (cos, sin, _), (cos_mirrored, sin_mirrored, _) = way(x), way(-x)
        np.testing.assert_array_equal(cos, cos_mirrored)
        np.testing.assert_array_equal(sin, -sin_mirrored)
        assert way(np.zeros(LANES, np.float32))[:2, 0].tolist() == [1, 0]

    @settings(max_examples=100, deadline=None)
    @given(st.lists(st.floats(width=32), min_size=LANES, max_size=LANES))
    def test_any_finite_angle_gives_a_point_on_the_circle(self, angles) -> None:
        """Angles up to 1e38 rad do. An infinite angle gives NaN and affects no other lane."""
        x = np.array(angles, np.float32)
        for cos, sin, _ in (as_machine_code(x), by_xla(x)):
            finite = np.isfinite(x)
            assert np.isnan(cos[~finite]).all()
            assert np.isnan(sin[~finite]).all()
            np.testing.assert_allclose(np.hypot(cos[finite], sin[finite]), 1, atol=2e-7)
            assert max(np.abs(cos[finite]).max(initial=0), np.abs(sin[finite]).max(initial=0)) <= 1


ANGLE = Kernel(lambda v, out: out.__setitem__(0, angle_of(v[0], v[1])), [Buffer((2,))], [Buffer((1,))])
angles = pytest.mark.parametrize("way", [lambda v: ANGLE.as_machine_code(v)[0][0], lambda v: np.asarray(angle_of(*v))])


class TestAngle:
    @angles
    def test_error_in_units_in_the_last_place_is_bounded(self, way) -> None:
        random = np.random.default_rng(5)
        x, y = (random.normal(size=COUNT) * np.exp(random.normal(0, 4, COUNT)) for _ in range(2))
        v = np.float32([x, y])
        assert units(way(v), np.arctan2(*v[::-1].astype(float))).max() < 4

    @angles
    def test_multiples_of_an_eighth_turn_are_exact_up_to_rounding(self, way) -> None:
        v = np.zeros((2, LANES), np.float32)
        v[:, :8] = [1, 1, 0, -1, -1, -1, 0, 1], [0, 1, 1, 1, 0, -1, -1, -1]
        eighths = np.array([0, 1, 2, 3, 4, -3, -2, -1] + [0] * (LANES - 8))
        np.testing.assert_allclose(way(v), eighths * np.pi / 4, rtol=2e-7)


class TestTanh:
    @ways
    def test_error_in_units_in_the_last_place_is_bounded(self, way) -> None:
        small = np.geomspace(1e-30, 1e-3, COUNT // 2)
        x = np.concatenate([small * np.tile([1, -1], COUNT // 4), np.linspace(-10, 10, COUNT // 2)]).astype(np.float32)
        ours, exact = way(x)[2], np.tanh(x.astype(float))
        assert units(ours, exact).max() < 7
        assert np.abs(ours).max() <= 1

    @ways
    def test_symmetry_is_exact(self, way) -> None:
        x = np.random.default_rng(4).normal(0, 4, COUNT).astype(np.float32)
        np.testing.assert_array_equal(way(x)[2], -way(-x)[2])

    @ways
    def test_tanh_of_zeros_infinities_and_nan(self, way) -> None:
        x = np.resize(np.float32([0.0, -0.0, np.inf, -np.inf, np.nan, 3e38, -3e38, 100]), LANES)
        ours = way(x)[2]
        np.testing.assert_allclose(ours[:8], [0, 0, 1, -1, np.nan, 1, -1, 1], atol=5e-7)
        assert np.signbit(ours[:2]).tolist() == [False, True]
