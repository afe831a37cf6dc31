"""Observations of stored states, made where JAX computes: on the accelerator where there is one."""

from dataclasses import replace
from functools import partial
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp

from levelproof.levelgen.level import Level
from levelproof.levelgen.task.environment import LOOKS, ObservationType
from levelproof.physics.types import State
from levelproof.pipeline.errors import UserError

COMPILING = Lock()  # threads that meet a program for the first time would compile it side by side


def kind_of(name: str | None) -> ObservationType | None:
    """Raises UserError where the environment has no such kind of observation."""
    try:
        return None if name is None else ObservationType(name)
    except ValueError:
        kinds = ", ".join(ObservationType)
        raise UserError(f"There is no observation {name!r}: choose one of {kinds}, or None.") from None


def observed(kind: ObservationType, level: Level, states: State) -> Any:
    """What the environment shows, [batch, time, ...], of levels [batch, ...] in states [batch, time, ...]."""
    with COMPILING:
        return _observed(kind, level, states)


@partial(jax.jit, static_argnames="kind")
def _observed(kind: ObservationType, level: Level, states: State) -> Any:
    level, states = jax.tree.map(lambda x: jnp.moveaxis(jnp.asarray(x), 0, -1), (level, states))
    seen = jax.vmap(lambda state: LOOKS[kind](replace(level, state=state), state))(states)
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), seen)
