"""The symbolic-flat observation: its layout, limits and what may change within a level."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.levelgen.level import SIZES, Level, Role
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.observe import flat
from levelproof.levelgen.task.observe.flat import (
    CIRCLE_ROWS,
    LIMIT,
    POLYGON_ROWS,
    dynamic_features,
    feature_count,
)
from levelproof.physics.types import FIXED_POLYGONS, State
from tests.quick import jit_once

LANES = 16
level_features, state_features, symbolic_flat = map(
    jit_once, (flat.level_features, flat.state_features, flat.symbolic_flat)
)


@pytest.fixture(scope="module", params=["s", "m"])
def level(request: pytest.FixtureRequest) -> Level:
    return jax.device_get(sample_levels(np.arange(LANES), SIZES[request.param]))


@jax.jit
def moved(state: State) -> State:
    """Move every movable body."""
    later = jax.tree.map(lambda x: x, state)
    change = lambda x, by: jnp.asarray(x).at[FIXED_POLYGONS:].add(by)
    return dataclasses.replace(
        later,
        position=change(later.position, 0.5),
        rotation=change(later.rotation, 0.3),
        velocity=change(later.velocity, -2.0),
        angular_velocity=change(later.angular_velocity, 7.0),
    )


@pytest.mark.parametrize(("name", "count"), [("s", 140), ("m", 247), ("l", 679)])
def test_feature_count_equals_the_references(name: str, count: int) -> None:
    assert feature_count(SIZES[name]) == count
    movable = SIZES[name].bodies - FIXED_POLYGONS
    assert len(dynamic_features(SIZES[name])) == 7 * movable


def test_only_dynamic_features_change_within_a_level(level: Level) -> None:
    before, after = symbolic_flat(level, level.state), symbolic_flat(level, moved(level.state))
    assert before.shape == (feature_count(level.size), LANES)
    changed = np.flatnonzero((np.asarray(before) != np.asarray(after)).any(1))
    assert set(changed) <= set(dynamic_features(level.size).tolist())
    assert len(changed) > 0


def test_constant_and_dynamic_features_make_the_whole(level: Level) -> None:
    index, later = dynamic_features(level.size), moved(level.state)
    whole, constant = np.asarray(symbolic_flat(level, later)), np.asarray(level_features(level))
    assert not constant[index].any()
    np.testing.assert_array_equal(whole[index], state_features(level, later))
    rest = np.setdiff1d(np.arange(len(whole)), index)
    np.testing.assert_array_equal(whole[rest], constant[rest])
    np.testing.assert_array_equal(symbolic_flat(level, later, level_features(level)), whole)


def test_body_features_follow_the_layout(level: Level) -> None:
    observed, size, state = np.asarray(symbolic_flat(level, level.state)), level.size, level.state
    first_movable = observed[POLYGON_ROWS : 2 * POLYGON_ROWS]
    active = np.asarray(level.model.active[FIXED_POLYGONS])
    np.testing.assert_array_equal(first_movable[0, active], state.position[FIXED_POLYGONS, 0][active])
    role = np.asarray(level.role[FIXED_POLYGONS])
    np.testing.assert_array_equal(first_movable[8 + Role.GREEN, active], (role == Role.GREEN)[active])
    start = (size.polygons - 3) * POLYGON_ROWS
    circle = observed[start : start + CIRCLE_ROWS]
    np.testing.assert_array_equal(circle[-1], level.model.active[size.polygons])
    np.testing.assert_allclose(observed[-1], -0.981, rtol=1e-6)


def test_features_of_inactive_entities_are_zero(level: Level) -> None:
    model = dataclasses.replace(
        level.model,
        active=np.zeros_like(level.model.active),
        joint_active=np.zeros_like(level.model.joint_active),
        thruster_active=np.zeros_like(level.model.thruster_active),
    )
    observed = symbolic_flat(dataclasses.replace(level, model=model), level.state)
    assert not np.asarray(observed)[:-1].any()


def test_features_are_clipped_and_nan_is_zero(level: Level) -> None:
    model = dataclasses.replace(level.model, active=np.ones_like(level.model.active))
    nan_x = jnp.asarray(level.state.position).at[FIXED_POLYGONS, 0].set(jnp.nan)
    far_y = nan_x.at[FIXED_POLYGONS, 1].set(-14.0)
    fast = jnp.asarray(level.state.velocity).at[FIXED_POLYGONS, 0].set(jnp.inf)
    state = dataclasses.replace(level.state, position=far_y, velocity=fast)
    observed = np.asarray(symbolic_flat(dataclasses.replace(level, model=model), state))
    assert np.isfinite(observed).all()
    np.testing.assert_array_equal(
        observed[POLYGON_ROWS : POLYGON_ROWS + 3].T, np.tile([0.0, -LIMIT, LIMIT], (LANES, 1))
    )


def test_flat_observation_broadcasts_one_level(level: Level) -> None:
    one = jax.tree.map(lambda x: x[..., :1], level)
    spread = jax.tree.map(lambda x: np.repeat(x, LANES, -1), one)
    np.testing.assert_array_equal(symbolic_flat(one, level.state), symbolic_flat(spread, level.state))


def test_triangle_has_a_marked_fourth_vertex(level: Level) -> None:
    model = dataclasses.replace(
        level.model, n_vertices=np.full_like(level.model.n_vertices, 3), active=np.ones_like(level.model.active)
    )
    observed = np.asarray(symbolic_flat(dataclasses.replace(level, model=model), level.state))
    np.testing.assert_array_equal(observed[POLYGON_ROWS - 3 : POLYGON_ROWS].T, np.tile([-1.0, -1.0, 1.0], (LANES, 1)))
