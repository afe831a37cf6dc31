"""Shapes of the arrays that a kernel reads, writes and uses as scratch memory."""

import math
from dataclasses import dataclass

import jax

LANES = 16  # of a block: as many float32 as the widest vector register holds
ALIGNMENT = 64  # bytes: a cache line, and the widest vector
BYTES = {"float32": 4, "int32": 4, "bool": 1}


@dataclass(frozen=True)
class Buffer:
    """Shape and dtype of an array. It is a leaf to JAX's trees, so it can stand in for an array or a reference."""

    shape: tuple[int, ...]  # without the lanes
    dtype: str = "float32"
    lanes: bool = True

    def array(self, lanes: int = LANES) -> jax.ShapeDtypeStruct:
        """Return the array's shape and dtype for a number of lanes."""
        return jax.ShapeDtypeStruct((*self.shape, lanes) if self.lanes else self.shape, self.dtype)

    @property
    def bytes(self) -> int:
        """Size for one block of lanes, in whole cache lines."""
        count = math.prod(self.shape) * (LANES if self.lanes else 1)
        return -(-count * BYTES[self.dtype] // ALIGNMENT) * ALIGNMENT
