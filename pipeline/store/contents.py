"""Contents of a shard of one size: its fields, their layout, and the integers that they may hold.

Derived from the annotations of `Level` and `Record` alone, so that a shard can be refused before any of it is used:
engines and pictures index arrays with these integers and check no bounds.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import Record
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID
from levelproof.levelgen.level import MAX_PER_KIND, MOTOR_BINDINGS, THRUSTER_BINDINGS, Level, Role, name_of
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.actions import CHOICES
from levelproof.physics.buffers import buffers_of
from levelproof.physics.types import FIXED_POLYGONS, MAX_VERTICES, Size
from levelproof.pipeline.store.density import KEY, kept
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.formats import FLAT, ContentsError, Encoding, FieldSpec, field_table
from levelproof.pipeline.store.packing import pack

COUNTED = (  # fields with one entry per polygon, circle, joint and thruster, in the order of Size
    "level/model/n_vertices",
    "level/model/radius",
    "level/model/joint_active",
    "level/model/thruster_active",
)
SMALLEST = Size(FIXED_POLYGONS, 0, 0, 0)
FULL = Encoding()


@cache
def table_for(size: Size, encoding: Encoding = FULL) -> tuple[FieldSpec, ...]:
    """Return the field table of a shard of this size; by default, all fields that a reader can ask for."""
    level, record = none_of(size)
    arrays = arrays_of(level, "level/") | arrays_of(record, "record/")
    return tuple(field_table(kept(arrays, encoding), encoding.density))


def none_of(size: Size) -> tuple[Level, Record]:
    """Return a batch of zero levels of this size and of zero records, for their shapes and types."""
    empty = lambda buffer: np.zeros((*buffer.shape, 0), buffer.dtype)
    level, record = (jax.tree.map(empty, buffers_of(kind, size)) for kind in (Level, Record))
    in_time = lambda tree: jax.tree.map(lambda x: np.stack([x] * RECORD_STEPS), tree)  # the engine's have no time axis
    return level, replace(record, state=in_time(record.state), manifold=in_time(record.manifold))


def level_fields(size: Size) -> list[FieldSpec]:
    """Return the fields that define a level, without its record."""
    return [field for field in table_for(size) if field.constant]


def size_of_levels(arrays: Mapping[str, np.ndarray]) -> Size:
    """Return the size of levels with these fields."""
    return Size(*(arrays[name].shape[0] for name in COUNTED))


@cache
def blank_row(size: Size, table: tuple[FieldSpec, ...]) -> np.ndarray:
    """Return the empty level's row of FLAT: its fields, its state in every key frame, and zeros elsewhere.

    Rows are stored XORed with it; the result is mostly zero, because nearly all levels share the scenery.
    """
    empty, arrays = arrays_of(empty_level(size, 1), "level/"), {}
    for field in table:
        start = empty.get(field.name.replace(KEY, "level/", 1), np.zeros((*field.shape, 1), field.dtype))
        arrays[field.name] = start if field.constant else np.repeat(start[None], field.steps, 0)
    return pack(arrays, table)[FLAT][0]


def size_in(fields: Any, encoding: Encoding) -> Size:
    """Return the size whose field table is `fields`, the JSON of a shard's attributes.

    Raises:
        ContentsError: no size has this table.
    """
    with suppress(KeyError, IndexError, TypeError):
        shapes = {field["name"]: field["shape"] for field in fields}
        size = Size(*(shapes[name][0] for name in COUNTED))
        fits = all(type(n) is int and low <= n <= MAX_PER_KIND for low, n in zip(SMALLEST, size, strict=True))
        if fits and fields == _table_json(size, encoding):
            return size
    raise ContentsError("its fields match no size")


@cache
def _table_json(size: Size, encoding: Encoding) -> list[dict[str, Any]]:
    """Return the field table as a shard's attributes have it."""
    return [field.as_json() for field in table_for(size, encoding)]


def level_ids_in(level_ids: Any) -> Int[np.ndarray, " level"]:
    """Return the level ids in a shard's attributes; raise ContentsError unless they are ascending, and one or more."""
    good = isinstance(level_ids, list) and {*map(type, level_ids)} == {int}
    ids = np.array(level_ids if good else [], np.int64)
    if not len(ids) or ids[0] < 0 or ids[-1] > MAX_LEVEL_ID or (ids[1:] <= ids[:-1]).any():
        raise ContentsError("its level ids are not ascending ids of levels")
    return ids


def check_numbers(arrays: Mapping[str, np.ndarray], size: Size) -> None:
    """Raise ContentsError if an integer is out of range for a level or a record of this size.

    `arrays` have the level axis first.
    """
    for name, most in highest(size).items():
        values = np.moveaxis(arrays[name], 0, -1) if name in arrays else np.zeros(0)
        if not ((values >= 0) & (values <= most)).all():
            raise ContentsError(f"its field {name} has numbers that size {name_of(size)} cannot have")


def highest(size: Size) -> dict[str, np.ndarray | int]:
    """Return the largest valid value of each integer field; the smallest is 0."""
    return {
        "record/timestep": np.iinfo(np.int32).max,
        "record/action": np.array(CHOICES)[:, None] - 1,
        "level/role": max(Role),
        "level/motor_binding": MOTOR_BINDINGS - 1,
        "level/thruster_binding": THRUSTER_BINDINGS - 1,
        "level/model/n_vertices": MAX_VERTICES,
        "level/model/collision_mode": 2,
        "level/model/joint_a": size.bodies - 1,
        "level/model/joint_b": size.bodies - 1,
        "level/model/thruster_body": size.bodies - 1,
    }
