"""Proximal policy optimisation of one expert, on the trajectory of one rollout; independent of physics."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.experts.config import ExpertConfig
from levelproof.experts.objective import normalised, terms
from levelproof.experts.optimise import clipped_adam
from levelproof.experts.policy import ActorCritic, Constant, Params, forward, initial
from levelproof.levelgen.task.actions import CHOICES


class TrainState(NamedTuple):
    """Parameters of an expert, and the state of their optimiser."""

    params: Params
    optimiser: optax.OptState


class LevelConstants(NamedTuple):
    """Constants of a level."""

    features: Constant  # constant features of the observation
    live: Bool[Array, "6"]  # entries of an action that have an effect


class Samples(NamedTuple):
    """Samples of an update or of one of its minibatches; advantages are from GAE."""

    moving: Float[Array, "dynamic sample"]
    action: Float[Array, "6 sample"]
    log_probability: Float[Array, " sample"]
    value: Float[Array, " sample"]
    advantage: Float[Array, " sample"]
    rehearsed: Float[Array, " sample"]  # 1 where a success was rehearsed, else 0


def init(key: Key[Array, ""], network: ActorCritic, constant: Constant, config: ExpertConfig) -> TrainState:
    """Initialise an expert."""
    params = initial(key, network, constant)
    return TrainState(params, clipped_adam(config).init(params))


def loss(
    params: Params, network: ActorCritic, constants: LevelConstants, minibatch: Samples, config: ExpertConfig
) -> Float[Array, ""]:
    """Sum the weighted minibatch means of clipped surrogate, clipped value error, imitation and entropy bonus."""
    logits, value = forward(network, params, constants.features, minibatch.moving)
    now = terms(
        logits,
        value,
        minibatch.action,
        constants.live[:, None],
        minibatch.log_probability,
        minibatch.value,
        minibatch.advantage,
        normalised(minibatch.advantage),
        config.clip,
    )
    likely = config.imitation_weight * (minibatch.rehearsed * now.log_probability).mean()
    return config.value_weight * now.value_error - now.surrogate - likely - config.entropy_weight * now.entropy


def update(
    train_state: TrainState,
    key: Key[Array, ""],
    network: ActorCritic,
    constants: LevelConstants,
    rows: Float[Array, "sample column"],
    config: ExpertConfig,
) -> TrainState:
    """Train for some epochs of minibatches, reshuffled each epoch. `rows` are samples as `as_rows` lays them out."""
    transform = clipped_adam(config)

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
    """Shuffle an update's samples so that every run of `environments` samples has one of each environment.

    Env steps are permuted once, then shifted by a random offset in each environment; environments are permuted too.
    So `horizon + environments` numbers are sorted; sorting all samples would take a seventh of the update's time.
    """
    by_time, by_environment, by_shift = jax.random.split(key, 3)
    times = jnp.argsort(jax.random.bits(by_time, (config.horizon,)))
    environments = jnp.argsort(jax.random.bits(by_environment, (config.environments,)))
    shift = jax.random.randint(by_shift, (config.environments,), 0, config.horizon)
    time = times[(jnp.arange(config.horizon)[:, None] + shift) % config.horizon]
    return (time * config.environments + environments).reshape(-1)


def as_rows(samples: Samples) -> Float[Array, "sample column"]:
    """Pack each sample into one row, so that shuffling copies rows.

    `samples` are as a rollout gives them: [time, ..., environment] instead of a sample axis.
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
