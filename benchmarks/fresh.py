"""Speed of random play on new levels at every reset, beside a table of levels: `levelproof.make("s")` against
`levelproof.make(levels)`, by `jax.vmap` and by `levelproof.Lanes`, with episodes of the usual length and short ones.

The programs take turns. Each continues its episodes from one turn to the next, so that a turn has the same mix of
episode ages as long play.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import levelproof
from benchmarks.report import Report, Table
from levelproof.levelgen.identity.keys import FRESH_BITS
from levelproof.levelgen.level import ACTIONS, SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.lanes import Lanes
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.runtime import own_cores, prepare_jax

LEVELS = 1024  # in the table
LANES = 512  # stepped together
STEPS = 64  # in a turn
LENGTHS = 256, 16  # env steps after which an episode ends
TURNS = 12
WARM_UP = 4  # turns before the timed ones: as many steps as an episode may have

Turn = Callable[[Any, jax.Array], tuple[Any, jax.Array]]  # takes and returns the episodes; returns those that ended


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--lanes", type=int, default=LANES, help=f"lanes stepped together (default: {LANES})")
    parser.add_argument("--turns", type=int, default=TURNS, help=f"timed turns; the median counts (default: {TURNS})")


def run(args: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    results = [measured(size, limit, args.lanes, args.turns) for size in args.size for limit in LENGTHS]
    head = ("size", "longest episode", "episodes/1,000 steps", "vmap, table", "fresh", "share")
    head = (*head, "Lanes, table", "fresh", "share")
    return Report(
        title="Fresh levels at every reset",
        results=results,
        tables=[Table(head, [row(result) for result in results], "Env steps/s of one core, with observations")],
        notes=[
            f"Random actions in {args.lanes} lanes, {STEPS} steps in a turn; the table has {LEVELS:,} levels. Rates "
            "are medians over turns, shares medians of the ratio in one turn. Episodes: on fresh levels, by vmap."
        ],
    )


def row(result: dict[str, Any]) -> list[str]:
    cells = [result["size"], str(result["longest"]), f"{1000 * result['ended']:.1f}"]
    for way in ("vmap", "Lanes"):
        cells += [
            f"{result[f'{way}, table']:,.0f}",
            f"{result[f'{way}, fresh']:,.0f}",
            f"{result[f'{way}, share']:.2f}",
        ]
    return cells


def measured(size: str, limit: int, lanes: int, turns: int) -> dict[str, Any]:
    """Measure env steps/s of each way, in turns."""
    rules, ways = TaskParams(max_timesteps=limit), {}
    for levels, given, count in (
        ("table", sample_levels(np.arange(LEVELS), size), LEVELS),
        ("fresh", size, 2**FRESH_BITS),
    ):
        env, params = levelproof.make(given, rules=rules)
        ways[f"vmap, {levels}"] = mapped(env, params, lanes)
        ways[f"Lanes, {levels}"] = in_lanes(env, params, lanes, count)
    episodes = {way: begin for way, (begin, _) in ways.items()}
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    ended = 0
    for turn in range(WARM_UP + turns):
        for way, (_, play) in ways.items():
            start = time.process_time()  # CPU time, which other processes on the machine disturb less
            episodes[way], over = jax.block_until_ready(play(episodes[way], jax.random.key(turn)))
            if turn >= WARM_UP:
                seconds[way].append(time.process_time() - start)
                ended += int(over) if way == "vmap, fresh" else 0
    steps = STEPS * lanes
    rates = {way: steps / float(np.median(spent)) for way, spent in seconds.items()}
    shares = {
        f"{way}, share": float(np.median(np.divide(seconds[f"{way}, table"], seconds[f"{way}, fresh"])))
        for way in ("vmap", "Lanes")
    }
    ended_share = ended / (turns * steps)
    return {"size": size, "longest": limit, "unit": "env steps/s of one core", "ended": ended_share, **rates, **shares}


def mapped(env: Any, params: Any, lanes: int) -> tuple[Any, Turn]:
    """Return episodes from `jax.vmap(env.reset)` and a function that plays STEPS of `jax.vmap(env.step)`."""
    reset, step = jax.vmap(env.reset, (0, None)), jax.vmap(env.step, (0, 0, 0, None))
    choose = jax.vmap(env.action_space(params).sample)

    @jax.jit
    def play(episodes, key):
        def act(carry, key):
            state, over, total = carry
            acting, stepping = jax.random.split(key)
            action = choose(jax.random.split(acting, lanes))
            observation, state, _, done, _ = step(jax.random.split(stepping, lanes), state, action, params)
            return (state, over + done.sum(), total + observation.sum()), None  # so that XLA computes observations

        (state, over, total), _ = jax.lax.scan(act, (episodes[0], 0, 0.0), jax.random.split(key, STEPS))
        return (state, total), over

    _, state = jax.jit(reset)(jax.random.split(jax.random.key(0), lanes), params)
    return (state, 0.0), play


def in_lanes(env: Any, params: Any, lanes: int, count: int) -> tuple[Any, Turn]:
    """Return episodes from `Lanes.reset` and a function that plays STEPS of `Lanes.step`.

    A lane's next level is one of `count`.
    """
    ours = Lanes(env)
    table = jax.jit(ours.table)(params)

    @jax.jit
    def play(episodes, key):
        def act(carry, key):
            state, played, over, total = carry
            acting, coming = jax.random.split(key)
            action = jax.random.randint(acting, (ACTIONS, lanes), 0, jnp.array(CHOICES)[:, None])
            index = jax.random.randint(coming, (lanes,), 0, count)
            observation, state, played, _, done, _ = ours.step(table, played, state, action, index)
            return (state, played, over + done.sum(), total + observation.sum()), None

        carry = (*episodes[:2], 0, 0.0)
        (state, played, over, total), _ = jax.lax.scan(act, carry, jax.random.split(key, STEPS))
        return (state, played, total), over

    _, state, played = jax.jit(ours.reset)(table, jax.random.randint(jax.random.key(0), (lanes,), 0, count))
    return (state, played, 0.0), play
