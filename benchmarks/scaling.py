"""Env steps/s against active contacts, and against the number of bodies.

One core, in blocks of lanes as in a job. Left: levels of s, m and l in mid-episode, sorted by their active contacts and
divided into groups; each group is stepped by itself, under sticky random actions. Right: sampled levels of custom sizes
of 8 to 32 bodies; the dashed line extrapolates the first point as if cost grew with all pairs, touching or not.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from benchmarks.plotting import pyplot, save
from benchmarks.reference.actions import sticky_actions
from benchmarks.report import Report, Table
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task import rules as task
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import FIXED_POLYGONS, Size
from levelproof.pipeline.runtime import own_cores, prepare_jax

LEVELS, LANES = 4096, 128  # sampled, and stepped together
SETTLING = 32  # env steps under random actions before the measurement
STEPS = 32  # env steps of a measurement
GROUPS = 8
REPEATS = 15
BODIES = (8, 12, 16, 20, 24, 28, 32)
PLOT = "scaling.svg"
COLOURS = {"s": "#0072b2", "m": "#d55e00", "l": "#009e73"}  # Okabe and Ito


def take(tree, lanes):
    return jax.tree.map(lambda x: x[..., lanes], tree)


@jax.jit
def play(level: Level, now: task.TaskState, actions: jax.Array):
    """Take env steps; return the active contacts after each."""

    def act(now, action):
        now, _ = task.step(level, now, action)
        return now, now.state.contact_active.sum(0)

    return jax.lax.scan(act, now, actions)


def in_blocks(level: Level, now: task.TaskState, actions: Int[np.ndarray, "step 6 lane"]) -> tuple[task.TaskState, Any]:
    """Play all lanes, LANES at a time."""
    cuts = [np.arange(i, i + LANES) for i in range(0, now.timestep.size, LANES)]
    parts = [play(take(level, cut), take(now, cut), actions[..., cut]) for cut in cuts]
    return jax.tree.map(lambda *xs: np.concatenate(xs, -1), *parts)


def rate(level: Level, now: task.TaskState) -> tuple[float, float]:
    """Measure env steps/s of one core, and the mean active contacts of a lane."""
    actions = jnp.asarray(sticky_actions(STEPS, LANES, 1))
    contacts = jax.block_until_ready(play(level, now, actions))[1]
    best = np.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(play(level, now, actions))
        best = min(best, time.perf_counter() - start)
    return STEPS * LANES / best, float(np.mean(contacts))


def by_contacts(size: str) -> list[tuple[float, float]]:
    """Measure (active contacts, env steps/s) of groups of levels."""
    level = sample_levels(np.arange(LEVELS), SIZES[size])
    now, contacts = in_blocks(level, task.reset(level), sticky_actions(SETTLING, LEVELS))
    order = np.argsort(contacts[-1], kind="stable")
    points = []
    for quantile in (np.arange(GROUPS) + 0.5) / GROUPS:
        middle = int(quantile * LEVELS)
        first = min(max(middle - LANES // 2, 0), LEVELS - LANES)
        lanes = order[first : first + LANES]
        speed, active = rate(take(level, lanes), take(now, lanes))
        points.append((active, speed))
    return sorted(points)


def by_bodies(bodies: int) -> tuple[float, float, int]:
    """Measure env steps/s, active contacts, and contacts of all pairs, of a custom size."""
    movable = bodies - FIXED_POLYGONS
    circles = movable // 3
    size = Size(bodies - circles, circles, joints=max(1, movable // 3), thrusters=2)
    level = sample_levels(np.arange(LANES), size)
    now, _ = in_blocks(level, task.reset(level), sticky_actions(SETTLING, LANES))
    return *rate(level, now), pairs_of(size).contacts


def register(_: argparse.ArgumentParser) -> None:
    """Add nothing: the benchmark has no arguments of its own."""


def run(_: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    touching = {size: by_contacts(size) for size in SIZES}
    grown = [by_bodies(bodies) for bodies in BODIES]
    results = [
        {"size": size, "contacts": active, "env_steps_per_second": speed}
        for size, points in touching.items()
        for active, speed in points
    ]
    results += [
        {"bodies": bodies, "contacts": active, "all_contacts": every, "env_steps_per_second": speed}
        for bodies, (speed, active, every) in zip(BODIES, grown, strict=True)
    ]
    left = [[size, f"{active:.1f}", f"{speed:,.0f}"] for size, points in touching.items() for active, speed in points]
    right = [
        [str(bodies), f"{active:.1f}", str(every), f"{speed:,.0f}"]
        for bodies, (speed, active, every) in zip(BODIES, grown, strict=True)
    ]
    return Report(
        title="Env steps/s against contacts and bodies",
        results=results,
        tables=[
            Table(("size", "active contacts", "env steps/s"), left, "Levels in groups by active contacts"),
            Table(("bodies", "active contacts", "contacts of all pairs", "env steps/s"), right, "Custom sizes"),
        ],
        notes=[f"![Env steps/s against active contacts, and against bodies]({PLOT})"],
        plots={PLOT: lambda path: draw(touching, grown, path)},
    )


def draw(touching: dict, grown: list, file: Path) -> None:
    plt = pyplot()

    figure, (left, right) = plt.subplots(1, 2, figsize=(8.6, 3.4), layout="constrained")
    for size, points in touching.items():
        left.plot(*zip(*points, strict=True), "o-", color=COLOURS[size], markersize=4, label=f"size {size}")
    left.set(xlabel="active contacts of a level", ylabel="env steps/s, one core", yscale="log")
    left.legend(frameon=False)
    speeds, _, every = zip(*grown, strict=True)
    right.plot(BODIES, speeds, "o-", color=COLOURS["s"], markersize=4, label="measured")
    right.plot(
        BODIES, speeds[0] * every[0] / np.array(every), "--", color="#777777", label="if cost grew with all pairs"
    )
    right.set(xlabel="bodies, the four of the scenery included", yscale="log")
    right.legend(frameon=False)
    for axes in (left, right):
        axes.grid(alpha=0.25, linewidth=0.5)
    save(figure, file)
