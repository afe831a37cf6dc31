"""The Pallas kernel in its interpreter: the same step, from the same source."""

import jax
import numpy as np
import pytest

from physics.engine import Given
from physics.lanes import LANES
from physics.pallas import as_pallas
from physics.step import on_all_lanes
from physics.types import DEFAULT_PARAMS
from tests.golden.load import HERE, load


@pytest.mark.slow
@pytest.mark.parametrize("size", ["s", "m"])
def test_it_is_the_step(size: str) -> None:
    """Two blocks, bit for bit what XLA makes of the source."""
    of, lanes = load(HERE / f"{size}.npz"), 2 * LANES
    some = lambda x: np.broadcast_to(x, (*x.shape[:-1], of.reward.size))[..., :lanes]
    given = jax.tree.map(some, Given(of.level.model, of.state, of.motor, of.thrust))
    ours = jax.jit(lambda given: as_pallas(given, DEFAULT_PARAMS, seen=True, interpret=True))(given)
    plain = jax.jit(lambda given: on_all_lanes(given, DEFAULT_PARAMS, seen=True))(given)
    assert jax.tree.structure(ours) == jax.tree.structure(plain)
    jax.tree.map(np.testing.assert_array_equal, ours, plain)
