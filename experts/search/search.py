"""Search of levels side by side: Go-Explore first, then variations of the nearest trajectories. When a level leaves its
search slot, the next one enters.
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
AHEAD = 8  # levels that wait per search slot: about a second's work, so that no slot is empty until more arrive
ONE = np.zeros(1, np.int32)


class Searching:
    """Search slots, shared by the levels of all units, and the queue before them.

    A level's result depends on the level and its id alone. All levels have one size. After an exception the object is
    unusable, because its arrays were donated.
    """

    def __init__(self, config: SearchConfig, rules: TaskParams) -> None:
        self.config, self._rules = config, rules
        self._exploring, self._varying = Stage(side_by_side(config)), Stage(side_by_side(config))

    def submit(self, levels: Level, level_ids: Int[np.ndarray, " level"]) -> SearchJob:
        """Queue levels for search slots.

        Args:
            levels: the levels, on the host.
            level_ids: their ids, the seeds of all randomness.
        """
        level_ids, rules = np.asarray(level_ids, np.int32), self._rules
        config = self._scaled = self.config.scaled(levels.model.size.bodies)
        begin = partial(explore.begin, config=config.endless, rules=rules)
        state_shapes = jax.eval_shape(begin, take(levels, ONE), jnp.array(ONE))
        empty = lambda x: np.zeros((len(level_ids), *x.shape[1:]), x.dtype)
        nothing = jax.tree.map(empty, jax.eval_shape(explored, state_shapes, config.ends)[1])
        job = SearchJob(levels, level_ids, nothing)
        self._exploring.waiting.extend(Entrant(job, i) for i in range(len(level_ids)))
        return job

    def waiting(self, job: SearchJob) -> list[int]:
        """Return indices of the job's levels that have had no search slot, ascending."""
        return [entrant.index for entrant in self._exploring.waiting if entrant.job is job]

    def withdraw(self, job: SearchJob, indices: Collection[int]) -> None:
        """Remove levels that have had no search slot."""
        queue = self._exploring.waiting
        staying = [entrant for entrant in queue if entrant.job is not job or entrant.index not in indices]
        job.left -= len(queue) - len(staying)
        self._exploring.waiting = deque(staying)

    @property
    def wants(self) -> int:
        """Number of levels to submit so that no search slot is empty for a while."""
        stage = self._exploring
        return max(0, AHEAD * len(stage.at) - len(stage.waiting)) if self.config.env_steps else 0

    def step(self) -> bool:
        """Search for `config.rounds` rounds; return whether there was anything to search.

        Variations run when they fill all their search slots, or when nothing else is left.
        """
        if self._varying.present >= len(self._varying.at) or (self._varying.present and not self._exploring.present):
            self._vary()
        elif self._exploring.present:
            self._explore()
        else:
            return False
        return True

    def result(self, job: SearchJob) -> SearchResult:
        """Return a finished job's results: shortened successes, verified by replay."""
        assert not job.left
        found, width = job.known, side_by_side(self.config)
        indices = np.flatnonzero(found.success.length)
        for block in blocks(len(indices), width):
            some = indices[block]
            given = jax.tree.map(lambda x, some=some: x[some], found.success)
            levels, level_ids = take(job.levels, some), job.level_ids[some]
            shorter = jax.device_get(shorten(levels, level_ids, given, self._scaled.endless, self._rules))
            found.success.action[some], found.success.length[some] = shorter.success
            found.env_steps[some] += shorter.env_steps  # a level that pads its block counts once
        return found

    def _explore(self) -> None:
        """Advance Go-Explore; queue levels that leave without a success for variations."""
        stage, config, rules = self._exploring, self._scaled, self._rules
        begin = lambda levels, level_ids, _: explore.begin(levels, level_ids, config.endless, rules)
        advance = lambda rows: explore.explore(rows, config, rules)
        nearest = None
        for row, entrant, seen in stage.step(begin, advance, partial(explored, ends=config.ends)):
            put(entrant, seen)
            if stage.at[row]:
                continue
            if seen.success.length or not config.variations:
                entrant.job.left -= 1
                continue
            nearest = nearest or jax.device_get(nearest_of(stage.rows.archive))
            known = jax.tree.map(lambda x, row=row: x[row].copy(), nearest)
            self._varying.waiting.append(Entrant(entrant.job, entrant.index, known))

    def _vary(self) -> None:
        """Advance variations of the nearest trajectories."""
        stage, config, rules = self._varying, self._scaled, self._rules
        begin = partial(vary.begin, config=config.endless, rules=rules)
        advance = lambda rows: vary.vary(rows, config, rules)
        for row, entrant, (success, env_steps) in stage.step(begin, advance, partial(varied, ends=config.ends)):
            before = jax.tree.map(lambda x, entrant=entrant: x[entrant.index], entrant.job.known)
            put(entrant, before._replace(success=success, varied=env_steps))
            entrant.job.left -= not stage.at[row]


def put(entrant: Entrant, seen: SearchResult) -> None:
    """Write a level's latest result into its `SearchJob.known` arrays."""
    for known, now in zip(jax.tree.leaves(entrant.job.known), jax.tree.leaves(seen), strict=True):
        known[entrant.index] = now


def side_by_side(config: SearchConfig) -> int:
    """Return the number of search slots in one program."""
    return at_once(config.lanes, IN_CACHE)


@jax.jit
def explored(search: Search, ends: StopLimits) -> tuple[Bool[Array, " level"], SearchResult]:
    """Return which levels are done, and the results of all levels so far."""
    found, none = success_of(search.code, search.length), jnp.zeros_like(search.env_steps)
    seen = SearchResult(found, search.env_steps, none, search.archive.cells, search.grew)
    return ~explore.under_way(search, ends), seen


@jax.jit
def varied(varying: Varying, ends: StopLimits) -> tuple[Bool[Array, " level"], tuple[Success, Int[Array, " level"]]]:
    """Return which levels are done, and successes and env steps of all levels so far."""
    return ~vary.under_way(varying, ends), (success_of(varying.code, varying.length), varying.env_steps)
