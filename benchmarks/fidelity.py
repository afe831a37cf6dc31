"""Whether our random levels are distributed as the reference's, statistic by statistic, from equally many of each.

Statistics with many values are compared by the two-sample test of Kolmogorov and Smirnov, the others by a chi-square
test of counts; p is corrected for the number of statistics of a size (Holm). Idle episodes of both are played on our
engine, so that only the levels can differ. The benchmark fails if a statistic differs.
"""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Shaped
from scipy import stats

from benchmarks import oracle
from benchmarks.reference.level_statistics import statistics
from benchmarks.report import Report, Table
from benchmarks.statistics import holm
from levelproof.experts.verdict.before import facts_of
from levelproof.levelgen.files.kinetix import level_from_kinetix, state_to_kinetix
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.proofs import Proof
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.runtime import prepare_jax

SIGNIFICANT = 1e-3
COUNTED = 40  # statistics with at most this many distinct values are compared by counts
RARE = 10  # values rarer than this, in both samples together, are pooled
Samples = dict[str, Shaped[np.ndarray, " value"]]  # by statistic: one value per level, body, joint or thruster
CODES = ("role", "roles", "kinds", "place", "binding")  # last words of statistics whose values are codes


@dataclass(frozen=True)
class Compared:
    """One statistic of one size, compared."""

    ours: str
    theirs: str
    p: float | None  # None: all values of both samples are equal
    corrected: float | None


@dataclass(frozen=True)
class SizeReport:
    size: str
    levels: int
    statistics: dict[str, Compared]

    @property
    def differ(self) -> list[str]:
        return [name for name, c in self.statistics.items() if c.corrected is not None and c.corrected < SIGNIFICANT]


def reference_levels(size: str, count: int, seed: int) -> Level:
    """Load levels of the reference's sampler from the cache folder; sample them on first use."""
    with np.load(oracle.sampled_levels(oracle.oracle_python(), size, count, seed)) as file:
        return level_from_kinetix({name: file[name] for name in file.files})


def samples(level: Level) -> Samples:
    """Compute the values of every statistic."""
    lanes = level.role.shape[-1]
    zeros = np.zeros(lanes, np.int32), np.zeros(lanes, np.float32)
    facts = jax.device_get(facts_of(level, DEFAULT_RULES))
    return statistics(state_to_kinetix(level, level.state, *zeros)) | {
        "noop reaches the goal": facts.reaches,
        "noop touches red": facts.fails,
        "noop proves it unsolvable": facts.proof != Proof.NONE,
    }


def p_value(ours: Shaped[np.ndarray, " value"], theirs: Shaped[np.ndarray, " value"]) -> float | None:
    """Test the hypothesis that both samples share a distribution; None if all values are equal."""
    ours, theirs = (np.asarray(x, np.float32) for x in (ours, theirs))
    values = np.unique(np.concatenate([ours, theirs]))
    if len(values) <= 1:
        return None
    if len(values) > COUNTED and len(ours) and len(theirs):
        return float(stats.ks_2samp(ours, theirs, method="asymp").pvalue)  # pyright: ignore[reportAttributeAccessIssue]
    table = np.array([[(x == value).sum() for value in values] for x in (ours, theirs)])
    rare = table.sum(0) < RARE
    table = np.concatenate([table[:, ~rare], table[:, rare].sum(1, keepdims=True)], 1)
    table = table[:, table.sum(0) > 0]
    if table.shape[1] == 1:
        return 1.0
    if not table.sum(1).all():
        return 0.0  # one sample is empty, the other is not
    return float(stats.chi2_contingency(table).pvalue)  # pyright: ignore[reportAttributeAccessIssue]


def compare(ours: Samples, theirs: Samples) -> dict[str, Compared]:
    """Compare statistic by statistic; leave out those that neither side has values of."""
    names = [name for name in theirs if len(ours[name]) or len(theirs[name])]
    p = {name: p_value(ours[name], theirs[name]) for name in names}
    varied = [name for name in names if p[name] is not None]
    corrected = dict(zip(varied, holm([p[name] or 0.0 for name in varied]), strict=True))
    return {
        name: Compared(summarise(name, ours[name]), summarise(name, theirs[name]), p[name], corrected.get(name))
        for name in names
    }


def summarise(name: str, values: Shaped[np.ndarray, " value"]) -> str:
    """Summarise a sample: its mean, its share of True, or its most frequent code with the share."""
    if not len(values):
        return "none"
    if name.split()[-1] in CODES:
        different, counts = np.unique(values, return_counts=True)
        return f"{different[counts.argmax()]:g}: {counts.max() / len(values):.1%}"
    return f"{values.mean():.2%}" if values.dtype == bool else f"{values.mean():.4g}"


def measured(size: str, count: int, seed: int) -> SizeReport:
    theirs = reference_levels(size, count, seed)
    ours = jax.tree.map(np.asarray, sample_levels(np.arange(count), SIZES[size]))
    return SizeReport(size, count, compare(samples(ours), samples(theirs)))


def summary(reports: Sequence[SizeReport]) -> Table:
    """Summarise the comparison in a column per size."""
    tested = [[c for c in r.statistics.values() if c.p is not None and c.corrected is not None] for r in reports]
    rows: dict[str, list[Any]] = {
        "levels of each": [f"{r.levels:,}" for r in reports],
        "statistics": [len(r.statistics) for r in reports],
        "of them the same number in every level": [
            len(r.statistics) - len(varied) for r, varied in zip(reports, tested, strict=True)
        ],
        "smallest p": [smallest(c.p for c in varied) for varied in tested],
        "smallest corrected p": [smallest(c.corrected for c in varied) for varied in tested],
        f"differ (corrected p < {SIGNIFICANT:g})": [len(r.differ) for r in reports],
    }
    return Table(("", *(r.size for r in reports)), [[name, *map(str, cells)] for name, cells in rows.items()])


def smallest(p: Iterable[float | None]) -> str:
    return f"{min(x for x in p if x is not None):.2g}"


def table(reports: Sequence[SizeReport]) -> Table:
    """List every statistic: ours, the reference's and p of each size, and the verdict."""
    rows = []
    for name in dict.fromkeys(name for r in reports for name in r.statistics):
        cells = [cell for r in reports for cell in _cells(r.statistics.get(name))]
        off = [r.size for r in reports if name in r.differ]
        rows.append([name, *cells, f"differs: {', '.join(off)}" if off else "same"])
    head = [title for r in reports for title in (f"{r.size}: ours", "reference", "p")]
    return Table(("statistic", *head, "verdict"), rows)


def _cells(c: Compared | None) -> tuple[str, str, str]:
    return ("", "", "") if c is None else (c.ours, c.theirs, "" if c.p is None else f"{c.p:.2g}")


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--levels", type=int, default=20_000, help="levels from each sampler (default: 20,000)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the reference's sampler (default: 0)")


def run(args: argparse.Namespace) -> Report:
    prepare_jax()
    reports = [measured(size, args.levels, args.seed) for size in args.size]
    off = [f"{name} of {r.size}" for r in reports for name in r.differ]
    return Report(
        title="Random levels, ours and the reference's",
        results=[
            {"size": r.size, "levels": r.levels, "differ": r.differ, "statistics": plain(r.statistics)} for r in reports
        ],
        tables=[summary(reports), table(reports)],
        notes=[
            "Means, shares of what is true; of a name or a place the most frequent one and its share. "
            "No p: every level of both has the same value."
        ],
        reference=oracle.versions(oracle.oracle_python()),
        fault=f"Statistics that differ from the reference's: {', '.join(off)}." if off else "",
    )


def plain(statistics: dict[str, Compared]) -> dict[str, dict]:
    names = {"ours": "ours", "theirs": "reference", "p": "p", "corrected": "corrected_p"}
    return {name: {names[key]: value for key, value in asdict(c).items()} for name, c in statistics.items()}
