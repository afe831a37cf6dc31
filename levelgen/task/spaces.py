"""Spaces of actions and observations, with the attributes and methods of gymnax's spaces."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Key


class Box:
    """Arrays with values between two bounds; integers include both bounds, bools are False and True."""

    def __init__(self, low: Any, high: Any, shape: tuple[int, ...], dtype: Any = jnp.float32) -> None:
        self.low, self.high, self.shape, self.dtype = low, high, shape, dtype

    def sample(self, key: Key[Array, ""]) -> Array:
        """Draw an element: uniform between the bounds; without bounds, normal or exponential as in Gymnasium."""
        if jnp.issubdtype(self.dtype, jnp.floating):
            return self._sample_floats(key)
        return jax.random.randint(key, self.shape, self.low, self.high + 1).astype(self.dtype)

    def _sample_floats(self, key: Key[Array, ""]) -> Array:
        low, high = (np.broadcast_to(np.asarray(x, self.dtype), self.shape) for x in (self.low, self.high))
        below, above = np.isfinite(low), np.isfinite(high)
        bounded = below & above
        if bounded.all():
            return jax.random.uniform(key, self.shape, self.dtype, low, high)
        between = jax.random.uniform(key, self.shape, self.dtype, np.where(bounded, low, 0), np.where(bounded, high, 1))
        beyond = jax.random.exponential(key, self.shape, self.dtype)
        one_sided = jnp.where(below, low + beyond, high - beyond)
        free = jax.random.normal(key, self.shape, self.dtype)
        return jnp.where(bounded, between, jnp.where(below | above, one_sided, free))

    def contains(self, x: Any) -> Bool[Array, ""]:
        x = jnp.asarray(x)
        return ((x >= self.low) & (x <= self.high)).all()


class Discrete(Box):
    """Integers 0 .. n - 1."""

    def __init__(self, n: int) -> None:
        super().__init__(0, n - 1, (), jnp.int32)
        self.n = n


class MultiDiscrete(Box):
    """Tuples of integers, each below its own bound; `n`, the sum of the bounds, is the number of logits of a policy."""

    def __init__(self, bounds: tuple[int, ...]) -> None:
        self.number_of_dims_per_distribution = np.array(bounds, np.int32)
        super().__init__(0, self.number_of_dims_per_distribution - 1, (len(bounds),), jnp.int32)
        self.n = sum(bounds)


class Dict:
    """Spaces by name."""

    def __init__(self, spaces: Mapping[str, Box]) -> None:
        self.spaces = dict(spaces)
        self.num_spaces = len(self.spaces)

    def sample(self, key: Key[Array, ""]) -> dict[str, Any]:
        keys = jax.random.split(key, len(self.spaces))
        return {name: space.sample(one) for one, (name, space) in zip(keys, self.spaces.items(), strict=True)}

    def contains(self, x: Any) -> Bool[Array, ""]:
        """Whether a mapping, or an object with these attributes, lies in the space."""
        get = x.__getitem__ if isinstance(x, Mapping) else partial(getattr, x)
        return jnp.stack([space.contains(get(name)) for name, space in self.spaces.items()]).all()


Space = Box | Dict
