# pyright: reportMissingImports=false
"""The PPO that the reference's users would write today, inside the reference's own environment.

One agent per level, in the manner of PureJaxRL, with our experts' network; to be vmapped over levels. Importing it
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
    """One level's expert and its episodes under way."""

    params: Any
    optimiser: Any
    worlds: Any
    observation: Any
    key: Any


class Transition(NamedTuple):
    """Of one env step of each environment, and what the policy thought of it."""

    observation: Any
    action: Any
    log_probability: Any
    value: Any
    reward: Any
    done: Any


class Network(nn.Module):
    """Log probabilities of each entry's choices, and the value."""

    @nn.compact
    def __call__(self, x):
        logits = nn.Dense(sum(CHOICES), kernel_init=nn.initializers.orthogonal(0.01))(trunk(x))
        parts = jnp.split(logits, np.cumsum(CHOICES)[:-1].tolist(), -1)
        return [jax.nn.log_softmax(part) for part in parts], nn.Dense(1)(trunk(x))[..., 0]


def trunk(x):
    """Layers of the network whose call this is in."""
    for _ in range(PPO.depth):
        x = nn.tanh(nn.Dense(PPO.width, kernel_init=nn.initializers.orthogonal(2**0.5))(x))
    return x


network = Network()
optimiser = optax.chain(
    optax.clip_by_global_norm(PPO.max_gradient_norm), optax.adam(PPO.learning_rate, eps=PPO.adam_epsilon)
)


@dataclass(frozen=True)
class Trainer:
    """Programs of one level and its expert."""

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
        of_network, of_worlds, kept = jax.random.split(key, 3)
        observation, worlds = self.reset(of_worlds, level, self.environments)
        params = network.init(of_network, observation)
        return Learner(params, optimiser.init(params), worlds, observation, kept)

    def update(self, learner: Learner, level):
        """(Learner, (ended, reached the goal)), flags [horizon, environment]."""
        key, of_rollout, of_epochs = jax.random.split(learner.key, 3)
        learner, transitions, goals = self.rollout(learner, level, of_rollout)
        gain = advantages(transitions, network.apply(learner.params, learner.observation)[1])
        samples = self.horizon * self.environments
        flat = jax.tree.map(lambda x: x.reshape(samples, *x.shape[2:]), (transitions, gain))

        def epoch(carry, key):
            order = jax.random.permutation(key, samples)
            cut = jax.tree.map(lambda x: x[order].reshape(PPO.minibatches, -1, *x.shape[1:]), flat)
            return jax.lax.scan(learn, carry, cut)

        carry = (learner.params, learner.optimiser)
        (params, state), _ = jax.lax.scan(epoch, carry, jax.random.split(of_epochs, PPO.epochs))
        return learner._replace(params=params, optimiser=state, key=key), (transitions.done, goals)

    def evaluate(self, learner: Learner, level, key, attempts: int, steps: int):
        """(actions [step, attempt, 6], ended, reached the goal); attempt 0 takes the most probable actions."""

        def act(carry, key):
            worlds, observation = carry
            of_action, of_world = jax.random.split(key)
            parts, _ = network.apply(learner.params, observation)
            action = draw(of_action, parts).at[0].set(jnp.stack([part[0].argmax() for part in parts]))
            seen, worlds, _, done, info = self.step(of_world, worlds, action, level, attempts)
            return (worlds, seen), (action, done, done & info["GoalR"])

        of_worlds, of_steps = jax.random.split(key)
        observation, worlds = self.reset(of_worlds, level, attempts)
        return jax.lax.scan(act, (worlds, observation), jax.random.split(of_steps, steps))[1]

    def rollout(self, learner: Learner, level, key):
        def act(carry, key):
            worlds, observation = carry
            of_action, of_world = jax.random.split(key)
            parts, value = network.apply(learner.params, observation)
            action = draw(of_action, parts)
            seen, worlds, reward, done, info = self.step(of_world, worlds, action, level, self.environments)
            transition = Transition(observation, action, log_probability(parts, action), value, reward, done)
            return (worlds, seen), (transition, (done & info["GoalR"]))

        keys = jax.random.split(key, self.horizon)
        (worlds, observation), (seen, goals) = jax.lax.scan(act, (learner.worlds, learner.observation), keys)
        return learner._replace(worlds=worlds, observation=observation), seen, goals

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


def advantages(seen: Transition, last_value):
    """Generalised advantages of a rollout, [horizon, environment]."""

    def back(carry, now):
        advantage, following = carry
        alive = 1.0 - now.done
        surprise = now.reward + PPO.discount * following * alive - now.value
        advantage = surprise + PPO.discount * PPO.gae_lambda * alive * advantage
        return (advantage, now.value), advantage

    return jax.lax.scan(back, (jnp.zeros_like(last_value), last_value), seen, reverse=True)[1]


def loss(params, batch):
    seen, gain = batch
    parts, value = network.apply(params, seen.observation)
    ratio = jnp.exp(log_probability(parts, seen.action) - seen.log_probability)
    target = seen.value + gain
    near = seen.value + jnp.clip(value - seen.value, -PPO.clip, PPO.clip)
    error = 0.5 * jnp.maximum(jnp.square(value - target), jnp.square(near - target)).mean()
    gain = (gain - gain.mean()) / (gain.std() + 1e-8)
    surrogate = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - PPO.clip, 1 + PPO.clip) * gain).mean()
    entropy = sum(-(jnp.exp(part) * part).sum(-1).mean() for part in parts)
    return PPO.value_weight * error - surrogate - PPO.entropy_weight * entropy


def learn(carry, batch):
    params, state = carry
    change, state = optimiser.update(jax.grad(loss)(params, batch), state, params)
    return (optax.apply_updates(params, change), state), None
