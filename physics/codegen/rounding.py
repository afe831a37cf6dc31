"""The processor's floating-point mode while a kernel runs: round to nearest, subnormal numbers as zeros.

XLA sets the same mode on its compute threads; a kernel does not rely on that. Subnormal operands and results count as
zeros of their sign. The kernel restores the previous mode when it ends.
"""

from collections.abc import Callable

from llvmlite import ir

from levelproof.physics.codegen.values import INDEX, Operand

POINTER, WORD = ir.PointerType(), ir.IntType(32)
MXCSR = 0x9FC0  # x86: exceptions masked, to nearest; flush to zero (bit 15), denormals are zeros (bit 6)
FPCR = 1 << 24  # AArch64: exceptions masked, to nearest; flush to zero

Restore = Callable[[], Operand]


def set_mode(b: ir.IRBuilder) -> Restore:
    """Emit instructions that set the mode; return a function that emits those that restore the previous one.

    Raises:
        NotImplementedError: the module is for a processor other than x86-64 or AArch64.
    """
    processor = b.module.triple.split("-")[0]
    if processor not in MODE_SETTERS:
        raise NotImplementedError(f"kernels run on x86-64 and AArch64, not on {processor}")
    return MODE_SETTERS[processor](b)


def _x86(b: ir.IRBuilder) -> Restore:
    load, store = (_declared(b, f"llvm.x86.sse.{name}", ir.VoidType(), POINTER) for name in ("ldmxcsr", "stmxcsr"))
    before, during = b.alloca(WORD), b.alloca(WORD)
    b.call(store, [before])
    b.store(WORD(MXCSR), during)
    b.call(load, [during])
    return lambda: b.call(load, [before])


def _aarch64(b: ir.IRBuilder) -> Restore:
    get = _declared(b, "llvm.aarch64.get.fpcr", INDEX)
    put = _declared(b, "llvm.aarch64.set.fpcr", ir.VoidType(), INDEX)
    before = b.call(get, [])
    b.call(put, [INDEX(FPCR)])
    return lambda: b.call(put, [before])


def _declared(b: ir.IRBuilder, name: str, result: ir.Type, *arguments: ir.Type) -> Operand:
    return ir.Function(b.module, ir.FunctionType(result, arguments), name)


MODE_SETTERS: dict[str, Callable[[ir.IRBuilder], Restore]] = {
    "x86_64": _x86,
    "aarch64": _aarch64,
    "arm64": _aarch64,  # as macOS calls it
}
