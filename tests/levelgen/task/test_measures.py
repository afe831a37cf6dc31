"""Kernels of levels refuse arrays that do not fit, before generated code reads out of bounds."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sampler
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.measures import goal_distance, world_points
from levelproof.physics.types import State

LANES, BODIES = 3, SIZES["s"].bodies


def state(position: jax.Array) -> State:
    return replace(empty_level(SIZES["s"], LANES).state, position=position)


def distance(position: jax.Array) -> Any:
    return goal_distance(empty_level(SIZES["s"], LANES), state(position))


def points(position: jax.Array) -> Any:
    return world_points(state(position), jnp.zeros((2, LANES), jnp.int32), jnp.zeros((2, 2, LANES)))


@pytest.mark.parametrize("measure", [distance, points])
def test_measures_refuse_positions_that_do_not_fit(measure: Callable[..., Any]) -> None:
    measure(jnp.zeros((BODIES, 2, LANES)))
    for shape in (1, 2, LANES), (BODIES + 1, 2, LANES), (BODIES, 2, LANES - 1), (BODIES, LANES):
        with pytest.raises(ValueError, match=r"^position has shape \(.*\), but must be \(7, 2, 3\)"):
            measure(jnp.zeros(shape))
    with pytest.raises(TypeError, match="position is float16, but must be float32"):
        measure(jnp.zeros((BODIES, 2, LANES), jnp.float16))


def test_sampler_refuses_level_ids_in_two_dimensions() -> None:
    with pytest.raises(ValueError, match=r"has shape \(2, 3\), but must be \(3,\)"):
        jax.eval_shape(sampler("s").lanes, jnp.zeros((2, LANES), jnp.int32))
