"""The curriculum by learnability: Rutherford et al. 2024 (arXiv:2408.15099), sampling for learnability."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

from levelproof.experts.generalist.config import LearnabilityConfig
from levelproof.experts.generalist.curricula import Attempt, Curriculum, chance, fresh
from levelproof.levelgen.task.lanes import Table


class Learnable(NamedTuple):
    """Levels that the policy sometimes solves, best first."""

    level_index: Int[Array, " level"]
    usable: Int[Array, ""]  # number of them; the others are not drawn


def by_level(candidates: Int[Array, " candidate"], *counts: Int[Array, " candidate"]) -> tuple[Array, ...]:
    """Add up the counts of duplicate candidates, which small tables give: else several lucky copies would be kept.

    Returns:
        Distinct levels, padded to as many as there are candidates, and their counts, which are 0 where padded.
    """
    levels, place = jnp.unique(candidates, return_inverse=True, size=len(candidates))
    return levels, *(jnp.zeros_like(count).at[place].add(count) for count in counts)


@cache
def learnability(config: LearnabilityConfig) -> Curriculum:
    """Return the curriculum.

    Every `every` updates the policy attempts levels drawn uniformly, which are fresh ones if levels are random. Those
    with the largest p(1 - p), where p is their solve rate, are drawn until the next measurement, mixed with others
    drawn uniformly.
    """

    def draw(table: Table, state: Learnable, key: Key[Array, ""], lanes: int) -> Int[Array, " lane"]:
        of_fresh, of_share, of_choice = jax.random.split(key, 3)
        chosen = state.level_index[jax.random.randint(of_choice, (lanes,), 0, jnp.maximum(state.usable, 1))]
        takes = chance(config.share, of_share, lanes) & (state.usable > 0)
        return jnp.where(takes, chosen, fresh(table, of_fresh, lanes))

    def measure(table: Table, attempt: Attempt, key: Key[Array, ""]) -> Learnable:
        of_levels, of_attempts = jax.random.split(key)
        candidates = fresh(table, of_levels, config.candidates)
        episodes, solved = attempt(candidates, config.measured_steps, of_attempts)
        candidates, episodes, solved = by_level(candidates, episodes, solved)
        rate = solved / jnp.maximum(episodes, 1)
        # As in the authors' code, n / (n + 1) scales down scores from few episodes n
        score, best = jax.lax.top_k(rate * (1 - rate) * episodes / (episodes + 1), config.keep)
        return Learnable(candidates[best], (score > 0).sum(dtype=jnp.int32))

    nothing = lambda: Learnable(jnp.zeros(config.keep, jnp.int32), jnp.int32(0))
    facts = lambda state: {"curriculum/usable": int(state.usable)}
    return Curriculum(nothing, draw, every=config.every, measure=measure, facts=facts)
