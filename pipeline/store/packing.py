"""Between named arrays and the packed arrays of a shard; every bit comes back. Knows nothing of files."""

from collections.abc import Mapping, Sequence

import numpy as np

from experts.config import RECORD_STEPS
from pipeline.store.schema import ALONG_TIME, PACKED, FieldPlace


def pack(arrays: Mapping[str, np.ndarray], table: Sequence[FieldPlace]) -> dict[str, np.ndarray]:
    """Packed arrays: (level, component, 256) for what changes along time, (level, component) for the rest.

    `arrays` have the level axis last, and time first for `record/` fields.

    Raises:
        ValueError: a small integer field holds a value that does not fit 8 bits.
    """
    parts: dict[str, list[np.ndarray]] = {name: [] for name in PACKED}
    levels = next(iter(arrays.values())).shape[-1]
    for place in table:
        values = _unsigned(arrays[place.name], place)
        if place.array in ALONG_TIME:
            parts[place.array].append(np.moveaxis(values, (-1, 0), (0, -1)).reshape(levels, place.count, RECORD_STEPS))
        else:
            parts[place.array].append(np.moveaxis(values, -1, 0).reshape(levels, place.count))
    return {name: np.ascontiguousarray(np.concatenate(part, 1)) for name, part in parts.items() if part}


def unpack(packed: Mapping[str, np.ndarray], table: Sequence[FieldPlace]) -> dict[str, np.ndarray]:
    """The inverse of `pack`, with the arrays that `packed` has.

    Raises:
        ValueError: a flag is neither 0 nor 1.
    """
    arrays = {}
    for place in table:
        if place.array not in packed:
            continue
        part = packed[place.array][:, place.first : place.first + place.count]
        if place.array in ALONG_TIME:
            shaped = np.moveaxis(part.reshape(len(part), *place.shape, RECORD_STEPS), (0, -1), (-1, 0))
        else:
            shaped = np.moveaxis(part.reshape(len(part), *place.shape), 0, -1)
        arrays[place.name] = _original(np.ascontiguousarray(shaped), place)
    return arrays


def _unsigned(values: np.ndarray, place: FieldPlace) -> np.ndarray:
    """The same bits as unsigned integers; small integers as 8 bits."""
    bits = PACKED[place.array]
    if values.dtype.itemsize * 8 == bits:
        return np.ascontiguousarray(values).view(f"u{bits // 8}")
    if values.size and not (values.min() >= 0 and values.max() < 2**bits):
        raise ValueError(f"{place.name} has values from {values.min()} to {values.max()}: they do not fit {bits} bits")
    return values.astype(f"u{bits // 8}")


def _original(values: np.ndarray, place: FieldPlace) -> np.ndarray:
    dtype = np.dtype(place.dtype)
    if dtype.kind == "b" and values.size and values.max() > 1:  # no bool for numpy, XLA and kernels
        raise ValueError(f"{place.name} has flags that are neither 0 nor 1")
    return values.view(dtype) if dtype.itemsize == values.dtype.itemsize else values.astype(dtype)
