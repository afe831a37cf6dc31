"""Env steps a second against what touches, and against the number of bodies: the plot of docs/physics.md.

    python -m benchmarks.scaling [FILE.svg]

One core, blocks of lanes as a job has them. Left: levels of s, m, l in mid-episode, sorted by their active contacts
and shared out into groups; each group is stepped by itself, under sticky random actions.
Right: custom sizes of 8 to 32 bodies, sampled levels; the dashed line is what a cost that grows with all pairs,
touching or not, would leave of the first point.
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

from levelgen.level import SIZES, Level
from levelgen.sampling.sampler import sample_levels
from levelgen.task import rules as task
from physics.pairs import pairs_of
from physics.types import FIXED_POLYGONS, Size

LEVELS, LANES = 4096, 128  # sampled, and stepped together
SETTLING = 32  # env steps under random actions before the measurement
STEPS = 32  # env steps of a measurement
GROUPS = 8
REPEATS = 15
BODIES = (8, 12, 16, 20, 24, 28, 32)
CHOICES = np.array([3, 3, 3, 3, 2, 2])[:, None]
COLOURS = {"s": "#0072b2", "m": "#d55e00", "l": "#009e73"}  # Okabe and Ito


def take(tree, lanes):
    return jax.tree.map(lambda x: x[..., lanes], tree)


def sticky(steps: int, lanes: int, seed: int) -> np.ndarray:
    """Random actions, (step, 6, lane), each kept for ten steps on average."""
    rng = np.random.default_rng(seed)
    action, actions = np.zeros((len(CHOICES), lanes), np.int32), []
    for _ in range(steps):
        fresh = rng.integers(0, CHOICES, action.shape, dtype=np.int32)
        action = np.where(rng.random(action.shape) < 0.1, fresh, action)
        actions.append(action)
    return np.array(actions)


@jax.jit
def play(level: Level, now: task.TaskState, actions: jax.Array):
    """Some env steps; contacts after each."""

    def act(now, action):
        now, _ = task.step(level, now, action)
        return now, now.state.contact_active.sum(0)

    return jax.lax.scan(act, now, actions)


def in_blocks(level: Level, now: task.TaskState, actions: np.ndarray):
    """All lanes, LANES at a time."""
    cuts = [np.arange(i, i + LANES) for i in range(0, now.timestep.size, LANES)]
    parts = [play(take(level, cut), take(now, cut), actions[..., cut]) for cut in cuts]
    return jax.tree.map(lambda *xs: np.concatenate(xs, -1), *parts)


def rate(level: Level, now: task.TaskState) -> tuple[float, float]:
    """Env steps a second of one core, and active contacts of a lane, on average."""
    actions = jnp.asarray(sticky(STEPS, LANES, 1))
    contacts = jax.block_until_ready(play(level, now, actions))[1]
    best = np.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(play(level, now, actions))
        best = min(best, time.perf_counter() - start)
    return STEPS * LANES / best, float(np.mean(contacts))


def by_contacts(size: str) -> list[tuple[float, float]]:
    """(active contacts, env steps a second) of groups of levels."""
    level = sample_levels(np.arange(LEVELS), SIZES[size])
    now, contacts = in_blocks(level, task.reset(level), sticky(SETTLING, LEVELS, 0))
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
    """Env steps a second, active contacts, and contacts of all pairs, of a custom size."""
    movable = bodies - FIXED_POLYGONS
    circles = movable // 3
    size = Size(bodies - circles, circles, joints=max(1, movable // 3), thrusters=2)
    level = sample_levels(np.arange(LANES), size)
    now, _ = in_blocks(level, task.reset(level), sticky(SETTLING, LANES, 0))
    return *rate(level, now), pairs_of(size).contacts


def main() -> None:
    touching = {size: by_contacts(size) for size in SIZES}
    for size, points in touching.items():
        print(size, *(f"{active:.1f} contacts: {speed:,.0f}" for active, speed in points), sep=" | ")
    grown = [by_bodies(bodies) for bodies in BODIES]
    for bodies, (speed, active, every) in zip(BODIES, grown, strict=True):
        print(f"{bodies} bodies | {speed:,.0f} env steps/s | {active:.1f} of {every} contacts active")
    if sys.argv[1:]:
        draw(touching, grown, sys.argv[1])


def draw(touching: dict, grown: list, file: str) -> None:
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "levelproof", "font.size": 9})
    import matplotlib.pyplot as plt

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
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, linewidth=0.5)
    figure.savefig(file, metadata={"Date": None})


if __name__ == "__main__":
    main()
