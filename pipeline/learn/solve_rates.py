"""Solve rates with their intervals, from attempts at levels."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from levelproof.pipeline.look.figures import DEVIATIONS, Share

WORST = 0.1  # share of the levels that count as the worst
Solved = Bool[np.ndarray, "level attempt"]


def solve_rates(solved: Solved) -> dict[str, Any]:
    """Return one attempt's solve rate, that of the best of all attempts and that of the worst tenth, as JSON types.

    Intervals hold 95% and are over levels, because attempts at one level are not independent. The worst tenth is
    chosen by the first half of the attempts and rated on the second: rated on those that chose it, it would look worse
    than it is. It is None for fewer than two attempts.
    """
    attempts, worst = solved.shape[1], None
    if attempts > 1:
        chosen = np.argsort(np.mean(solved[:, : attempts // 2], axis=1), kind="stable")[
            : max(1, round(WORST * len(solved)))
        ]
        worst = _rate(solved[chosen, attempts // 2 :])
    return {
        "levels": len(solved),
        "once": _rate(solved),
        "best": _rate(np.any(solved, axis=1, keepdims=True)),
        "worst": worst,
    }


def _rate(solved: Solved) -> dict[str, Any]:
    low, high = interval(solved)
    return {"rate": round(float(solved.mean()), 4), "interval": [round(low, 4), round(high, 4)]}


def interval(solved: Solved) -> tuple[float, float]:
    """Return the 95% interval of the mean over levels: Wilson's for one attempt, else normal in the levels' means."""
    means: Float[np.ndarray, " level"] = np.mean(solved, axis=1)
    if solved.shape[1] == 1 or len(solved) == 1 or not means.std():
        return Share(int(np.any(solved, axis=1).sum()), len(solved)).interval
    half = DEVIATIONS * float(means.std(ddof=1)) / len(means) ** 0.5
    return max(0.0, float(means.mean()) - half), min(1.0, float(means.mean()) + half)
