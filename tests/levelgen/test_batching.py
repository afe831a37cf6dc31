"""Lanes chosen from arrays of any layout."""

import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.levelgen.batching import take

X = np.arange(24).reshape(2, 3, 4)


@pytest.mark.parametrize("lanes", [np.array([2, 0, 0]), slice(1, 3)])
@pytest.mark.parametrize("array", [X, np.asfortranarray(X), np.moveaxis(X, 0, -1).repeat(2, -1), jnp.asarray(X)])
def test_take_selects_lanes_whatever_the_layout(array: np.ndarray, lanes: np.ndarray | slice) -> None:
    np.testing.assert_array_equal(take({"x": array}, lanes)["x"], np.ascontiguousarray(array)[..., lanes])
