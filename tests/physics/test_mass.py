"""Masses against the reference's on its own states, and from first principles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.physics.mass import (
    circle_area,
    circle_inertia,
    inverse,
    polygon_area,
    polygon_inertia,
)
from levelproof.physics.types import FIXED_POLYGONS
from tests.golden.load import golden

sides = st.floats(0.0625, 1.0, width=32)
corner = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)], np.float32)


def one(vertices: list | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one polygon in one lane, padded to four vertices."""
    given = np.asarray(vertices, np.float32)
    padded = np.zeros((4, 2), np.float32)
    padded[: len(given)] = given
    return padded[None, :, :, None], np.full((1, 1), len(given), np.int32)


@pytest.mark.parametrize("size", ["s", "m", "l"])
def test_masses_equal_the_references(size: str) -> None:
    """For rectangles, triangles and circles of sampled levels."""
    level = golden(size).level
    model, polygons = level.model, level.size.polygons
    density = np.asarray(level.density)
    area = [polygon_area(model.vertices, model.n_vertices), circle_area(model.radius)]
    inertia = [polygon_inertia(model.vertices, model.n_vertices), circle_inertia(model.radius)]
    for ours, theirs in ((area, model.inverse_mass), (inertia, model.inverse_inertia)):
        expected = np.asarray(theirs)
        finite = (expected != 0) & np.asarray(model.active)
        made = np.asarray(inverse(np.concatenate([np.asarray(part) for part in ours]) * density))
        assert finite[FIXED_POLYGONS:polygons].sum() > 300
        assert finite[polygons:].sum() > 300
        np.testing.assert_allclose(made[finite], expected[finite], rtol=3e-5)
    assert (np.asarray(model.n_vertices) == 3).any()


@settings(deadline=None)
@given(sides, sides)
def test_rectangle_has_its_textbook_mass_and_inertia(half_width: float, half_height: float) -> None:
    vertices, four = one(corner * [half_width, half_height])
    mass = 4 * half_width * half_height
    np.testing.assert_allclose(polygon_area(vertices, four), mass, rtol=1e-5)
    np.testing.assert_allclose(polygon_inertia(vertices, four), mass * (half_width**2 + half_height**2) / 3, rtol=1e-5)


def test_triangle_has_its_area() -> None:
    vertices, three = one([(0, 2), (3, 0), (0, 0)])
    np.testing.assert_allclose(polygon_area(vertices, three), 3)


def test_circle_has_half_the_inertia_of_a_disc() -> None:
    """The reference's formula; a disc has m r^2 / 2."""
    radius = np.float32(0.3)
    np.testing.assert_allclose(circle_inertia(radius), circle_area(radius) * radius**2 / 4, rtol=1e-6)


def test_inverse_of_zero_is_one() -> None:
    assert inverse(np.zeros(2, np.float32)).tolist() == [1, 1]
