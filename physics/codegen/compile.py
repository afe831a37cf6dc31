"""From a kernel to a function that XLA calls: LLVM module, handler, machine code, registration.

The handler speaks XLA's foreign function interface (xla/ffi/api/c_api.h, part of jaxlib), whose structures are stable.
It steps block after block of lanes over the arrays that XLA hands it.
"""

import ctypes
import hashlib
import math
from collections.abc import Sequence
from threading import Lock

import jax
from jax.extend import core
from llvmlite import binding, ir

from physics.codegen.lower import Memory, lower
from physics.codegen.values import INDEX, STORED, Operand
from physics.lanes import LANES
from physics.rooms import Room

BYTE, POINTER, INT = ir.IntType(8), ir.PointerType(), ir.IntType(32)
# Offsets in bytes into XLA_FFI_CallFrame and what it points to
FRAME_EXTENSION, FRAME_ARGUMENTS, FRAME_RESULTS = 8, 72, 112
EXTENSION_KIND, EXTENSION_METADATA, METADATA_MAJOR, METADATA_MINOR = 8, 24, 24, 28
BUFFER_DATA, BUFFER_RANK, BUFFER_DIMENSIONS = 24, 32, 40
METADATA_QUERY = 1  # XLA_FFI_Extension_Metadata: XLA asks which version the handler was made for
MAJOR, MINOR = 0, 1
ALIGNMENT = 64  # bytes: a cache line, and the widest vector
BYTES = {"float32": 4, "int32": 4, "bool": 1}


def bytes_of(room: Room) -> int:
    """Of one block of lanes, in whole cache lines."""
    count = math.prod(room.shape) * (LANES if room.lanes else 1)
    return -(-count * BYTES[room.dtype] // ALIGNMENT) * ALIGNMENT


_engines: dict[str, object] = {}  # machine code must outlive every executable that calls it
_registering = Lock()  # a name is registered once, whichever thread asks first


def compile_kernel(
    jaxpr: core.ClosedJaxpr, arguments: Sequence[Room], results: Sequence[Room], scratch: Sequence[Room]
) -> str:
    """Compile a kernel and register it with XLA.

    Args:
        jaxpr: of a function of references: to the arguments, to the results, to scratch memory.
        arguments: the arrays that XLA hands over; the first has lanes.
        results: the arrays that the kernel fills; XLA gets one more, the scratch memory.
        scratch: what the kernel works in.

    Returns:
        The name by which `jax.ffi.ffi_call` finds it.
    """
    module = _module(jaxpr, arguments, results, scratch)
    text = str(module)
    name = "levelproof_" + hashlib.sha256(text.encode()).hexdigest()[:16]
    with _registering:
        if name not in _engines:
            engine = _machine_code(text)
            address = engine.get_function_address("handler")
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(ctypes.c_void_p(address)), platform="cpu")
            _engines[name] = engine
    return name


def _module(jaxpr, arguments, results, scratch) -> ir.Module:
    module = ir.Module("levelproof")
    module.triple = binding.get_default_triple()
    block = _block(module, jaxpr, [*arguments, *results, *scratch], len(arguments) + len(results))
    _handler(module, block, arguments, results, scratch)
    return module


def _block(module: ir.Module, jaxpr: core.ClosedJaxpr, rooms: Sequence[Room], outside: int) -> ir.Function:
    """block(stride, pointers ...): the kernel. Rows of the first `outside` arrays are `stride` numbers apart."""
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [INDEX] + [POINTER] * len(rooms)), "block")
    function.linkage = "internal"
    for pointer in function.args[1:]:
        pointer.add_attribute("noalias")
    b = ir.IRBuilder(function.append_basic_block("entry"))
    memories = []
    for i, (room, pointer) in enumerate(zip(rooms, function.args[1:], strict=True)):
        stride = INDEX(1) if not room.lanes else function.args[0] if i < outside else INDEX(LANES)
        memories.append(Memory(pointer, room.shape, room.dtype, room.lanes, stride))
    lower(b, jaxpr, memories)
    b.ret_void()
    return function


def _handler(module: ir.Module, block: ir.Function, arguments, results, scratch) -> None:
    """handler(frame): `block` for each block of lanes of the buffers in XLA's call frame."""
    function = ir.Function(module, ir.FunctionType(POINTER, [POINTER]), "handler")
    (frame,) = function.args
    b = ir.IRBuilder(function.append_basic_block("entry"))
    success = ir.Constant(POINTER, None)

    def field(pointer: Operand, offset: int, kind: ir.Type = POINTER) -> Operand:
        return b.load(b.gep(pointer, [INDEX(offset)], source_etype=BYTE), typ=kind)

    extension = field(frame, FRAME_EXTENSION)
    with b.if_then(b.icmp_unsigned("!=", extension, success)):
        asked = b.icmp_signed("==", field(extension, EXTENSION_KIND, INT), INT(METADATA_QUERY))
        with b.if_then(asked):
            metadata = field(extension, EXTENSION_METADATA)
            for offset, number in ((METADATA_MAJOR, MAJOR), (METADATA_MINOR, MINOR)):
                b.store(INT(number), b.gep(metadata, [INDEX(offset)], source_etype=BYTE))
            b.ret(success)

    handed, filled = field(frame, FRAME_ARGUMENTS), field(frame, FRAME_RESULTS)
    buffer = lambda array, i: field(array, 8 * i)
    data = [field(buffer(handed, i), BUFFER_DATA) for i in range(len(arguments))]
    data += [field(buffer(filled, i), BUFFER_DATA) for i in range(len(results) + 1)]
    first = buffer(handed, 0)
    last_axis = b.sub(field(first, BUFFER_RANK, INDEX), INDEX(1))
    dimension = b.gep(field(first, BUFFER_DIMENSIONS), [last_axis], source_etype=INDEX)
    lanes = b.load(dimension, typ=INDEX)

    rooms, pointers, offset = [*arguments, *results], data[:-1], 0
    workspace = []
    for room in scratch:
        workspace.append(b.gep(data[-1], [INDEX(offset)], source_etype=BYTE))
        offset += bytes_of(room)
    start = b.block
    test, body, done = (b.append_basic_block(name) for name in ("test", "body", "done"))
    b.branch(test)
    b.position_at_end(test)
    lane = b.phi(INDEX)
    lane.add_incoming(INDEX(0), start)
    b.cbranch(b.icmp_signed("<", lane, lanes), body, done)
    b.position_at_end(body)
    here = [
        b.gep(pointer, [lane], source_etype=STORED[room.dtype]) if room.lanes else pointer
        for room, pointer in zip(rooms, pointers, strict=True)
    ]
    b.call(block, [lanes, *here, *workspace])
    lane.add_incoming(b.add(lane, INDEX(LANES)), b.block)
    b.branch(test)
    b.position_at_end(done)
    b.ret(success)


def _machine_code(text: str):
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    module = binding.parse_assembly(text)
    target = binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(), features=binding.get_host_cpu_features().flatten(), opt=3, jit=True
    )
    builder = binding.create_pass_builder(target, binding.create_pipeline_tuning_options(speed_level=2))
    builder.getModulePassManager().run(module, builder)
    engine = binding.create_mcjit_compiler(module, target)
    engine.finalize_object()
    return engine
