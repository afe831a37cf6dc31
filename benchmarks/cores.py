"""Speedup of one process on several cores, which JAX sees as devices: env steps/s of `levelproof.Lanes`."""

import argparse
import os
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, PartitionSpec

from benchmarks.observation import LEVELS, STEPS, lanes_rollout
from benchmarks.reference.actions import sticky_actions
from benchmarks.report import Report, Table
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.environment import make
from levelproof.levelgen.task.lanes import Lanes
from levelproof.pipeline.runtime import own_cores

LANES_PER_CORE = 512
REPEATS = 30


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=["s"], help="default: s")
    parser.add_argument(
        "--repeats", type=int, default=REPEATS, help=f"timed runs; the best counts (default: {REPEATS})"
    )


def run(args: argparse.Namespace) -> Report:
    count = len(own_cores())
    flags = os.environ.get("XLA_FLAGS", ""), f"--xla_force_host_platform_device_count={count}"
    os.environ["XLA_FLAGS"] = " ".join(flags).strip()
    results = [measured(size, count, args.repeats) for size in args.size]
    rows = [
        [result["size"], f"{result['one']:,.0f}", f"{result['all']:,.0f}", f"{result['all'] / result['one']:.2f}"]
        for result in results
    ]
    caption = (
        f"Env steps/s of one process, the best of {args.repeats} runs. Undivided work moves between the cores; held on "
        "one, it runs at the speed of `Lanes.step` in `observation`"
    )
    table = Table(("size", "undivided", f"{count} cores", "times"), rows, caption)
    return Report("All cores from one process", results, [table])


def measured(size: str, count: int, repeats: int) -> dict[str, Any]:
    """Measure env steps/s on one core and on all, in turns; keep the best repeat of each."""
    env, params = make(sample_levels(np.arange(LEVELS), size))
    programs = {cores: _program(Lanes(env), params, cores) for cores in (1, count)}
    best = dict.fromkeys(programs, np.inf)
    for _ in range(repeats):
        for cores, (compiled, inputs) in programs.items():
            begin = time.perf_counter()
            jax.block_until_ready(compiled(*inputs))
            best[cores] = min(best[cores], time.perf_counter() - begin)
    rates = {cores: STEPS * LANES_PER_CORE * cores / seconds for cores, seconds in best.items()}
    return {"size": size, "cores": count, "unit": "env steps/s", "one": rates[1], "all": rates[count]}


def _program(lanes: Lanes, params: Any, cores: int) -> tuple[Any, tuple]:
    """Compile a rollout, with its lanes divided among the cores if there are several; return it with its inputs."""
    total = LANES_PER_CORE * cores
    table = jax.jit(lanes.table)(params)
    _, state, played = jax.jit(lanes.reset)(table, jnp.arange(total) % LEVELS)
    coming = jax.random.randint(jax.random.key(0), (STEPS, total), 0, LEVELS)
    inputs = table, played, state, jnp.asarray(sticky_actions(STEPS, total)), coming
    rollout = lambda *inputs: lanes_rollout(lanes, *inputs)[0]
    if cores == 1:  # as it runs for a caller who does not divide the lanes
        return jax.jit(rollout).lower(*inputs).compile(), inputs
    mesh = jax.make_mesh((cores,), ("core",), axis_types=(AxisType.Auto,), devices=jax.devices()[:cores])
    lanes_last = partial(jax.tree.map, lambda x: PartitionSpec(*[None] * (x.ndim - 1), "core"))
    everywhere = jax.tree.map(lambda _: PartitionSpec(), table)
    specs = everywhere, *map(lanes_last, inputs[1:])
    out = lanes_last(jax.eval_shape(rollout, *inputs))
    divided = jax.shard_map(rollout, mesh=mesh, in_specs=specs, out_specs=out, check_vma=False)
    placed = jax.tree.map(lambda x, spec: jax.device_put(x, jax.sharding.NamedSharding(mesh, spec)), inputs, specs)
    return jax.jit(divided).lower(*placed).compile(), placed
