"""The objective of proximal policy optimisation and its advantages, for experts and for policies for all levels.

Schulman et al. 2017 (arXiv:1707.06347) with clipped values and normalised advantages: an expert's in each minibatch,
those of a policy for all levels over a whole update.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from levelproof.experts.policy import entropy, log_probability

ADVANTAGE_EPSILON = 1e-8


class Terms(NamedTuple):
    """Terms of the objective, means over a minibatch but for the last."""

    surrogate: Float[Array, ""]  # clipped; to be maximised
    value_error: Float[Array, ""]  # clipped, half of its square
    entropy: Float[Array, ""]  # of the live entries, nats
    log_probability: Float[Array, " sample"]  # of the actions taken


def advantages(
    value: Float[Array, "time ..."],
    reward: Float[Array, "time ..."],
    done: Array,
    last_value: Float[Array, "..."],
    discount: float,
    gae_lambda: float,
) -> Float[Array, "time ..."]:
    """Estimate generalised advantages (Schulman et al. 2016, arXiv:1506.02438).

    The value after an episode's end is 0, also at a time limit. There, a policy for all levels learns nothing from the
    last action, and the caller puts the value of the last state in place of that action's reward. Experts do not
    bootstrap.
    """

    def back(carry, now):
        advantage, next_value = carry
        value, reward, alive = now
        surprise = reward + discount * next_value * alive - value
        advantage = surprise + discount * gae_lambda * alive * advantage
        return (advantage, value), advantage

    start = (jnp.zeros_like(last_value), last_value)
    _, estimates = jax.lax.scan(back, start, (value, reward, 1.0 - done), reverse=True)
    return estimates


def normalised(advantage: Float[Array, "..."]) -> Float[Array, "..."]:
    """Shift and scale a minibatch's advantages to mean 0 and deviation 1."""
    return (advantage - advantage.mean()) / (advantage.std() + ADVANTAGE_EPSILON)


def normalised_over(axis_name: str, advantage: Float[Array, "..."], counts: Bool[Array, "..."]) -> Float[Array, "..."]:
    """Normalise over the samples that count, across a mapped axis; the others' advantage is 0."""
    total = lambda x: jax.lax.psum(jnp.where(counts, x, 0.0).sum(), axis_name)
    count = jnp.maximum(total(1.0), 1.0)
    centred = jnp.where(counts, advantage - total(advantage) / count, 0.0)
    return centred / (jnp.sqrt(total(jnp.square(centred)) / count) + ADVANTAGE_EPSILON)


def terms(
    logits: Float[Array, "logit sample"],
    value: Float[Array, " sample"],
    action: Int[Array, "6 sample"] | Float[Array, "6 sample"],
    live: Bool[Array, "6 sample"],
    log_before: Float[Array, " sample"],
    value_before: Float[Array, " sample"],
    advantage: Float[Array, " sample"],
    gain: Float[Array, " sample"],
    clip: float,
    weight: Float[Array, " sample"] | float = 1.0,
) -> Terms:
    """Compare a policy and its values with what was sampled from an earlier one.

    Args:
        logits: of the policy.
        value: of the policy's value function.
        action: taken by the earlier policy.
        live: entries of the action that have an effect; one column serves all samples.
        log_before: log-probability of the action's live entries under the earlier policy.
        value_before: of the earlier value function.
        advantage: of the action.
        gain: the advantage, normalised.
        clip: maximum change of the probability ratio, and of the value.
        weight: of each sample in all means.
    """
    log_now = log_probability(logits, action, live)  # type: ignore[arg-type]
    ratio = jnp.exp(log_now - log_before)
    mean = lambda x: (weight * x).mean()
    surrogate = mean(jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - clip, 1 + clip) * gain))

    target = value_before + advantage
    near = value_before + jnp.clip(value - value_before, -clip, clip)
    error = 0.5 * mean(jnp.maximum(jnp.square(value - target), jnp.square(near - target)))
    return Terms(surrogate, error, mean(entropy(logits, live)), log_now)
