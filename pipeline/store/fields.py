"""Conversion between nested dataclasses, such as `Level` and `Record`, and flat dictionaries of numpy arrays.

Knows nothing of files. Names are paths: `state/position`, `model/joint_anchor_a`.
"""

import dataclasses
from collections.abc import Mapping
from functools import cache
from typing import Any, TypeVar, get_type_hints

import numpy as np

from levelproof.experts.witness.resume import paths_of

T = TypeVar("T")


def arrays_of(tree: Any, path: str = "") -> dict[str, np.ndarray]:
    """Return every leaf of a nested dataclass of arrays, by its path."""
    return {path + name: np.asarray(leaf) for name, leaf in paths_of(tree).items()}


def tree_of(cls: type[T], arrays: Mapping[str, np.ndarray], path: str = "") -> T:
    """Build a `cls` from the arrays of `arrays_of`; its annotations say which fields are dataclasses."""
    hints = _hints(cls)
    values = {}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        hint, name = hints[field.name], f"{path}{field.name}"
        nested = isinstance(hint, type) and dataclasses.is_dataclass(hint)
        values[field.name] = tree_of(hint, arrays, f"{name}/") if nested else arrays[name]
    return cls(**values)  # type: ignore[return-value]


@cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def same_bits(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether each level (last axis) has the same bits in `a` and `b`; NaN payloads and -0.0 count."""
    if a.shape != b.shape or a.dtype != b.dtype:
        return np.zeros(a.shape[-1], bool)
    raw_a, raw_b = (np.ascontiguousarray(x).view(np.dtype(f"u{x.dtype.itemsize}")) for x in (a, b))
    return (raw_a == raw_b).all(tuple(range(a.ndim - 1)))


def unlike_fields(ours: T, theirs: T) -> dict[int, str]:
    """Return the first field whose bits differ, by index of each level that differs between two trees."""
    others = arrays_of(theirs)
    wrong: dict[int, str] = {}
    for name, values in arrays_of(ours).items():
        for i in np.flatnonzero(~same_bits(values, others[name])):
            wrong.setdefault(int(i), name)
    return wrong
