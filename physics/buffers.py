"""Buffers with the shapes and dtypes of a type's annotations, such as `motion: Float[Ref, "body 5 lane"]`."""

from typing import Any, TypeVar, get_type_hints

import jax
import jax.numpy as jnp
from jaxtyping import AbstractArray, Bool, Float, Int

from levelproof.physics.codegen.buffers import Buffer
from levelproof.physics.pairs import GROUPS, KINDS, pairs_of
from levelproof.physics.types import MAX_VERTICES, Size

T = TypeVar("T")
DTYPES: dict[Any, str] = {Float: "float32", Int: "int32", Bool: "bool"}
LANE = "lane"  # last axis of arrays that differ between lanes


def axes_of(size: Size) -> dict[str, int]:
    """Return the length of every axis that annotations name, except the lanes."""
    pairs = pairs_of(size)
    return {
        "body": size.bodies,
        "polygon": size.polygons,
        "vertex": MAX_VERTICES,
        "circle": size.circles,
        "joint": size.joints,
        "thruster": size.thrusters,
        "contact": pairs.contacts,
        "kind": KINDS,
        "group": GROUPS,
        "listing": sum(len(kind) * kind.batches for kind in pairs.by_group)
        + 1,  # one spare element: `contact.assign_batches` writes past the last
        "boundary": sum(kind.batches for kind in pairs.by_group) + 1,
    }


def buffers_of(cls: type[T], size: Size) -> T:
    """Return a `cls`, a (nested) NamedTuple or dataclass of annotated arrays, with a Buffer for each array."""
    axes = axes_of(size)

    def buffer(hint: Any) -> Any:
        if not issubclass(hint, AbstractArray):
            return buffers_of(hint, size)
        names = hint.dim_str.split()
        lanes = names[-1] == LANE
        shape = tuple(int(name) if name.isdigit() else axes[name] for name in (names[:-1] if lanes else names))
        return Buffer(shape, DTYPES[hint.dtype], lanes)

    return cls(**{name: buffer(hint) for name, hint in get_type_hints(cls).items()})


def buffers_like(arrays: Any) -> Any:
    """Return a Buffer for each array of a tree whose arrays all have lanes."""
    return jax.tree.map(lambda x: Buffer(x.shape[:-1], str(x.dtype)), arrays)


def zeros_of(cls: type[T], size: Size, lanes: int) -> T:
    """Return a `cls` as `buffers_of` does, with an array of zeros in place of each Buffer."""
    return jax.tree.map(lambda buffer: jnp.zeros_like(buffer.array(lanes)), buffers_of(cls, size))
