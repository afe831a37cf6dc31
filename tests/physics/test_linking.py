"""Both of LLVM's linkers link the same code to the same step."""

import platform
import sys
from typing import Any

import jax
import numpy as np
import pytest
from llvmlite import binding

from levelproof.physics import step as step_module
from levelproof.physics.codegen import call as call_module
from levelproof.physics.codegen import compile as compile_module
from levelproof.physics.step import step
from tests.physics.codegen.kernels import same_bits
from tests.physics.worlds import ROOM, scattered

JIT: list[binding.LLJIT] = []  # kept until the process ends, like the code it linked


def after(seed: int = 1) -> list[Any]:
    return [np.asarray(x) for x in jax.tree.leaves(step(*scattered(ROOM, 64, seed)))]  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="RuntimeDyld corrupts memory elsewhere"
)
def test_runtime_dyld_gives_the_bits_of_jitlink(monkeypatch: pytest.MonkeyPatch) -> None:
    by_jitlink = after()
    JIT.append(binding.create_lljit_compiler(use_jit_link=False))
    marked = lambda request, make, folders: make() + b"\n; for RuntimeDyld"  # another name: XLA accepts each only once
    monkeypatch.setattr(call_module, "cached_by_sources", marked)
    monkeypatch.setattr(compile_module, "_jit", lambda: JIT[-1])
    step_module._compiled.forget()  # pyright: ignore[reportFunctionMemberAccess]
    before = len(compile_module._libraries)
    same_bits(by_jitlink, after())
    assert len(compile_module._libraries) == before + 1
    step_module._compiled.forget()  # pyright: ignore[reportFunctionMemberAccess]


def test_kernels_are_linked_by_jitlink(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(binding, "create_lljit_compiler", lambda **settings: calls.append(settings))
    compile_module._jit.__wrapped__()
    assert calls == [{"use_jit_link": True}]
