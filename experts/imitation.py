"""Behaviour cloning of one policy over many levels: its loss, its optimiser and its update; reads no files."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.typing import VariableDict
from jaxtyping import Array, Float, Int

from levelproof.experts.networks.chunks import lanes_at_once, mean_gradient
from levelproof.experts.networks.over_levels import NetworkConfig, initial_policy, policy_logits
from levelproof.experts.optimise import running_average
from levelproof.experts.policy import log_probability, most_probable
from levelproof.levelgen.batching import split_lanes
from levelproof.levelgen.identity.keys import key_of_seed
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.actions import action_mask
from levelproof.physics.bounds import require
from levelproof.physics.buffers import zeros_of
from levelproof.physics.types import Size, State

MOTION = 6  # numbers of a body: position, velocity, rotation, angular velocity


@dataclass(frozen=True)
class ImitationConfig:
    """Hyperparameters of cloning (hashable: pass as a static argument)."""

    updates: int = 20_000  # updates of the weights
    batch: int = 1024  # transitions of an update
    learning_rate: float = 1e-3  # largest step size of AdamW; falls to 0 along a cosine
    warmup: int = 500  # updates over which the step size grows from 0; at most half of all
    weight_decay: float = 1e-4  # AdamW's weight decay
    max_gradient_norm: float = 1.0  # maximum global norm of the gradient
    average: float = 0.999  # maximum decay of the averaged weights, the policy; at update n at most n/(n+9)

    def __post_init__(self) -> None:
        require(self, ("updates", "batch"), 1)
        require(self, ("learning_rate", "max_gradient_norm"), 0, above=True)
        require(self, ("warmup", "weight_decay"), 0)
        require(self, ("average",), 0, 1)


class Transitions(NamedTuple):
    """Steps of witnesses: levels, what moves in them, and the actions taken."""

    level: Level  # lanes last; `state` is None
    motion: Float[Array | np.ndarray, "lane column"]  # MOTION numbers for each body, then any contacts: 1 where active
    action: Int[Array | np.ndarray, "lane 6"]


class Imitation(NamedTuple):
    """Training under way."""

    params: VariableDict
    optimiser: optax.OptState
    average: VariableDict
    updates: Int[Array, ""]


class Likeness(NamedTuple):
    """How a policy's actions compare with the data's, averaged over live entries, then over transitions."""

    loss: Float[Array, ""]  # nats, negative log-likelihood
    accuracy: Float[Array, ""]  # share of entries whose most probable choice was taken


def optimiser_of(config: ImitationConfig) -> optax.GradientTransformation:
    warmup = min(config.warmup, config.updates // 2)
    schedule = optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, warmup, config.updates)
    clip = optax.clip_by_global_norm(config.max_gradient_norm)
    return optax.chain(clip, optax.adamw(schedule, weight_decay=config.weight_decay))


@partial(jax.jit, static_argnames=("network", "size", "config"))
def begin_imitation(
    seed: Int[Array, ""],
    network: NetworkConfig,
    size: Size,
    config: ImitationConfig,
    start: VariableDict | None = None,
) -> Imitation:
    """Begin to train a policy from the parameters `start`, or from scratch.

    `size` is the levels' size, which matters only if the network fits a single size.
    """
    params = initial_policy(key_of_seed(seed), network, size) if start is None else start
    # Copies, because updates donate both, and no buffer can be donated twice
    params, average = jax.tree.map(jnp.copy, (params, params))
    return Imitation(params, optimiser_of(config).init(params), average, jnp.int32(0))


@partial(jax.jit, static_argnames=("network", "config"), donate_argnums=0)
def imitate(
    now: Imitation, transitions: Transitions, network: NetworkConfig, config: ImitationConfig
) -> tuple[Imitation, Likeness]:
    """Take one update; return the likeness before it."""
    gradient, likeness = mean_gradient(partial(_loss, network=network), now.params, _chunks(transitions))
    change, state = optimiser_of(config).update(gradient, now.optimiser, now.params)
    params: Any = optax.apply_updates(now.params, change)
    average = running_average(now.average, params, now.updates, config.average)
    return Imitation(params, state, average, now.updates + 1), likeness


def _chunks(transitions: Transitions) -> Transitions:
    """Return transitions as chunks that go through the network one after another, chunk axis first."""
    lanes = lanes_at_once(transitions.level.size, len(transitions.motion))
    rows = (x.reshape(-1, lanes, x.shape[-1]) for x in (transitions.motion, transitions.action))
    return Transitions(split_lanes(transitions.level, lanes), *rows)


@partial(jax.jit, static_argnames="network")
def compare(params: VariableDict, transitions: Transitions, network: NetworkConfig) -> Likeness:
    """Compare a policy with data."""
    return _loss(params, transitions, network)[1]


def _loss(params: VariableDict, transitions: Transitions, network: NetworkConfig) -> tuple[Float[Array, ""], Likeness]:
    lanes, size, action = len(transitions.motion), transitions.level.size, jnp.asarray(transitions.action).T
    state = from_motion(transitions.motion, size)
    logits = policy_logits(params, network, replace(transitions.level, state=state), state)
    live = jnp.broadcast_to(action_mask(transitions.level), (len(action), lanes))
    count = jnp.maximum(live.sum(0), 1)
    loss = -(log_probability(logits, action, live) / count).mean()
    right = ((most_probable(logits) == action) & live).sum(0) / count
    return loss, Likeness(loss, right.mean())


def to_motion(state: State, contacts: bool) -> Float[Array, "lane column"]:
    """Return the motion of states, as `Transitions` have it; `contacts`: with the columns of contacts."""
    columns = state.position, state.velocity, state.rotation[:, None], state.angular_velocity[:, None]
    moving = jnp.concatenate(columns, 1)
    motion = moving.reshape(-1, moving.shape[-1]).T
    return jnp.concatenate([motion, state.contact_active.T.astype(motion.dtype)], 1) if contacts else motion


def from_motion(motion: Float[Array | np.ndarray, "lane column"], size: Size) -> State:
    """Return states without impulses, which no network reads; with contacts only if the motion has their columns."""
    motion, moving = jnp.asarray(motion), MOTION * size.bodies
    by_body = motion[:, :moving].reshape(len(motion), size.bodies, MOTION).transpose(1, 2, 0)
    state = replace(
        zeros_of(State, size, len(motion)),
        position=by_body[:, 0:2],
        velocity=by_body[:, 2:4],
        rotation=by_body[:, 4],
        angular_velocity=by_body[:, 5],
    )
    if motion.shape[1] == moving:
        return state
    return replace(state, contact_active=motion[:, moving:].T > 0)
