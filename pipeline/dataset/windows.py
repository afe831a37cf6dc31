"""Cutting of records into consecutive windows, the last one padded."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.pipeline.dataset.order import as_int
from levelproof.pipeline.errors import UserError


class Windows(NamedTuple):
    """Windows of `length` steps that start at steps 0, length, 2 * length, ... of each record."""

    length: int

    @staticmethod
    def of(length: int | None) -> "Windows":
        """Return windows of `length` steps; None: whole records.

        Raises:
            UserError: `length` is not an integer from 1 to the steps of a record.
        """
        length = as_int(length)
        if length is not None and not (type(length) is int and 0 < length <= RECORD_STEPS):
            raise UserError(f"A window cannot have {length} steps: use 1 to {RECORD_STEPS}, or None for whole records.")
        return Windows(length or RECORD_STEPS)

    @property
    def whole(self) -> bool:
        """Whether a window is as long as a record."""
        return self.length == RECORD_STEPS

    @property
    def per_record(self) -> int:
        """Number of windows per record."""
        return -(-RECORD_STEPS // self.length)

    def locate(self, items: Int[np.ndarray, " item"]) -> tuple[Int[np.ndarray, " item"], Int[np.ndarray, " item"]]:
        """Return the trajectory index of each window, and the step at which it starts."""
        return items // self.per_record, items % self.per_record * self.length

    def mask(self, first: Int[np.ndarray, " item"]) -> Bool[np.ndarray, "item time"]:
        """Return which steps of windows starting at `first` lie within the record; the others are padding."""
        return first[:, None] + np.arange(self.length) < RECORD_STEPS

    def steps(self, first: Int[np.ndarray, " item"]) -> Int[np.ndarray, "item time"]:
        """Return the steps of records that windows starting at `first` have; the last step stands for padding."""
        return np.minimum(first[:, None] + np.arange(self.length), RECORD_STEPS - 1)

    def cut(self, arrays: Mapping[str, np.ndarray], first: Int[np.ndarray, " item"]) -> dict[str, np.ndarray]:
        """Cut windows from records [item, time, ...], padded with the last step; keep fields without a time axis."""
        if self.whole and not first.any():
            return dict(arrays)
        rows, steps = np.arange(len(first))[:, None], self.steps(first)
        return {name: x[rows, steps] if name.startswith("record/") else x for name, x in arrays.items()}
