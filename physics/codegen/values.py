"""Arrays of a kernel as LLVM values: one vector for each row of lanes, one scalar for each element without lanes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir

from levelproof.physics.codegen.buffers import LANES

Operand = Any  # an LLVM value; llvmlite's own class declares no `type`
INDEX = ir.IntType(64)
ELEMENT = {"float32": ir.FloatType(), "int32": ir.IntType(32), "bool": ir.IntType(1)}  # in registers
STORED = {**ELEMENT, "bool": ir.IntType(8)}  # in memory


def has_lanes(shape: tuple[int, ...]) -> bool:
    return bool(shape) and shape[-1] == LANES


@dataclass(frozen=True)
class Value:
    """An array: `rows` is an object array of LLVM values, each a vector of lanes if `lanes`, else a scalar."""

    rows: np.ndarray
    dtype: str
    lanes: bool

    @property
    def shape(self) -> tuple[int, ...]:
        return (*self.rows.shape, LANES) if self.lanes else self.rows.shape


def llvm_type(dtype: str, lanes: bool) -> ir.Type:
    if dtype not in ELEMENT:
        raise NotImplementedError(f"a kernel cannot use numbers of type {dtype}")
    element = ELEMENT[dtype]
    return ir.VectorType(element, LANES) if lanes else element


class Splat(ir.Constant):
    """A constant with one number in all lanes; llvmlite's own would write that number LANES times."""

    def __init__(self, number: ir.Constant) -> None:
        self.type, self.constant, self.number = ir.VectorType(number.type, LANES), number.constant, number

    def _get_reference(self) -> str:
        return f"splat ({self.number})"


def constant(x, dtype: str) -> ir.Constant:
    """Return a constant number."""
    return ir.Constant(llvm_type(dtype, False), float(x) if dtype == "float32" else int(x))


def vector(builder: ir.IRBuilder, numbers: Sequence[Operand]) -> Operand:
    """Emit a vector of lanes from scalars: one for all lanes, or one each."""
    if len(numbers) == 1 and isinstance(numbers[0], ir.Constant):
        return Splat(numbers[0])
    index = ir.IntType(32)
    undefined = Splat(ir.Constant(numbers[0].type, ir.Undefined))
    filled = undefined
    for lane, number in enumerate(numbers):
        filled = builder.insert_element(filled, number, ir.Constant(index, lane))
    if len(numbers) == LANES:
        return filled
    return builder.shuffle_vector(filled, undefined, ir.Constant(ir.VectorType(index, LANES), [0] * LANES))


def array(shape: tuple[int, ...], fill) -> np.ndarray:
    """Return an object array whose elements are `fill(index)`."""
    out = np.empty(shape, object)
    for index in np.ndindex(*shape):
        out[index] = fill(index)
    return out
