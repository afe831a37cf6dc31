"""Environments that sample a new level at every reset."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import levelproof
from levelproof.levelgen.task.fresh import renewed

LANES, STEPS = 24, 9
RULES = levelproof.TaskParams(max_timesteps=4)


def test_renewed_begins_only_the_lanes_that_are_done() -> None:
    done = np.random.default_rng(0).random(100) < 0.4
    before = np.arange(300.0, dtype=np.float32).reshape(3, 100)
    begin = lambda ids: jnp.stack([-ids.astype(jnp.float32)] * 3)
    for some in (done, np.zeros(100, bool), np.ones(100, bool)):
        after = jax.jit(lambda some: renewed(some, jnp.arange(100), begin, jnp.asarray(before)))(some)
        np.testing.assert_array_equal(after, np.where(some, -np.arange(100.0), before))


def test_every_reset_draws_a_new_level() -> None:
    env, params = levelproof.make("s", rules=RULES)
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))
    key = jax.random.key(3)
    _, state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key, LANES), params)
    met = [np.asarray(state.level_index)]
    ended = np.zeros(LANES, bool)
    for t in range(STEPS):
        keys = jax.random.split(jax.random.fold_in(key, t), LANES)
        _, state, _, done, info = step(keys, state, jnp.zeros((LANES, 6), jnp.int32), params)
        np.testing.assert_array_equal(info["level_index"], met[-1])
        met.append(np.asarray(state.level_index))
        np.testing.assert_array_equal(met[-1] != met[-2], done)
        ended |= np.asarray(done)
    assert ended.all()
    assert len({*np.concatenate(met).tolist()}) > 2 * LANES
    fresh = np.asarray(state.timestep) == 0
    levels = levelproof.sample_levels(met[-1], "s")
    for ours, theirs in zip(jax.tree.leaves(state.level.model), jax.tree.leaves(levels.model), strict=True):
        np.testing.assert_array_equal(np.moveaxis(ours, 0, -1), theirs)
    np.testing.assert_array_equal(np.moveaxis(state.level.state.position, 0, -1)[..., fresh],
                                  levels.state.position[..., fresh])  # fmt: skip


@pytest.mark.slow
def test_lanes_start_the_levels_whose_ids_they_are_given() -> None:
    env, params = levelproof.make("s", rules=RULES)
    lanes = levelproof.Lanes(env)
    table, ids = lanes.table(params), jnp.arange(LANES, dtype=jnp.int32)
    step = jax.jit(lanes.step)
    observation, state, played = lanes.reset(table, ids)
    for _ in range(RULES.max_timesteps):
        observation, state, played, *_ = step(table, played, state, jnp.zeros((6, LANES), jnp.int32), ids + 100)
    assert (np.asarray(state.level_index) >= 100).all()
    starting = np.asarray(state.now.timestep) == 0
    expected, _, _ = lanes.reset(table, ids + 100)
    np.testing.assert_allclose(np.asarray(observation)[:, starting], np.asarray(expected)[:, starting], atol=1e-6)
    assert starting.any()


def test_make_takes_a_preset_and_names_unknown_ones() -> None:
    env, _ = levelproof.make("m", distribution="clutter")
    assert env.size == levelproof.SIZES["m"]
    for arguments, message in (
        ({"distribution": "tidy"}, "There is no distribution 'tidy': choose one of"),
        (
            {"levels": levelproof.sample_levels([1], "s"), "distribution": "clutter"},
            "pass a size such as 's' as levels",
        ),
        (
            {"levels": None, "split": "data/128k/s", "distribution": "clutter"},
            "split= has its own levels: leave",
        ),
    ):
        with pytest.raises(levelproof.UserError, match=message):
            levelproof.make(**({"levels": "m"} | arguments))
