"""Solve rates with their intervals, from attempts at levels."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from levelproof.pipeline.look.figures import DEVIATIONS, Share

WORST = 0.1  # share of the levels that count as the worst
Solved = Bool[np.ndarray, "level attempt"]


def solve_rates(solved: Solved, env_steps: Int[np.ndarray, "level attempt"] | None) -> dict[str, Any]:
    """Return one attempt's solve rate, that of the best of all attempts and that of the worst tenth, as JSON types.

    `steps` is the mean number of env steps of the attempts that reached the goal; None if none did, or if it is
    unknown. Intervals hold 95% and are over levels, because attempts at one level are not independent. The worst tenth
    is chosen by the first half of the attempts and rated on the second: rated on those that chose it, it would look
    worse than it is. It is None for fewer than two attempts.
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
        "steps": round(float(env_steps[solved].mean()), 1) if env_steps is not None and solved.any() else None,
    }


def _rate(solved: Solved) -> dict[str, Any]:
    low, high = interval(solved)
    return {"rate": round(float(solved.mean()), 4), "interval": [round(low, 4), round(high, 4)]}


def interval(solved: Solved) -> tuple[float, float]:
    """Return the 95% interval of the mean over levels.

    For one attempt it is Wilson's. Else it is normal in the levels' means, after two levels that are always solved and
    two that never are have been added: few levels that are all solved, or all failed, have a far too small spread.
    """
    if solved.shape[1] == 1:
        return Share(int(solved.sum()), len(solved)).interval
    means: Float[np.ndarray, " level"] = np.concatenate([np.mean(solved, axis=1), (0.0, 0.0, 1.0, 1.0)])
    half = DEVIATIONS * float(means.std(ddof=1)) / len(means) ** 0.5
    return max(0.0, float(means.mean()) - half), min(1.0, float(means.mean()) + half)
