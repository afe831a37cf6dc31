"""Compare one step as machine code and as XLA operations bit for bit, in a separate process.

XLA computes the same bits only if it neither contracts multiplications with additions (there is no instruction for it
before AVX2) nor rearranges operations. The instruction set can only be chosen when a process starts.

    python -m tests.physics.both_ways s l 8,8,8,4
"""

import dataclasses
import hashlib
import json
import os
import sys
from typing import Any

import numpy as np

from levelproof.pipeline.runtime import prepare_jax
from tests.golden.load import golden
from tests.physics.worlds import PARAMS, scattered

NO_CONTRACTION = "--xla_cpu_max_isa=AVX"
AS_WRITTEN = {"xla_disable_hlo_passes": "algsimp,simplify-fp-conversions", "xla_backend_optimization_level": 0}


def worlds(name: str) -> Any:
    """Return inputs of a step: golden states for the name of a size, scattered worlds for four numbers."""
    from levelproof.physics.block import Inputs
    from levelproof.physics.types import Size

    if name in "sml":
        sample = golden(name)
        return Inputs(sample.level.model, sample.state, sample.motor, sample.thrust)
    return Inputs(*scattered(Size(*map(int, name.split(","))), lanes=256))


def digest(tree: Any) -> str:
    """Hash all bits of a tree of arrays."""
    import jax

    return hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(tree))).hexdigest()


def compare(name: str) -> dict[str, Any]:
    """Return, for each field of state and manifold, the share of lanes with equal bits."""
    import jax

    from levelproof.physics.step import as_machine_code, on_all_lanes

    given = worlds(name)
    ours = jax.jit(lambda given: as_machine_code(given, PARAMS, True))(given)
    theirs = jax.jit(lambda given: on_all_lanes(given, PARAMS, True), compiler_options=AS_WRITTEN)(given)
    shares = {}
    for a, b in zip(ours, theirs, strict=True):
        for field in dataclasses.fields(a):
            x, y = (np.asarray(getattr(tree, field.name)) for tree in (a, b))
            equal = (x == y) | ((x != x) & (y != y))
            shares[f"{type(a).__name__}.{field.name}"] = float(equal.reshape(-1, equal.shape[-1]).all(0).mean())
    touching = np.asarray(ours[0].contact_active).any(0)
    return {"alike": shares, "touching": float(touching.mean()), "digest": digest(ours)}


if __name__ == "__main__":
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {NO_CONTRACTION}".strip()
    prepare_jax()
    print(json.dumps({name: compare(name) for name in sys.argv[1:]}))
