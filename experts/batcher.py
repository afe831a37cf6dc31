"""Continuous batching, for the search and for training: levels wait for the slots of one program, in which they advance
side by side; when one leaves, the next enters.
"""

from collections import deque
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from itertools import takewhile
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Int

from levelproof.experts.ledger import Ledger
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level
from levelproof.levelgen.programs import jit_stored

row_at, update_at = jax.lax.dynamic_index_in_dim, jax.lax.dynamic_update_index_in_dim
Rows = Any  # state of slots: a dataclass, its `levels` with the slot axis last, all else slot-first


class Submission:
    """Levels submitted together; they finish together."""

    def __init__(self, levels: Level, level_ids: Int[np.ndarray, " level"]) -> None:
        self.levels, self.level_ids = levels, np.asarray(level_ids, np.int32)
        self.under_way = set(range(len(level_ids)))  # indices of levels that wait or are in slots
        self.ledger = Ledger(len(level_ids))


class Entrant(NamedTuple):
    """A level in a slot, or waiting for one."""

    submission: Any  # a `Submission` of the batcher's kind
    position: int  # of the level in the submission
    known: Any = None  # data besides the level that its slot begins with, such as the search's nearest trajectories


class Batcher:
    """Slots and the queue before them; unusable after an exception, because the arrays of slots are donated."""

    def __init__(self, width: int, group: int) -> None:
        self.width = width  # number of slots
        self.group = group  # levels that begin in one call, some before a slot is empty: cheaper than one at a time
        self.waiting: deque[Entrant] = deque()
        self.at: dict[int, Entrant] = {}  # levels in slots
        self.rows: Rows = None  # state of all slots; None until the first level enters
        self._fresh: Rows = None  # state of the last group that has begun
        self._begun: dict[tuple[Submission, int], int] = {}  # row in `_fresh` of each level of that group

    @property
    def present(self) -> int:
        """Number of levels in slots or waiting."""
        return len(self.waiting) + len(self.at)

    def busy(self) -> list[tuple[int, Entrant]]:
        """Return slots that are not empty, ascending, with their levels."""
        return [(slot, self.at[slot]) for slot in sorted(self.at)]

    def submit(self, submission: Submission) -> None:
        """Queue all levels of a submission."""
        self.waiting.extend(Entrant(submission, i) for i in sorted(submission.under_way))

    def waiting_of(self, submission: Submission) -> list[int]:
        """Return indices of the submission's levels that have had no slot, in order of arrival."""
        return [entrant.position for entrant in self.waiting if entrant.submission is submission]

    def withdraw(self, submission: Submission, indices: Collection[int]) -> None:
        """Remove levels that have had no slot."""
        stays = lambda entrant: entrant.submission is not submission or entrant.position not in indices
        self.waiting = deque(filter(stays, self.waiting))
        submission.under_way.difference_update(indices)

    def fill(self, begin: Callable[[Level, Int[np.ndarray, " level"], list[Entrant]], Rows]) -> None:
        """Move waiting levels into empty slots.

        Args:
            begin: makes the state of slots from levels, their ids and entrants; called for `group` levels at a time.
        """
        empty = [slot for slot in range(self.width) if slot not in self.at]
        while empty and self.waiting:
            if self.waiting[0][:2] not in self._begun:
                some = [self.waiting[min(i, len(self.waiting) - 1)] for i in range(self.group)]
                self._begun = {entrant[:2]: row for row, entrant in enumerate(some)}
                self._fresh = begin(*levels_of(some), some)
                self.rows = blank(self._fresh, self.width) if self.rows is None else self.rows
            ready = takewhile(lambda entrant: entrant[:2] in self._begun, self.waiting)
            entering = dict(zip(empty, ready, strict=False))
            pad = [self.width] * (self.group - len(entering))
            rows = [self._begun[entrant[:2]] for entrant in entering.values()]
            sources, slots = np.array([*rows, *[0] * len(pad)]), np.array([*entering, *pad])
            self.rows = entered(self.rows, self._fresh, sources, slots)
            self.at.update(entering)
            empty = empty[len(entering) :]
            for _ in entering:
                self.waiting.popleft()


def levels_of(entrants: list[Entrant]) -> tuple[Level, Int[np.ndarray, " level"]]:
    """Return the entrants' levels and their ids, on the host."""
    each = [take(entrant.submission.levels, np.array([entrant.position])) for entrant in entrants]
    level_ids = np.array([entrant.submission.level_ids[entrant.position] for entrant in entrants])
    return jax.tree.map(lambda *xs: np.concatenate(xs, -1), *each), level_ids


def by_axis(last: Callable, first: Callable, *rows: Rows) -> Rows:
    """Map `last` over the arrays of `levels`, and `first` over all others."""
    levels = jax.tree.map(last, *(each.levels for each in rows))
    return replace(jax.tree.map(first, *(replace(each, levels=None) for each in rows)), levels=levels)


def blank(rows: Rows, width: int) -> Rows:
    """Return the state of slots that are all empty: zeros."""
    return by_axis(
        lambda x: np.zeros((*x.shape[:-1], width), x.dtype), lambda x: np.zeros((width, *x.shape[1:]), x.dtype), rows
    )


@jit_stored(donate_argnames="rows")
def entered(rows: Rows, fresh: Rows, sources: Int[Array, " group"], slots: Int[Array, " group"]) -> Rows:
    """Copy the rows `sources` of `fresh` into `slots`, up to the first slot past the end.

    On a CPU, rows are copied one after another, each in all arrays: a scatter into each array takes twice as long to
    compile, and longer to run.
    """
    if jax.default_backend() != "cpu":
        first = lambda old, new: old.at[slots].set(new[sources], mode="drop")
        last = lambda old, new: old.at[..., slots].set(new[..., sources], mode="drop")
        return by_axis(last, first, rows, fresh)

    def enter(number: Int[Array, ""], rows: Rows) -> Rows:
        source, slot = sources[number], slots[number]
        copied = lambda axis, old, new: update_at(old, row_at(new, source, axis, keepdims=False), slot, axis)
        return by_axis(partial(copied, -1), partial(copied, 0), rows, fresh)

    return jax.lax.fori_loop(0, (slots < len(rows.level_ids)).sum(), enter, rows)
