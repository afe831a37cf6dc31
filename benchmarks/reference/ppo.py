# pyright: reportMissingImports=false
"""The PPO that the reference's users would write today, inside the reference's own environment.

One agent per level, in the manner of PureJaxRL, with our experts' network; to be vmapped over levels.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from world import static_of

CHOICES = (3, 3, 3, 3, 2, 2)
WIDTH = 64
EPOCHS, MINIBATCHES = 4, 4
RATE, ADAM_EPSILON, MAX_NORM = 3e-4, 1e-5, 1.0
DISCOUNT, LAMBDA, CLIP = 0.995, 0.9, 0.2
VALUE_WEIGHT, ENTROPY_WEIGHT = 0.5, 0.01
DENSE_REWARD = 0.2


class Learner(NamedTuple):
    """One level's expert and its episodes under way."""

    params: Any
    optimiser: Any
    worlds: Any
    observation: Any
    key: Any


class Sample(NamedTuple):
    """A transition, and what the policy thought of it."""

    observation: Any
    action: Any
    chance: Any  # log probability
    value: Any
    reward: Any
    done: Any


class Programs(NamedTuple):
    """Of one level and its expert."""

    start: Callable  # (key, level) -> Learner
    update: Callable  # (Learner, level) -> (Learner, (ended, reached the goal)), flags [horizon, environment]
    # (Learner, level, key, attempts, steps) -> (actions [step, attempt, 6], ended, reached the goal)
    evaluate: Callable


def programs(size: str, environments: int, horizon: int) -> Programs:
    """To be vmapped over levels."""
    import flax.linen as nn
    import jax
    import jax.numpy as jnp
    import optax
    from kinetix.environment import EnvParams
    from kinetix.environment.env import make_kinetix_env
    from kinetix.environment.spaces import ActionType, ObservationType

    rules = EnvParams().replace(dense_reward_scale=DENSE_REWARD)
    static = static_of(size)
    env = make_kinetix_env(ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_FLAT, None, rules, static)
    ends = np.cumsum(CHOICES)[:-1].tolist()

    class Network(nn.Module):
        @nn.compact
        def __call__(self, x):
            def trunk(x):
                for _ in range(2):
                    x = nn.tanh(nn.Dense(WIDTH, kernel_init=nn.initializers.orthogonal(2**0.5))(x))
                return x

            logits = nn.Dense(sum(CHOICES), kernel_init=nn.initializers.orthogonal(0.01))(trunk(x))
            return [jax.nn.log_softmax(part) for part in jnp.split(logits, ends, -1)], nn.Dense(1)(trunk(x))[..., 0]

    network = Network()
    optimiser = optax.chain(optax.clip_by_global_norm(MAX_NORM), optax.adam(RATE, eps=ADAM_EPSILON))

    def log_chance(parts, action):
        each = [jnp.take_along_axis(part, action[..., i : i + 1], -1)[..., 0] for i, part in enumerate(parts)]
        return sum(each)

    def draw(key, parts):
        draws = zip(jax.random.split(key, len(CHOICES)), parts, strict=True)
        return jnp.stack([jax.random.categorical(k, part) for k, part in draws], -1)

    reset_all = jax.vmap(env.reset, in_axes=(0, None, None))
    step_all = jax.vmap(env.step, in_axes=(0, 0, 0, None, None))

    def start(key, level):
        of_network, of_worlds, kept = jax.random.split(key, 3)
        observation, worlds = reset_all(jax.random.split(of_worlds, environments), rules, level)
        params = network.init(of_network, observation)
        return Learner(params, optimiser.init(params), worlds, observation, kept)

    def rollout(learner, level, key):
        def act(carry, key):
            worlds, observation = carry
            of_action, of_world = jax.random.split(key)
            parts, value = network.apply(learner.params, observation)
            action = draw(of_action, parts)
            after = step_all(jax.random.split(of_world, environments), worlds, action, rules, level)
            seen, worlds, reward, done, info = after
            sample = Sample(observation, action, log_chance(parts, action), value, reward, done)
            return (worlds, seen), (sample, (done & info["GoalR"]))

        keys = jax.random.split(key, horizon)
        (worlds, observation), (samples, goals) = jax.lax.scan(act, (learner.worlds, learner.observation), keys)
        return learner._replace(worlds=worlds, observation=observation), samples, goals

    def advantages(samples, last_value):
        def back(carry, now):
            advantage, following = carry
            alive = 1.0 - now.done
            surprise = now.reward + DISCOUNT * following * alive - now.value
            advantage = surprise + DISCOUNT * LAMBDA * alive * advantage
            return (advantage, now.value), advantage

        return jax.lax.scan(back, (jnp.zeros_like(last_value), last_value), samples, reverse=True)[1]

    def loss(params, batch):
        samples, gain = batch
        parts, value = network.apply(params, samples.observation)
        ratio = jnp.exp(log_chance(parts, samples.action) - samples.chance)
        target = samples.value + gain
        near = samples.value + jnp.clip(value - samples.value, -CLIP, CLIP)
        error = 0.5 * jnp.maximum(jnp.square(value - target), jnp.square(near - target)).mean()
        gain = (gain - gain.mean()) / (gain.std() + 1e-8)
        surrogate = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * gain).mean()
        entropy = sum(-(jnp.exp(part) * part).sum(-1).mean() for part in parts)
        return VALUE_WEIGHT * error - surrogate - ENTROPY_WEIGHT * entropy

    def learn(carry, batch):
        params, state = carry
        change, state = optimiser.update(jax.grad(loss)(params, batch), state, params)
        return (optax.apply_updates(params, change), state), None

    def update(learner, level):
        key, of_rollout, of_epochs = jax.random.split(learner.key, 3)
        learner, samples, goals = rollout(learner, level, of_rollout)
        gain = advantages(samples, network.apply(learner.params, learner.observation)[1])
        flat = jax.tree.map(lambda x: x.reshape(horizon * environments, *x.shape[2:]), (samples, gain))

        def epoch(carry, key):
            order = jax.random.permutation(key, horizon * environments)
            cut = jax.tree.map(lambda x: x[order].reshape(MINIBATCHES, -1, *x.shape[1:]), flat)
            return jax.lax.scan(learn, carry, cut)

        carry = (learner.params, learner.optimiser)
        (params, state), _ = jax.lax.scan(epoch, carry, jax.random.split(of_epochs, EPOCHS))
        return learner._replace(params=params, optimiser=state, key=key), (samples.done, goals)

    def evaluate(learner, level, key, attempts, steps):
        def act(carry, key):
            worlds, observation = carry
            of_action, of_world = jax.random.split(key)
            parts, _ = network.apply(learner.params, observation)
            action = draw(of_action, parts).at[0].set(jnp.stack([part[0].argmax() for part in parts]))
            after = step_all(jax.random.split(of_world, attempts), worlds, action, rules, level)
            seen, worlds, _, done, info = after
            return (worlds, seen), (action, done, done & info["GoalR"])

        of_worlds, of_steps = jax.random.split(key)
        observation, worlds = reset_all(jax.random.split(of_worlds, attempts), rules, level)
        return jax.lax.scan(act, (worlds, observation), jax.random.split(of_steps, steps))[1]

    return Programs(start, update, evaluate)
