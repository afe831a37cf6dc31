"""Time of training: a rollout and an update on one core, and the program that does both in slots.

Levels stay in their slots, and there are no evaluations.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.endless import endless_slots, update_slots
from benchmarks.report import Report, Table
from levelproof.experts.config import ExpertConfig
from levelproof.experts.policy import network_of
from levelproof.experts.pool.pool import slot_count
from levelproof.experts.training import ppo
from levelproof.experts.training.advance import sample_rows
from levelproof.experts.training.ppo import LevelConstants
from levelproof.experts.training.rollout import ActionRule, rollout, start
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.runtime import own_cores, prepare_jax

REPEATS = 30


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")


def run(args: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    config, parts = ExpertConfig(), ("rollout", "update", "both")
    experts = slot_count(config)
    results = []
    for size in args.size:
        levels = jax.device_get(sample_levels(jnp.arange(experts), SIZES[size]))
        rates = [experts * config.steps_per_update / seconds(call) for call in calls(levels, config)]
        results.append({"size": size, "unit": "env steps/s of one core", **dict(zip(parts, rates, strict=True))})
    rows = [[result["size"], *(f"{result[name]:,.0f}" for name in parts)] for result in results]
    table = Table(("size", "rollout", "update", "both, in slots"), rows, "Env steps/s of one core, the defaults")
    return Report("Rollout and update apart", results, [table])


def calls(levels: Level, config: ExpertConfig) -> Iterator[Callable[[], Any]]:
    """Yield functions without arguments that run a rollout, an update, and both."""
    count = levels.role.shape[-1]
    slots, _ = update_slots(endless_slots(levels, np.arange(count), config), config)
    experts, levels = slots.slot.training.train_state, jax.tree.map(jnp.asarray, levels)
    experts = jax.tree.map(jnp.copy, experts)  # `update_slots` donates its slots
    lanes, network = config.environments * count, network_of(levels.size, config)
    manner = ActionRule.sampling(lanes, count)
    keys, acting = jax.random.split(jax.random.key(0), count), start(repeat(levels, config.environments))
    ours = config.horizon, DEFAULT_RULES
    act = jax.jit(lambda params, acting: rollout(network, params, levels, acting, keys, manner, *ours))
    yield partial(act, experts.params, acting)

    _, trajectory, last_value = act(experts.params, acting)
    rows = sample_rows(trajectory, last_value, manner.rehearsing, config)
    constants = LevelConstants(network.constant(levels), action_mask(levels))
    constants = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), constants)

    @jax.jit
    def update(experts):
        one = lambda inputs: ppo.update(inputs[0], inputs[1], network, inputs[2], inputs[3], config)
        return jax.lax.map(one, (experts, keys, constants, rows))

    yield partial(update, experts)

    def both() -> Any:
        nonlocal slots
        slots, report = update_slots(slots, config)
        return report

    yield both


def seconds(call: Callable[[], Any]) -> float:
    """Return the median seconds of REPEATS calls."""
    jax.block_until_ready(call())
    taken = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        taken.append(time.perf_counter() - begin)
    return float(np.median(taken))
