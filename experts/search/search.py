"""From levels to what was found: some are searched side by side, and when one leaves the next comes in."""

from collections import deque
from collections.abc import Collection
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from experts.ledger import Lap, Ledger, lap
from experts.search.config import SearchConfig
from experts.search.explore import Search, begin, explore, successes, under_way
from experts.search.shorten import shorten
from experts.success import Success
from experts.witness import at_once, blocks, take
from levelgen.level import Level
from levelgen.task.rules import TaskParams

IN_CACHE = 256  # lanes: their physics and archives fit the cache of a core
AHEAD = 8  # levels that wait for a row, of each row: about a second's, so that none is empty until more have come
ONE = np.zeros(1, np.int32)


class Searched(NamedTuple):
    """What came of some levels, level first."""

    success: Success  # length 0: none was found
    env_steps: Int[Array, " level"]  # of all lanes, those that shorten a success included
    cells: Int[Array, " level"]  # that were reached; each as wide as cells were then
    grew: Int[Array, " level"]  # env steps when the last cell was reached


class Sought:
    """Levels that came together, and what is known of each so far."""

    def __init__(self, levels: Level, level_ids: Int[np.ndarray, " level"], nothing: Searched) -> None:
        self.levels, self.level_ids, self.known = levels, level_ids, nothing
        self.left = len(level_ids)  # levels that are searched, or wait for it
        self.ledger = Ledger(len(level_ids))

    @property
    def env_steps(self) -> int:
        """So far."""
        return int(self.known.env_steps.sum())


class Searching:
    """Rows in which levels are searched, and the queue before them: when one leaves the next comes in, of whichever
    unit. What is found for one depends on nothing but it and its id. All levels have one size.

    An exception leaves it useless: its arrays were used up.
    """

    def __init__(self, config: SearchConfig, rules: TaskParams) -> None:
        self._config, self._rules = config, rules
        self._waiting: deque[tuple[Sought, int]] = deque()
        self._at: list[tuple[Sought, int] | None] = [None] * side_by_side(config)  # of each row
        self._search: Search | None = None  # there once the first level has come

    def submit(self, levels: Level, level_ids: Int[np.ndarray, " level"]) -> Sought:
        """Let levels wait for rows.

        Args:
            levels: on the host.
            level_ids: their ids, the seeds of all randomness.
        """
        level_ids, rules = np.asarray(level_ids, np.int32), self._rules
        config = self._scaled = self._config.scaled(levels.model.size.bodies)
        of_one = jax.eval_shape(partial(begin, config=config, rules=rules), take(levels, ONE), jnp.array(ONE))
        empty = lambda x: np.zeros((len(level_ids), *x.shape[1:]), x.dtype)
        nothing = jax.tree.map(empty, jax.eval_shape(partial(searched, config=config), of_one)[1])
        sought = Sought(levels, level_ids, nothing)
        self._waiting.extend((sought, i) for i in range(len(level_ids)))
        return sought

    def waiting(self, sought: Sought) -> list[int]:
        """Indices of its levels that have had no row, ascending."""
        return [i for of, i in self._waiting if of is sought]

    def withdraw(self, sought: Sought, indices: Collection[int]) -> None:
        """Take levels out that have had no row."""
        staying = [(of, i) for of, i in self._waiting if of is not sought or i not in indices]
        sought.left -= len(self._waiting) - len(staying)
        self._waiting = deque(staying)

    @property
    def wants(self) -> int:
        """Levels by which so many would wait that no row is empty for a while."""
        return max(0, AHEAD * len(self._at) - len(self._waiting)) if self._config.env_steps else 0

    def step(self) -> bool:
        """Search on for `config.rounds` rounds; whether there was anything to search."""
        if not self._waiting and not any(self._at):
            return False
        with lap() as took:
            self._enter()
            assert self._search is not None
            self._search = explore(self._search, self._scaled, self._rules)
            left, seen = jax.device_get(searched(self._search, self._scaled))
        busy = [(row, *at) for row, at in enumerate(self._at) if at]
        of_row = took.seconds / len(self._at)
        # Empty rows are those of one that is there, so that their cost is counted once
        busy[-1][1].ledger.add("idle", Lap(of_row * (len(self._at) - len(busy)), took.compiling))
        for row, sought, i in busy:
            sought.ledger.put("search", i, of_row)
            for known, now in zip(jax.tree.leaves(sought.known), jax.tree.leaves(seen), strict=True):
                known[i] = now[row]
            if left[row]:
                sought.left -= 1
                self._at[row] = None
        return True

    def result(self, sought: Sought) -> Searched:
        """What was found, once none is left to search: successes that replay, made shorter."""
        assert not sought.left
        found, width = sought.known, len(self._at)
        indices = np.flatnonzero(found.success.length)
        for block in blocks(len(indices), width):
            some = indices[block]
            given = jax.tree.map(lambda x, some=some: x[some], found.success)
            levels, level_ids = take(sought.levels, some), sought.level_ids[some]
            shorter = jax.device_get(shorten(levels, level_ids, given, self._scaled, self._rules))
            found.success.action[some], found.success.length[some] = shorter.success
            found.env_steps[some] += shorter.env_steps  # once for a level that fills up its block
        return found

    def _enter(self) -> None:
        """Let levels that wait take the rows that others left."""
        empty = [row for row, at in enumerate(self._at) if not at][: len(self._waiting)]
        if not empty:
            return
        for row in empty:
            self._at[row] = self._waiting.popleft()
        all_rows = [at or self._at[empty[0]] for at in self._at]
        some = [(take(of.levels, np.array([i])), of.level_ids[i]) for of, i in filter(None, all_rows)]
        levels = jax.tree.map(lambda *xs: np.concatenate(xs, -1), *(level for level, _ in some))
        fresh = begin(levels, np.array([level_id for _, level_id in some]), self._scaled, self._rules)
        comes = np.isin(np.arange(len(all_rows)), empty)
        self._search = fresh if self._search is None else entered(self._search, fresh, comes)


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
