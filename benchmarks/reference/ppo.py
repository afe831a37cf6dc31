# pyright: reportMissingImports=false
"""The PPO that the reference's users would write today, inside the reference's own environment.

One agent per level, in the style of PureJaxRL, with our experts' network; vmap it over levels. Importing this module
starts JAX: pin the process first (world.stay_on).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from actions import CHOICES
from hyperparameters import PPO
from kinetix.environment import EnvParams
from kinetix.environment.env import make_kinetix_env
from kinetix.environment.spaces import ActionType, ObservationType
from world import static_of


class Learner(NamedTuple):
    """One level's expert and its running episodes."""

    params: Any
    optimiser: Any
    worlds: Any
    observation: Any
    key: Any


class Transition(NamedTuple):
    """One env step of each environment, with the policy's log probability and value."""

    observation: Any
    action: Any
    log_probability: Any
    value: Any
    reward: Any
    done: Any


class Network(nn.Module):
    """Network that returns log probabilities of each entry's choices, and the value."""

    @nn.compact
    def __call__(self, x):
        logits = nn.Dense(sum(CHOICES), kernel_init=nn.initializers.orthogonal(0.01))(trunk(x))
        parts = jnp.split(logits, np.cumsum(CHOICES)[:-1].tolist(), -1)
        return [jax.nn.log_softmax(part) for part in parts], nn.Dense(1)(trunk(x))[..., 0]


def trunk(x):
    """Apply hidden layers, which belong to the calling module."""
    for _ in range(PPO.depth):
        x = nn.tanh(nn.Dense(PPO.width, kernel_init=nn.initializers.orthogonal(2**0.5))(x))
    return x


network = Network()
optimiser = optax.chain(
    optax.clip_by_global_norm(PPO.max_gradient_norm), optax.adam(PPO.learning_rate, eps=PPO.adam_epsilon)
)


@dataclass(frozen=True)
class Trainer:
    """Training programs of one level's expert."""

    env: Any
    rules: Any
    environments: int
    horizon: int

    @staticmethod
    def of(size: str, environments: int, horizon: int) -> "Trainer":
        rules = EnvParams().replace(dense_reward_scale=PPO.dense_reward_scale)
        static = static_of(size)
        env = make_kinetix_env(ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_FLAT, None, rules, static)
        return Trainer(env, rules, environments, horizon)

    def start(self, key, level) -> Learner:
        network_key, worlds_key, learner_key = jax.random.split(key, 3)
        observation, worlds = self.reset(worlds_key, level, self.environments)
        params = network.init(network_key, observation)
        return Learner(params, optimiser.init(params), worlds, observation, learner_key)

    def update(self, learner: Learner, level):
        """Roll out and update; return the learner and flags (ended, reached the goal) [horizon, environment]."""
        key, rollout_key, epochs_key = jax.random.split(learner.key, 3)
        learner, transitions, goals = self.rollout(learner, level, rollout_key)
        gain = advantages(transitions, network.apply(learner.params, learner.observation)[1])
        samples = self.horizon * self.environments
        flat = jax.tree.map(lambda x: x.reshape(samples, *x.shape[2:]), (transitions, gain))

        def epoch(carry, key):
            order = jax.random.permutation(key, samples)
            cut = jax.tree.map(lambda x: x[order].reshape(PPO.minibatches, -1, *x.shape[1:]), flat)
            return jax.lax.scan(learn, carry, cut)

        carry = (learner.params, learner.optimiser)
        (params, state), _ = jax.lax.scan(epoch, carry, jax.random.split(epochs_key, PPO.epochs))
        return learner._replace(params=params, optimiser=state, key=key), (transitions.done, goals)

    def evaluate(self, learner: Learner, level, key, attempts: int, steps: int):
        """Play attempts; return actions [step, attempt, 6] and flags (ended, reached the goal).

        Attempt 0 takes the most probable actions.
        """

        def act(carry, key):
            worlds, observation = carry
            action_key, world_key = jax.random.split(key)
            parts, _ = network.apply(learner.params, observation)
            action = draw(action_key, parts).at[0].set(jnp.stack([part[0].argmax() for part in parts]))
            observed, worlds, _, done, info = self.step(world_key, worlds, action, level, attempts)
            return (worlds, observed), (action, done, done & info["GoalR"])

        worlds_key, steps_key = jax.random.split(key)
        observation, worlds = self.reset(worlds_key, level, attempts)
        return jax.lax.scan(act, (worlds, observation), jax.random.split(steps_key, steps))[1]

    def rollout(self, learner: Learner, level, key):
        def act(carry, key):
            worlds, observation = carry
            action_key, world_key = jax.random.split(key)
            parts, value = network.apply(learner.params, observation)
            action = draw(action_key, parts)
            observed, worlds, reward, done, info = self.step(world_key, worlds, action, level, self.environments)
            transition = Transition(observation, action, log_probability(parts, action), value, reward, done)
            return (worlds, observed), (transition, (done & info["GoalR"]))

        keys = jax.random.split(key, self.horizon)
        (worlds, observation), (observed, goals) = jax.lax.scan(act, (learner.worlds, learner.observation), keys)
        return learner._replace(worlds=worlds, observation=observation), observed, goals

    def reset(self, key, level, count: int):
        return jax.vmap(self.env.reset, in_axes=(0, None, None))(jax.random.split(key, count), self.rules, level)

    def step(self, key, worlds, action, level, count: int):
        step = jax.vmap(self.env.step, in_axes=(0, 0, 0, None, None))
        return step(jax.random.split(key, count), worlds, action, self.rules, level)


def draw(key, parts):
    draws = zip(jax.random.split(key, len(CHOICES)), parts, strict=True)
    return jnp.stack([jax.random.categorical(k, part) for k, part in draws], -1)


def log_probability(parts, action):
    return sum(jnp.take_along_axis(part, action[..., i : i + 1], -1)[..., 0] for i, part in enumerate(parts))


def advantages(observed: Transition, last_value):
    """Compute generalised advantages of a rollout, [horizon, environment]."""

    def back(carry, transition):
        advantage, next_value = carry
        alive = 1.0 - transition.done
        surprise = transition.reward + PPO.discount * next_value * alive - transition.value
        advantage = surprise + PPO.discount * PPO.gae_lambda * alive * advantage
        return (advantage, transition.value), advantage

    return jax.lax.scan(back, (jnp.zeros_like(last_value), last_value), observed, reverse=True)[1]


def loss(params, batch):
    observed, gain = batch
    parts, value = network.apply(params, observed.observation)
    ratio = jnp.exp(log_probability(parts, observed.action) - observed.log_probability)
    target = observed.value + gain
    near = observed.value + jnp.clip(value - observed.value, -PPO.clip, PPO.clip)
    error = 0.5 * jnp.maximum(jnp.square(value - target), jnp.square(near - target)).mean()
    gain = (gain - gain.mean()) / (gain.std() + 1e-8)
    surrogate = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - PPO.clip, 1 + PPO.clip) * gain).mean()
    entropy = sum(-(jnp.exp(part) * part).sum(-1).mean() for part in parts)
    return PPO.value_weight * error - surrogate - PPO.entropy_weight * entropy


def learn(carry, batch):
    params, state = carry
    change, state = optimiser.update(jax.grad(loss)(params, batch), state, params)
    return (optax.apply_updates(params, change), state), None
