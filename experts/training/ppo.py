"""Proximal policy optimisation of one expert, on the trajectory of one rollout. Knows nothing of physics.

Schulman et al. 2017 (arXiv:1707.06347) with clipped values and per-minibatch normalised advantages.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.experts.config import ExpertConfig
from levelproof.experts.policy import ActorCritic, Constant, Params, entropy, forward, initial, log_probability
from levelproof.levelgen.task.actions import CHOICES

ADVANTAGE_EPSILON = 1e-8


class TrainState(NamedTuple):
    """What learns."""

    params: Params
    optimiser: optax.OptState


class LevelConstants(NamedTuple):
    """What is constant within a level."""

    features: Constant  # of what the network sees
    live: Bool[Array, "6"]  # entries of an action that something obeys


class Samples(NamedTuple):
    """What an update learns from; targets and advantages from GAE. A minibatch is some of them."""

    moving: Float[Array, "dynamic sample"]
    action: Float[Array, "6 sample"]
    log_probability: Float[Array, " sample"]
    value: Float[Array, " sample"]
    advantage: Float[Array, " sample"]
    rehearsed: Float[Array, " sample"]  # 1 where a success was repeated, else 0


def optimiser(config: ExpertConfig) -> optax.GradientTransformation:
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        optax.adam(config.learning_rate, eps=config.adam_epsilon),
    )


def init(key: Key[Array, ""], network: ActorCritic, constant: Constant, config: ExpertConfig) -> TrainState:
    """An expert that has seen nothing."""
    params = initial(key, network, constant)
    return TrainState(params, optimiser(config).init(params))


def advantages(
    value: Float[Array, "time ..."],
    reward: Float[Array, "time ..."],
    done: Array,
    last_value: Float[Array, "..."],
    config: ExpertConfig,
) -> Float[Array, "time ..."]:
    """Generalised advantage estimates (Schulman et al. 2016, arXiv:1506.02438)."""

    def back(carry, now):
        advantage, next_value = carry
        value, reward, alive = now
        surprise = reward + config.discount * next_value * alive - value
        advantage = surprise + config.discount * config.gae_lambda * alive * advantage
        return (advantage, value), advantage

    start = (jnp.zeros_like(last_value), last_value)
    _, estimates = jax.lax.scan(back, start, (value, reward, 1.0 - done), reverse=True)
    return estimates


def loss(
    params: Params, network: ActorCritic, constants: LevelConstants, minibatch: Samples, config: ExpertConfig
) -> Float[Array, ""]:
    """Clipped policy surrogate, clipped value error, imitation, entropy bonus; means over the minibatch."""
    logits, value = forward(network, params, constants.features, minibatch.moving)
    live = constants.live[:, None]
    log_prob = log_probability(logits, minibatch.action, live)  # type: ignore[arg-type]
    ratio = jnp.exp(log_prob - minibatch.log_probability)
    gain = (minibatch.advantage - minibatch.advantage.mean()) / (minibatch.advantage.std() + ADVANTAGE_EPSILON)
    clipped_ratio = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    surrogate = jnp.minimum(ratio * gain, clipped_ratio * gain).mean()

    target = minibatch.value + minibatch.advantage
    near = minibatch.value + jnp.clip(value - minibatch.value, -config.clip, config.clip)
    error = 0.5 * jnp.maximum(jnp.square(value - target), jnp.square(near - target)).mean()
    likely = config.imitation_weight * (minibatch.rehearsed * log_prob).mean()
    return config.value_weight * error - surrogate - likely - config.entropy_weight * entropy(logits, live).mean()


def update(
    train_state: TrainState,
    key: Key[Array, ""],
    network: ActorCritic,
    constants: LevelConstants,
    rows: Float[Array, "sample column"],
    config: ExpertConfig,
) -> TrainState:
    """Several epochs of minibatches, shuffled anew each epoch. `rows` are samples as `as_rows` lays them."""
    transform = optimiser(config)

    def learn(now, minibatch):
        gradient = jax.grad(loss)(now.params, network, constants, from_rows(minibatch), config)
        change, state = transform.update(gradient, now.optimiser, now.params)
        params: Any = optax.apply_updates(now.params, change)
        return TrainState(params, state), None

    def epoch(now, key):
        minibatches = rows[shuffled(key, config)].reshape(config.minibatches, -1, rows.shape[1])
        return jax.lax.scan(learn, now, minibatches)

    return jax.lax.scan(epoch, train_state, jax.random.split(key, config.epochs))[0]


def shuffled(key: Key[Array, ""], config: ExpertConfig) -> Int[Array, " sample"]:
    """A random order of an update's samples, in which every run of `environments` has one of each environment.

    The env steps are shuffled, by another shift in each environment, and so are the environments: that takes sorting
    `horizon + environments` numbers, where sorting all of them takes a seventh of the update.
    """
    by_time, by_environment, by_shift = jax.random.split(key, 3)
    times = jnp.argsort(jax.random.bits(by_time, (config.horizon,)))
    environments = jnp.argsort(jax.random.bits(by_environment, (config.environments,)))
    shift = jax.random.randint(by_shift, (config.environments,), 0, config.horizon)
    time = times[(jnp.arange(config.horizon)[:, None] + shift) % config.horizon]
    return (time * config.environments + environments).reshape(-1)


def as_rows(samples: Samples) -> Float[Array, "sample column"]:
    """Everything a sample needs side by side in one row: shuffling is then one copy of rows.

    `samples` has [time, ..., environment] instead of an axis of samples, as a rollout gives them.
    """
    singles = [x[:, None] for x in samples[2:]]
    columns = jnp.concatenate([samples.moving, samples.action.astype(jnp.float32), *singles], axis=1)
    return jnp.moveaxis(columns, 1, -1).reshape(-1, columns.shape[1])


def from_rows(rows: Float[Array, "sample column"]) -> Samples:
    columns = rows.T
    singles = len(Samples._fields) - 2  # all but the observation and the action
    dynamic = columns.shape[0] - len(CHOICES) - singles
    action = columns[dynamic : dynamic + len(CHOICES)]
    return Samples(columns[:dynamic], action, *columns[-singles:])
