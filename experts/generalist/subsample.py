"""Which samples of a rollout an update learns from.

Most samples teach little: in a level that the policy always solves, or never does, the advantage is near 0. The
gradient takes most of the time of an update, so learning from a part of the samples, those of large advantages more
often, covers more levels in equal time. Weights undo the preference: a weighted mean over the chosen samples has the
expectation of the mean over all (importance sampling, as Katharopoulos and Fleuret 2018, arXiv:1803.00942, choose
samples by a bound of their gradient's norm).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

EVEN = 0.5  # added to every sample's absolute gain, in multiples of their mean; bounds the weights
LEAST = 1e-6  # added to every chance: if all gains are 0, samples are chosen evenly


def choose(
    gain: Float[Array, "time lane"], counts: Bool[Array, "time lane"], samples: int, key: Key[Array, ""]
) -> tuple[Int[Array, "time sample"], Float[Array, "time sample"]]:
    """Choose `samples` lanes per time step, with probabilities that grow with |gain|.

    The choice is systematic: a lane that is expected k times is chosen k times, rounded up or down.

    Args:
        gain: advantages, normalised.
        counts: whether a sample may be learned from; others are never chosen.
        samples: lanes to choose at every time.
        key: consumed.

    Returns:
        The chosen lanes, ascending, and the weight of each: the mean of weight times x over the chosen ones estimates
        the sum of x over those that count, divided by the number of lanes. Where none counts, all weights are 0.
    """
    size = jnp.where(counts, jnp.abs(gain), 0.0)
    chance = jnp.where(counts, size + EVEN * size.mean() + LEAST, 0.0)
    edges = jnp.cumsum(chance, 1)
    total = edges[:, -1:]
    at = (jnp.arange(samples) + jax.random.uniform(key, (len(gain), 1))) / samples * total
    at = jnp.minimum(at, jnp.nextafter(total, jnp.zeros_like(total)))  # rounding up to the total would pass every lane
    lane = jnp.minimum(jax.vmap(lambda edge, x: jnp.searchsorted(edge, x, side="right"))(edges, at), gain.shape[1] - 1)
    own = jnp.take_along_axis(chance, lane, 1)
    return lane, jnp.where(own > 0, total / (gain.shape[1] * jnp.where(own > 0, own, 1.0)), 0.0)
