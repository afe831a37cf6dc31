"""Lanes against mapped single environments: the same worlds, rewards, ends and observations."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.levelgen.level import Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.environment import make, starts
from levelproof.levelgen.task.lanes import Lanes
from levelproof.levelgen.task.observe.kinds import ObservationType
from tests.trees import assert_same, lanes_last

COUNT, STEPS = 24, 12


@pytest.fixture(scope="module")
def levels() -> Level:
    return sample_levels(np.arange(COUNT), "s")


@pytest.mark.slow
def test_lanes_step_as_mapped_environments_do(levels: Level) -> None:
    env, params = make(levels, rules=task.TaskParams(max_timesteps=5), final_observation=True)
    lanes = Lanes(env)
    actions = np.random.default_rng(0).integers(0, np.array(CHOICES), (STEPS, COUNT, 6)).astype(np.int32)
    keys, one, fresh = jax.random.split(jax.random.key(0), COUNT), starts(levels), starts(levels)
    table = lanes.table(params)
    observed, state, played = jax.jit(lanes.reset)(table, jnp.arange(COUNT)[::-1])
    mapped, step = jax.jit(jax.vmap(env.step, (0, 0, 0, None, 0))), jax.jit(lanes.step)
    one = jax.tree.map(lambda x: x[::-1], one)
    ended = 0
    for number in range(STEPS):
        chosen = np.roll(np.arange(COUNT), number)  # the levels that lanes start next
        given = jax.tree.map(lambda x, chosen=chosen: x[chosen], fresh)
        expected, one, reward, done, expected_info = mapped(keys, one, actions[number], params, given)
        observed, state, played, *rest, info = step(table, played, state, actions[number].T, chosen)
        assert_same(rest, [reward, done])
        assert_same(state.now, lanes_last(one.now))
        np.testing.assert_array_equal(state.level_index, one.level_index)
        np.testing.assert_allclose(observed, expected.T, rtol=1e-6)
        np.testing.assert_allclose(info.pop("final_observation"), expected_info.pop("final_observation").T, rtol=1e-6)
        assert_same(info, expected_info)
        ended += int(done.sum())
    assert ended > 2 * COUNT
    assert_same(played, jax.jit(lanes.take)(table, state.level_index))


def test_lanes_take_numpy_levels_and_refuse_actions_of_another_type(levels: Level) -> None:
    env, params = make(levels)
    lanes = Lanes(env)
    table = lanes.table(replace(params, levels=levels[:8]))
    _, state, played = jax.eval_shape(lanes.reset, table, jnp.arange(3))
    step = lambda action: jax.eval_shape(lanes.step, table, played, state, action, jnp.arange(3))
    assert step(jnp.zeros((6, 3), int))[3].shape == (3,)
    for shape, words in (
        ((3,), r"\(3,\), but must have \(6, lanes\)"),
        ((3, 6), r"\(3, 6\), but there are 3"),
        ((6, 1), r"\(6, 1\), but there are 3"),
    ):
        with pytest.raises(ValueError, match=f"actions have shape {words}"):
            step(jnp.zeros(shape, int))
    with pytest.raises(TypeError, match="actions are float32, but must be integers"):
        step(jnp.zeros((6, 3)))
    discrete = Lanes(make(levels, "discrete")[0])
    with pytest.raises(ValueError, match=r"but must have \(lanes\)"):
        jax.eval_shape(discrete.step, table, played, state, jnp.zeros((6, 3), int), jnp.arange(3))


def test_lane_state_contains_no_level_arrays(levels: Level) -> None:
    env, params = make(levels)
    _, state, _ = jax.eval_shape(lambda: Lanes(env).reset(Lanes(env).table(params), jnp.arange(3)))
    assert {x.shape[-1] for x in jax.tree.leaves(state)} == {3}
    assert sum(x.size for x in jax.tree.leaves(state)) < sum(x.size for x in jax.tree.leaves(levels[:3]))


@pytest.mark.parametrize("kind", list(ObservationType))
def test_lanes_observe_as_the_environment_does(levels: Level, kind: str) -> None:
    env, params = make(levels[:2], observation_type=kind)
    lanes = Lanes(env)
    shown = jax.eval_shape(lambda: lanes.reset(lanes.table(params), jnp.arange(2))[0])
    single = jax.eval_shape(lambda: env.reset(jax.random.key(0))[0])
    assert jax.tree.map(lambda x: (*x.shape, 2), single) == jax.tree.map(lambda x: x.shape, shown)


def test_lanes_reset_to_a_state_of_the_types_that_step_returns(levels: Level) -> None:
    lanes = Lanes(make(levels)[0])
    table, index = lanes.table(), jnp.arange(3, dtype=jnp.uint32)
    _, state, played = jax.eval_shape(lanes.reset, table, index)
    _, after, *_ = jax.eval_shape(lanes.step, table, played, state, jnp.zeros((6, 3), int), index)
    assert after == state
