"""Registration with XLA."""

import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import pytest

from physics.codegen import compile as compile_module
from physics.codegen.buffers import LANES, Buffer


def test_threads_may_compile_the_same_kernel_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the work units of one worker do; XLA takes a name only once."""
    compiled, compiling = [], compile_module._object_code

    def slowly(text: str) -> bytes:
        compiled.append(text)
        time.sleep(0.2)  # for the other threads to come, too
        return compiling(text)

    def kernel(x, out):
        out_ref, x_ref = jax.new_ref(out), jax.new_ref(x)
        out_ref[...] = x_ref[...] + 1234

    monkeypatch.setattr(compile_module, "_object_code", slowly)
    buffer, row = Buffer((1,), "float32"), jnp.zeros((1, LANES))
    jaxpr = jax.make_jaxpr(kernel)(row, row)
    with ThreadPoolExecutor(4) as threads:
        names = set(threads.map(lambda _: compile_module.compile_kernel(jaxpr, [buffer], [buffer], []), range(4)))
    assert len(names) == len(compiled) == 1
