"""JAX's elementwise and shape-changing primitives in LLVM.

Strict IEEE: nothing is contracted or reordered, so that every machine computes the same bits.
"""

from collections.abc import Callable
from functools import reduce

import numpy as np
from llvmlite import ir

from levelproof.physics.codegen.buffers import LANES
from levelproof.physics.codegen.values import Operand, Splat, Value, array, constant, has_lanes, llvm_type, vector

Emit = Callable[..., Operand]
FLOAT, INT, BOOL = "float32", "int32", "bool"
COMPARE = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}


def _call(name: str) -> Emit:
    """Return a function that emits a call of an LLVM intrinsic from floats to a float."""

    def emit(b, *xs):
        kind = xs[0].type
        full_name = f"llvm.{name}.{f'v{LANES}' if isinstance(kind, ir.VectorType) else ''}f32"
        function = b.module.globals.get(full_name)
        if function is None:
            function = ir.Function(b.module, ir.FunctionType(kind, [x.type for x in xs]), full_name)
        return b.call(function, xs)

    return emit


def _number(x: Operand, number: float) -> ir.Constant:
    """Return a constant of the type of x."""
    lanes = isinstance(x.type, ir.VectorType)
    scalar = ir.Constant(x.type.element if lanes else x.type, number)
    return Splat(scalar) if lanes else scalar


def _extreme(order: str) -> Emit:
    """Return a function that emits max or min of floats: as in XLA, NaN if either is NaN; y if both are zeros."""

    def emit(b, x, y):
        chosen = b.select(b.fcmp_ordered(order, x, y), x, y)  # y if either is NaN
        return b.select(b.fcmp_unordered("uno", x, x), x, chosen)

    return emit


def _extreme_int(order: str) -> Emit:
    return lambda b, x, y: b.select(b.icmp_signed(order, x, y), x, y)


def _compare(order: str) -> dict[str, Emit]:
    float_compare = "fcmp_unordered" if order == "!=" else "fcmp_ordered"
    return {
        FLOAT: lambda b, x, y: getattr(b, float_compare)(order, x, y),
        INT: lambda b, x, y: b.icmp_signed(order, x, y),
        BOOL: lambda b, x, y: b.icmp_unsigned(order, x, y),  # a signed True would be -1
    }


def _sign(b, x):
    return b.select(b.fcmp_unordered("==", x, _number(x, 0.0)), x, _call("copysign")(b, _number(x, 1.0), x))


def _select(b, condition, x, y):
    return b.select(condition, y, x)


def _shift(name: str) -> dict[str, Emit]:
    """Return what emits shifts by a constant of 0 to 31, by dtype: LLVM leaves longer shifts undefined."""

    def emit(b, x, y):
        if not isinstance(y, ir.Constant) or not 0 <= y.constant < 32:
            raise NotImplementedError("a kernel only shifts by a constant from 0 to 31")
        return getattr(b, name)(x, y)

    return {INT: emit}


def _bits(name: str) -> dict[str, Emit]:
    return dict.fromkeys((INT, BOOL), lambda b, *xs: getattr(b, name)(*xs))


# By the dtype of the last operand
ELEMENTWISE: dict[str, dict[str, Emit]] = {
    "add": {FLOAT: lambda b, x, y: b.fadd(x, y), INT: lambda b, x, y: b.add(x, y)},
    "sub": {FLOAT: lambda b, x, y: b.fsub(x, y), INT: lambda b, x, y: b.sub(x, y)},
    "mul": {FLOAT: lambda b, x, y: b.fmul(x, y), INT: lambda b, x, y: b.mul(x, y)},
    "div": {FLOAT: lambda b, x, y: b.fdiv(x, y)},
    "max": {FLOAT: _extreme(">"), INT: _extreme_int(">"), BOOL: lambda b, x, y: b.or_(x, y)},
    "min": {FLOAT: _extreme("<"), INT: _extreme_int("<"), BOOL: lambda b, x, y: b.and_(x, y)},
    "neg": {FLOAT: lambda b, x: b.fneg(x), INT: lambda b, x: b.neg(x)},
    "abs": {FLOAT: _call("fabs")},
    "sign": {FLOAT: _sign},
    "sqrt": {FLOAT: _call("sqrt")},
    "floor": {FLOAT: _call("floor")},
    "round": {FLOAT: _call("rint")},
    "square": {FLOAT: lambda b, x: b.fmul(x, x), INT: lambda b, x: b.mul(x, x)},
    "and": _bits("and_"),
    "or": _bits("or_"),
    "xor": _bits("xor"),
    "not": _bits("not_"),
    "shift_left": _shift("shl"),
    "shift_right_logical": _shift("lshr"),
    "select_n": dict.fromkeys((FLOAT, INT, BOOL), _select),
    **{name: _compare(order) for name, order in COMPARE.items()},
}


def combine(b: ir.IRBuilder, name: str, dtype: str, *xs: Operand) -> Operand:
    """Emit one elementwise operation on operands of a dtype."""
    if dtype not in ELEMENTWISE[name]:
        raise NotImplementedError(f"a kernel cannot use the primitive {name} of {dtype}")
    return ELEMENTWISE[name][dtype](b, *xs)


def elementwise(b: ir.IRBuilder, name: str, operands: list[Value], dtype: str) -> Value:
    """Emit one operation for each element; axes of length 1 and scalars broadcast."""
    if name == "select_n" and operands[0].dtype != BOOL:
        raise NotImplementedError(f"a kernel cannot use the primitive select_n by {operands[0].dtype}")
    lanes = any(x.lanes for x in operands)
    operand_dtype = operands[-1].dtype  # of select_n, the cases, not the selector
    operands = [with_lanes(b, x) for x in operands] if lanes else operands
    shape = np.broadcast_shapes(*(x.rows.shape for x in operands))
    rows = [np.broadcast_to(x.rows, shape) for x in operands]
    return Value(array(shape, lambda at: combine(b, name, operand_dtype, *(x[at] for x in rows))), dtype, lanes)


def with_lanes(b: ir.IRBuilder, x: Value) -> Value:
    """Give x lanes as its last axis; a scalar is copied to every lane."""
    if x.lanes:
        return x
    rows = x.rows if x.shape else x.rows[None]
    return Value(array(rows.shape[:-1], lambda at: vector(b, list(rows[at]))), x.dtype, True)


def convert(b: ir.IRBuilder, x: Value, dtype: str) -> Value:
    """Convert between dtypes: exactly, to the nearest float, or towards zero to an integer within its range."""
    if x.dtype == dtype:
        return x
    if dtype == FLOAT:
        emit = b.uitofp if x.dtype == BOOL else b.sitofp
    elif dtype == INT:
        emit = b.zext if x.dtype == BOOL else _truncate(b)
    else:
        raise NotImplementedError(f"a kernel cannot convert {x.dtype} to {dtype}")
    return _each(x, dtype, emit)


def bitcast(b: ir.IRBuilder, x: Value, dtype: str) -> Value:
    """Read the bits of 32-bit numbers as another dtype's. JAX allows it between dtypes of one width only."""
    return _each(x, dtype, b.bitcast)


def integer_pow(b: ir.IRBuilder, x: Value, exponent: int) -> Value:
    """Multiply x with itself, in the order in which XLA does."""
    if exponent < 1 or x.dtype != FLOAT:
        raise NotImplementedError(f"a kernel cannot raise {x.dtype} to the power of {exponent}")

    def power(factor: Operand) -> Operand:
        total, rest = None, exponent
        while True:
            if rest % 2:
                total = factor if total is None else b.fmul(total, factor)
            rest //= 2
            if not rest:
                return total
            factor = b.fmul(factor, factor)

    return Value(array(x.rows.shape, lambda at: power(x.rows[at])), x.dtype, x.lanes)


def _each(x: Value, dtype: str, emit: Emit) -> Value:
    """Emit a cast of every element."""
    kind = llvm_type(dtype, x.lanes)
    return Value(array(x.rows.shape, lambda at: emit(x.rows[at], kind)), dtype, x.lanes)


def _truncate(b: ir.IRBuilder) -> Emit:
    """Return a function that converts floats to integers as XLA does: towards zero, NaN to 0, saturating."""

    def emit(x: Operand, kind: ir.Type) -> Operand:
        width = f"v{LANES}" if isinstance(kind, ir.VectorType) else ""
        full_name = f"llvm.fptosi.sat.{width}i32.{width}f32"
        function = b.module.globals.get(full_name)
        if function is None:
            function = ir.Function(b.module, ir.FunctionType(kind, [x.type]), full_name)
        return b.call(function, [x])

    return emit


def broadcast_in_dim(b: ir.IRBuilder, x: Value, shape: tuple[int, ...], dimensions: tuple[int, ...]) -> Value:
    lanes, along_lanes = has_lanes(shape), bool(dimensions) and dimensions[-1] == len(shape) - 1
    if x.lanes and not (lanes and along_lanes):
        raise NotImplementedError("a kernel cannot broadcast lanes to another axis than the last")
    if lanes and not x.lanes:
        dimensions = dimensions[:-1] if along_lanes else dimensions
        x = with_lanes(b, x if along_lanes else reshape(x, (*x.shape, 1)))
    elif lanes:
        dimensions = dimensions[:-1]
    target = shape[:-1] if lanes else shape
    expanded = [1] * len(target)
    for axis, size in zip(dimensions, x.rows.shape, strict=True):
        expanded[axis] = size
    return Value(np.broadcast_to(x.rows.reshape(expanded), target), x.dtype, lanes)


def reshape(x: Value, shape: tuple[int, ...]) -> Value:
    if x.lanes and not has_lanes(shape):
        raise NotImplementedError("a kernel cannot reshape its lanes")
    return Value(x.rows.reshape(shape[:-1] if x.lanes else shape), x.dtype, x.lanes)


def reduction(b: ir.IRBuilder, name: str, x: Value, axes: tuple[int, ...], dtype: str) -> Value:
    """Reduce by or, and, max or min over rows, lanes or both."""
    emit = name.removeprefix("reduce_")
    over_lanes = x.lanes and x.rows.ndim in axes
    along = tuple(axis for axis in axes if axis < x.rows.ndim)
    kept = [axis for axis in range(x.rows.ndim) if axis not in along]
    rows = x.rows.transpose(*kept, *along).reshape([x.rows.shape[axis] for axis in kept] + [-1])
    fold = array(rows.shape[:-1], lambda at: reduce(lambda p, q: combine(b, emit, x.dtype, p, q), rows[at]))
    if over_lanes:
        fold = array(fold.shape, lambda at: _across(b, name, x.dtype, fold[at]))
    return Value(fold, dtype, x.lanes and not over_lanes)


def _across(b: ir.IRBuilder, name: str, dtype: str, x: Operand) -> Operand:
    """Reduce the lanes of a vector of bools to one bool."""
    if dtype != BOOL:
        raise NotImplementedError(f"a kernel cannot use the primitive {name} of {dtype} over lanes")
    word = ir.IntType(LANES)
    order, bound = ("!=", 0) if name in ("reduce_or", "reduce_max") else ("==", -1)
    return b.icmp_unsigned(order, b.bitcast(x, word), word(bound))


def iota(shape: tuple[int, ...], dimension: int, dtype: str) -> Value:
    return Value(array(shape, lambda at: constant(at[dimension], dtype)), dtype, False)
