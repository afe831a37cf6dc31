"""Trajectories one by one, as grain and PyTorch ask for them. Imports neither."""

import os
from collections.abc import Sequence
from typing import Any, Protocol

import jax
import numpy as np
from jaxtyping import Int

from levelproof.levelgen.task.environment import ObservationType
from levelproof.pipeline.dataset.batch import Batch
from levelproof.pipeline.dataset.windows import Windows
from levelproof.pipeline.errors import UserError


class Readable(Protocol):
    """What a source needs of a `Dataset`, which makes it."""

    def read(self, indices: Any, length: Any, first: Any, fields: Any, observation: Any, /) -> Batch: ...
    def grain(self, subset: Any, length: Any, fields: Any, observation: Any, /) -> "TrajectorySource": ...


class TrajectorySource:
    """A grain RandomAccessDataSource, and a map-style data set for a PyTorch DataLoader.

    Its pickle is small: a worker process opens the split again. A worker that was forked cannot make observations,
    because JAX may have been started before; spawn workers can.
    """

    def __init__(
        self,
        data: Readable,
        indices: Int[np.ndarray, " index"],
        subset: str | None,
        length: int | None,
        fields: Sequence[str],
        observation: ObservationType | None,
    ) -> None:
        """Made by `Dataset.grain` and `Dataset.torch`; `indices` are the trajectories of `subset`."""
        self._data, self._indices, self._windows = data, indices, Windows.of(length)
        self._settings = (subset, length, tuple(fields), observation)
        self._process = os.getpid()

    def __len__(self) -> int:
        return len(self._indices) * self._windows.each

    def __getitem__(self, item: int) -> dict[str, Any]:
        """One trajectory or window: arrays [time, ...] by name."""
        return self.__getitems__([item])[0]

    def __getitems__(self, items: Sequence[int]) -> list[dict[str, Any]]:
        """Several at once, as torch asks for them if it can."""
        _, length, fields, observation = self._settings
        if observation and os.getpid() != self._process:
            raise UserError(
                "A forked process cannot make observations with JAX: give the DataLoader "
                "multiprocessing_context='spawn', or take observation=None."
            )
        chosen = np.asarray(items, np.int64)
        if not ((chosen >= 0) & (chosen < len(self))).all():
            raise IndexError(f"There is no item {chosen.max()}: these are {len(self)}.")
        which, first = self._windows.at(chosen)
        batch = self._data.read(self._indices[which], length, first, fields, observation)
        return [_element(batch, i) for i in range(len(chosen))]

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self._data).grain, (self._data, *self._settings)

    def __repr__(self) -> str:
        subset, length, fields, observation = self._settings
        seen = observation and str(observation)
        settings = f"subset={subset!r}, length={length}, fields={list(fields)}, observation={seen!r}"
        return f"{self._data!r}.grain({settings})"


def _element(batch: Batch, i: int) -> dict[str, Any]:
    one = {name: x for name, x in vars(batch).items() if name != "fields" and x is not None} | batch.fields
    return jax.tree.map(lambda x: np.array(np.asarray(x)[i]), one)
