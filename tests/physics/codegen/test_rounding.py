"""Kernels round the same way on every thread and processor, and restore the thread's mode."""

import ctypes
import threading
from collections.abc import Callable

import numpy as np
import pytest
from llvmlite import ir

from levelproof.physics.block import Inputs
from levelproof.physics.buffers import buffers_of
from levelproof.physics.codegen import compile as compile_module
from levelproof.physics.codegen import ffi
from levelproof.physics.codegen.buffers import LANES, Buffer
from levelproof.physics.codegen.rounding import set_mode
from levelproof.physics.step import kernel_of
from levelproof.physics.types import Params
from tests import arm
from tests.pace import patience
from tests.physics.codegen.kernels import Kernel
from tests.physics.worlds import ROOM


def body(x, one, out) -> None:
    out[0] = x[0] * one[0]  # a subnormal operand
    out[1] = x[1] * x[1]  # a subnormal result


KERNEL = Kernel(body, [Buffer((2,)), Buffer((1,))], [Buffer((2,))])
X = np.repeat(np.array([[1e-40], [1e-20]], np.float32), LANES, 1)
ONE = np.ones((1, LANES), np.float32)


def through_xla() -> np.ndarray:
    return KERNEL.as_machine_code(X, ONE)[0]


def without_xla() -> np.ndarray:
    """Call the handler as XLA does, on a thread in the system's default mode."""
    arrays = [X, ONE, np.ones_like(X), np.ones(0, np.uint8)]
    keep, buffers = [], []
    for array in arrays:
        dims = (ctypes.c_int64 * array.ndim)(*array.shape)
        data, dimensions = array.ctypes.data, ctypes.addressof(dims)
        buffers.append(ffi.FrameBuffer(data=data, rank=array.ndim, dims=dimensions))
        keep.append(dims)
    given, filled = ((ctypes.c_void_p * 2)(*map(ctypes.addressof, part)) for part in (buffers[:2], buffers[2:]))
    args = ffi.Args(size=2, args=ctypes.addressof(given))
    rets = ffi.Rets(size=2, rets=ctypes.addressof(filled))
    frame = ffi.CallFrame(args=args, rets=rets)
    address = compile_module._libraries[KERNEL._name]["handler"]
    assert not ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(address)(ctypes.addressof(frame))
    return arrays[2]


@pytest.mark.parametrize("call", [through_xla, without_xla])
def test_kernel_takes_subnormal_numbers_as_zeros_on_every_thread(call: Callable[[], np.ndarray]) -> None:
    results = [call()]
    thread = threading.Thread(target=lambda: results.append(call()))
    thread.start()
    thread.join(patience(60))
    np.testing.assert_array_equal(np.stack(results), np.zeros((2, *X.shape), np.float32))


def test_kernel_leaves_the_mode_of_its_thread_as_it_was() -> None:
    without_xla()
    assert np.float32(1e-40) * np.float32(1) != 0
    assert np.float32(1e-20) * np.float32(1e-20) != 0


@pytest.mark.slow
@pytest.mark.parametrize("triple", arm.TARGETS)
def test_arm_code_of_the_step_sets_the_mode_and_fuses_nothing(triple: str) -> None:
    arm.assert_portable(kernel_of(ROOM, Params(), False, buffers_of(Inputs, ROOM)), triple)


def test_kernel_for_an_unknown_processor_is_refused() -> None:
    module = ir.Module("m")
    module.triple = "riscv64-unknown-linux-gnu"
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), []), "f")
    with pytest.raises(NotImplementedError, match="not on riscv64"):
        set_mode(ir.IRBuilder(function.append_basic_block("entry")))
