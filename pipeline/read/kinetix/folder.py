"""Levels and actions from folders in the reference's layout. The folders are untrusted: every value is checked."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.files.kinetix import Fields, level_from_kinetix
from levelproof.levelgen.files.level_file import flaws, with_known_bindings
from levelproof.levelgen.level import ACTIONS, MAX_PER_KIND, Level, name_of
from levelproof.levelgen.task.actions import CHOICES
from levelproof.physics.types import FIXED_POLYGONS, Size
from levelproof.pipeline.read.kinetix.records import LEVEL_FIELDS, WORLD, dtype_of
from levelproof.pipeline.read.kinetix.zarr2 import FormatError, StoredArray, arrays_in
from levelproof.pipeline.store.contents import highest
from levelproof.pipeline.store.fields import arrays_of

COUNTED_FIELDS = (
    "polygon/n_vertices",
    "circle/radius",
    "joint/active",
    "thruster/active",
)  # whose lengths are the fields of Size, in order
MAX_TRAJECTORIES = 100_000_000  # of a folder; the largest released has 6 million
INT32 = np.iinfo(np.int32)
KINDS = {"b": "b", "i": "iu", "f": "f"}  # of a field's type, by that of ours


class Trajectories(NamedTuple):
    """Levels and actions of some rows of an array, from which records can be replayed."""

    level: Level  # from the first state of each row
    action: Int[np.ndarray, "256 6 level"]
    wrong: list[str]  # per row, why its level or actions are invalid; empty: valid


@dataclass(frozen=True)
class Folder:
    """A folder of trajectories with checked metadata."""

    path: Path
    size: Size
    arrays: list[StoredArray]

    @cached_property
    def rows(self) -> int:
        """Number of trajectories in all arrays."""
        return sum(array.rows for array in self.arrays)

    def array(self, name: str) -> StoredArray:
        """Return an array by name. Raise FormatError if it does not exist."""
        for array in self.arrays:
            if array.path.name == name:
                return array
        raise FormatError(f"it has no array {name}")


def open_folder(path: Path) -> Folder:
    """Open a folder of trajectories: read and check its metadata.

    Raises:
        FormatError: the folder has no usable trajectories.
    """
    arrays = arrays_in(path)
    size = _size_of(arrays[0])
    for array in arrays:
        _check_fields(array, size)
    folder = Folder(path, size, arrays)
    if folder.rows > MAX_TRAJECTORIES:
        raise FormatError(f"it claims {folder.rows:,} trajectories, more than the maximum of {MAX_TRAJECTORIES:,}")
    return folder


def read_trajectories(array: StoredArray, first: int, last: int) -> Trajectories:
    """Read rows `first` to `last - 1`. Keeps only the first state of each: the actions determine the others.

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
            for name, column in fields.items():
                column[at] = values[f"{WORLD}{name}"][:, 0]
    wrong = [""] * count
    for i, reason in _invalid_values(fields, action):
        wrong[i] = reason
    level = with_known_bindings(level_from_kinetix({name: _convertible(column) for name, column in fields.items()}))
    for i, reason in _invalid_levels(level):
        wrong[i] = wrong[i] or reason
    return Trajectories(level, np.moveaxis(action, 0, -1).astype(np.int32), wrong)


def _size_of(array: StoredArray) -> Size:
    names = array.dtype.names or ()
    counts = [array.dtype[f"{WORLD}{name}"].shape for name in COUNTED_FIELDS if f"{WORLD}{name}" in names]
    if len(counts) == len(COUNTED_FIELDS) and all(len(shape) == 1 and shape[0] <= MAX_PER_KIND for shape in counts):
        size = Size(*(shape[0] for shape in counts))
        if size.polygons >= FIXED_POLYGONS and size.bodies > FIXED_POLYGONS:
            return size
    raise FormatError(f"the fields of its array {array.path.name} do not match any level size")


def _check_fields(array: StoredArray, size: Size) -> None:
    """Raise FormatError if a required field is missing, or differs in shape or kind."""
    wanted = dtype_of(size)
    for name in ("action", *(f"{WORLD}{name}" for name in LEVEL_FIELDS)):
        if name not in (array.dtype.names or ()):
            raise FormatError(f"its array {array.path.name} has no field {name}")
        theirs, ours, shape = array.dtype[name], wanted[name].base, wanted[name].shape[1:]
        if theirs.shape != shape or theirs.base.kind not in KINDS[ours.kind] or theirs.base.itemsize > 8:
            raise FormatError(
                f"the field {name} of its array {array.path.name} is {theirs.base} of shape {theirs.shape}, "
                f"but must be {ours} of shape {shape} for levels of size {name_of(size)}"
            )


def _invalid_values(fields: Fields, action: np.ndarray) -> Iterator[tuple[int, str]]:
    """Yield rows with a value that no state or action can have, and the reason."""
    bad = ((action < 0) | (action >= np.array(CHOICES))).any((1, 2))
    yield from ((int(i), "its actions are not actions of this task") for i in np.flatnonzero(bad))
    for name, column in fields.items():
        kind = column.dtype.kind
        if kind == "b":
            bad = np.ascontiguousarray(column).view(np.uint8) > 1
        elif kind == "f":
            with np.errstate(over="ignore"):
                bad = ~np.isfinite(column.astype(np.float32))
        else:
            bad = (column < INT32.min) | (column > INT32.max)
        for i in np.flatnonzero(bad.reshape(len(column), -1).any(1)):
            yield int(i), f"its {name} has a value that is not a {'flag' if kind == 'b' else 'finite 32-bit number'}"
    for i in np.flatnonzero(fields["timestep"] != 0):
        yield int(i), "it does not begin at the start of an episode"


def _invalid_levels(level: Level) -> Iterator[tuple[int, str]]:
    """Yield levels that the engine cannot simulate, and the reason."""
    arrays = arrays_of(level, "level/")
    for name, most in highest(level.size).items():
        if name in arrays:
            bad = (arrays[name] < 0) | (arrays[name] > most)
            for i in np.flatnonzero(bad.reshape(-1, bad.shape[-1]).any(0)):
                yield int(i), f"its {name.removeprefix('level/')} has values out of range for this size"
    one_way = level.model.collides != np.swapaxes(level.model.collides, 0, 1)
    for i in np.flatnonzero(one_way.any((0, 1))):
        yield int(i), "its collision matrix lets a body collide with another, but not that one with it"
    for i in np.flatnonzero(np.asarray(level.state.contact_active).any(0)):
        yield int(i), "it begins with contacts, which levels do not"
    for bad, kind, why in flaws(level):
        for i in np.flatnonzero(np.asarray(bad).any(0)):
            yield int(i), f"one {kind} {why}"


def _convertible(values: np.ndarray) -> np.ndarray:
    """Clip values so that they convert to 32 bits without undefined behaviour or warnings."""
    if values.dtype.kind == "b":
        return np.ascontiguousarray(values).view(np.uint8) != 0
    with np.errstate(over="ignore"):
        return np.clip(values, INT32.min, INT32.max) if values.dtype.kind in "iu" else values.astype(np.float32)
