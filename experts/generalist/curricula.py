"""Which levels come next: each curriculum is an initial state, a draw, and perhaps a measurement of levels.

A curriculum sees levels as indices into a table. Random levels have no table but a sampler, and their indices are ids:
so a curriculum of random levels keeps only ids, however large levels are.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

from levelproof.experts.generalist.config import CurriculumConfig
from levelproof.levelgen.sampling.sampler import Sampler
from levelproof.levelgen.task.lanes import Table

State = Any  # what a curriculum knows, a pytree; () if nothing
# From levels, env steps and a key to the episodes that end in each level, and how many of them are solved
Attempt = Callable[[Int[Array, " level"], int, Key[Array, ""]], tuple[Array, Array]]


class Curriculum(NamedTuple):
    """Which levels come next. Functions are pure; every core calls all but `draw` with equal arguments."""

    begin: Callable[[], State]
    draw: Callable[[Table, State, Key[Array, ""], int], Int[Array, " lane"]]  # the next level of each lane
    measure: Callable[[Table, Attempt, Key[Array, ""]], State] | None = None  # replaces the state
    every: int = 0  # updates between calls of `measure`; 0: it is never called


class Learnable(NamedTuple):
    """Levels that the policy sometimes solves, best first."""

    level_index: Int[Array, " level"]
    usable: Int[Array, ""]  # number of them; the others are not drawn


def fresh(table: Table, key: Key[Array, ""], lanes: int) -> Int[Array, " lane"]:
    """Draw levels evenly: of a sampler those that are never measured on, of a table any."""
    if isinstance(table, Sampler):
        return table.draw_ids(key, (lanes,))
    assert table.start is not None
    return jax.random.randint(key, (lanes,), 0, table.start.timestep.shape[-1])


UNIFORM = Curriculum(lambda: (), lambda table, state, key, lanes: fresh(table, key, lanes))


def learnability(config: CurriculumConfig) -> Curriculum:
    """Return the curriculum of Rutherford et al. 2024 (arXiv:2408.15099), sampling for learnability.

    Every now and then the policy attempts fresh levels; those that it solves at a rate p with the largest p(1 - p) are
    drawn until the next measurement, beside fresh ones.
    """

    def draw(table: Table, state: Learnable, key: Key[Array, ""], lanes: int) -> Int[Array, " lane"]:
        of_fresh, of_share, of_choice = jax.random.split(key, 3)
        chosen = state.level_index[jax.random.randint(of_choice, (lanes,), 0, jnp.maximum(state.usable, 1))]
        takes = (jax.random.uniform(of_share, (lanes,)) < config.share) & (state.usable > 0)
        return jnp.where(takes, chosen, fresh(table, of_fresh, lanes))

    def measure(table: Table, attempt: Attempt, key: Key[Array, ""]) -> Learnable:
        of_levels, of_attempts = jax.random.split(key)
        candidates = fresh(table, of_levels, config.candidates)
        episodes, solved = attempt(candidates, config.measured_steps, of_attempts)
        rate = solved / jnp.maximum(episodes, 1)
        # As in the authors' code, n / (n + 1) holds back rates of few episodes n
        score, best = jax.lax.top_k(rate * (1 - rate) * episodes / (episodes + 1), config.keep)
        return Learnable(candidates[best], (score > 0).sum(dtype=jnp.int32))

    nothing = lambda: Learnable(jnp.zeros(config.keep, jnp.int32), jnp.int32(0))
    return Curriculum(nothing, draw, measure, config.every)


def curriculum_of(name: str, config: CurriculumConfig) -> Curriculum:
    """Return the curriculum with this name; any other name is that of levels that are drawn evenly."""
    return learnability(config) if name == "learnability" else UNIFORM
