"""Observations of stored states, computed on JAX's default device."""

from functools import partial
from threading import Lock
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from levelproof.levelgen.level import Level
from levelproof.levelgen.task.observe.kinds import ObservationType, changing_features, constant_features, join
from levelproof.levelgen.task.observe.kinds import observe as observe_lanes
from levelproof.physics.types import State
from levelproof.pipeline.errors import UserError

MIN_ROWS = 1024  # observed at once: fewer are padded, others to a power of two, so that few programs serve all counts
COMPILING = Lock()  # or threads that need the same new program would each compile it
T = TypeVar("T")


def parse_observation(name: str | None) -> ObservationType | None:
    """Parse the name of an observation type. Raise UserError if the environment has no such type."""
    try:
        return None if name is None else ObservationType(name)
    except ValueError:
        kinds = ", ".join(ObservationType)
        raise UserError(f"There is no observation {name!r}: choose one of {kinds}, or None.") from None


def observe(kind: ObservationType, level: Level, states: State) -> Any:
    """Observe levels [batch, ...] in states [batch, time, ...]; return numpy arrays [batch, time, ...]."""
    count = len(level.role)
    with COMPILING:
        shown = _observe(kind, *_padded((level, states), _rounded(count)))
    return jax.tree.map(lambda x: x[:count], jax.device_get(shown))


def observe_rows(kind: ObservationType, level: Level, row_level: Int[np.ndarray, " row"], states: State) -> Any:
    """Observe states [row, ...], each in its level of several [level, ...]; return numpy arrays [row, ...]."""
    count = len(row_level)
    padded = max(MIN_ROWS, 1 << (count - 1).bit_length())
    row_level, states = _padded((row_level, states), padded)
    with COMPILING:
        made = _observe_rows(kind, level, row_level, states)
    constant, changing = jax.device_get(made)
    changing = jax.tree.map(lambda x: x[:count], changing)
    return join(kind, jax.eval_shape(_lanes_last, level).size, constant, changing, row_level[:count])


@partial(jax.jit, static_argnames="kind")
def _observe(kind: ObservationType, level: Level, states: State) -> Any:
    level, states = _lanes_last((level, states))
    shown = jax.vmap(lambda state: observe_lanes(kind, level, state))(states)
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), shown)


@partial(jax.jit, static_argnames="kind")
def _observe_rows(kind: ObservationType, level: Level, row_level: Any, states: State) -> Any:
    level, states = _lanes_last((level, states))
    changing = changing_features(kind, jax.tree.map(lambda x: x[..., row_level], level), states)
    return constant_features(kind, level).T, jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), changing)


def _rounded(count: int) -> int:
    """Return a count at most an eighth larger, so that few programs serve all counts: eight for each doubling."""
    step = 1 << max(count.bit_length() - 4, 0)
    return -(-count // step) * step


def _padded(tree: T, count: int) -> T:
    """Repeat the rows of arrays until there are `count`."""
    return jax.tree.map(lambda x: x if len(x) == count else np.resize(x, (count, *x.shape[1:])), tree)


def _lanes_last(tree: T) -> T:
    return jax.tree.map(lambda x: jnp.moveaxis(jnp.asarray(x), 0, -1), tree)
