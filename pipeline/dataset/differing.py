"""Levels whose states differ on this machine from the stored ones: reported once, counted, kept or left out."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from threading import Lock

import jax
import numpy as np
from jaxtyping import Bool, Int

from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.store.shard import STATES_DIFFER, EngineDiffers, Unlike
from levelproof.pipeline.words import many

KEEP, LEAVE_OUT, RAISE = "keep", "leave_out", "raise"
WAYS = {
    KEEP: "they are kept, with this machine's own states",
    LEAVE_OUT: "they are left out, with mask False in all their steps",
    RAISE: "read the split with the machine and versions that made it, or pass differing='leave_out' to open",
}


class Differing:
    """The differing levels that a dataset has found so far. Safe to use from several threads.

    Attributes:
        level_ids: their ids, ascending, int64 [level].
    """

    def __init__(self, split: Path, way: str) -> None:
        """Treat the differing levels of `split` in a way, a key of WAYS. Raise UserError if there is no such way."""
        if way not in WAYS:
            raise UserError(f"differing is {way!r}: use one of {', '.join(WAYS)}.")
        self._split, self._way, self._lock, self._reported = split, way, Lock(), False
        self.level_ids: Int[np.ndarray, " level"] = np.zeros(0, np.int64)

    def note(self, unlike: Sequence[Unlike]) -> None:
        """Count levels; warn if these are the first.

        Raises:
            Failure: differing levels are not accepted.
        """
        with self._lock:
            ids = [level_id for one in unlike for level_id in one.level_ids]
            self.level_ids = np.union1d(self.level_ids, np.array(ids, np.int64))
            is_first, self._reported = not self._reported, True
        if self._way != RAISE and not is_first:
            return
        count = many(len(self.level_ids), "level")
        found = f"{STATES_DIFFER} {count} of {self._split} so far, such as level {ids[0]}"
        if jax.default_backend() != "cpu":
            found += f" (JAX computes on {jax.default_backend()} here; JAX_PLATFORMS=cpu gives the bits of CPUs)"
        if self._way == RAISE:
            raise Failure(f"{found}: {WAYS[RAISE]}.")
        try:
            warnings.warn(
                f"{found}: {WAYS[self._way]}; `differing` of the dataset lists all.", EngineDiffers, stacklevel=2
            )
        except EngineDiffers:
            self._reported = False  # where warnings are errors, each is one
            raise

    def kept(self, level_ids: Int[np.ndarray, " level"]) -> Bool[np.ndarray, " level"]:
        """Return which of these levels, all of which were read, are not left out."""
        return np.ones(len(level_ids), bool) if self._way != LEAVE_OUT else ~np.isin(level_ids, self.level_ids)
