"""Cost of the experts' networks: multiply-adds of one env step, and env steps/s of training.

No expert has a transformer: it is counted here, not trained. Its tokens are the floor, movable polygons, circles,
joints and thrusters; policy and value function share no layers, as in the other networks.
"""

import argparse
import time
from typing import Any

import jax
import numpy as np

from benchmarks.endless import endless_slots, update_slots
from benchmarks.report import Report, Table
from levelproof.experts.config import ExpertConfig, Network
from levelproof.experts.networks.entity import KINDS
from levelproof.experts.networks.layers import LOGITS
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.observe.flat import DYNAMIC_ROWS
from levelproof.physics.types import FIXED_POLYGONS, Size
from levelproof.pipeline.runtime import own_cores, prepare_jax

SLOTS, UPDATES, REPEATS = 4, 5, 9  # networks take turns, so that medians compare
LAYERS, MODEL = 2, 64  # of the transformer; the number of heads does not change the count
FEED_FORWARD = 4 * MODEL
CONFIGS = {kind.value: ExpertConfig(network=kind, slots=SLOTS) for kind in Network}
FLAT = CONFIGS["flat"]
STEPS_OF_UPDATES = 3 * FLAT.epochs  # forward passes per env step: a backward pass costs about two more


def multiply_adds(name: str, size: Size) -> int:
    """Count multiply-adds of one forward pass of one lane, without what is folded once per level."""
    moving = len(DYNAMIC_ROWS)
    entities = (size.polygons - FIXED_POLYGONS, size.circles, size.joints, size.thrusters)
    moving_rows = sum(n * len(kind.moving_rows) for n, kind in zip(entities, KINDS, strict=True))
    if name == "transformer":
        tokens = 1 + sum(entities)
        projections = 4 * MODEL * MODEL  # queries, keys, values, outputs
        layer = tokens * (projections + 2 * tokens * MODEL + 2 * MODEL * FEED_FORWARD)
        trunk = moving_rows * MODEL + LAYERS * layer
        last = MODEL
    elif name == "entity":
        config = CONFIGS[name]
        sums = sum(entities) * config.encoding
        kinds = sum(n > 0 for n in (1, *entities[1:]))
        trunk = moving_rows * config.encoding + sums + kinds * config.encoding * config.width
        trunk, last = trunk + (config.depth - 2) * config.width**2, config.width
    else:
        config = CONFIGS[name]
        trunk = (size.bodies - FIXED_POLYGONS) * moving * config.width + (config.depth - 1) * config.width**2
        last = config.width
    ends = (2 * size.joints + size.thrusters) * (size.bodies - FIXED_POLYGONS) * moving if name != "flat" else 0
    return 2 * trunk + last * (LOGITS + 1) + ends


def ready(size: Size, config: ExpertConfig):
    """Train UPDATES updates; return a function that trains as many more."""
    ids = np.arange(SLOTS)
    slots = endless_slots(jax.device_get(sample_levels(ids, size)), ids, config)

    def train() -> None:
        nonlocal slots
        for _ in range(UPDATES):
            slots, _ = update_slots(slots, config)
        jax.block_until_ready(slots)

    train()
    return train


def rates(size: Size) -> dict[str, float]:
    """Measure env steps/s of training on one core, in turns; return medians."""
    contestants = {name: ready(size, config) for name, config in CONFIGS.items()}
    seconds = {name: [] for name in contestants}
    for _ in range(REPEATS):
        for name, train in contestants.items():
            start = time.process_time()
            train()
            seconds[name].append(time.process_time() - start)
    return {name: SLOTS * UPDATES * CONFIGS[name].steps_per_update / np.median(s) for name, s in seconds.items()}


def register(_: argparse.ArgumentParser) -> None:
    """Add nothing: the benchmark has no arguments of its own."""


def run(_: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    results = [result(name, size) for name, size in SIZES.items()]
    names = ("flat", "entity", "transformer")
    counts = [
        [*(f"{result['multiply_adds'][n]:,}" for n in names), f"{result['with_updates']:,}"] for result in results
    ]
    speeds = [[f"{rate:,.0f}" for rate in result["env_steps_per_second"].values()] for result in results]
    sizes = [result["size"] for result in results]
    rows = lambda cells: [[size, *result] for size, result in zip(sizes, cells, strict=True)]
    return Report(
        title="Networks",
        results=results,
        tables=[
            Table(("size", *names, "transformer with its updates"), rows(counts), "Multiply-adds of one env step"),
            Table(("size", *CONFIGS), rows(speeds), "Env steps/s of a core, training"),
        ],
        notes=["No expert has a transformer: it is counted here, not trained."],
    )


def result(name: str, size: Size) -> dict[str, Any]:
    adds = {network: multiply_adds(network, size) for network in ("flat", "entity", "transformer")}
    updates = (1 + STEPS_OF_UPDATES) * adds["transformer"]
    return {"size": name, "multiply_adds": adds, "with_updates": updates, "env_steps_per_second": rates(size)}
