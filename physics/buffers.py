"""Buffers with the shapes and dtypes that a type's annotations say, `motion: Float[Ref, "body 5 lane"]`."""

from collections.abc import Mapping
from typing import Any, TypeVar, get_type_hints

import jax
from jaxtyping import AbstractArray, Bool, Float, Int

from physics.codegen.buffers import Buffer

T = TypeVar("T")
DTYPES: dict[Any, str] = {Float: "float32", Int: "int32", Bool: "bool"}
LANE = "lane"  # the last axis of what differs between lanes


def buffers_of(cls: type[T], axes: Mapping[str, int]) -> T:
    """A `cls`, and whatever types are in it, with a Buffer for each array.

    Args:
        cls: a NamedTuple or dataclass of annotated arrays, or of such types.
        axes: length of each axis that an annotation names.
    """
    return cls(**{name: _buffer(hint, axes) for name, hint in get_type_hints(cls).items()})


def _buffer(hint: Any, axes: Mapping[str, int]) -> Any:
    if not issubclass(hint, AbstractArray):
        return buffers_of(hint, axes)
    names = hint.dim_str.split()
    lanes = names[-1] == LANE
    shape = tuple(int(name) if name.isdigit() else axes[name] for name in (names[:-1] if lanes else names))
    return Buffer(shape, DTYPES[hint.dtype], lanes)


def buffers_like(arrays: Any) -> Any:
    """The buffers of a tree of arrays that have lanes."""
    return jax.tree.map(lambda x: Buffer(x.shape[:-1], str(x.dtype)), arrays)
