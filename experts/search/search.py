"""From levels to what was found: Go-Explore first, then variations of what came nearest. Levels are searched side by
side, and when one leaves the next comes in.
"""

from collections import deque
from collections.abc import Collection
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from levelproof.experts.search import explore, vary
from levelproof.experts.search.config import SearchConfig, StopLimits
from levelproof.experts.search.explore import Search, success_of
from levelproof.experts.search.shorten import shorten
from levelproof.experts.search.stage import Entrant, SearchJob, SearchResult, Stage
from levelproof.experts.search.vary import Varying, nearest_of
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import at_once, blocks, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams

IN_CACHE = 256  # lanes: their physics and archives fit the cache of a core
AHEAD = 8  # levels that wait for a row, of each row: about a second's, so that none is empty until more have come
ONE = np.zeros(1, np.int32)


class Searching:
    """Rows in which levels are searched, and the queue before them: when one leaves the next comes in, of whichever
    unit. What is found for one depends on nothing but it and its id. All levels have one size.

    An exception leaves it useless: its arrays were used up.
    """

    def __init__(self, config: SearchConfig, rules: TaskParams) -> None:
        self.config, self._rules = config, rules
        self._exploring, self._varying = Stage(side_by_side(config)), Stage(side_by_side(config))

    def submit(self, levels: Level, level_ids: Int[np.ndarray, " level"]) -> SearchJob:
        """Let levels wait for rows.

        Args:
            levels: on the host.
            level_ids: their ids, the seeds of all randomness.
        """
        level_ids, rules = np.asarray(level_ids, np.int32), self._rules
        config = self._scaled = self.config.scaled(levels.model.size.bodies)
        begin = partial(explore.begin, config=config.endless, rules=rules)
        of_one = jax.eval_shape(begin, take(levels, ONE), jnp.array(ONE))
        empty = lambda x: np.zeros((len(level_ids), *x.shape[1:]), x.dtype)
        nothing = jax.tree.map(empty, jax.eval_shape(explored, of_one, config.ends)[1])
        sought = SearchJob(levels, level_ids, nothing)
        self._exploring.waiting.extend(Entrant(sought, i) for i in range(len(level_ids)))
        return sought

    def waiting(self, sought: SearchJob) -> list[int]:
        """Indices of its levels that have had no row, ascending."""
        return [of.index for of in self._exploring.waiting if of.sought is sought]

    def withdraw(self, sought: SearchJob, indices: Collection[int]) -> None:
        """Take levels out that have had no row."""
        queue = self._exploring.waiting
        staying = [of for of in queue if of.sought is not sought or of.index not in indices]
        sought.left -= len(queue) - len(staying)
        self._exploring.waiting = deque(staying)

    @property
    def wants(self) -> int:
        """Levels by which so many would wait that no row is empty for a while."""
        stage = self._exploring
        return max(0, AHEAD * len(stage.at) - len(stage.waiting)) if self.config.env_steps else 0

    def step(self) -> bool:
        """Search on for `config.rounds` rounds; whether there was anything to search.

        Varied is what fills all rows of its program, or what is left at the end.
        """
        if self._varying.present >= len(self._varying.at) or (self._varying.present and not self._exploring.present):
            self._vary()
        elif self._exploring.present:
            self._explore()
        else:
            return False
        return True

    def result(self, sought: SearchJob) -> SearchResult:
        """What was found, once none is left to search: successes that replay, made shorter."""
        assert not sought.left
        found, width = sought.known, side_by_side(self.config)
        indices = np.flatnonzero(found.success.length)
        for block in blocks(len(indices), width):
            some = indices[block]
            given = jax.tree.map(lambda x, some=some: x[some], found.success)
            levels, level_ids = take(sought.levels, some), sought.level_ids[some]
            shorter = jax.device_get(shorten(levels, level_ids, given, self._scaled.endless, self._rules))
            found.success.action[some], found.success.length[some] = shorter.success
            found.env_steps[some] += shorter.env_steps  # once for a level that fills up its block
        return found

    def _explore(self) -> None:
        """Go-Explore; what it leaves without a success has its nearest trajectories varied."""
        stage, config, rules = self._exploring, self._scaled, self._rules
        begin = lambda levels, level_ids, _: explore.begin(levels, level_ids, config.endless, rules)
        advance = lambda rows: explore.explore(rows, config, rules)
        nearest = None
        for row, of, seen in stage.step(begin, advance, partial(explored, ends=config.ends)):
            put(of, seen)
            if stage.at[row]:
                continue
            if seen.success.length or not config.variations:
                of.sought.left -= 1
                continue
            nearest = nearest or jax.device_get(nearest_of(stage.rows.archive))
            known = jax.tree.map(lambda x, row=row: x[row].copy(), nearest)
            self._varying.waiting.append(Entrant(of.sought, of.index, known))

    def _vary(self) -> None:
        """Variations of what came nearest."""
        stage, config, rules = self._varying, self._scaled, self._rules
        begin = partial(vary.begin, config=config.endless, rules=rules)
        advance = lambda rows: vary.vary(rows, config, rules)
        for row, of, (success, env_steps) in stage.step(begin, advance, partial(varied, ends=config.ends)):
            before = jax.tree.map(lambda x, of=of: x[of.index], of.sought.known)
            put(of, before._replace(success=success, varied=env_steps))
            of.sought.left -= not stage.at[row]


def put(of: Entrant, seen: SearchResult) -> None:
    """Into what is known of a level."""
    for known, now in zip(jax.tree.leaves(of.sought.known), jax.tree.leaves(seen), strict=True):
        known[of.index] = now


def side_by_side(config: SearchConfig) -> int:
    """How many levels are searched in one program."""
    return at_once(config.lanes, IN_CACHE)


@jax.jit
def explored(search: Search, ends: StopLimits) -> tuple[Bool[Array, " level"], SearchResult]:
    """Levels that are done, and what came of all of them so far."""
    found, none = success_of(search.code, search.length), jnp.zeros_like(search.env_steps)
    seen = SearchResult(found, search.env_steps, none, search.archive.cells, search.grew)
    return ~explore.under_way(search, ends), seen


@jax.jit
def varied(varying: Varying, ends: StopLimits) -> tuple[Bool[Array, " level"], tuple[Success, Int[Array, " level"]]]:
    """Levels that are done, what was found in all of them, and in how many env steps."""
    return ~vary.under_way(varying, ends), (success_of(varying.code, varying.length), varying.env_steps)
