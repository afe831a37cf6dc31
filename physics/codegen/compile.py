"""Compile a kernel's jaxpr: write the LLVM module, make machine code, register it with XLA under a name."""

import ctypes
import hashlib
import re
import threading
from collections.abc import Sequence
from functools import cache

import jax
import llvmlite
from jax.extend import core
from llvmlite import binding, ir

from levelproof.physics.codegen.buffers import LANES, Buffer
from levelproof.physics.codegen.ffi import POINTER, add_handler
from levelproof.physics.codegen.kept import cached
from levelproof.physics.codegen.lower import Memory, lower
from levelproof.physics.codegen.values import INDEX

COMPILING = threading.RLock()  # held while a kernel is compiled: LLVM and XLA accept a name only once in a process
PASSES = "opt=3 jit speed_level=2"  # what `_object_code` asks of LLVM: part of the key of stored code
NAME = "levelproof_"  # prefix of kernels' names, which XLA knows
_libraries: dict[str, binding.ResourceTracker] = {}  # machine code must outlive every executable that calls it
_texts: dict[str, str] = {}


def write(
    jaxpr: core.ClosedJaxpr, arguments: Sequence[Buffer], results: Sequence[Buffer], scratch: Sequence[Buffer]
) -> str:
    """Write a kernel as the text of an LLVM module.

    Args:
        jaxpr: a function of references to the arguments, the results and scratch memory.
        arguments: arrays that XLA passes in; the first has lanes.
        results: arrays that the kernel fills. XLA sees one more result: scratch memory, `sum(Buffer.bytes)` uint8.
        scratch: arrays that the kernel works in.

    Raises:
        NotImplementedError: the kernel uses a feature that `lower` does not support.
    """
    module = ir.Module("levelproof")
    module.triple = binding.get_default_triple()
    block = _block(module, jaxpr, [*arguments, *results, *scratch], len(arguments) + len(results))
    add_handler(module, block, arguments, results, scratch)
    return str(module)


def register(text: str) -> str:
    """Compile the text from `write` and register it with XLA; return its name for `jax.ffi.ffi_call`."""
    name = NAME + hashlib.sha256(text.encode()).hexdigest()[:16]
    with COMPILING:
        if name not in _libraries:
            builder = binding.JITLibraryBuilder().add_object_img(_object_code(text))
            library = builder.export_symbol("handler").link(_jit(), name)
            handler = jax.ffi.pycapsule(ctypes.c_void_p(library["handler"]))
            jax.ffi.register_ffi_target(name, handler, platform="cpu")
            _libraries[name], _texts[name] = library, text
    return name


def texts_in(program: str) -> list[str]:
    """Return the texts of the registered kernels that a program's text names; `register` takes them."""
    return [_texts[name] for name in sorted(set(re.findall(rf"{NAME}[0-9a-f]{{16}}", program)))]


def _block(module: ir.Module, jaxpr: core.ClosedJaxpr, buffers: Sequence[Buffer], outside: int) -> ir.Function:
    """Add the kernel, block(stride, pointers ...). Rows of the first `outside` arrays are `stride` elements apart."""
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [INDEX] + [POINTER] * len(buffers)), "block")
    function.linkage = "internal"
    for pointer in function.args[1:]:
        pointer.add_attribute("noalias")
    b = ir.IRBuilder(function.append_basic_block("entry"))
    memories = []
    for i, (buffer, pointer) in enumerate(zip(buffers, function.args[1:], strict=True)):
        stride = 1 if not buffer.lanes else function.args[0] if i < outside else LANES
        memories.append(Memory(pointer, buffer.shape, buffer.dtype, buffer.lanes, stride))
    lower(b, jaxpr, memories)
    b.ret_void()
    return function


def _object_code(text: str) -> bytes:
    """Return optimised machine code for this CPU."""
    cpu, features = binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()

    def optimise() -> bytes:
        _initialize()
        module = binding.parse_assembly(text)
        triple = binding.Target.from_default_triple()
        target = triple.create_target_machine(cpu=cpu, features=features, opt=3, jit=True)
        passes = binding.create_pass_builder(target, binding.create_pipeline_tuning_options(speed_level=2))
        passes.getModulePassManager().run(module, passes)
        return target.emit_object(module)

    return cached("\n".join([PASSES, llvmlite.__version__, cpu, features, text]), optimise)


def _initialize() -> None:
    """Set LLVM up for this machine; repeated calls cost nothing."""
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()


@cache
def _jit() -> binding.LLJIT:
    """Return the process's just-in-time linker (LLVM ORC).

    It uses JITLink, the only linker that LLVM maintains for AArch64 and macOS; on x86-64 too, so that tests there
    run the same linker. RuntimeDyld, llvmlite's default, corrupts memory on AArch64 (llvmlite issue 1000).
    """
    _initialize()
    return binding.create_lljit_compiler(use_jit_link=True)
