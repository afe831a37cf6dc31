"""Proximal policy optimisation of one expert, on the experience of one rollout. Knows nothing of physics.

Schulman et al. 2017 (arXiv:1707.06347) with clipped values and per-minibatch normalised advantages.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from experts.config import ExpertConfig
from experts.policy import ActorCritic, Constant, Params, entropy, forward, initial, log_probability
from levelgen.task.actions import CHOICES

ADVANTAGE_EPSILON = 1e-8


class Expert(NamedTuple):
    """What learns."""

    params: Params
    optimiser: optax.OptState


class Seen(NamedTuple):
    """What is constant within a level."""

    constant: Constant  # of what the network sees
    live: Bool[Array, "6"]  # entries of an action that something obeys


class Batch(NamedTuple):
    """Samples as columns; targets and advantages from GAE."""

    moving: Float[Array, "dynamic sample"]
    action: Float[Array, "6 sample"]
    log_probability: Float[Array, " sample"]
    value: Float[Array, " sample"]
    advantage: Float[Array, " sample"]


def optimiser(config: ExpertConfig) -> optax.GradientTransformation:
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        optax.adam(config.learning_rate, eps=config.adam_epsilon),
    )


def init(key: Key[Array, ""], network: ActorCritic, constant: Constant, config: ExpertConfig) -> Expert:
    """An expert that has seen nothing."""
    params = initial(key, network, constant)
    return Expert(params, optimiser(config).init(params))


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


def loss(params: Params, network: ActorCritic, seen: Seen, batch: Batch, config: ExpertConfig) -> Float[Array, ""]:
    """Clipped policy surrogate, clipped value error, entropy bonus; means over the minibatch."""
    logits, value = forward(network, params, seen.constant, batch.moving)
    live = seen.live[:, None]
    ratio = jnp.exp(log_probability(logits, batch.action, live) - batch.log_probability)  # type: ignore[arg-type]
    gain = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std() + ADVANTAGE_EPSILON)
    clipped_ratio = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    surrogate = jnp.minimum(ratio * gain, clipped_ratio * gain).mean()

    target = batch.value + batch.advantage
    near = batch.value + jnp.clip(value - batch.value, -config.clip, config.clip)
    error = 0.5 * jnp.maximum(jnp.square(value - target), jnp.square(near - target)).mean()
    return config.value_weight * error - surrogate - config.entropy_weight * entropy(logits, live).mean()


def update(
    expert: Expert,
    key: Key[Array, ""],
    network: ActorCritic,
    seen: Seen,
    samples: Float[Array, "sample column"],
    config: ExpertConfig,
) -> Expert:
    """Several epochs of minibatches, shuffled anew each epoch. `samples` are rows as `as_samples` lays them."""
    transform = optimiser(config)

    def learn(expert, minibatch):
        gradient = jax.grad(loss)(expert.params, network, seen, from_samples(minibatch.T), config)
        change, state = transform.update(gradient, expert.optimiser, expert.params)
        params: Any = optax.apply_updates(expert.params, change)
        return Expert(params, state), None

    def epoch(expert, key):
        minibatches = samples[shuffled(key, config)].reshape(config.minibatches, -1, samples.shape[1])
        return jax.lax.scan(learn, expert, minibatches)

    return jax.lax.scan(epoch, expert, jax.random.split(key, config.epochs))[0]


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


def as_samples(batch: Batch) -> Float[Array, "sample column"]:
    """Everything a sample needs side by side in one row: shuffling is then one copy of rows.

    `batch` has [time, ..., environment] in place of samples, as a rollout gives them.
    """
    singles = [x[:, None] for x in (batch.log_probability, batch.value, batch.advantage)]
    columns = jnp.concatenate([batch.moving, batch.action.astype(jnp.float32), *singles], axis=1)
    return jnp.moveaxis(columns, 1, -1).reshape(-1, columns.shape[1])


def from_samples(columns: Float[Array, "column sample"]) -> Batch:
    dynamic = columns.shape[0] - len(CHOICES) - 3
    action = columns[dynamic : dynamic + len(CHOICES)]
    return Batch(columns[:dynamic], action, *columns[-3:])
