"""Clipped Adam (experts, reinforcement over levels) and the running average of weights (policies over levels)."""

from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int

T = TypeVar("T")


class AdamSettings(Protocol):
    """The settings that `clipped_adam` reads."""

    @property
    def learning_rate(self) -> float: ...
    @property
    def max_gradient_norm(self) -> float: ...
    @property
    def adam_epsilon(self) -> float: ...


def clipped_adam(config: AdamSettings) -> optax.GradientTransformation:
    """Return Adam on gradients whose global norm is clipped."""
    clip = optax.clip_by_global_norm(config.max_gradient_norm)
    return optax.chain(clip, optax.adam(config.learning_rate, eps=config.adam_epsilon))


def running_average(average: T, params: T, updates: Int[Array, ""], most: float) -> T:
    """Return the exponential average of weights after another update.

    Args:
        average: the average so far.
        params: the weights after the update.
        updates: number of updates before it.
        most: largest share of the old average that is kept. The first updates keep less, so that the average soon
            forgets the initial weights.
    """
    kept = jnp.minimum(most, (1.0 + updates) / (10.0 + updates))
    return jax.tree.map(lambda old, new: old + (1 - kept) * (new - old), average, params)
