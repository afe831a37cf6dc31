"""Statistical tests for benchmarks, from scipy and statsmodels."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest
from statsmodels.stats.multitest import multipletests


def too_few(successes: int, trials: int, share: float) -> bool:
    """Whether chance does not explain so few successes (exact one-sided p < 0.001) if `share` of all trials succeed."""
    return bool(binomtest(successes, trials, share, alternative="less").pvalue < 1e-3)


def mcnemar(only_one: int, only_other: int) -> float:
    """Return the exact two-sided p for levels that only one of two variants solved (McNemar 1947).

    Under the null hypothesis a fair coin decides which variant solves each.
    """
    flips = only_one + only_other
    return float(binomtest(only_one, flips).pvalue) if flips else 1.0


def flips(pairs: Iterable[tuple[Any, Any]], solved: Any, unsolved: Any) -> list[str]:
    """Compare two labels of each level; return cells of a table.

    They are the levels that both call solved or unsolved, those that only the first and only the second solves, and p.
    """
    undecided = [pair for pair in pairs if {*pair} <= {solved, unsolved}]
    lost, gained = undecided.count((solved, unsolved)), undecided.count((unsolved, solved))
    return [f"{len(undecided):,}", str(lost), str(gained), f"{mcnemar(lost, gained):.2g}"]


def holm(p: Sequence[float]) -> list[float]:
    """Return corrected p in the given order; Holm's procedure rejects the hypotheses whose p is below its level."""
    return np.asarray(multipletests(p, method="holm")[1]).tolist() if p else []
