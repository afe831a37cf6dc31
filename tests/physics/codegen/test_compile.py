"""Registration with XLA."""

import jax
import jax.numpy as jnp
import pytest

from levelproof.physics.codegen import compile as compile_module
from levelproof.physics.codegen.buffers import LANES, Buffer


def test_register_compiles_the_same_kernel_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """XLA accepts a name only once."""
    compiled, compiling = [], compile_module._object_code

    def noted(text: str) -> bytes:
        compiled.append(text)
        return compiling(text)

    def kernel(x, out):
        out_ref, x_ref = jax.new_ref(out), jax.new_ref(x)
        out_ref[...] = x_ref[...] + 1234

    monkeypatch.setattr(compile_module, "_object_code", noted)
    buffer, row = Buffer((1,), "float32"), jnp.zeros((1, LANES))
    jaxpr = jax.make_jaxpr(kernel)(row, row)
    names = {compile_module.register(compile_module.write(jaxpr, [buffer], [buffer], [])) for _ in range(2)}
    assert len(names) == len(compiled) == 1
