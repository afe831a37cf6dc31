"""A public PPO written for gymnax, rejax 0.1.3, learns here, and whole runs may be mapped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces
from rejax import PPO

from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.environment import ActionType, Environment, EnvParams, make

STEPS = 262_144
EPISODES = 128  # per evaluation
SEEDS = 3


class WithGymnaxSpace(Environment):
    """Our environment with gymnax's own class of discrete spaces, which rejax checks for; it accepts the rest."""

    def action_space(self, params: EnvParams | None = None) -> spaces.Discrete:
        return spaces.Discrete(super().action_space(params).n)  # pyright: ignore[reportAttributeAccessIssue]


def solved(algo, ts, rng) -> jax.Array:
    """Return the share of first episodes that reach the goal."""
    act = algo.make_act(ts)

    def play(rng):
        rng, first = jax.random.split(rng)
        obs, state = algo.env.reset(first, algo.env_params)

        def step(carry, key):
            obs, state, over, goal = carry
            act_key, step_key = jax.random.split(key)
            obs, state, _, done, info = algo.env.step(step_key, state, act(obs, act_key), algo.env_params)
            return (obs, state, over | done, goal | (~over & (info["GoalR"] > 0))), None

        start = (obs, state, jnp.bool_(False), jnp.bool_(False))
        return jax.lax.scan(step, start, jax.random.split(rng, 256))[0][3]

    return jax.vmap(play)(jax.random.split(rng, EPISODES)).mean()


@pytest.mark.campaign
def test_ppo_learns() -> None:
    """On four random levels, some of which random play solves. What a seed learns depends on the machine's rounding."""
    env, params = make(sample_levels(jnp.arange(4), SIZES["s"]), ActionType.DISCRETE)
    algo = PPO.create(
        env=WithGymnaxSpace(**vars(env)), env_params=params, num_envs=64, num_steps=64, num_epochs=4,
        num_minibatches=4, learning_rate=1e-3, max_grad_norm=0.5, total_timesteps=STEPS, eval_freq=STEPS,
    )  # fmt: skip
    train = jax.jit(algo.replace(eval_callback=solved).train)
    shares = np.array([train(jax.random.key(seed))[1] for seed in range(SEEDS)])
    before, after = shares.mean(0)
    assert after > before + 0.15, shares


@pytest.mark.campaign
def test_ppo_trains_with_continuous_actions() -> None:
    env, params = make(sample_levels(jnp.arange(4), SIZES["s"]), ActionType.CONTINUOUS)
    algo = PPO.create(
        env=env, env_params=params, num_envs=16, num_steps=32, num_minibatches=2, num_epochs=1,
        total_timesteps=1024, eval_freq=1024, skip_initial_evaluation=True,
    )  # fmt: skip
    algo = algo.replace(eval_callback=lambda algo, ts, rng: ts.global_step)
    state, steps = jax.jit(algo.train)(jax.random.key(0))
    assert int(steps[-1]) == 1024
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state.actor_ts.params))


@pytest.mark.campaign
def test_training_runs_can_be_mapped_over_seeds() -> None:
    """`vmap` over a whole training run, as for error bars; here over one rollout."""
    env, params = make(sample_levels(jnp.arange(2), SIZES["s"]), ActionType.DISCRETE)

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
