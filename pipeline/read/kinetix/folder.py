"""Trajectories of a folder in the reference's layout as levels and actions of ours. Nobody vouches for what it says."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.files.kinetix import Fields, level_from_kinetix
from levelproof.levelgen.files.level_file import flaws
from levelproof.levelgen.level import ACTIONS, MAX_THINGS, Level, name_of
from levelproof.levelgen.task.actions import CHOICES
from levelproof.physics.types import FIXED_POLYGONS, Size
from levelproof.pipeline.read.kinetix.records import LEVEL_FIELDS, WORLD, dtype_of
from levelproof.pipeline.read.kinetix.zarr2 import FormatError, StoredArray, arrays_in
from levelproof.pipeline.store.contents import highest
from levelproof.pipeline.store.fields import arrays_of

COUNTED = ("polygon/n_vertices", "circle/radius", "joint/active", "thruster/active")  # in the order of Size
MOST = 100_000_000  # trajectories of a folder; the largest that is released has 6 million
INT32 = np.iinfo(np.int32)


class Trajectories(NamedTuple):
    """What some rows of an array have that cannot be worked out again."""

    level: Level  # of each row, its first state
    action: Int[np.ndarray, "256 6 level"]
    wrong: list[str]  # of each row, what no level can have; empty: nothing


@dataclass(frozen=True)
class Folder:
    """A folder whose description can be used."""

    path: Path
    size: Size
    arrays: list[StoredArray]

    @cached_property
    def rows(self) -> int:
        """Trajectories of all arrays."""
        return sum(array.rows for array in self.arrays)

    def named(self, name: str) -> StoredArray:
        """Raises FormatError where there is no such array."""
        for array in self.arrays:
            if array.path.name == name:
                return array
        raise FormatError(f"it has no array {name}")


def open_folder(path: Path) -> Folder:
    """The trajectories below a folder.

    Raises:
        FormatError: it has none that can be used.
    """
    arrays = arrays_in(path)
    size = _size_of(arrays[0])
    for array in arrays:
        _check_fields(array, size)
    folder = Folder(path, size, arrays)
    if folder.rows > MOST:
        raise FormatError(f"it says that it has {folder.rows:,} trajectories, and at most {MOST:,} are read")
    return folder


def read_trajectories(array: StoredArray, first: int, last: int) -> Trajectories:
    """Rows `first` to `last - 1`. Of their states the first alone is kept: the others follow from it.

    Raises:
        FormatError: a chunk is missing or damaged.
    """
    count = last - first
    action = np.zeros((count, RECORD_STEPS, ACTIONS), np.int64)
    fields: Fields = {name: np.zeros((count, *array.dtype[f"{WORLD}{name}"].shape), array.dtype[f"{WORLD}{name}"].base)
                      for name in LEVEL_FIELDS}  # fmt: skip
    for row, step, values in array.read(first, last):
        at = slice(row - first, row - first + len(values))
        action[at, step : step + values.shape[1]] = values["action"]
        if step == 0:
            for name, of in fields.items():
                of[at] = values[f"{WORLD}{name}"][:, 0]
    wrong = [""] * count
    for i, what in _impossible(fields, action):
        wrong[i] = what
    level = level_from_kinetix({name: _tamed(of) for name, of in fields.items()})
    for i, what in _useless(level):
        wrong[i] = wrong[i] or what
    return Trajectories(level, np.moveaxis(action, 0, -1).astype(np.int32), wrong)


def _size_of(array: StoredArray) -> Size:
    names = array.dtype.names or ()
    counts = [array.dtype[f"{WORLD}{name}"].shape for name in COUNTED if f"{WORLD}{name}" in names]
    if len(counts) == len(COUNTED) and all(len(shape) == 1 and shape[0] <= MAX_THINGS for shape in counts):
        size = Size(*(shape[0] for shape in counts))
        if size.polygons >= FIXED_POLYGONS and size.bodies > FIXED_POLYGONS:
            return size
    raise FormatError(f"the fields of its array {array.path.name} are those of no size of levels")


def _check_fields(array: StoredArray, size: Size) -> None:
    """Raises FormatError where a field that is read is not there, or is of another shape or kind."""
    wanted = dtype_of(size)
    for name in ("action", *(f"{WORLD}{name}" for name in LEVEL_FIELDS)):
        if name not in (array.dtype.names or ()):
            raise FormatError(f"its array {array.path.name} has no field {name}")
        theirs, ours, shape = array.dtype[name], wanted[name].base, wanted[name].shape[1:]
        if theirs.shape != shape or (theirs.base.kind in "iu") != (ours.kind == "i") or theirs.base.itemsize > 8:
            raise FormatError(
                f"the field {name} of its array {array.path.name} is {theirs.base} of shape {theirs.shape}, "
                f"and a level of size {name_of(size)} has {ours} of shape {shape}"
            )


def _impossible(fields: Fields, action: np.ndarray) -> Iterator[tuple[int, str]]:
    """Rows, and what in them is no number of a state or an action."""
    bad = ((action < 0) | (action >= np.array(CHOICES))).any((1, 2))
    yield from ((int(i), "its actions are none of this task") for i in np.flatnonzero(bad))
    for name, of in fields.items():
        if of.dtype.kind == "b":
            odd = np.ascontiguousarray(of).view(np.uint8) > 1
        elif of.dtype.kind == "f":
            with np.errstate(over="ignore"):
                odd = ~np.isfinite(of.astype(np.float32))
        else:
            odd = (of < INT32.min) | (of > INT32.max)
        for i in np.flatnonzero(odd.reshape(len(of), -1).any(1)):
            yield int(i), f"its {name} has what is no {'flag' if of.dtype.kind == 'b' else 'number'}"
    for i in np.flatnonzero(fields["timestep"] != 0):
        yield int(i), "it does not begin with an episode"


def _useless(level: Level) -> Iterator[tuple[int, str]]:
    """Levels that the engine cannot have, and why."""
    arrays = arrays_of(level, "level/")
    for name, most in highest(level.size).items():
        if name in arrays:
            bad = (arrays[name] < 0) | (arrays[name] > most)
            for i in np.flatnonzero(bad.reshape(-1, bad.shape[-1]).any(0)):
                yield int(i), f"its {name.removeprefix('level/')} has numbers that no such level can have"
    for bad, kind, why in flaws(level):
        for i in np.flatnonzero(np.asarray(bad).any(0)):
            yield int(i), f"a {kind} of it {why}"


def _tamed(values: np.ndarray) -> np.ndarray:
    """The same in numbers that convert, whatever bits they have."""
    if values.dtype.kind == "b":
        return np.ascontiguousarray(values).view(np.uint8) != 0
    with np.errstate(over="ignore"):
        return np.clip(values, INT32.min, INT32.max) if values.dtype.kind in "iu" else values.astype(np.float32)
