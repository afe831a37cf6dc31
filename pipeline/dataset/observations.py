"""Observations of stored states, computed on JAX's default device."""

from dataclasses import replace
from functools import partial
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp

from levelproof.levelgen.level import Level
from levelproof.levelgen.task.environment import OBSERVE, ObservationType
from levelproof.physics.types import State
from levelproof.pipeline.errors import UserError

COMPILING = Lock()  # or threads that need the same new program would each compile it


def parse_observation(name: str | None) -> ObservationType | None:
    """Parse the name of an observation type. Raise UserError if the environment has no such type."""
    try:
        return None if name is None else ObservationType(name)
    except ValueError:
        kinds = ", ".join(ObservationType)
        raise UserError(f"There is no observation {name!r}: choose one of {kinds}, or None.") from None


def observe(kind: ObservationType, level: Level, states: State) -> Any:
    """Observe levels [batch, ...] in states [batch, time, ...]; return jax arrays [batch, time, ...]."""
    with COMPILING:
        return _observe(kind, level, states)


@partial(jax.jit, static_argnames="kind")
def _observe(kind: ObservationType, level: Level, states: State) -> Any:
    level, states = jax.tree.map(lambda x: jnp.moveaxis(jnp.asarray(x), 0, -1), (level, states))
    shown = jax.vmap(lambda state: OBSERVE[kind](replace(level, state=state), state))(states)
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), shown)
