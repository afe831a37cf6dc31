"""How a record is cut into windows: one behind the other from its first step, the last one filled up."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.pipeline.errors import UserError


class Windows(NamedTuple):
    """Windows of `length` steps lie at 0, length, 2 * length, ... of each record."""

    length: int

    @staticmethod
    def of(length: int | None) -> "Windows":
        """None: whole records.

        Raises:
            UserError: no record has so many steps.
        """
        if length is not None and not (type(length) is int and 0 < length <= RECORD_STEPS):
            raise UserError(f"A window cannot have {length} steps: give 1 to {RECORD_STEPS}, or None for all.")
        return Windows(length or RECORD_STEPS)

    @property
    def each(self) -> int:
        """Windows of a record."""
        return -(-RECORD_STEPS // self.length)

    def at(self, items: Int[np.ndarray, " item"]) -> tuple[Int[np.ndarray, " item"], Int[np.ndarray, " item"]]:
        """The trajectory of each window, and the step at which it starts."""
        return items // self.each, items % self.each * self.length

    def mask(self, first: Int[np.ndarray, " item"]) -> Bool[np.ndarray, "item time"]:
        """Which steps of windows that start there are steps of their record; the others repeat its last step."""
        return first[:, None] + np.arange(self.length) < RECORD_STEPS

    def cut(self, arrays: Mapping[str, np.ndarray], first: Int[np.ndarray, " item"]) -> dict[str, np.ndarray]:
        """The windows of whole records [item, time, ...]; what does not change along time is left as it is."""
        if self.length == RECORD_STEPS and not first.any():
            return dict(arrays)
        steps = np.minimum(first[:, None] + np.arange(self.length), RECORD_STEPS - 1)
        rows = np.arange(len(first))[:, None]
        return {name: x[rows, steps] if name.startswith("record/") else x for name, x in arrays.items()}
