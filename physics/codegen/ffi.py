"""The handler that XLA calls: it runs the kernel on each block of lanes of the buffers in XLA's call frame.

The structures are those of version 0.3 of XLA's foreign function interface (xla/ffi/api/c_api.h), shipped with jaxlib
0.10.0 to 0.10.2. XLA asks a handler for its version and accepts those from 0.1 to its own.
tests/physics/codegen/test_ffi.py compares all of this with the header of the installed jaxlib.
"""

import ctypes
from collections.abc import Sequence
from ctypes import c_int, c_int64, c_size_t, c_uint32, c_void_p
from typing import Any

from llvmlite import ir

from levelproof.physics.codegen.buffers import LANES, Buffer
from levelproof.physics.codegen.rounding import set_mode
from levelproof.physics.codegen.values import INDEX, STORED, Operand

VERSION_MAJOR, VERSION_MINOR = 0, 3
METADATA_QUERY = 1  # XLA_FFI_Extension_Metadata: XLA asks for the handler's version


START: dict[str, Any] = {"struct_size": c_size_t, "extension_start": c_void_p}  # how most structures begin
ARRAY: dict[str, Any] = {**START, "size": c_int64, "types": c_void_p}


def _structure(name: str, **fields: Any) -> Any:
    """Declare a structure of the header under its name there; trailing fields that nothing reads may be left out."""
    return type(name, (ctypes.Structure,), {"_fields_": tuple(fields.items())})


ExtensionBase = _structure("XLA_FFI_Extension_Base", struct_size=c_size_t, type=c_int, next=c_void_p)
ApiVersion = _structure("XLA_FFI_Api_Version", **START, major_version=c_int, minor_version=c_int)
# What XLA queries. It passes the structure with traits and state unset; this handler has neither, so leave them
Metadata = _structure("XLA_FFI_Metadata", struct_size=c_size_t, api_version=ApiVersion, traits=c_uint32)
MetadataExtension = _structure("XLA_FFI_Metadata_Extension", extension_base=ExtensionBase, metadata=c_void_p)
FrameBuffer = _structure("XLA_FFI_Buffer", **START, dtype=c_int, data=c_void_p, rank=c_int64, dims=c_void_p)
Args = _structure("XLA_FFI_Args", **ARRAY, args=c_void_p)
Rets = _structure("XLA_FFI_Rets", **ARRAY, rets=c_void_p)
CallFrame = _structure("XLA_FFI_CallFrame", **START, api=c_void_p, ctx=c_void_p, stage=c_int, args=Args, rets=Rets)

BYTE, POINTER, INT = ir.IntType(8), ir.PointerType(), ir.IntType(32)
NULL = ir.Constant(POINTER, None)


def _offset(structure: Any, *path: str) -> int:
    """Return the offset of a (nested) field from the start of a structure, bytes."""
    total = 0
    for name in path:
        total += getattr(structure, name).offset
        structure = dict(structure._fields_)[name]
    return total


def _load(b: ir.IRBuilder, pointer: Operand, offset: int, kind: ir.Type = POINTER) -> Operand:
    return b.load(b.gep(pointer, [INDEX(offset)], source_etype=BYTE), typ=kind)


def add_handler(
    module: ir.Module,
    block: ir.Function,
    arguments: Sequence[Buffer],
    results: Sequence[Buffer],
    scratch: Sequence[Buffer],
) -> None:
    """Add `handler(frame)`, which calls the kernel `block(lanes, pointers ...)` for each block of lanes.

    `compile.write` describes the buffers.
    """
    blocks = _add_blocks(module, block, arguments, results, scratch)
    function = ir.Function(module, ir.FunctionType(POINTER, [POINTER]), "handler")
    (frame,) = function.args
    b = ir.IRBuilder(function.append_basic_block("entry"))
    _answer_query(b, frame)
    restore = set_mode(b)
    b.call(blocks, [frame])
    restore()
    b.ret(NULL)  # success


def _add_blocks(
    module: ir.Module,
    block: ir.Function,
    arguments: Sequence[Buffer],
    results: Sequence[Buffer],
    scratch: Sequence[Buffer],
) -> ir.Function:
    """Add `blocks(frame)`, which steps all blocks. Not inlined, so no arithmetic moves out of the rounding mode."""
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTER]), "blocks")
    function.linkage = "internal"
    function.attributes.add("noinline")
    (frame,) = function.args
    b = ir.IRBuilder(function.append_basic_block("entry"))
    passed = _load(b, frame, _offset(CallFrame, "args", "args"))
    returned = _load(b, frame, _offset(CallFrame, "rets", "rets"))
    buffer = lambda array, i: _load(b, array, ctypes.sizeof(c_void_p) * i)
    data = [_load(b, buffer(passed, i), _offset(FrameBuffer, "data")) for i in range(len(arguments))]
    data += [_load(b, buffer(returned, i), _offset(FrameBuffer, "data")) for i in range(len(results) + 1)]
    first = buffer(passed, 0)
    last = b.sub(_load(b, first, _offset(FrameBuffer, "rank"), INDEX), INDEX(1))
    dimension = b.gep(_load(b, first, _offset(FrameBuffer, "dims")), [last], source_etype=INDEX)
    lanes = b.load(dimension, typ=INDEX)
    *outside, memory = data
    workspace, offset = [], 0
    for part in scratch:
        workspace.append(b.gep(memory, [INDEX(offset)], source_etype=BYTE))
        offset += part.bytes
    _each_block(b, lanes, block, list(zip([*arguments, *results], outside, strict=True)), workspace)
    b.ret_void()
    return function


def _answer_query(b: ir.IRBuilder, frame: Operand) -> None:
    """If XLA queries the handler's metadata, write the version and return."""
    extension = _load(b, frame, _offset(CallFrame, "extension_start"))
    with b.if_then(b.icmp_unsigned("!=", extension, NULL)):
        kind = _load(b, extension, _offset(MetadataExtension, "extension_base", "type"), INT)
        with b.if_then(b.icmp_signed("==", kind, INT(METADATA_QUERY))):
            metadata = _load(b, extension, _offset(MetadataExtension, "metadata"))
            for field, number in (("major_version", VERSION_MAJOR), ("minor_version", VERSION_MINOR)):
                offset = _offset(Metadata, "api_version", field)
                b.store(INT(number), b.gep(metadata, [INDEX(offset)], source_etype=BYTE))
            b.ret(NULL)


def _each_block(
    b: ir.IRBuilder, lanes: Operand, block: ir.Function, outside: list[tuple[Buffer, Any]], workspace: list
) -> None:
    """Emit: for lane in range(0, lanes, LANES): block(lanes, pointers offset by lane ...)."""
    start = b.block
    test, body, done = (b.append_basic_block(name) for name in ("test", "body", "done"))
    b.branch(test)
    b.position_at_end(test)
    lane = b.phi(INDEX)
    lane.add_incoming(INDEX(0), start)
    b.cbranch(b.icmp_signed("<", lane, lanes), body, done)
    b.position_at_end(body)
    at_lane = [
        b.gep(pointer, [lane], source_etype=STORED[buffer.dtype]) if buffer.lanes else pointer
        for buffer, pointer in outside
    ]
    b.call(block, [lanes, *at_lane, *workspace])
    lane.add_incoming(b.add(lane, INDEX(LANES)), b.block)
    b.branch(test)
    b.position_at_end(done)
