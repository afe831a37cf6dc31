"""Are our random levels the reference's? Statistic by statistic, from as many levels of each.

    python -m benchmarks.fidelity [SIZE ...] [--levels 20000] [--keep FOLDER] [--write docs/levels.md]

Statistics with many values are compared by the two-sample test of Kolmogorov and Smirnov, the others by a chi-square
test of counts; p is corrected for the number of statistics of a size (Holm). Doing nothing is played on our engine for
both, so that only the levels can differ. Exits with 1 where a statistic differs.

The reference samples in a process of its own; its levels stay in the cache folder for the next time, or in the folder
that `--keep` names.
"""

import argparse
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy import stats

from benchmarks.document import between_marks
from benchmarks.oracle import environment, oracle_python, tell
from benchmarks.reference.level_statistics import statistics
from experts.before import facts_of
from levelgen.files.kinetix import level_from_kinetix, state_to_kinetix
from levelgen.level import SIZES, Level
from levelgen.proofs import Proof
from levelgen.sampling.sampler import sample_levels
from levelgen.task.rules import DEFAULT_RULES
from pipeline.runtime import cache_folder

SIGNIFICANT = 1e-3
COUNTED = 40  # statistics with at most so many different values are compared by their counts
RARE = 10  # values seen less often, in both samples together, are counted as one
CODES = ("role", "roles", "kinds", "place", "binding")  # last words of statistics whose numbers are names
MARK = "fidelity"

REFERENCE = """
import dataclasses, sys
import jax, numpy as np
from kinetix.environment import EnvParams, static_env_params_from_size
from kinetix.environment.ued.ued import make_reset_fn_sample_kinetix_level
path, size, (count, seed, batch) = sys.argv[1], sys.argv[2], map(int, sys.argv[3:])
def flatten(state, prefix=""):
    fields = {}
    for field in dataclasses.fields(state):
        value, name = getattr(state, field.name), prefix + field.name
        fields |= flatten(value, name + "/") if dataclasses.is_dataclass(value) else {name: np.asarray(value)}
    return fields
sample = jax.jit(jax.vmap(make_reset_fn_sample_kinetix_level(EnvParams(), static_env_params_from_size(size))))
keys = jax.random.split(jax.random.PRNGKey(seed), -(-count // batch) * batch).reshape(-1, batch, 2)
parts = [flatten(sample(some)) for some in keys]
np.savez_compressed(path, **{name: np.concatenate([part[name] for part in parts])[:count] for name in parts[0]})
"""
BATCH = 500  # of the reference: its memory grows with the batch


@dataclass(frozen=True)
class Compared:
    """One statistic of one size."""

    ours: str
    theirs: str
    p: float | None  # None: one and the same value in every level of both
    corrected: float | None


@dataclass(frozen=True)
class SizeReport:
    size: str
    levels: int
    statistics: dict[str, Compared]

    @property
    def differ(self) -> list[str]:
        return [name for name, c in self.statistics.items() if c.corrected is not None and c.corrected < SIGNIFICANT]


def reference_levels(folder: Path, size: str, count: int, seed: int) -> Level:
    """Levels of the reference's sampler, from `folder` if they are there."""
    path = folder / f"levels-{size}-{count}-{seed}.npz"
    if not path.is_file():
        tell(f"Sampling {count} levels of size {size} with the reference ...")
        folder.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f"unfinished-{path.name}")
        words = map(str, (oracle_python(), "-c", REFERENCE, unfinished, size, count, seed, BATCH))
        subprocess.run(list(words), env=environment(), check=True)
        unfinished.replace(path)
    with np.load(path) as file:
        return level_from_kinetix({name: file[name] for name in file.files})


def samples(level: Level) -> dict[str, np.ndarray]:
    """Every statistic's values."""
    lanes = level.role.shape[-1]
    zeros = np.zeros(lanes, np.int32), np.zeros(lanes, np.float32)
    facts = facts_of(level, DEFAULT_RULES)
    return statistics(state_to_kinetix(level, level.state, *zeros)) | {
        "noop reaches the goal": facts.reaches,
        "noop touches red": facts.fails,
        "noop proves it unsolvable": facts.proof != Proof.NONE,
    }


def p_value(ours: np.ndarray, theirs: np.ndarray) -> float | None:
    """Of the hypothesis that both samples have one distribution; None where both hold one and the same value."""
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
        return 0.0  # one side never has what the other has
    return float(stats.chi2_contingency(table)[1])


def holm(p: Sequence[float]) -> list[float]:
    """Corrected p, in the given order: below a bound where Holm's procedure rejects at that bound."""
    order, corrected, worst = np.argsort(p), [0.0] * len(p), 0.0
    for rank, i in enumerate(order):
        worst = max(worst, min(1.0, (len(p) - rank) * p[i]))
        corrected[i] = worst
    return corrected


def compare(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> dict[str, Compared]:
    """Statistic by statistic; what neither side ever has is left out."""
    names = [name for name in theirs if len(ours[name]) or len(theirs[name])]
    p = {name: p_value(ours[name], theirs[name]) for name in names}
    varied = [name for name in names if p[name] is not None]
    corrected = dict(zip(varied, holm([p[name] or 0.0 for name in varied]), strict=True))
    return {
        name: Compared(told(name, ours[name]), told(name, theirs[name]), p[name], corrected.get(name)) for name in names
    }


def told(name: str, values: np.ndarray) -> str:
    """A sample in a word: its mean, the share of True, or the most frequent name and its share."""
    if not len(values):
        return "none"
    if name.split()[-1] in CODES:
        different, counts = np.unique(values, return_counts=True)
        return f"{different[counts.argmax()]:g}: {counts.max() / len(values):.1%}"
    return f"{values.mean():.2%}" if values.dtype == bool else f"{values.mean():.4g}"


def report(size: str, count: int, seed: int, keep: Path) -> SizeReport:
    theirs = reference_levels(keep, size, count, seed)
    ours = jax.tree.map(np.asarray, sample_levels(np.arange(count), SIZES[size]))
    return SizeReport(size, count, compare(samples(ours), samples(theirs)))


def summary(reports: Sequence[SizeReport]) -> str:
    """What it comes to, a column a size."""
    p = [[c for c in r.statistics.values() if c.corrected is not None] for r in reports]
    lines: dict[str, list[Any]] = {
        "levels of each": [f"{r.levels:,}" for r in reports],
        "statistics": [len(r.statistics) for r in reports],
        "of them the same number in every level": [
            len(r.statistics) - len(of) for r, of in zip(reports, p, strict=True)
        ],
        "smallest p": [f"{min(c.p for c in of):.2g}" for of in p],  # type: ignore[type-var]
        "smallest corrected p": [f"{min(c.corrected for c in of):.2g}" for of in p],  # type: ignore[type-var]
        f"differ (corrected p < {SIGNIFICANT:g})": [len(r.differ) for r in reports],
    }
    head = f"| | {' | '.join(r.size for r in reports)} |\n|---{'|---' * len(reports)}|\n"
    return head + "".join(f"| {name} | {' | '.join(map(str, values))} |\n" for name, values in lines.items())


def table(reports: Sequence[SizeReport]) -> str:
    """Every statistic: ours, the reference's and p of each size, and the verdict."""
    names = list(dict.fromkeys(name for r in reports for name in r.statistics))
    head = "".join(f" {r.size}: ours | reference | p |" for r in reports)
    lines = [f"| statistic |{head} verdict |", f"|---{'|---|---|---' * len(reports)}|---|"]
    for name in names:
        cells = "".join(_cells(r.statistics.get(name)) for r in reports)
        off = [r.size for r in reports if name in r.differ]
        lines.append(f"| {name} |{cells} {'differs: ' + ', '.join(off) if off else 'same'} |")
    return "\n".join(lines) + "\n"


def _cells(c: Compared | None) -> str:
    if c is None:
        return " | | |"
    return f" {c.ours} | {c.theirs} | {'' if c.p is None else f'{c.p:.2g}'} |"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fidelity", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("size", nargs="*", default=list(SIZES), help="s, m or l (default: all)")
    parser.add_argument("--levels", type=int, default=20_000, help="levels of each sampler (default: 20,000)")
    parser.add_argument("--seed", type=int, default=0, help="of the reference's sampler (default: 0)")
    parser.add_argument("--keep", type=Path, default=cache_folder() / "fidelity", help="folder for its levels")
    parser.add_argument("--write", type=Path, help="document to put the tables into, between its marks")
    given = parser.parse_args()
    reports = [report(size, given.levels, given.seed, given.keep) for size in given.size]
    made = f"{summary(reports)}\n{table(reports)}"
    print(made)
    if given.write:
        given.write.write_text(between_marks(given.write.read_text(), MARK, made))
    for r in reports:
        print(f"{r.size}: {len(r.differ)} of {len(r.statistics)} statistics differ {r.differ or ''}", file=sys.stderr)
    return int(any(r.differ for r in reports))


if __name__ == "__main__":
    sys.exit(main())
