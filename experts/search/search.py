"""From levels to what was found: some are searched side by side, and when one leaves the next comes in."""

from collections import deque
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from experts.search.config import SearchConfig
from experts.search.explore import Search, begin, explore, successes, under_way
from experts.search.shorten import shorten
from experts.success import Success
from experts.witness import at_once, blocks, take
from levelgen.level import Level
from levelgen.task.rules import TaskParams

IN_CACHE = 256  # lanes: their physics and archives fit the cache of a core
ONE = np.zeros(1, np.int32)


class Searched(NamedTuple):
    """What came of some levels, level first."""

    success: Success  # length 0: none was found
    env_steps: Int[Array, " level"]  # of all lanes, those that shorten a success included
    cells: Int[Array, " level"]  # that were reached; each as wide as cells were then
    grew: Int[Array, " level"]  # env steps when the last cell was reached


class Searching:
    """Levels that are searched, a few at a time. What is found for one depends on nothing but it and its id.

    An exception leaves it useless: its arrays were used up.
    """

    def __init__(
        self, levels: Level, level_ids: Int[np.ndarray, " level"], config: SearchConfig, rules: TaskParams
    ) -> None:
        """
        Args:
            levels: on the host.
            level_ids: their ids, the seeds of all randomness.
            config: how they are searched.
            rules: of the task.
        """
        count = len(level_ids)
        config = config.scaled(levels.model.size.bodies)
        self.levels, self.level_ids, self.config, self.rules = levels, np.asarray(level_ids, np.int32), config, rules
        self._waiting = deque(range(count))
        self._index = np.full(side_by_side(config), -1)  # of the level under search; -1: none
        self._search: Search | None = None
        self.env_steps = 0  # of all levels, so far
        of_one = jax.eval_shape(partial(begin, config=config, rules=rules), take(levels, ONE), jnp.array(ONE))
        empty = lambda x: np.zeros((count, *x.shape[1:]), x.dtype)
        self._result = jax.tree.map(empty, jax.eval_shape(partial(searched, config=config), of_one)[1])

    def step(self) -> bool:
        """Search on for `config.rounds` rounds; whether there is anything left to search."""
        self._enter()
        if self._search is None or not (self._index >= 0).any():
            return False
        self._search = explore(self._search, self.config, self.rules)
        self._leave(*jax.device_get(searched(self._search, self.config)))
        return bool(self._waiting) or bool((self._index >= 0).any())

    def result(self) -> Searched:
        """What was found, once nothing is left to search: successes that replay, made shorter."""
        found, width = self._result, len(self._index)
        indices = np.flatnonzero(found.success.length)
        for block in blocks(len(indices), width):
            some = indices[block]
            given = jax.tree.map(lambda x, some=some: x[some], found.success)
            levels, level_ids = take(self.levels, some), self.level_ids[some]
            shorter = jax.device_get(shorten(levels, level_ids, given, self.config, self.rules))
            found.success.action[some], found.success.length[some] = shorter.success
            found.env_steps[some] += shorter.env_steps  # once for a level that fills up its block
        return found

    def _enter(self) -> None:
        """Let levels that wait take the rows that others left."""
        empty = np.flatnonzero(self._index < 0)[: len(self._waiting)]
        if not len(empty):
            return
        self._index[empty] = [self._waiting.popleft() for _ in empty]
        index = np.where(self._index < 0, self._index.max(), self._index)
        fresh = begin(take(self.levels, index), self.level_ids[index], self.config, self.rules)
        comes = np.isin(np.arange(len(index)), empty)
        self._search = fresh if self._search is None else entered(self._search, fresh, comes)

    def _leave(self, left: Bool[np.ndarray, " level"], seen: Searched) -> None:
        """Write down what became of levels that are done."""
        rows = np.flatnonzero(left & (self._index >= 0))
        for whole, part in zip(jax.tree.leaves(self._result), jax.tree.leaves(seen), strict=True):
            whole[self._index[rows]] = part[rows]
        self._index[rows] = -1
        going = self._index >= 0
        self.env_steps = int(self._result.env_steps.sum()) + int(np.asarray(seen.env_steps)[going].sum())


def side_by_side(config: SearchConfig) -> int:
    """How many levels are searched in one program."""
    return at_once(config.lanes, IN_CACHE)


@partial(jax.jit, static_argnames="config")
def searched(search: Search, config: SearchConfig) -> tuple[Bool[Array, " level"], Searched]:
    """Levels that are done: they have a success, or have had their env steps; and what came of all of them so far."""
    seen = Searched(successes(search), search.env_steps, search.archive.cells, search.grew)
    return ~under_way(search, config), seen


@partial(jax.jit, donate_argnames="search")
def entered(search: Search, fresh: Search, comes: Bool[Array, " level"]) -> Search:
    """The levels under search, some of their rows taken by fresh ones."""
    first = lambda old, new: jnp.where(comes.reshape(-1, *[1] * (new.ndim - 1)), new, old)
    last = lambda old, new: jnp.where(comes, new, old)
    levels = jax.tree.map(last, search.levels, fresh.levels)
    return replace(jax.tree.map(first, replace(search, levels=None), replace(fresh, levels=None)), levels=levels)
