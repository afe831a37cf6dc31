"""All observation and action types against the reference, in 512 states per size."""

import jax
import numpy as np
import pytest

from levelproof.levelgen.level import SIZES
from levelproof.levelgen.task.environment import CONTROLS, ActionType
from levelproof.levelgen.task.observe.entities import entities, padded_shape, symbolic_padded
from levelproof.levelgen.task.observe.flat import symbolic_flat
from tests.golden.load_seen import Seen, assert_seen, load_seen
from tests.quick import jit_once


@pytest.fixture(scope="module", params=["s", "m", "l"])
def seen(request: pytest.FixtureRequest) -> Seen:
    return load_seen(request.param)


def test_golden_observations_cover_enough_states(seen: Seen) -> None:
    assert seen.fields["image"].shape[-1] >= 500


@pytest.mark.parametrize(("name", "look"), [("flat", symbolic_flat), ("padded", symbolic_padded)])
def test_flat_and_padded_rows_equal_the_references(seen: Seen, name: str, look) -> None:
    assert_seen(seen.fields, name, np.asarray(jit_once(look)(seen.level, seen.level.state)))


def test_entities_equal_the_references(seen: Seen) -> None:
    ours = jit_once(entities)(seen.level, seen.level.state)
    assert {f"entity/{name}" for name in vars(ours)} <= set(seen.fields)
    for name, values in vars(ours).items():
        assert_seen(seen.fields, f"entity/{name}", np.asarray(values))
    masks = np.asarray(ours.attention_mask)
    assert masks.any((1, 2)).all(0).any()  # a state with pairs of every kind


@pytest.mark.parametrize("name", ["discrete", "continuous"])
def test_actions_give_the_references_controls(seen: Seen, name: str) -> None:
    ours = np.concatenate(jax.jit(CONTROLS[ActionType(name)])(seen.level, seen.fields[name]))
    np.testing.assert_array_equal(ours, seen.fields[f"control_{name}"])


def test_observations_of_a_broken_world_are_finite(seen: Seen) -> None:
    broken = jax.tree.map(lambda x: np.full_like(x, np.nan) if x.dtype == np.float32 else x, seen.level.state)
    for look in (symbolic_padded, entities):
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(jit_once(look)(seen.level, broken)))


def test_shapes_are_the_references() -> None:
    assert [padded_shape(SIZES[name]) for name in "sml"] == [(6, 41), (10, 45), (21, 59)]
