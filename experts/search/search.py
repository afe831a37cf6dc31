"""Search of levels side by side: Go-Explore first, then variations of the nearest trajectories. When a level leaves its
search slot, the next one enters.
"""

from collections.abc import Callable, Collection, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from levelproof.experts.batcher import Batcher, Entrant, Rows, Submission
from levelproof.experts.ledger import Lap, lap
from levelproof.experts.search import explore, vary
from levelproof.experts.search.config import SearchConfig, StopLimits
from levelproof.experts.search.explore import Search
from levelproof.experts.search.play import success_of
from levelproof.experts.search.shorten import shorten
from levelproof.experts.search.vary import Varying, nearest_of
from levelproof.experts.witness.success import Success, no_success
from levelproof.levelgen.batching import at_once, blocks, stacked, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.programs import jit_sooner
from levelproof.levelgen.task.rules import TaskParams

IN_CACHE = 256  # lanes: their physics and archives fit the cache of a core
ALONE = 1  # lane: on a CPU each success is shortened alone, because together the shorter ones wait for the longest
AHEAD = 8  # levels that wait per search slot: about a second's work, so that no slot is empty until more arrive


class SearchResult(NamedTuple):
    """Results of some levels, level first."""

    success: Success  # length 0: none
    env_steps: Int[Array, " level"]  # of Go-Explore, in all lanes
    varied: Int[Array, " level"]  # env steps of variations
    cells: Int[Array, " level"]  # cells reached, each of the width that cells had then
    grew: Int[Array, " level"]  # env steps when the last cell was reached
    shortened: Int[Array, " level"]  # env steps that shorten a success


class SearchJob(Submission):
    """Levels that are searched, and the results of each so far."""

    def __init__(self, levels: Level, level_ids: Int[np.ndarray, " level"]) -> None:
        super().__init__(levels, level_ids)
        nothing = no_success(len(level_ids)), *np.zeros((5, len(level_ids)), np.int32)
        self.known = SearchResult(*nothing)  # pyright: ignore[reportArgumentType]

    @property
    def env_steps(self) -> int:
        """Env steps so far."""
        return int(self.known.env_steps.sum() + self.known.varied.sum() + self.known.shortened.sum())

    def put(self, index: int, result: SearchResult) -> None:
        """Replace a level's result by its latest."""
        for known, now in zip(jax.tree.leaves(self.known), jax.tree.leaves(result), strict=True):
            known[index] = now


class Searching:
    """Search slots, shared by the levels of all units, and the queue before them.

    A level's result depends on the level and its id alone. All levels have one size. After an exception the object is
    unusable, because its arrays were donated.
    """

    def __init__(self, config: SearchConfig, rules: TaskParams) -> None:
        self.config, self._rules = config, rules
        self._exploring, self._varying = (Batcher(*[side_by_side(config)] * 2) for _ in range(2))

    def submit(self, levels: Level, level_ids: Int[np.ndarray, " level"]) -> SearchJob:
        """Queue levels for search slots; without a search (`config.env_steps` is 0) the job is finished at once.

        Args:
            levels: the levels, on the host.
            level_ids: their ids, the seeds of all randomness.
        """
        self._scaled = self.config.scaled(levels.model.size.bodies)
        job = SearchJob(levels, level_ids)
        if not self.config.env_steps:
            job.under_way.clear()
        self._exploring.submit(job)
        return job

    def waiting(self, job: SearchJob) -> list[int]:
        """Return indices of the job's levels that have had no search slot, ascending."""
        return self._exploring.waiting_of(job)

    def withdraw(self, job: SearchJob, indices: Collection[int]) -> None:
        """Remove levels that have had no search slot."""
        self._exploring.withdraw(job, indices)

    @property
    def wants(self) -> int:
        """Number of levels to submit so that no search slot is empty for a while."""
        slots = self._exploring
        return max(0, AHEAD * slots.width - len(slots.waiting)) if self.config.env_steps else 0

    def step(self) -> bool:
        """Search for `config.rounds` rounds; return whether there was anything to search.

        Variations run when they fill all their search slots, or when nothing else is left.
        """
        exploring, varying = self._exploring.present, self._varying.present
        if varying >= self._varying.width or (varying and not exploring):
            self._vary()
        elif exploring:
            self._explore()
        return bool(exploring or varying)

    def result(self, job: SearchJob) -> SearchResult:
        """Return a finished job's results: shortened successes, verified by replay."""
        assert not job.under_way
        results, width = job.known, at_once(self.config.lanes, ALONE)
        indices = np.flatnonzero(results.success.length)
        for block in blocks(len(indices), width):
            some = indices[block]
            given = jax.tree.map(lambda x, some=some: x[some], results.success)
            levels, level_ids = take(job.levels, some), job.level_ids[some]
            shorter = jax.device_get(shorten(levels, level_ids, given, self._scaled.endless, self._rules))
            results.success.action[some], results.success.length[some] = shorter.success
            results.shortened[some] = shorter.env_steps  # a level that pads its block counts once
        return results

    def _explore(self) -> None:
        """Advance Go-Explore; queue levels that leave without a success for variations."""
        slots, config, rules = self._exploring, self._scaled, self._rules
        begin = lambda levels, level_ids, _: explore.begin(levels, level_ids, config.endless, rules)
        advance = lambda rows: explore.explore(rows, config, rules)
        nearest = None
        for slot, (job, index, _), result in stepped(slots, begin, advance, partial(explored, ends=config.ends)):
            job.put(index, result)
            if slot in slots.at:
                continue
            if result.success.length or not config.variations:
                job.under_way.remove(index)
                continue
            nearest = nearest or jax.device_get(nearest_of(slots.rows.archive))
            known = jax.tree.map(lambda x, slot=slot: x[slot].copy(), nearest)
            self._varying.waiting.append(Entrant(job, index, known))

    def _vary(self) -> None:
        """Advance variations of the nearest trajectories."""
        slots, config, rules = self._varying, self._scaled, self._rules
        begin = lambda levels, level_ids, some: vary.begin(
            levels, level_ids, stacked(entrant.known for entrant in some), config.endless
        )
        advance = lambda rows: vary.vary(rows, config, rules)
        for slot, (job, index, _), result in stepped(slots, begin, advance, partial(varied, ends=config.ends)):
            success, env_steps = result
            known = jax.tree.map(lambda x, index=index: x[index], job.known)
            job.put(index, known._replace(success=success, varied=env_steps))
            if slot not in slots.at:
                job.under_way.remove(index)


def stepped(
    slots: Batcher, begin: Callable[..., Rows], advance: Callable[[Rows], Rows], poll: Callable[[Rows], tuple]
) -> Iterator[tuple[int, Entrant, Any]]:
    """Advance all search slots; yield each level as (slot, entrant, result so far). Levels that are done leave.

    Args:
        slots: the search slots.
        begin: as in `Batcher.fill`.
        advance: advances the state of all slots.
        poll: returns which levels are done, and the results of all, level first.
    """
    with lap() as took:
        slots.fill(begin)
        slots.rows = advance(slots.rows)
        done, results = jax.device_get(poll(slots.rows))
    busy, per_slot = slots.busy(), took.seconds / slots.width
    # charge empty slots to one present job, so that they count once
    busy[-1][1].submission.ledger.add("idle", Lap(per_slot * (slots.width - len(busy)), took.compiling))
    for slot, entrant in busy:
        entrant.submission.ledger.put("search", entrant.position, per_slot)
        if done[slot]:
            del slots.at[slot]
        yield slot, entrant, jax.tree.map(lambda x, slot=slot: x[slot], results)


def side_by_side(config: SearchConfig) -> int:
    """Return the number of search slots in one program."""
    return at_once(config.lanes, IN_CACHE)


@jit_sooner()
def explored(search: Search, ends: StopLimits) -> tuple[Bool[Array, " level"], SearchResult]:
    """Return which levels are done, and the results of all levels so far."""
    success, none = success_of(search.code, search.length), jnp.zeros_like(search.env_steps)
    result = SearchResult(success, search.env_steps, none, search.archive.cells, search.grew, none)
    return ~explore.under_way(search, ends), result


@jit_sooner()
def varied(varying: Varying, ends: StopLimits) -> tuple[Bool[Array, " level"], tuple[Success, Int[Array, " level"]]]:
    """Return which levels are done, and successes and env steps of all levels so far."""
    return ~vary.under_way(varying, ends), (success_of(varying.code, varying.length), varying.env_steps)
