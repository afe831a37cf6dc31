"""Conversion between named arrays and a shard's packed arrays, preserving every bit; knows nothing of files."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from levelproof.experts.config import RECORD_STEPS
from levelproof.pipeline.store.formats import ALONG_TIME, FLAT, PACKED, FieldSpec


def pack(arrays: Mapping[str, np.ndarray], table: Sequence[FieldSpec]) -> dict[str, np.ndarray]:
    """Pack arrays: (level, component, 256) for what changes along time, else (level, component); FLAT (level, byte).

    `arrays` have the level axis last, and time first except in `level/` fields.

    Raises:
        ValueError: a small integer field holds a value that does not fit 8 bits.
    """
    parts: dict[str, list[np.ndarray]] = {name: [] for name in PACKED}
    levels = next(iter(arrays.values())).shape[-1]
    for field in table:
        values = np.moveaxis(_unsigned(arrays[field.name], field), -1, 0)
        if not field.constant:
            values = np.moveaxis(values, 1, -1)
        if field.array == FLAT:
            values = np.ascontiguousarray(values.reshape(levels, field.count * field.steps)).view(np.uint8)
        shape = (field.count, RECORD_STEPS) if field.array in ALONG_TIME else (field.extent,)
        parts[field.array].append(values.reshape(levels, *shape))
    return {name: np.ascontiguousarray(np.concatenate(part, 1)) for name, part in parts.items() if part}


def empty(table: Iterable[FieldSpec], names: Iterable[str], levels: int) -> dict[str, np.ndarray]:
    """Allocate these packed arrays for `levels` levels."""
    extents = {name: sum(field.extent for field in table if field.array == name) for name in names}
    return {
        name: np.empty((levels, extent, *((RECORD_STEPS,) if name in ALONG_TIME else ())), f"u{PACKED[name] // 8}")
        for name, extent in extents.items()
    }


def unpack(packed: Mapping[str, np.ndarray], table: Sequence[FieldSpec]) -> dict[str, np.ndarray]:
    """Unpack the fields of the arrays in `packed`, with axes in the order level, time, others.

    Fields that are stored with their own number of bits are views.

    Raises:
        ValueError: a flag is neither 0 nor 1.
    """
    arrays = {}
    for field in table:
        if field.array not in packed:
            continue
        part = packed[field.array][:, field.first : field.first + field.extent]
        if field.array == FLAT:
            part = np.ascontiguousarray(part).view(f"u{field.bits // 8}")
        if field.constant:
            part = part.reshape(len(part), *field.shape)
        else:
            part = part.reshape(len(part), *field.shape, field.steps)
            part = part.transpose(0, -1, *range(1, part.ndim - 1))
        arrays[field.name] = _original(part, field)
    return arrays


def _unsigned(values: np.ndarray, field: FieldSpec) -> np.ndarray:
    """View values as unsigned integers of the same bits; narrow small integers to 8 bits."""
    if values.dtype.itemsize * 8 == field.bits:
        return np.ascontiguousarray(values).view(f"u{field.bits // 8}")
    if values.size and not (values.min() >= 0 and values.max() < 2**field.bits):
        raise ValueError(f"{field.name} has values from {values.min()} to {values.max()}: they do not fit 8 bits")
    return values.astype(f"u{field.bits // 8}")


def _original(values: np.ndarray, field: FieldSpec) -> np.ndarray:
    dtype = np.dtype(field.dtype)
    if dtype.kind == "b" and values.size and values.max() > 1:  # undefined as a bool in numpy, XLA and kernels
        raise ValueError(f"{field.name} has flags that are neither 0 nor 1")
    return values.view(dtype) if dtype.itemsize == values.dtype.itemsize else values.astype(dtype)
