"""Between named arrays and the packed arrays of a shard; every bit comes back. Knows nothing of files."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from experts.config import RECORD_STEPS
from physics.types import Size
from pipeline.store.contents import table_for
from pipeline.store.schema import ALONG_TIME, PACKED, FieldSpec


def pack(arrays: Mapping[str, np.ndarray], table: Sequence[FieldSpec]) -> dict[str, np.ndarray]:
    """Packed arrays: (level, component, 256) for what changes along time, (level, component) for the rest.

    `arrays` have the level axis last, and time first for `record/` fields.

    Raises:
        ValueError: a small integer field holds a value that does not fit 8 bits.
    """
    parts: dict[str, list[np.ndarray]] = {name: [] for name in PACKED}
    levels = next(iter(arrays.values())).shape[-1]
    for field in table:
        values = _unsigned(arrays[field.name], field)
        if field.array in ALONG_TIME:
            parts[field.array].append(np.moveaxis(values, (-1, 0), (0, -1)).reshape(levels, field.count, RECORD_STEPS))
        else:
            parts[field.array].append(np.moveaxis(values, -1, 0).reshape(levels, field.count))
    return {name: np.ascontiguousarray(np.concatenate(part, 1)) for name, part in parts.items() if part}


def empty(size: Size, names: Iterable[str], levels: int) -> dict[str, np.ndarray]:
    """Room for these packed arrays of so many levels."""
    components = {name: sum(field.count for field in table_for(size) if field.array == name) for name in names}
    return {
        name: np.empty((levels, count, *((RECORD_STEPS,) if name in ALONG_TIME else ())), f"u{PACKED[name] // 8}")
        for name, count in components.items()
    }


def unpack(packed: Mapping[str, np.ndarray], table: Sequence[FieldSpec]) -> dict[str, np.ndarray]:
    """The inverse of `pack`, with the arrays that `packed` has, but for the order of axes: level first, then time.

    These are views where types have as many bits as they are stored with.

    Raises:
        ValueError: a flag is neither 0 nor 1.
    """
    arrays = {}
    for field in table:
        if field.array not in packed:
            continue
        part = packed[field.array][:, field.first : field.first + field.count]
        if field.array in ALONG_TIME:
            part = np.moveaxis(part.reshape(len(part), *field.shape, RECORD_STEPS), -1, 1)
        else:
            part = part.reshape(len(part), *field.shape)
        arrays[field.name] = _original(part, field)
    return arrays


def _unsigned(values: np.ndarray, field: FieldSpec) -> np.ndarray:
    """The same bits as unsigned integers; small integers as 8 bits."""
    bits = PACKED[field.array]
    if values.dtype.itemsize * 8 == bits:
        return np.ascontiguousarray(values).view(f"u{bits // 8}")
    if values.size and not (values.min() >= 0 and values.max() < 2**bits):
        raise ValueError(f"{field.name} has values from {values.min()} to {values.max()}: they do not fit {bits} bits")
    return values.astype(f"u{bits // 8}")


def _original(values: np.ndarray, field: FieldSpec) -> np.ndarray:
    dtype = np.dtype(field.dtype)
    if dtype.kind == "b" and values.size and values.max() > 1:  # no bool for numpy, XLA and kernels
        raise ValueError(f"{field.name} has flags that are neither 0 nor 1")
    return values.view(dtype) if dtype.itemsize == values.dtype.itemsize else values.astype(dtype)
