"""A kernel's jaxpr as an LLVM function: straight-line code becomes vector operations, `fori_loop`, `while_loop` and
`cond` become branches, reads and writes of references become loads and stores."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.extend import core
from llvmlite import ir

from physics.codegen import primitives
from physics.codegen.values import INDEX, STORED, Operand, Value, array, constant, has_lanes, llvm_type
from physics.lanes import LANES


@dataclass(frozen=True)
class Memory:
    """What a reference refers to: rows of `stride` numbers, the first LANES of which are this block's."""

    pointer: Operand
    shape: tuple[int, ...]  # without the lanes
    dtype: str
    lanes: bool
    stride: Operand  # numbers from row to row

    def at(self, b: ir.IRBuilder, index: Sequence) -> Operand:
        """Address of a row."""
        row = INDEX(0)
        for number, size in zip(index, self.shape, strict=True):
            row = b.add(b.mul(row, INDEX(size)), primitives.to_index(b, number))
        return b.gep(self.pointer, [b.mul(row, self.stride)], source_etype=STORED[self.dtype])


def lower(b: ir.IRBuilder, jaxpr: core.Jaxpr, arguments: Sequence[Value | Memory]) -> list[Value]:
    """Emit a jaxpr; its results."""
    known: dict[Any, Any] = dict(zip(jaxpr.invars, arguments, strict=True))

    def read(x):
        return _literal(x) if isinstance(x, core.Literal) else known[x]

    for equation in jaxpr.eqns:
        results = _equation(b, equation, [read(x) for x in equation.invars])
        known.update(zip(equation.outvars, results, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _literal(x: core.Literal) -> Value:
    aval: Any = x.aval
    dtype = str(aval.dtype)
    return Value(array((), lambda _: constant(x.val, dtype)), dtype, False)


def _consts(closed: core.ClosedJaxpr) -> list[Value]:
    """Constants that a kernel closes over: numbers only."""
    return [Value(array((), lambda _, c=c: constant(c, str(c.dtype))), str(c.dtype), False) for c in closed.consts]


def _equation(b: ir.IRBuilder, equation, operands: list) -> list:
    name, params = equation.primitive.name, equation.params
    out: Any = equation.outvars[0].aval if equation.outvars else None
    if name in primitives.ELEMENTWISE:
        return [primitives.elementwise(b, name, operands, str(out.dtype))]
    match name:
        case "get":
            return [_get(b, *_place(params, operands), out)]
        case "swap":
            return [_swap(b, operands[1], *_place(params, operands, 2), out)]
        case "addupdate":
            return _add(b, operands[1], *_place(params, operands, 2))
        case "convert_element_type":
            return [primitives.convert(b, operands[0], str(params["new_dtype"]))]
        case "broadcast_in_dim":
            return [primitives.broadcast_in_dim(b, operands[0], params["shape"], params["broadcast_dimensions"])]
        case "reshape" | "squeeze" | "expand_dims":
            return [primitives.reshape(operands[0], out.shape)]
        case "integer_pow":
            return [_power(b, operands[0], params["y"], str(out.dtype))]
        case "slice":
            steps = params["strides"] or [1] * len(params["start_indices"])
            cut = tuple(map(slice, params["start_indices"], params["limit_indices"], steps))
            return [Value(operands[0].rows[cut[: operands[0].rows.ndim]], operands[0].dtype, operands[0].lanes)]
        case "concatenate":
            rows = np.concatenate([x.rows for x in operands], axis=params["dimension"])
            return [Value(rows, operands[0].dtype, operands[0].lanes)]
        case "stack":
            return [
                Value(np.stack([x.rows for x in operands], axis=params["axis"]), operands[0].dtype, operands[0].lanes)
            ]
        case "reduce_or" | "reduce_and" | "reduce_max" | "reduce_min" | "reduce_sum":
            return [primitives.reduction(b, name, operands[0], params["axes"], str(out.dtype))]
        case "iota":
            return [primitives.iota(params["shape"], params["dimension"], str(params["dtype"]))]
        case "ref" | "new_ref" | "copy":  # a reference to an argument: the argument itself
            return operands
        case "while":
            return _while(b, params, operands)
        case "scan":
            return _scan(b, params, operands)
        case "cond":
            return _cond(b, params, operands, equation.outvars)
    inner = params.get("jaxpr") or params.get("call_jaxpr")
    if inner is None:
        raise NotImplementedError(f"a kernel cannot use the primitive {name}")
    return lower(b, inner.jaxpr, [*_consts(inner), *operands][-len(inner.jaxpr.invars) :] if operands else operands)


def _power(b: ir.IRBuilder, x: Value, y: int, dtype: str) -> Value:
    result = x
    for _ in range(y - 1):
        result = primitives.elementwise(b, "mul", [result, x], dtype)
    return result


def _place(params: dict, operands: list, first: int = 1) -> tuple[Memory, list[list]]:
    """The memory that a reference names and, for each axis but the lanes, the row numbers that are meant."""
    memory = operands[0]
    transforms = jax.tree.unflatten(params["tree"], operands[first:])
    if not transforms:
        return memory, [list(range(size)) for size in memory.shape]
    (indexer,) = transforms
    axes = []
    for index in indexer.indices[: len(memory.shape)]:
        if hasattr(index, "stride"):
            axes.append([index.start + i * index.stride for i in range(index.size)])
        else:
            axes.append(index.rows[()] if isinstance(index, Value) else int(index))
    return memory, axes


def _rows(axes: list) -> tuple[tuple[int, ...], Callable[[tuple], list]]:
    """Shape of what is read or written, and the address of each of its rows."""
    shape = tuple(len(axis) for axis in axes if isinstance(axis, list))

    def address(at):
        place = iter(at)
        return [axis[next(place)] if isinstance(axis, list) else axis for axis in axes]

    return shape, address


def _get(b: ir.IRBuilder, memory: Memory, axes: list, out) -> Value:
    shape, address = _rows(axes)
    return Value(array(shape, lambda at: _load(b, memory, address(at))), memory.dtype, has_lanes(out.shape))


def _load(b: ir.IRBuilder, memory: Memory, index: list) -> Operand:
    kind = STORED[memory.dtype]
    kind = ir.VectorType(kind, LANES) if memory.lanes else kind
    x = b.load(memory.at(b, index), align=STORED_BYTES[memory.dtype], typ=kind)
    return b.trunc(x, llvm_type("bool", memory.lanes)) if memory.dtype == "bool" else x


STORED_BYTES = {"float32": 4, "int32": 4, "bool": 1}


def _store(b: ir.IRBuilder, memory: Memory, index: list, x: Operand) -> None:
    if memory.dtype == "bool":
        kind = STORED["bool"]
        x = b.zext(x, ir.VectorType(kind, LANES) if memory.lanes else kind)
    b.store(x, memory.at(b, index), align=STORED_BYTES[memory.dtype])


def _swap(b: ir.IRBuilder, x: Value, memory: Memory, axes: list, out) -> Value | None:
    """Write. What was there before is not read: no kernel of ours asks for it."""
    shape, address = _rows(axes)
    rows = np.broadcast_to(x.rows, shape)
    for at in np.ndindex(*shape):
        _store(b, memory, address(at), rows[at])
    return None


def _add(b: ir.IRBuilder, x: Value, memory: Memory, axes: list) -> list:
    shape, address = _rows(axes)
    rows = np.broadcast_to(x.rows, shape)
    for at in np.ndindex(*shape):
        _store(b, memory, address(at), b.fadd(_load(b, memory, address(at)), rows[at]))
    return []


def _flat(values: Sequence[Value]) -> list[Operand]:
    return [x for value in values for x in value.rows.reshape(-1)]


def _unflat(like: Sequence[Value], flat: Sequence[Operand]) -> list[Value]:
    rest = iter(flat)
    return [Value(array(v.rows.shape, lambda _: next(rest)), v.dtype, v.lanes) for v in like]


def _loop(b: ir.IRBuilder, start: list[Value], go_on, body) -> list[Value]:
    """while go_on(values): values = body(values)."""
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
    b.cbranch(go_on(values), enter, leave)
    b.position_at_end(enter)
    for phi, x in zip(phis, _flat(body(values)), strict=True):
        phi.add_incoming(x, b.block)
    b.branch(test)
    b.position_at_end(leave)
    return values


def _while(b: ir.IRBuilder, params: dict, operands: list) -> list[Value]:
    m, n = params["cond_nconsts"], params["body_nconsts"]
    of_test, of_body, start = operands[:m], operands[m : m + n], operands[m + n :]
    test, body = params["cond_jaxpr"], params["body_jaxpr"]

    def go_on(values):
        return lower(b, test.jaxpr, [*_consts(test), *of_test, *values])[0].rows[()]

    return _loop(b, start, go_on, lambda values: lower(b, body.jaxpr, [*_consts(body), *of_body, *values]))


def _scan(b: ir.IRBuilder, params: dict, operands: list) -> list[Value]:
    """A `fori_loop` of fixed length: a scan that neither reads nor writes sequences."""
    body, constants = params["jaxpr"], operands[: params["num_consts"]]
    start = operands[params["num_consts"] :]
    if len(start) != params["num_carry"] or params["reverse"]:
        raise NotImplementedError("a kernel cannot scan over sequences")
    counter = Value(array((), lambda _: constant(0, "int32")), "int32", False)
    length, one = constant(params["length"], "int32"), constant(1, "int32")

    def step(values):
        after = lower(b, body.jaxpr, [*_consts(body), *constants, *values[1:]])
        return [Value(array((), lambda _: b.add(values[0].rows[()], one)), "int32", False), *after]

    return _loop(b, [counter, *start], lambda values: b.icmp_signed("<", values[0].rows[()], length), step)[1:]


def _cond(b: ir.IRBuilder, params: dict, operands: list, outvars) -> list[Value]:
    which, operands = operands[0].rows[()], operands[1:]
    branches, after = params["branches"], b.append_basic_block("after")
    blocks = [b.append_basic_block(f"branch{i}") for i in range(len(branches))]
    switch = b.switch(which, blocks[0])
    for i, block in enumerate(blocks[1:], 1):
        switch.add_case(constant(i, "int32"), block)
    ends = []
    for branch, block in zip(branches, blocks, strict=True):
        b.position_at_end(block)
        values = lower(b, branch.jaxpr, [*_consts(branch), *operands])
        values = [
            primitives.with_lanes(b, x) if has_lanes(v.aval.shape) else x for x, v in zip(values, outvars, strict=True)
        ]
        ends.append((b.block, values))
        b.branch(after)
    b.position_at_end(after)
    merged = []
    for flat in zip(*(_flat(values) for _, values in ends), strict=True):
        phi = b.phi(flat[0].type)
        for (block, _), x in zip(ends, flat, strict=True):
            phi.add_incoming(x, block)
        merged.append(phi)
    return _unflat(ends[0][1], merged)
