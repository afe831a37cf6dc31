"""Steps to the goal of witnesses before and after polishing, and of experts that master their levels."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int

from benchmarks.alone import label
from benchmarks.oracle import log
from benchmarks.report import Report, Table
from levelproof.configs.compose import compose_job
from levelproof.experts.labels import BY_EXPERT, Label
from levelproof.experts.pool.rework import rework
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.procedure import Procedure
from levelproof.experts.verdict.judge import Witness
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.runtime import prepare_jax

FIRST = 1_000_000  # first level id; the search was tuned on others
LEVELS = {"s": 64, "m": 64, "l": 32}
BUDGET = 256_000  # env steps of an expert
POLISH = (16_384, 65_536, 262_144)  # env steps per witness


@dataclass(frozen=True)
class Lengths:
    """Env steps to the goal on levels that both procedures solve; masters must do so by an expert's own witness."""

    default: Int[np.ndarray, " level"]
    polished: Int[np.ndarray, "budget level"]
    masters: Int[np.ndarray, " level"]


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--levels", type=int, help="ids of each size (default: 64 of s and m, 32 of l)")
    parser.add_argument("--first", type=int, default=FIRST, help=f"first level id (default: {FIRST:,})")


def run(args: argparse.Namespace) -> Report:
    prepare_jax()
    lengths_by_size = {size: lengths(size, args.first, args.levels or LEVELS[size]) for size in args.size}
    budgets = [f"{budget:,}" for budget in POLISH]
    return Report(
        title="Polished witnesses",
        results=[{"size": size} | summary(lengths) for size, lengths in lengths_by_size.items()],
        tables=[
            Table(
                ("size", "levels", "default", *(f"polished, {budget}" for budget in budgets), "masters"),
                [
                    [size, str(len(lengths.default)), *(f"{x:.1f}" for x in means(lengths))]
                    for size, lengths in lengths_by_size.items()
                ],
                "Mean steps to the goal",
            ),
            Table(
                ("size", "longer than polished, mean", "median", "as short or shorter"),
                [
                    [size, f"{excess.mean():.0%}", f"{np.median(excess):.0%}", f"{(excess <= 0).mean():.0%}"]
                    for size, lengths in lengths_by_size.items()
                    for excess in [masters_excess(lengths)]
                ],
                f"Masters, against witnesses polished for {budgets[-1]} env steps",
            ),
        ],
        notes=[
            f"Levels from id {args.first:,} on, experts of {BUDGET:,} env steps; only levels count that the default "
            "procedure solves and for which `procedure=masters` has a witness of its expert's own. *Polished*: the "
            "default's witnesses after this many env steps of `search.polish` each, the shortest whatever its "
            "portability.",
        ],
    )


def lengths(size: str, first: int, count: int) -> Lengths:
    """Measure `count` levels of a size from id `first` on."""
    ids = np.arange(first, first + count, dtype=np.int32)
    levels = jax.tree.map(np.asarray, sample_levels(ids, SIZES[size]))
    default, masters = (
        label(levels, ids, BUDGET, compose_job([f"procedure={name}"]).procedure, DEFAULT_RULES)
        for name in ("default", "masters")
    )
    both = [
        i
        for i, (one, other) in enumerate(zip(default.verdicts, masters.verdicts, strict=True))
        if one.label is Label.SOLVED and other.witness in BY_EXPERT
    ]
    log(f"{size}: {len(both)} of {count} levels count.")
    witnesses, indices = [witness_of(default, i) for i in both], np.array(both, int)
    polished = [steps_of(polish(take(levels, indices), ids[indices], witnesses, env_steps)) for env_steps in POLISH]
    return Lengths(steps_of(witnesses), np.array(polished), steps_of([witness_of(masters, i) for i in both]))


def polish(levels: Level, level_ids: Int[np.ndarray, " level"], witnesses: Sequence[Witness], env_steps: int) -> list:
    """Polish witnesses; return the shortest of each level, whatever its portability."""
    procedure = Procedure()
    only = replace(
        procedure, search=replace(procedure.search, polish=env_steps), expert=replace(procedure.expert, replays=0)
    )
    return rework(levels, level_ids, witnesses, only, DEFAULT_RULES)[0]


def witness_of(result: UnitResult, index: int) -> Witness:
    verdict = result.verdicts[index]
    assert verdict.witness is not None
    assert verdict.steps_to_goal is not None
    return Witness(np.asarray(result.record.action)[..., index], verdict.witness, verdict.steps_to_goal)


def steps_of(witnesses: Sequence[Witness]) -> Int[np.ndarray, " level"]:
    return np.array([witness.steps for witness in witnesses], int)


def means(lengths: Lengths) -> list[float]:
    return [float(x.mean()) for x in (lengths.default, *lengths.polished, lengths.masters)]


def masters_excess(lengths: Lengths) -> Float[np.ndarray, " level"]:
    """Return the excess of masters' steps over the most polished witness, as a share."""
    return lengths.masters / lengths.polished[-1] - 1


def summary(lengths: Lengths) -> dict:
    """Summarise one size as a JSON document."""
    default, *polished, masters = means(lengths)
    return {
        "levels": len(lengths.default),
        "default": default,
        "polished": dict(zip(map(str, POLISH), polished, strict=True)),
        "masters": masters,
        "masters_excess": float(masters_excess(lengths).mean()),
    }
