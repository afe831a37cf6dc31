"""Cost of the symbolic-flat observation of every step, and the speed of `levelproof.Lanes` and `vmap`.

Four ways take turns: lanes that stay on their level, without and with observations; `levelproof.Lanes`, whose lanes
start another level when an episode ends; and `jax.vmap` of `Environment.step`.
"""

import argparse
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.reference.actions import sticky_actions
from benchmarks.report import Report, Table
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.environment import make, starts
from levelproof.levelgen.task.lanes import Lanes
from levelproof.levelgen.task.observe.flat import level_features, symbolic_flat
from levelproof.pipeline.runtime import own_cores, prepare_jax

WAYS = ("without", "with", "Lanes.step", "vmap(env.step)")
LANES = 128  # stepped together
LEVELS = 1024  # in the table
STEPS = 64
REPEATS = 60


def rollout(level, now, actions, observed: bool):
    """Take env steps; carry the observation along, so that XLA computes each one."""
    constant = level_features(level)

    def act(carry, action):
        now, observation = carry
        now, outcome = task.step(level, now, action)
        observation = symbolic_flat(level, now.state, constant) if observed else observation
        return (now, observation), outcome.done.sum()

    start = jnp.zeros((len(constant), actions.shape[-1]))
    return jax.lax.scan(act, (now, start), actions)


def lanes_rollout(lanes, table, played, state, actions, coming):
    """Take env steps with `levelproof.Lanes`; `coming` are the indices of the next levels."""

    def act(carry, inputs):
        observation, state, played, _, done, _ = lanes.step(table, carry[2], carry[1], *inputs)
        return (observation, state, played), done.sum()

    return jax.lax.scan(act, (lanes.observe(state, played), state, played), (actions, coming))


def mapped_rollout(env, params, state, actions, key):
    """Take env steps with `jax.vmap(env.step)`."""
    step = jax.vmap(env.step, (0, 0, 0, None))

    def act(carry, inputs):
        action, key = inputs
        observation, state, _, done, _ = step(jax.random.split(key, len(carry[0])), carry[1], action.T, params)
        return (observation, state), done.sum()

    return jax.lax.scan(act, (jax.vmap(env.get_obs)(state), state), (actions, jax.random.split(key, STEPS)))


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--lanes", type=int, default=LANES, help=f"lanes stepped together (default: {LANES})")
    parser.add_argument(
        "--repeats", type=int, default=REPEATS, help=f"timed runs; the best counts (default: {REPEATS})"
    )


def run(args: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    results = [measured(size, args.lanes, args.repeats) for size in args.size]
    rows = [[result["size"], *(f"{result[way]:,.0f}" for way in WAYS), *_shares(result)] for result in results]
    header = ("size", *WAYS, "observation slower by", "Lanes", "vmap")
    table = Table(
        header,
        rows,
        f"Env steps/s of one core, the best of {args.repeats} runs; Lanes and vmap also as a share of `with`",
    )
    return Report("The symbolic-flat observation", results, [table])


def _shares(result: dict[str, Any]) -> list[str]:
    return [
        f"{share:.0%}"
        for share in (1 - result["with"] / result["without"], *(result[way] / result["with"] for way in WAYS[2:]))
    ]


def measured(size: str, lanes: int, repeats: int) -> dict[str, Any]:
    """Measure env steps/s of each way, in turns; keep the best repeat."""
    levels = jax.tree.map(jnp.asarray, sample_levels(np.arange(LEVELS), size))
    level, action = jax.tree.map(lambda x: x[..., :lanes], levels), jnp.asarray(sticky_actions(STEPS, lanes))
    env, params = make(levels)
    ours = Lanes(env)
    table = jax.jit(ours.table)(params)
    _, state, played = jax.jit(ours.reset)(table, jnp.arange(lanes))
    coming = jax.random.randint(jax.random.key(0), (STEPS, lanes), 0, LEVELS)
    fixed, programs = (level, task.reset(level), action), {}
    for way, program, inputs in (
        ("without", partial(rollout, observed=False), fixed),
        ("with", partial(rollout, observed=True), fixed),
        ("Lanes.step", partial(lanes_rollout, ours), (table, played, state, action, coming)),
        ("vmap(env.step)", partial(mapped_rollout, env), (params, starts(level), action, jax.random.key(0))),
    ):
        programs[way] = jax.jit(program).lower(*inputs).compile(), inputs
    best = dict.fromkeys(programs, np.inf)
    for _ in range(repeats):
        for way, (compiled, inputs) in programs.items():
            begin = time.process_time()  # CPU time, which other processes on the machine disturb less
            jax.block_until_ready(compiled(*inputs))
            best[way] = min(best[way], time.process_time() - begin)
    rates = {way: STEPS * lanes / seconds for way, seconds in best.items()}
    return {"size": size, "lanes": lanes, "unit": "env steps/s of one core", **rates}
