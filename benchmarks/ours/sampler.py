"""Our side of `python -m benchmarks sampler`: seconds of the first call, of its compiling, and the rate afterwards."""

import argparse
import json

import jax
import numpy as np
from jax import monitoring

from benchmarks.reference.serve import timed
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.physics.codegen import call

FIRST = 256  # levels of the first call: one block
XLA = "/jax/core/compile/backend_compile_duration"


def note_compiling() -> list[float]:
    """Return a list that collects the seconds for which LLVM and XLA compile, without tracing and lowering."""
    spent: list[float] = []

    def note(event: str, duration_secs: float, **_: object) -> None:
        if event == XLA:
            spent.append(duration_secs)

    monitoring.register_event_duration_secs_listener(note)
    register = call.register

    def timed_register(text: str) -> str:
        seconds, name = timed(lambda: register(text))
        spent.append(seconds)
        return name

    call.register = timed_register
    return spent


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", required=True)
    parser.add_argument("--levels", type=int, required=True)
    args = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)  # compiling is timed
    sample = lambda count: jax.block_until_ready(sample_levels(np.arange(count), SIZES[args.size]))
    spent = note_compiling()
    first, _ = timed(lambda: sample(FIRST))
    compiling = sum(spent)
    seconds, _ = timed(lambda: sample(args.levels))
    print(json.dumps({"first": first, "compiling": compiling, "rate": args.levels / seconds}))


if __name__ == "__main__":
    main()
