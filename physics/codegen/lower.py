"""Lower a kernel's jaxpr to an LLVM function.

Straight-line code becomes vector operations; `fori_loop`, `while_loop` and `cond` become branches; reads and writes
of references become loads and stores.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.extend import core
from jax.lax import RoundingMethod
from llvmlite import ir

from levelproof.physics.codegen import primitives
from levelproof.physics.codegen.buffers import BYTES, LANES
from levelproof.physics.codegen.values import INDEX, STORED, Operand, Value, array, constant, has_lanes, llvm_type


@dataclass(frozen=True)
class Memory:
    """Memory behind a reference: rows `stride` elements apart, whose first LANES elements are this block's."""

    pointer: Operand
    shape: tuple[int, ...]  # without the lanes
    dtype: str
    lanes: bool
    stride: Operand | int  # elements from row to row

    def at(self, b: ir.IRBuilder, index: Sequence) -> Operand:
        """Emit the address of a row."""
        known, step, row = 0, 1, None  # the row's index is the constant `known` plus `row`, known only at run time
        for number, size in reversed([*zip(index, self.shape, strict=True)]):
            if isinstance(number, int):
                known += number * step
            else:
                part = b.mul(b.sext(number, INDEX), INDEX(step))
                row = part if row is None else b.add(row, part)
            step *= size
        stride = INDEX(self.stride) if isinstance(self.stride, int) else self.stride
        if row is None and isinstance(self.stride, int):
            offset = INDEX(known * self.stride)
        else:
            row = INDEX(known) if row is None else b.add(row, INDEX(known)) if known else row
            offset = b.mul(row, stride)
        return b.gep(self.pointer, [offset], source_etype=STORED[self.dtype])


def lower(b: ir.IRBuilder, jaxpr: core.ClosedJaxpr, arguments: Sequence[Value | Memory]) -> list[Value]:
    """Emit a jaxpr; return its results."""
    known: dict[Any, Any] = dict(zip(jaxpr.jaxpr.invars, arguments, strict=True))
    for variable, x in zip(jaxpr.jaxpr.constvars, jaxpr.consts, strict=True):
        known[variable] = _fit_lanes(b, _constants(np.asarray(x)), variable.aval)

    def read(x):
        if not isinstance(x, core.Literal):
            return known[x]
        aval: Any = x.aval
        return _constants(np.asarray(x.val, aval.dtype))

    for equation in jaxpr.jaxpr.eqns:
        results = _equation(b, equation, [read(x) for x in equation.invars])
        for x, result in zip(equation.outvars, results, strict=True):
            known[x] = _fit_lanes(b, result, x.aval)
    return [read(x) for x in jaxpr.jaxpr.outvars]


def _constants(x: np.ndarray) -> Value:
    """Turn an array into constants of the kernel."""
    dtype = str(x.dtype)
    return Value(array(x.shape, lambda at: constant(x[at], dtype)), dtype, False)


def _fit_lanes(b: ir.IRBuilder, x: Value | Memory, aval: Any) -> Value | Memory:
    """Give x lanes if its shape in the jaxpr ends in them."""
    return primitives.with_lanes(b, x) if isinstance(x, Value) and has_lanes(aval.shape) else x


def _equation(b: ir.IRBuilder, equation: core.JaxprEqn, operands: list) -> list:
    """Emit one equation; return its results."""
    name, params = equation.primitive.name, equation.params
    out: Any = equation.outvars[0].aval if equation.outvars else None
    if name == "round" and params["rounding_method"] != RoundingMethod.TO_NEAREST_EVEN:
        raise NotImplementedError("a kernel only rounds halves to even")
    if name in primitives.ELEMENTWISE:
        return [primitives.elementwise(b, name, operands, str(out.dtype))]
    if name in CONTROL:
        return CONTROL[name](b, equation, operands)
    match name:
        case "get":
            return [_read(b, *_indexed(params, operands))]
        case "swap":
            return [_swap(b, params, operands)]
        case "convert_element_type":
            return [primitives.convert(b, operands[0], str(params["new_dtype"]))]
        case "bitcast_convert_type":
            return [primitives.bitcast(b, operands[0], str(params["new_dtype"]))]
        case "integer_pow":
            return [primitives.integer_pow(b, operands[0], params["y"])]
        case "broadcast_in_dim":
            return [primitives.broadcast_in_dim(b, operands[0], params["shape"], params["broadcast_dimensions"])]
        case "reshape" | "squeeze":
            return [primitives.reshape(operands[0], out.shape)]
        case "slice":
            return [_slice(operands[0], params)]
        case "concatenate":
            return [_join(b, np.concatenate, operands, params["dimension"])]
        case "stack":
            return [_join(b, np.stack, operands, params["axis"])]
        case "reduce_or" | "reduce_and" | "reduce_max" | "reduce_min":
            return [primitives.reduction(b, name, operands[0], params["axes"], str(out.dtype))]
        case "iota":
            return [primitives.iota(params["shape"], params["dimension"], str(params["dtype"]))]
        case "new_ref" if isinstance(operands[0], Memory):  # a reference to an argument is the argument itself
            return operands
    raise NotImplementedError(f"a kernel cannot use the primitive {name}")


def _join(b: ir.IRBuilder, how: Callable, operands: list[Value], axis: int) -> Value:
    pieces = [primitives.with_lanes(b, x) for x in operands] if any(x.lanes for x in operands) else operands
    return Value(how([x.rows for x in pieces], axis=axis), pieces[0].dtype, pieces[0].lanes)


def _slice(x: Value, params: dict) -> Value:
    steps = params["strides"] or [1] * len(params["start_indices"])
    cut = tuple(map(slice, params["start_indices"], params["limit_indices"], steps))
    if x.lanes and len(range(LANES)[cut[-1]]) != LANES:
        raise NotImplementedError("a kernel cannot slice its lanes")
    return Value(x.rows[cut[: x.rows.ndim]], x.dtype, x.lanes)


def _indexed(params: dict, operands: list, first: int = 1) -> tuple[Memory, list]:
    """Return the memory behind a reference and, for each axis except the lanes, the selected row indices."""
    memory = operands[0]
    transforms = jax.tree.unflatten(params["tree"], operands[first:])
    if not transforms:
        return memory, [list(range(size)) for size in memory.shape]
    if len(transforms) > 1:
        raise NotImplementedError("a kernel cannot index a reference to part of a reference")
    shape = (*memory.shape, LANES) if memory.lanes else memory.shape
    axes = [_axis(index, size) for index, size in zip(transforms[0].indices, shape, strict=True)]
    if memory.lanes and axes.pop() != list(range(LANES)):
        raise NotImplementedError("a kernel cannot index its lanes")
    return memory, axes


def _axis(index: Any, size: int) -> list[int] | Operand | int:
    """Return the row indices along one axis: a list, or a single index, which may be known only at run time."""
    if hasattr(index, "stride") and isinstance(index.start, int):
        return [index.start + i * index.stride for i in range(index.size)]
    if isinstance(index, Value) and not index.shape:
        number = index.rows[()]
        if not isinstance(number, ir.Constant):
            return number  # must be within 0 .. size - 1 at run time; nothing checks it
        index = number.constant
    if isinstance(index, int) and -size <= index < size:
        return index % size
    raise NotImplementedError(f"a kernel cannot index {size} rows by {index}")


def _rows(axes: list) -> tuple[tuple[int, ...], Callable[[tuple], list]]:
    """Return the shape that is read or written, and a function from a position in it to a row's indices."""
    shape = tuple(len(axis) for axis in axes if isinstance(axis, list))

    def address(at):
        numbers = iter(at)
        return [axis[next(numbers)] if isinstance(axis, list) else axis for axis in axes]

    return shape, address


def _read(b: ir.IRBuilder, memory: Memory, axes: list) -> Value:
    shape, address = _rows(axes)
    return Value(array(shape, lambda at: _load(b, memory, address(at))), memory.dtype, memory.lanes)


def _load(b: ir.IRBuilder, memory: Memory, index: list) -> Operand:
    kind = STORED[memory.dtype]
    kind = ir.VectorType(kind, LANES) if memory.lanes else kind
    x = b.load(memory.at(b, index), align=BYTES[memory.dtype], typ=kind)
    return b.trunc(x, llvm_type("bool", memory.lanes)) if memory.dtype == "bool" else x


def _store(b: ir.IRBuilder, memory: Memory, index: list, x: Operand) -> None:
    if memory.dtype == "bool":
        kind = STORED["bool"]
        x = b.zext(x, ir.VectorType(kind, LANES) if memory.lanes else kind)
    b.store(x, memory.at(b, index), align=BYTES[memory.dtype])


def _swap(b: ir.IRBuilder, params: dict, operands: list) -> Value:
    """Emit a write; return the previous contents."""
    memory, axes = _indexed(params, operands, 2)
    before = _read(b, memory, axes)
    shape, address = _rows(axes)
    x = primitives.with_lanes(b, operands[1]) if memory.lanes else operands[1]
    if x.lanes != memory.lanes:
        raise NotImplementedError(f"a kernel writes arrays without lanes only element by element, not {LANES} at once")
    rows = np.broadcast_to(x.rows, shape)
    for at in np.ndindex(*shape):
        _store(b, memory, address(at), rows[at])
    return before


def _flat(values: Sequence[Value]) -> list[Operand]:
    return [x for value in values for x in value.rows.reshape(-1)]


def _unflat(like: Sequence[Value], flat: Sequence[Operand]) -> list[Value]:
    rest = iter(flat)
    return [Value(array(v.rows.shape, lambda _: next(rest)), v.dtype, v.lanes) for v in like]


def _loop(b: ir.IRBuilder, start: list[Value], condition, body) -> list[Value]:
    """Emit: while condition(values): values = body(values). Return the last values."""
    before, test = b.block, b.append_basic_block("test")
    b.branch(test)
    b.position_at_end(test)
    phis = []
    for x in _flat(start):
        phi = b.phi(x.type)
        phi.add_incoming(x, before)
        phis.append(phi)
    values = _unflat(start, phis)
    enter, leave = b.append_basic_block("body"), b.append_basic_block("done")
    b.cbranch(condition(values), enter, leave)
    b.position_at_end(enter)
    for phi, x in zip(phis, _flat(body(values)), strict=True):
        phi.add_incoming(x, b.block)
    b.branch(test)
    b.position_at_end(leave)
    return values


def _while(b: ir.IRBuilder, equation: core.JaxprEqn, operands: list) -> list[Value]:
    params = equation.params
    m, n = params["cond_nconsts"], params["body_nconsts"]
    test_constants, body_constants, start = operands[:m], operands[m : m + n], operands[m + n :]
    test, body = params["cond_jaxpr"], params["body_jaxpr"]

    def condition(values):
        return lower(b, test, [*test_constants, *values])[0].rows[()]

    return _loop(b, start, condition, lambda values: lower(b, body, [*body_constants, *values]))


def _scan(b: ir.IRBuilder, equation: core.JaxprEqn, operands: list) -> list[Value]:
    """Emit a `fori_loop` of fixed length, which is a scan without input or output sequences."""
    params = equation.params
    body, constants = params["jaxpr"], operands[: params["num_consts"]]
    start = operands[params["num_consts"] :]
    if len(start) != params["num_carry"] or len(body.out_avals) != params["num_carry"]:
        raise NotImplementedError("a kernel cannot scan over sequences")
    counter = Value(array((), lambda _: constant(0, "int32")), "int32", False)
    length, one = constant(params["length"], "int32"), constant(1, "int32")

    def step(values):
        after = lower(b, body, [*constants, *values[1:]])
        return [Value(array((), lambda _: b.add(values[0].rows[()], one)), "int32", False), *after]

    return _loop(b, [counter, *start], lambda values: b.icmp_signed("<", values[0].rows[()], length), step)[1:]


def _cond(b: ir.IRBuilder, equation: core.JaxprEqn, operands: list) -> list[Value]:
    selector, operands = operands[0].rows[()], operands[1:]
    branches, after = equation.params["branches"], b.append_basic_block("after")
    starts = [b.append_basic_block(f"branch{i}") for i in range(len(branches))]
    switch = b.switch(selector, starts[0])
    for i, start in enumerate(starts[1:], 1):
        switch.add_case(constant(i, "int32"), start)
    ends = []
    for branch, start in zip(branches, starts, strict=True):
        b.position_at_end(start)
        results = lower(b, branch, operands)
        values = [_fit_lanes(b, x, v.aval) for x, v in zip(results, equation.outvars, strict=True)]
        ends.append((b.block, values))
        b.branch(after)
    b.position_at_end(after)
    merged = []
    for flat in zip(*(_flat(values) for _, values in ends), strict=True):
        phi = b.phi(flat[0].type)
        for (end, _), x in zip(ends, flat, strict=True):
            phi.add_incoming(x, end)
        merged.append(phi)
    return _unflat(ends[0][1], merged)


def _call(parameter: str) -> Callable[[ir.IRBuilder, core.JaxprEqn, list], list[Value]]:
    """Return a function that inlines the jaxpr in this parameter."""
    return lambda b, equation, operands: lower(b, equation.params[parameter], operands)


CONTROL: dict[str, Callable[[ir.IRBuilder, core.JaxprEqn, list], list[Value]]] = {
    "while": _while,
    "scan": _scan,
    "cond": _cond,
    "jit": _call("jaxpr"),
    "closed_call": _call("call_jaxpr"),
}
