"""What each elementwise or shape-changing JAX primitive is in LLVM. Strict IEEE: nothing is contracted or reordered,
so that every machine computes the same bits."""

from collections.abc import Callable
from functools import reduce

import numpy as np
from llvmlite import ir

from physics.codegen.values import INDEX, Operand, Value, array, constant, has_lanes, llvm_type, splat
from physics.lanes import LANES

Emit = Callable[..., Operand]
COMPARE = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}


def _call(b: ir.IRBuilder, name: str, *xs: Operand) -> Operand:
    """An LLVM intrinsic on floats."""
    kind = xs[0].type
    suffix = f"v{LANES}f32" if isinstance(kind, ir.VectorType) else "f32"
    function = b.module.globals.get(f"llvm.{name}.{suffix}")
    if function is None:
        function = ir.Function(b.module, ir.FunctionType(kind, [kind] * len(xs)), f"llvm.{name}.{suffix}")
    return b.call(function, xs)


def _is_float(x: Operand) -> bool:
    return isinstance(getattr(x.type, "element", x.type), ir.FloatType)


def _either(name: str) -> Emit:
    """add, sub, mul of floats or integers."""
    return lambda b, x, y: getattr(b, f"f{name}" if _is_float(x) else name)(x, y)


def _extreme(order: str) -> Emit:
    """max or min; NaN if either is, as XLA's."""

    def emit(b, x, y):
        if not _is_float(x):
            return b.select(b.icmp_signed(order, x, y), x, y)
        chosen = b.select(b.fcmp_ordered(order, x, y), x, y)  # y if either is NaN
        return b.select(b.fcmp_unordered("uno", x, x), x, chosen)

    return emit


def _compare(order: str) -> Emit:
    def emit(b, x, y):
        if not _is_float(x):
            return b.icmp_signed(order, x, y)
        return b.fcmp_unordered(order, x, y) if order == "!=" else b.fcmp_ordered(order, x, y)

    return emit


def _sign(b, x):
    one = ir.Constant(x.type, [1.0] * LANES if isinstance(x.type, ir.VectorType) else 1.0)
    return b.select(b.fcmp_unordered("ueq", x, b.fsub(x, x)), x, _call(b, "copysign", one, x))


ELEMENTWISE: dict[str, Emit] = {
    "add": _either("add"),
    "add_any": _either("add"),
    "sub": _either("sub"),
    "mul": _either("mul"),
    "div": lambda b, x, y: b.fdiv(x, y) if _is_float(x) else b.sdiv(x, y),
    "rem": lambda b, x, y: b.srem(x, y),
    "max": _extreme(">"),
    "min": _extreme("<"),
    "neg": lambda b, x: b.fneg(x) if _is_float(x) else b.neg(x),
    "abs": lambda b, x: _call(b, "fabs", x),
    "sign": _sign,
    "sqrt": lambda b, x: _call(b, "sqrt", x),
    "floor": lambda b, x: _call(b, "floor", x),
    "round": lambda b, x: _call(b, "rint", x),
    "square": lambda b, x: b.fmul(x, x),
    "and": lambda b, x, y: b.and_(x, y),
    "or": lambda b, x, y: b.or_(x, y),
    "xor": lambda b, x, y: b.xor(x, y),
    "not": lambda b, x: b.not_(x),
    "select_n": lambda b, which, x, y: b.select(which, y, x),
    "clamp": lambda b, low, x, high: _extreme("<")(b, _extreme(">")(b, x, low), high),
    **{name: _compare(order) for name, order in COMPARE.items()},
}


def elementwise(b: ir.IRBuilder, name: str, operands: list[Value], dtype: str) -> Value:
    """One operation for each element; axes of length 1, and numbers without axes, apply to all."""
    lanes = any(x.lanes for x in operands)
    operands = [with_lanes(b, x) for x in operands] if lanes else operands
    shape = np.broadcast_shapes(*(x.rows.shape for x in operands))
    rows = [np.broadcast_to(x.rows, shape) for x in operands]
    return Value(array(shape, lambda at: ELEMENTWISE[name](b, *(x[at] for x in rows))), dtype, lanes)


def with_lanes(b: ir.IRBuilder, x: Value) -> Value:
    """x, its numbers in every lane: an axis of length 1 becomes the lanes."""
    if x.lanes:
        return x
    rows = x.rows[..., 0] if x.shape else x.rows
    return Value(array(rows.shape, lambda at: splat(b, rows[at])), x.dtype, True)


def convert(b: ir.IRBuilder, x: Value, dtype: str) -> Value:
    if x.dtype == dtype:
        return x
    to = llvm_type(dtype, x.lanes)

    def one(v):
        if dtype == "bool":
            zero = constant(0, x.dtype, x.lanes)
            return b.fcmp_unordered("!=", v, zero) if x.dtype == "float32" else b.icmp_signed("!=", v, zero)
        if dtype == "float32":
            return b.uitofp(v, to) if x.dtype == "bool" else b.sitofp(v, to)
        return b.zext(v, to) if x.dtype == "bool" else b.fptosi(v, to)

    return Value(array(x.rows.shape, lambda at: one(x.rows[at])), dtype, x.lanes)


def broadcast_in_dim(b: ir.IRBuilder, x: Value, shape: tuple[int, ...], dimensions: tuple[int, ...]) -> Value:
    lanes = has_lanes(shape)
    if lanes and not x.lanes:
        along_lanes = bool(dimensions) and dimensions[-1] == len(shape) - 1
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
    return Value(x.rows.reshape(shape[:-1] if x.lanes else shape), x.dtype, x.lanes)


def reduction(b: ir.IRBuilder, name: str, x: Value, axes: tuple[int, ...], dtype: str) -> Value:
    """or, and, max, min, sum over rows, over lanes, or over both."""
    emit = {"reduce_or": "or", "reduce_and": "and", "reduce_max": "max", "reduce_min": "min", "reduce_sum": "add"}[name]
    over_lanes = x.lanes and x.rows.ndim in axes
    along = tuple(axis for axis in axes if axis < x.rows.ndim)
    kept = [axis for axis in range(x.rows.ndim) if axis not in along]
    rows = x.rows.transpose(*kept, *along).reshape([x.rows.shape[axis] for axis in kept] + [-1])
    fold = array(rows.shape[:-1], lambda at: reduce(lambda p, q: ELEMENTWISE[emit](b, p, q), rows[at]))
    if over_lanes:
        fold = array(fold.shape, lambda at: _across(b, emit, fold[at]))
    return Value(fold, dtype, x.lanes and not over_lanes)


def _across(b: ir.IRBuilder, emit: str, x: Operand) -> Operand:
    """One number from the lanes of a vector of bools."""
    if emit not in ("or", "and"):
        raise NotImplementedError(f"reduction {emit} over lanes")
    word = ir.IntType(LANES)
    order, bound = ("!=", 0) if emit == "or" else ("==", -1)
    return b.icmp_unsigned(order, b.bitcast(x, word), word(bound))


def iota(shape: tuple[int, ...], dimension: int, dtype: str) -> Value:
    return Value(array(shape, lambda at: constant(at[dimension], dtype)), dtype, False)


def to_index(b: ir.IRBuilder, x: Operand | int) -> Operand:
    """A number of a row, as 64 bits."""
    return INDEX(x) if isinstance(x, int) else b.sext(x, INDEX)
