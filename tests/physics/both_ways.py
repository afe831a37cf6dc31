"""One step as machine code and as XLA's operations, compared to the bit, in a process of its own.

XLA computes the same bits only when it neither contracts multiplications and additions (it has no instruction for
that before AVX2) nor rearranges what it is given; the processor's level cannot be chosen but at the start of a process.

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
from tests.golden.load import HERE, load
from tests.physics.worlds import PARAMS, scattered

NO_CONTRACTION = "--xla_cpu_max_isa=AVX"
AS_WRITTEN = {"xla_disable_hlo_passes": "algsimp,simplify-fp-conversions", "xla_backend_optimization_level": 0}


def worlds(name: str) -> Any:
    """Golden states of a size's name, scattered worlds of four numbers; to be given to a step."""
    from levelproof.physics.block import Given
    from levelproof.physics.types import Size

    if name in "sml":
        of = load(HERE / f"{name}.npz")
        return Given(of.level.model, of.state, of.motor, of.thrust)
    return Given(*scattered(Size(*map(int, name.split(","))), lanes=256))


def digest(tree: Any) -> str:
    """Of all bits."""
    import jax

    return hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(tree))).hexdigest()


def compare(name: str) -> dict[str, Any]:
    """Of each field of the state and of the manifold, the share of lanes that are alike."""
    import jax

    from levelproof.physics.step import as_machine_code, on_all_lanes

    given = worlds(name)
    ours = jax.jit(lambda given: as_machine_code(given, PARAMS, True))(given)
    theirs = jax.jit(lambda given: on_all_lanes(given, PARAMS, True), compiler_options=AS_WRITTEN)(given)
    shares = {}
    for a, b in zip(ours, theirs, strict=True):
        for field in dataclasses.fields(a):
            x, y = (np.asarray(getattr(tree, field.name)) for tree in (a, b))
            alike = (x == y) | ((x != x) & (y != y))
            shares[f"{type(a).__name__}.{field.name}"] = float(alike.reshape(-1, alike.shape[-1]).all(0).mean())
    touching = np.asarray(ours[0].contact_active).any(0)
    return {"alike": shares, "touching": float(touching.mean()), "digest": digest(ours)}


if __name__ == "__main__":
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {NO_CONTRACTION}".strip()
    prepare_jax()
    print(json.dumps({name: compare(name) for name in sys.argv[1:]}))
