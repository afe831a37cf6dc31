"""Parts of training one policy over many levels: advantages, the penalty's decay, and which levels come next."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.generalist.config import LearnabilityConfig, PPOConfig
from levelproof.experts.generalist.curricula import fresh
from levelproof.experts.generalist.learnability import learnability
from levelproof.experts.generalist.rollout import Experience, table_of
from levelproof.experts.generalist.train import _advantages, _kl_weight, _open_ended
from levelproof.experts.objective import normalised, normalised_over, terms
from levelproof.experts.optimise import running_average
from levelproof.experts.policy import divergence, log_probability
from levelproof.levelgen.level import ACTIONS
from levelproof.levelgen.sampling.sampler import sample_levels, sampler
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.learn.sealed import SEALED_IDS

CONFIG = PPOConfig(repeat=1, discount=0.9, gae_lambda=0.8)


def experience(done: list[bool], terminated: list[bool]) -> Experience:
    """Return one lane's rewards 1, 2, ... and values 10, 20, ..."""
    time = jnp.arange(1.0, len(done) + 1)[:, None]
    flags = [jnp.array(each)[:, None] for each in (done, terminated)]
    return Experience(None, None, None, None, 10 * time, time, *flags)  # type: ignore[arg-type]


def test_truncated_episode_bootstraps_and_terminated_one_does_not() -> None:
    """The step of an open end counts for nothing: its value stands for all that would follow."""
    last, ended, cut = (
        np.asarray(_advantages(experience([False, done, False], [False, goal, False]), CONFIG))[:, 0]
        for done, goal in ((False, False), (True, True), (True, False))
    )
    np.testing.assert_allclose(ended, [1 + 0.9 * 20 - 10 + 0.72 * (2 - 20), 2 - 20, 0], rtol=1e-6)
    np.testing.assert_allclose(cut, [1 + 0.9 * 20 - 10, 0, 0], rtol=1e-6)
    assert _open_ended(experience([False, True, True], [False, False, True]))[:, 0].tolist() == [False, True, False]
    assert _open_ended(experience([False, True, False], [False, True, False]))[:, 0].tolist() == [False, False, True]
    np.testing.assert_allclose(last, [1 + 0.9 * 20 - 10 + 0.72 * (2 + 0.9 * 30 - 20), 2 + 0.9 * 30 - 20, 0], rtol=1e-6)


def test_discount_counts_env_steps_whatever_an_action_lasts() -> None:
    lane = experience([False, False, True], [False, False, True])
    longer = replace(CONFIG, repeat=2, discount=0.9**0.5)
    np.testing.assert_allclose(_advantages(lane, longer), _advantages(lane, CONFIG), rtol=1e-6)


@pytest.mark.parametrize("repeat", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_repeated_action_equals_that_many_env_steps(repeat: int) -> None:
    """The same world, and the same reward after the first action, whose shaping is 0; the same lanes end."""
    config = PPOConfig(repeat=repeat, dense_reward_scale=0.3)
    once, whole = config.training_rules(DEFAULT_RULES), replace(config, repeat=1).training_rules(DEFAULT_RULES)
    assert once.max_timesteps == -(-256 // repeat)
    levels = sample_levels(np.arange(64), "s")
    one = several = task.reset(levels)
    over, reward, goal = np.zeros(64, bool), np.zeros(64), np.zeros(64, bool)
    for turn in range(12):
        action = jax.random.randint(jax.random.key(turn), (ACTIONS, 64), 0, 2)
        before, (one, result) = over, task.advance(levels, one, action, once)
        for _ in range(repeat):
            several, each = task.advance(levels, several, action, whole)
            reward, goal = reward + np.where(over, 0, each.reward), goal | (~over & np.asarray(each.goal))
            over = over | np.asarray(each.done)
        np.testing.assert_array_equal(over, before | np.asarray(result.done))
        reward = np.where(turn > 0, reward - np.where(before, 0, result.reward), 0)
        goal ^= ~before & np.asarray(result.goal)
        np.testing.assert_array_equal(one.state.position[..., ~over], several.state.position[..., ~over])
    assert 0 < over.sum() < 64
    np.testing.assert_allclose(reward, 0, atol=1e-5)
    assert not goal.any()


def test_cores_normalise_the_samples_that_count_together() -> None:
    advantage = jax.random.normal(jax.random.key(0), (4, 8)) * jnp.arange(4)[:, None]
    counts = jnp.arange(8) != 3
    parts = jax.vmap(partial(normalised_over, "core"), axis_name="core")(advantage, jnp.broadcast_to(counts, (4, 8)))
    np.testing.assert_allclose(parts[:, counts], normalised(advantage[:, counts]), rtol=1e-5, atol=1e-6)
    assert not parts[:, 3].any()


def test_weight_n_equals_n_copies() -> None:
    keys = jax.random.split(jax.random.key(0), 6)
    times = jnp.array([0, 1, 2, 3, 2])
    logits, before, gain = (
        jax.random.normal(key, shape) for key, shape in zip(keys, ((16, 5), (5,), (5,)), strict=False)
    )
    action = jnp.stack([jax.random.randint(keys[3], (5,), 0, count) for count in CHOICES])
    live, value, advantage = jnp.ones((ACTIONS, 5), bool), jax.random.normal(keys[4], (5,)), 2 * gain
    given = logits, value, action, live, before - 3, value + 0.3, advantage, gain
    again = [jnp.repeat(x, times, axis=-1, total_repeat_length=8) for x in given]
    *weighted, _ = terms(*given, clip=0.2, weight=times * 5 / 8)
    *repeated, _ = terms(*again, clip=0.2)
    np.testing.assert_allclose(weighted, repeated, rtol=1e-5)


def test_kl_penalty_waits_for_the_critic_then_falls_to_zero() -> None:
    config = PPOConfig(critic_updates=10, kl_weight=0.2, kl_updates=100)
    weights = [float(_kl_weight(config, jnp.int32(update))) for update in (0, 10, 60, 110, 500)]
    np.testing.assert_allclose(weights, [0.2, 0.2, 0.1, 0, 0], atol=1e-7)
    assert float(_kl_weight(replace(config, kl_updates=0), jnp.int32(10))) == 0


def test_divergence_is_the_mean_log_ratio_of_live_entries() -> None:
    p, q = jax.random.normal(jax.random.key(0), (2, sum(CHOICES), 1))
    live = jnp.array([True, False, True, False, False, True])[:, None]
    assert float(divergence(p, p, live)[0]) == pytest.approx(0, abs=1e-6)
    actions = jnp.stack(jnp.meshgrid(*map(jnp.arange, CHOICES), indexing="ij")).reshape(ACTIONS, -1)
    spread = lambda x: jnp.broadcast_to(x, (len(x), actions.shape[1]))
    log_p, log_q = (log_probability(spread(x), actions, spread(live)) for x in (p, q))
    all_live = jnp.exp(log_probability(spread(p), actions, jnp.ones_like(spread(live))))
    assert float(divergence(p, q, live)[0]) == pytest.approx(float((all_live * (log_p - log_q)).sum()), rel=1e-4)


def test_average_keeps_little_of_the_first_weights() -> None:
    """After updates 0, 1 and 2 it keeps 1/10, 2/11 and 3/12 of what it was, and never more than `most`."""
    average = {"w": jnp.array([10.0])}
    for updates, weight, expected in ((0, 0.0, 1.0), (1, 5.5, 4.6818), (2, 4.0, 4.1705), (1000, 6.0, 5.085)):
        average = running_average(average, {"w": jnp.array([weight])}, jnp.int32(updates), 0.5)
        assert float(average["w"][0]) == pytest.approx(expected, abs=1e-3)


def test_average_of_equal_weights_is_exact() -> None:
    weights = jax.random.normal(jax.random.key(0), (1000,))
    assert (running_average(weights, weights, jnp.int32(7), 0.99) == weights).all()


def test_random_levels_are_never_sealed_and_table_levels_are_all_drawn() -> None:
    ids = np.asarray(fresh(sampler("s"), jax.random.key(0), 100_000))
    assert ids.min() >= 0
    assert ids.max() < SEALED_IDS.start
    table = table_of(sample_levels(np.arange(5), "s"), DEFAULT_RULES)
    assert set(np.asarray(fresh(table, jax.random.key(0), 200)).tolist()) == set(range(5))


def test_learnability_keeps_levels_that_are_sometimes_solved() -> None:
    config = LearnabilityConfig(share=0.75, candidates=64, keep=16)
    curriculum = learnability(config)
    table, key = sampler("s"), jax.random.key(1)
    before = np.asarray(curriculum.draw(table, curriculum.begin(), key, 1000))
    assert len(np.unique(before)) > 990, "nothing is measured yet: all levels are fresh"

    def attempt(ids, steps, key):
        assert steps == config.measured_steps
        number = jnp.arange(len(ids)) % 8  # 2 of 8 levels are solved sometimes, 1 of them as often as not
        return jnp.full(len(ids), 10), jnp.select([number == 0, number == 1, number == 2], [5, 1, 10], 0)

    assert curriculum.measure
    state = curriculum.measure(table, attempt, key)
    candidates = np.asarray(fresh(table, jax.random.split(key)[0], 64))
    assert set(np.asarray(state.level_index)[:8].tolist()) == set(candidates[::8].tolist())
    assert int(state.usable) == 16
    drawn = np.asarray(curriculum.draw(table, state, key, 4000))
    assert np.isin(drawn, np.asarray(state.level_index)).mean() == pytest.approx(0.75, abs=0.05)
    never = curriculum.measure(table, lambda ids, steps, key: (jnp.ones(len(ids)), jnp.zeros(len(ids))), key)
    assert int(never.usable) == 0


def test_learnability_adds_up_the_attempts_at_copies_of_few_levels() -> None:
    """Half of the copies of level 0 are always solved, the others never; level 1 is solved a quarter of the time."""
    config = LearnabilityConfig(candidates=64, keep=16)
    table = table_of(sample_levels(np.arange(5), "s"), DEFAULT_RULES)

    def attempt(ids, steps, key):
        even = jnp.cumsum(ids == 0) % 2 == 0
        return jnp.full(len(ids), 8), jnp.select([ids == 0, ids == 1], [jnp.where(even, 8, 0), 2], 0)

    curriculum = learnability(config)
    assert curriculum.measure
    state = curriculum.measure(table, attempt, jax.random.key(0))
    assert sorted(np.asarray(state.level_index)[: int(state.usable)].tolist()) == [0, 1]
