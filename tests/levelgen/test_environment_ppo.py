"""PPO as people write it for gymnax (one file, `vmap` around reset and step, a wrapper that counts) learns here."""

from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax.linen.initializers import orthogonal

from levelgen.environment import ActionType, make
from levelgen.level import SIZES
from levelgen.sampler import sample_levels

LEVELS, ENVS, STEPS, UPDATES, EPOCHS, MINIBATCHES = 4, 64, 64, 40, 4, 4
GAMMA, LAMBDA, CLIP, ENTROPY, VALUE, RATE = 0.99, 0.95, 0.2, 0.01, 0.5, 1e-3


class Transition(NamedTuple):
    done: jax.Array
    action: jax.Array
    value: jax.Array
    reward: jax.Array
    log_prob: jax.Array
    obs: jax.Array
    info: Any


class ActorCritic(nn.Module):
    actions: int

    @nn.compact
    def __call__(self, x):
        def tower(out, scale):
            y = x
            for _ in range(2):
                y = nn.tanh(nn.Dense(64, kernel_init=orthogonal(2**0.5))(y))
            return nn.Dense(out, kernel_init=orthogonal(scale))(y)

        return tower(self.actions, 0.01), tower(1, 1.0)[..., 0]


class LogWrapper:
    """Counts returns, as the wrapper that comes with most such code."""

    def __init__(self, env) -> None:
        self._env = env

    def __getattr__(self, name):
        return getattr(self._env, name)

    @partial(jax.jit, static_argnums=0)
    def reset(self, key, params=None):
        obs, state = self._env.reset(key, params)
        return obs, (state, 0.0, 0.0)

    @partial(jax.jit, static_argnums=0)
    def step(self, key, state, action, params=None):
        state, so_far, last = state
        obs, state, reward, done, info = self._env.step(key, state, action, params)
        so_far = so_far + reward
        last = jnp.where(done, so_far, last)
        return obs, (state, so_far * (1 - done), last), reward, done, info | {"returned_episode_returns": last}


def make_train(env, env_params):
    env = LogWrapper(env)
    network = ActorCritic(env.action_space(env_params).n)
    tx = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(RATE, eps=1e-5))

    def loss(params, batch, gae, targets):
        logits, value = network.apply(params, batch.obs)
        log_probs = jax.nn.log_softmax(logits)
        log_prob = jnp.take_along_axis(log_probs, batch.action[:, None], 1)[:, 0]
        ratio = jnp.exp(log_prob - batch.log_prob)
        gae = (gae - gae.mean()) / (gae.std() + 1e-8)
        actor = -jnp.minimum(ratio * gae, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * gae).mean()
        clipped = batch.value + jnp.clip(value - batch.value, -CLIP, CLIP)
        critic = jnp.maximum((value - targets) ** 2, (clipped - targets) ** 2).mean() / 2
        entropy = -(jnp.exp(log_probs) * log_probs).sum(-1).mean()
        return actor + VALUE * critic - ENTROPY * entropy

    def env_step(carry, _):
        params, env_state, last_obs, rng = carry
        rng, rng_act, rng_step = jax.random.split(rng, 3)
        logits, value = network.apply(params, last_obs)
        action = jax.random.categorical(rng_act, logits)
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], 1)[:, 0]
        keys = jax.random.split(rng_step, ENVS)
        obs, env_state, reward, done, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            keys, env_state, action, env_params
        )
        return (params, env_state, obs, rng), Transition(done, action, value, reward, log_prob, last_obs, info)

    def advantages(batch, last_value):
        def back(carry, transition):
            gae, next_value = carry
            delta = transition.reward + GAMMA * next_value * (1 - transition.done) - transition.value
            gae = delta + GAMMA * LAMBDA * (1 - transition.done) * gae
            return (gae, transition.value), gae

        return jax.lax.scan(back, (jnp.zeros(ENVS), last_value), batch, reverse=True)[1]

    def update(carry, _):
        params, opt_state, env_state, obs, rng = carry
        (_, env_state, obs, rng), batch = jax.lax.scan(env_step, (params, env_state, obs, rng), None, STEPS)
        gae = advantages(batch, network.apply(params, obs)[1])
        data = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (batch, gae, gae + batch.value))

        def minibatch(carry, index):
            params, opt_state = carry
            grads = jax.grad(loss)(params, *jax.tree.map(lambda x: x[index], data))
            change, opt_state = tx.update(grads, opt_state)
            return (optax.apply_updates(params, change), opt_state), None

        rng, *keys = jax.random.split(rng, EPOCHS + 1)
        order = jnp.concatenate([jax.random.permutation(key, ENVS * STEPS) for key in keys])
        order = order.reshape(EPOCHS * MINIBATCHES, -1)
        (params, opt_state), _ = jax.lax.scan(minibatch, (params, opt_state), order)
        told = batch.info["GoalR"].sum(), batch.done.sum(), batch.info["returned_episode_returns"].mean()
        return (params, opt_state, env_state, obs, rng), told

    def train(rng):
        rng, rng_net, rng_env = jax.random.split(rng, 3)
        params = network.init(rng_net, jnp.zeros(env.observation_space(env_params).shape))
        obs, env_state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(rng_env, ENVS), env_params)
        return jax.lax.scan(update, (params, tx.init(params), env_state, obs, rng), None, UPDATES)[1]

    return train


@pytest.mark.slow
def test_it_learns() -> None:
    """160,000 steps on four random levels."""
    env, params = make(sample_levels(np.arange(LEVELS), SIZES["s"]), ActionType.DISCRETE)
    goals, ends, returns = map(np.asarray, jax.jit(make_train(env, params))(jax.random.PRNGKey(0)))
    first, last = slice(0, 10), slice(-10, None)  # ten updates are two episodes and a half, at their longest
    assert np.isfinite(returns).all()
    assert goals[last].sum() > 2 * goals[first].sum()
    assert goals[last].sum() / ends[last].sum() > goals[first].sum() / ends[first].sum() + 0.1


def test_seeds_train_side_by_side() -> None:
    """`vmap` of a whole training run, as people do for error bars: here of one rollout."""
    env, params = make(sample_levels(np.arange(2), SIZES["s"]), ActionType.DISCRETE)

    def rollout(rng):
        _, state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(rng, 3), params)

        def step(state, rng):
            action = jax.random.randint(rng, (3,), 0, env.num_actions)
            obs, state, reward, done, _ = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
                jax.random.split(rng, 3), state, action, params
            )
            return state, (obs, reward, done)

        return jax.lax.scan(step, state, jax.random.split(rng, 8))[1]

    seeds = jax.random.split(jax.random.PRNGKey(1), 2)
    together = jax.jit(jax.vmap(rollout))(seeds)
    for seed in range(2):
        alone = jax.jit(rollout)(seeds[seed])
        jax.tree.map(lambda x, y, seed=seed: np.testing.assert_allclose(x[seed], y, rtol=1e-6), together, alone)
