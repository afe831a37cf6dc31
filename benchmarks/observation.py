"""What the symbolic-flat observation of every step costs beside the step: env steps/s without and with it."""

import argparse
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.reference.actions import sticky_actions
from benchmarks.reference.serve import timed
from benchmarks.report import Report, Table
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.observe.flat import level_features, symbolic_flat
from levelproof.pipeline.runtime import own_cores, prepare_jax

LANES = 128  # stepped together
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


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")


def run(given: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    results = [measured(size) for size in given.size]
    rows = [
        [of["size"], f"{of['without']:,.0f}", f"{of['with']:,.0f}", f"{1 - of['with'] / of['without']:.0%}"]
        for of in results
    ]
    table = Table(("size", "without", "with", "slower by"), rows, "Env steps/s of one core")
    return Report("The symbolic-flat observation", results, [table])


def measured(size: str) -> dict[str, Any]:
    """Env steps/s, the best of REPEATS in turns."""
    level = jax.tree.map(jnp.asarray, sample_levels(np.arange(LANES), SIZES[size]))
    given = level, task.reset(level), jnp.asarray(sticky_actions(STEPS, LANES))
    ways = {seen: jax.jit(partial(rollout, observed=seen)).lower(*given).compile() for seen in (False, True)}
    best = dict.fromkeys(ways, np.inf)
    for _ in range(REPEATS):
        for seen, compiled in ways.items():
            seconds, _ = timed(lambda compiled=compiled: jax.block_until_ready(compiled(*given)))
            best[seen] = min(best[seen], seconds)
    rate = {seen: STEPS * LANES / seconds for seen, seconds in best.items()}
    return {"size": size, "unit": "env steps/s of one core", "without": rate[False], "with": rate[True]}
