"""Deterministic order of an epoch: shuffled without a list of all items, and apportioned to hosts.

The shuffle is a keyed permutation of 0 .. count - 1: a Feistel network over the next power of four, walked along its
cycles until it is back in range (Black and Rogaway, Ciphers with Arbitrary Finite Domains, CT-RSA 2002), with the
finaliser of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014) as its round function. It is not cryptographically secure.
"""

import operator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from levelproof.pipeline.errors import UserError

ROUNDS = 6


@dataclass(frozen=True)
class EpochOrder:
    """The batches of all epochs on one host."""

    count: int  # items
    batch_size: int  # items per batch on this host
    seed: int | None  # None: no shuffling
    process_index: int = 0
    process_count: int = 1

    def __post_init__(self) -> None:
        for name in ("batch_size", "seed", "process_index", "process_count"):
            object.__setattr__(self, name, as_int(getattr(self, name)))
        if not (type(self.batch_size) is int and self.batch_size > 0):
            raise UserError(f"A batch cannot have {self.batch_size} items: use an integer from 1.")
        process = self.process_index, self.process_count
        if not (all(type(number) is int for number in process) and 0 <= self.process_index < self.process_count):
            raise UserError(
                f"There is no process {self.process_index} of {self.process_count}: "
                "process_index must be from 0 to process_count - 1."
            )
        if self.seed is not None and not (type(self.seed) is int and self.seed >= 0):
            raise UserError(f"The seed is {self.seed}: use an integer from 0, or None for no shuffling.")

    @property
    def batches(self) -> int:
        """Number of batches per epoch, equal on every host."""
        return -(-self.count // (self.batch_size * self.process_count))

    def items(self, positions: int | range) -> tuple[Int[np.ndarray, " item"], Bool[np.ndarray, " item"]]:
        """Return the items of batches, one batch after another, and which of them are not padding.

        Every item occurs once per epoch; repeated items pad the last batch on every host.

        Args:
            positions: indices of the batches, counted from the start of the first epoch; or of one batch.
        """
        epochs, steps = np.divmod(np.atleast_1d(positions), self.batches)
        first = (steps * self.process_count + self.process_index) * self.batch_size
        ranks = first[:, None] + np.arange(self.batch_size)
        items = ranks % self.count
        if self.seed is not None:
            for epoch in np.unique(epochs).tolist():
                items[epochs == epoch] = permute(items[epochs == epoch], self.count, self.seed, epoch)
        return items.ravel(), ranks.ravel() < self.count


def as_int(value: Any) -> Any:
    """Return an integer of numpy or JAX as Python's, which JSON can hold; other values unchanged."""
    try:
        return operator.index(value)
    except TypeError:
        return value


def permute(positions: Int[np.ndarray, "*n"], count: int, seed: int, epoch: int = 0) -> Int[np.ndarray, "*n"]:
    """Return the items at these positions of a keyed permutation of 0 .. count - 1."""
    keys = np.random.SeedSequence([seed, epoch]).generate_state(ROUNDS, np.uint64)
    half = np.uint64(max((count - 1).bit_length() + 1, 2) // 2)  # bits
    items = _network(positions.astype(np.uint64), keys, half)
    while (outside := items >= count).any():
        items[outside] = _network(items[outside], keys, half)
    return items.astype(np.int64)


def _network(x: np.ndarray, keys: np.ndarray, half: np.uint64) -> np.ndarray:
    mask = (np.uint64(1) << half) - np.uint64(1)
    left, right = x >> half, x & mask
    for key in keys:
        left, right = right, left ^ (_mix(right + key) & mask)
    return (left << half) | right


def _mix(x: np.ndarray) -> np.ndarray:
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
