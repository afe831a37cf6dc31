"""Random access to single trajectories, for grain and PyTorch. Imports neither."""

import os
from collections.abc import Sequence
from dataclasses import is_dataclass
from typing import Any, Protocol

import jax
import numpy as np
from jaxtyping import Int

from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.pipeline.dataset.batch import Batch
from levelproof.pipeline.dataset.windows import Windows
from levelproof.pipeline.errors import UserError


class Readable(Protocol):
    """The methods of `Dataset` that a source calls."""

    @property
    def simulates(self) -> bool: ...
    def read(self, indices: Any, length: Any, first: Any, fields: Any, observation: Any, /) -> Batch: ...
    def grain(self, subset: Any, length: Any, fields: Any, observation: Any, /) -> "TrajectorySource": ...


class TrajectorySource:
    """A grain RandomAccessDataSource and a map-style PyTorch dataset, from `Dataset.grain` and `Dataset.torch`.

    Its pickle is small: a worker process reopens the split. Forked workers can compute neither observations nor what a
    record does not store, because JAX may already be initialised in their parent; spawned workers can.
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
        """Store the arguments of `Dataset.grain`; `indices` are the trajectories of `subset`."""
        self._data, self._indices, self._windows = data, indices, Windows.of(length)
        self._settings = (subset, length, tuple(fields), observation)
        self._process = os.getpid()

    def __len__(self) -> int:
        return len(self._indices) * self._windows.per_record

    def __getitem__(self, item: int) -> dict[str, Any]:
        """Return a trajectory or window: arrays [time, ...] by name. Raise IndexError if it does not exist."""
        return self.__getitems__([item])[0]

    def __getitems__(self, items: Sequence[int]) -> list[dict[str, Any]]:
        """Return several elements; torch calls this, if present, to read a batch at once."""
        _, length, fields, observation = self._settings
        if os.getpid() != self._process and (observation or self._data.simulates):
            what, way = "compute observations", ", or pass observation=None"
            if self._data.simulates:
                what, way = "simulate records, which this split does not store whole,", ""
            raise UserError(
                f"A forked process cannot {what} with JAX: pass the DataLoader multiprocessing_context='spawn'{way}."
            )
        chosen = np.asarray(items, np.int64)
        if len(wrong := chosen[(chosen < 0) | (chosen >= len(self))]):
            raise IndexError(f"There is no item {wrong[0]}: the source has {len(self)}.")
        which, first = self._windows.locate(chosen)
        batch = self._data.read(self._indices[which], length, first, fields, observation)
        return [_element(batch, i) for i in range(len(chosen))]

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self._data).grain, (self._data, *self._settings)

    def __repr__(self) -> str:
        subset, length, fields, observation = self._settings
        name = observation and str(observation)
        settings = f"subset={subset!r}, length={length}, fields={list(fields)}, observation={name!r}"
        return f"{self._data!r}.grain({settings})"


def _element(batch: Batch, i: int) -> dict[str, Any]:
    element = {name: x for name, x in vars(batch).items() if name != "fields" and x is not None} | batch.fields
    if is_dataclass(shown := batch.observation):
        element["observation"] = vars(shown)  # torch's default collation refuses dataclasses
    return jax.tree.map(lambda x: np.array(np.asarray(x)[i]), element)
