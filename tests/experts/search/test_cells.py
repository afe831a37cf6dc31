"""Features of cells: weighted positions and rotations of movable bodies."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from levelproof.experts.search.cells import TURN, features
from levelproof.experts.search.config import SearchConfig
from levelproof.levelgen.level import SIZES, Level, Role
from levelproof.levelgen.proofs import driven
from levelproof.levelgen.sampling.sampler import sample_levels

CONFIG = SearchConfig(driven_weight=0.5)


@cache
def levels() -> Level:
    return sample_levels(np.arange(64), SIZES["m"])


def moves() -> np.ndarray:
    """Find bodies that can move."""
    model = levels().model
    return np.asarray(model.active & (model.inverse_mass + model.inverse_inertia > 0))


def apart(**changed: jax.Array) -> np.ndarray:
    """Return each level's largest change of a feature if its start is changed like this."""
    rows = lambda state: np.asarray(features(levels(), state, CONFIG))
    return np.abs(rows(replace(levels().state, **changed)) - rows(levels().state)).max(-1)


def test_features_weight_bodies_by_role() -> None:
    """Movable bodies count in full, except those that actuators drive, if neither green nor blue."""
    moving, goal = moves(), np.isin(np.asarray(levels().role), (Role.GREEN, Role.BLUE))
    acted_on, kinds = np.asarray(driven(levels())), set()
    for body in range(len(moving)):
        position = jnp.asarray(levels().state.position).at[body, 1].add(0.25)
        weight = np.where(moving[body], np.where(acted_on[body] & ~goal[body], 0.5, 1.0), 0.0)
        np.testing.assert_allclose(apart(position=position), 0.25 * weight, atol=1e-5)
        kinds |= set(zip(moving[body].tolist(), acted_on[body].tolist(), goal[body].tolist(), strict=True))
    assert {(True, True, False), (True, False, False), (True, True, True), (True, False, True)} <= kinds


def test_features_ignore_velocities_and_full_turns() -> None:
    """Velocities and full turns leave features unchanged."""
    state = levels().state
    assert not apart(velocity=state.velocity + 3.0, angular_velocity=state.angular_velocity - 2.0).any()
    assert apart(rotation=state.rotation + TURN).max() < 1e-4
    quarter = apart(rotation=state.rotation + TURN / 4)
    assert (quarter[(moves() & (np.asarray(levels().model.inverse_inertia) > 0)).any(0)] > 0).all()
