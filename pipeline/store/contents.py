"""What a shard of one size holds: its fields, where each lies, and the whole numbers that may stand in them.

Told by the annotations of `Level` and `Record` alone, so that a shard can be refused before anything of it is used:
engines and pictures look things up by these numbers and check no bounds.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import numpy as np

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
from levelproof.pipeline.store.packing import pack
from levelproof.pipeline.store.schema import FLAT, ContentsError, Encoding, FieldSpec, field_table

COUNTED = (  # fields with one entry for each thing of a kind, in the order of Size
    "level/model/n_vertices",
    "level/model/radius",
    "level/model/joint_active",
    "level/model/thruster_active",
)
FEWEST = Size(FIXED_POLYGONS, 0, 0, 0)
FULL = Encoding()


@cache
def table_for(size: Size, encoding: Encoding = FULL) -> tuple[FieldSpec, ...]:
    """The field table of a shard of this size; by default, all the fields that any shard gives back."""
    level, record = none_of(size)
    arrays = arrays_of(level, "level/") | arrays_of(record, "record/")
    return tuple(field_table(kept(arrays, encoding), encoding.density))


def none_of(size: Size) -> tuple[Level, Record]:
    """No level of this size and no record, with all their shapes and types."""
    empty = lambda buffer: np.zeros((*buffer.shape, 0), buffer.dtype)
    level, record = (jax.tree.map(empty, buffers_of(of, size)) for of in (Level, Record))
    in_time = lambda tree: jax.tree.map(lambda x: np.stack([x] * RECORD_STEPS), tree)  # the engine's are of one moment
    return level, replace(record, state=in_time(record.state), manifold=in_time(record.manifold))


def level_fields(size: Size) -> list[FieldSpec]:
    """Those that tell what a level is, without its record."""
    return [field for field in table_for(size) if field.constant]


def size_of_levels(arrays: Mapping[str, np.ndarray]) -> Size:
    """The size of levels with these fields."""
    return Size(*(arrays[name].shape[0] for name in COUNTED))


@cache
def blank_row(size: Size, encoding: Encoding) -> np.ndarray:
    """A row of FLAT for the empty level: its fields, its state in every key frame, and zeros elsewhere.

    Of rows it is stored where they differ from it (exclusive or): nearly all levels have the same scenery.
    """
    empty, arrays = arrays_of(empty_level(size, 1), "level/"), {}
    table = table_for(size, encoding)
    for field in table:
        start = empty.get(field.name.replace(KEY, "level/", 1), np.zeros((*field.shape, 1), field.dtype))
        arrays[field.name] = start if field.constant else np.repeat(start[None], field.steps, 0)
    return pack(arrays, table)[FLAT][0]


def size_in(fields: Any, encoding: Encoding) -> Size:
    """The size whose fields, all of them, are these, as a shard's attributes have them.

    Raises:
        ContentsError: they are those of none.
    """
    with suppress(KeyError, IndexError, TypeError):
        shapes = {field["name"]: field["shape"] for field in fields}
        size = Size(*(shapes[name][0] for name in COUNTED))
        fits = all(type(n) is int and low <= n <= MAX_PER_KIND for low, n in zip(FEWEST, size, strict=True))
        if fits and fields == _told(size, encoding):
            return size
    raise ContentsError("its fields are those of no size")


@cache
def _told(size: Size, encoding: Encoding) -> list[dict[str, Any]]:
    """The field table as a shard's attributes have it."""
    return [field.as_json() for field in table_for(size, encoding)]


def check_level_ids(level_ids: Any) -> None:
    """Raises ContentsError where these are not the ascending ids of one or more levels."""
    good = isinstance(level_ids, list) and len(level_ids) > 0 and all(type(x) is int for x in level_ids)
    if not good or level_ids[0] < 0 or level_ids[-1] > MAX_LEVEL_ID or level_ids != sorted(set(level_ids)):
        raise ContentsError("its level ids are not ascending ids of levels")


def check_numbers(arrays: Mapping[str, np.ndarray], size: Size) -> None:
    """Raises ContentsError where a whole number is one that a level or a record of this size cannot have.

    `arrays` have the level axis first.
    """
    for name, most in highest(size).items():
        values = np.moveaxis(arrays[name], 0, -1) if name in arrays else np.zeros(0)
        if not ((values >= 0) & (values <= most)).all():
            raise ContentsError(f"its field {name} has numbers that size {name_of(size)} cannot have")


def highest(size: Size) -> dict[str, np.ndarray | int]:
    """The largest number that may stand in each field of integers; the smallest is 0."""
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
