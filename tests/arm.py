"""ARM processors: kernels compiled for them on any machine, and run by an emulator where one is installed.

The emulator is QEMU's for programs (qemu-user), the linker that of GCC's cross compiler. Debian has both:
`apt-get install qemu-user gcc-aarch64-linux-gnu libc6-dev-arm64-cross`.
"""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
import numpy as np
import pytest
from llvmlite import binding

from levelproof.physics.codegen.buffers import LANES
from levelproof.physics.codegen.call import Kernel
from levelproof.physics.codegen.compile import write
from tests.pace import patience

LINUX = "aarch64-unknown-linux-gnu"
TARGETS = {LINUX: "neoverse-v1", "arm64-apple-darwin": "apple-m1"}
EMULATED = ("cortex-a72", "neoverse-v1")  # without and with vectors of variable length (SVE)
MAIN = Path(__file__).with_suffix(".c")
EMULATOR, COMPILER = "qemu-aarch64", "aarch64-linux-gnu-gcc"
FUSED = r"\bf(?:n?madd|n?msub|mla|mls|nmla|nmls)\b"
needs_emulator = pytest.mark.skipif(
    not (shutil.which(EMULATOR) and shutil.which(COMPILER)), reason=f"needs {EMULATOR} and {COMPILER}"
)


def compiled(kernel: Kernel, triple: str, cpu: str) -> tuple[bytes, str]:
    """Compile a kernel for another processor, as `codegen.compile` does for this one; return object and assembly."""
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    reads, tables, results, scratch = map(jax.tree.leaves, kernel.buffers)
    with patch.object(binding, "get_default_triple", lambda: triple):
        module = binding.parse_assembly(write(kernel.trace(), [*reads, *tables], results, scratch))
    target = binding.Target.from_triple(triple).create_target_machine(cpu=cpu, opt=3, jit=True, reloc="pic")
    passes = binding.create_pass_builder(target, binding.create_pipeline_tuning_options(speed_level=2))
    passes.getModulePassManager().run(module, passes)
    return target.emit_object(module), target.emit_assembly(module)


def assert_portable(kernel: Kernel, triple: str) -> None:
    """Check a kernel's assembly: it sets the rounding mode, fuses no operations, and calls nothing that computes."""
    _, assembly = compiled(kernel, triple, TARGETS[triple])
    assert not re.findall(FUSED, assembly)
    assert len(re.findall(r"\bmsr\s+FPCR", assembly)) == 2
    called = set(re.findall(r"\bbl\s+_?(\w+)", assembly))
    assert called <= {"blocks", "block", "memset", "memcpy", "bzero"}, "the process must have what a kernel calls"


class Emulated:
    """A kernel on an emulated processor: a function of its arguments."""

    def __init__(self, kernel: Kernel, cpu: str, folder: Path) -> None:
        """Compile the kernel for a processor, with files in `folder`."""
        code, _ = compiled(kernel, LINUX, cpu)
        (folder / "kernel.o").write_bytes(code)
        self._kernel, self._program = kernel, folder / "kernel"
        include = f"-I{jax.ffi.include_dir()}"
        subprocess.run(
            [COMPILER, "-static", include, "-o", self._program, MAIN, folder / "kernel.o"],
            check=True,
            timeout=patience(1800),
        )

    def __call__(self, arguments: Any) -> Any:
        """Return the kernel's results for arrays of whole blocks of lanes."""
        passed = [np.asarray(x) for x in jax.tree.leaves((arguments, self._kernel.tables))]
        lanes = passed[0].shape[-1]
        assert not lanes % LANES
        *_, results, scratch = map(jax.tree.leaves, self._kernel.buffers)
        filled = [np.zeros(buffer.array(lanes).shape, buffer.dtype) for buffer in results]
        workspace = np.zeros(sum(buffer.bytes for buffer in scratch), np.uint8)
        request = b"".join(map(described, [np.array(len(passed)), *passed, *filled, workspace]))
        command = [EMULATOR, "-cpu", "max", self._program]
        answer = subprocess.run(command, input=request, capture_output=True, check=True, timeout=patience(1800)).stdout
        cuts = np.cumsum([0, *(x.nbytes for x in filled)])
        assert len(answer) == cuts[-1]
        arrays = [
            np.frombuffer(answer[first:last], x.dtype).reshape(x.shape)
            for x, first, last in zip(filled, cuts[:-1], cuts[1:], strict=True)
        ]
        return jax.tree.unflatten(jax.tree.structure(self._kernel.results), arrays)


def described(array: np.ndarray) -> bytes:
    """Encode an array for the program: rank, shape, number of bytes, bytes."""
    array = np.ascontiguousarray(array)
    head = np.array([array.ndim, *array.shape, array.nbytes], np.int64)
    return head.tobytes() + array.tobytes()
