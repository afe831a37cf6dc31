"""What the symbolic-flat observation of every step costs beside the step: env steps/s of one core without and with it.

python -m benchmarks.observation [SIZE ...]
"""

import os
import sys
import time

os.environ.update(dict.fromkeys(("NPROC", "OMP_NUM_THREADS"), "1"))
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.scaling import LANES, sticky
from levelgen.level import SIZES
from levelgen.sampling.sampler import sample_levels
from levelgen.task import rules as task
from levelgen.task.observe.flat import level_features, symbolic_flat

STEPS = 64
REPEATS = 60


def rollout(level, now, actions, observed: bool):
    """Some env steps; the last observation is carried along, so that none is left out."""
    constant = level_features(level)

    def act(carry, action):
        now, seen = carry
        now, outcome = task.step(level, now, action)
        seen = symbolic_flat(level, now.state, constant) if observed else seen
        return (now, seen), outcome.done.sum()

    start = jnp.zeros((len(constant), LANES))
    return jax.lax.scan(act, (now, start), actions)


def main() -> None:
    print("| size | without | with | slower by |\n|---|---|---|---|")
    for size in sys.argv[1:] or SIZES:
        level = jax.tree.map(jnp.asarray, sample_levels(np.arange(LANES), SIZES[size]))
        given = level, task.reset(level), jnp.asarray(sticky(STEPS, LANES, 0))
        ways = {
            seen: jax.jit(lambda *g, seen=seen: rollout(*g, seen)).lower(*given).compile() for seen in (False, True)
        }
        best = dict.fromkeys(ways, np.inf)
        for _ in range(REPEATS):  # in turns
            for seen, compiled in ways.items():
                start = time.perf_counter()
                jax.block_until_ready(compiled(*given))
                best[seen] = min(best[seen], time.perf_counter() - start)
        rates = [f"{STEPS * LANES / best[seen]:,.0f}" for seen in (False, True)]
        print("|", " | ".join((size, *rates, f"{1 - best[False] / best[True]:.0%}")), "|", flush=True)


if __name__ == "__main__":
    main()
