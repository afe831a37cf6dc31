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
    unknown. Intervals are 95% intervals over levels, because attempts at one level are not independent. The worst tenth
    is chosen by the first half of the attempts and rated on the second: rated on those that chose it, it would look
    worse than it is. It includes all levels that tie with its last, so it may be larger than a tenth; its `levels` says
    how large. It is None for fewer than two attempts.
    """
    attempts, worst = solved.shape[1], None
    if attempts > 1:
        successes = np.sum(solved[:, : attempts // 2], axis=1)
        last = np.sort(successes)[max(1, round(WORST * len(solved))) - 1]
        chosen = successes <= last
        worst = _rate(solved[chosen, attempts // 2 :]) | {"levels": int(chosen.sum())}
    return {
        "levels": len(solved),
        "once": _rate(solved),
        "best": _rate(np.any(solved, axis=1, keepdims=True)),
        "worst": worst,
        "steps": round(float(env_steps[solved].mean()), 1) if env_steps is not None and solved.any() else None,
    }


def difference(ours: Solved, theirs: Solved) -> dict[str, Any]:
    """Return by how much one player's solve rate exceeds another's on the same levels, with a 95% interval.

    The interval is normal in the differences level by level, to which 1 and -1 are added for the reason in `interval`.
    It is narrower than the players' own intervals, because both find the same levels hard. The two may have different
    numbers of attempts.
    """
    apart: Float[np.ndarray, " level"] = np.mean(ours, axis=1) - np.mean(theirs, axis=1)
    apart = np.concatenate([apart, (-1.0, 1.0)])
    mean, half = float(apart[:-2].mean()), DEVIATIONS * float(apart.std(ddof=1)) / len(apart) ** 0.5
    return {"rate": round(mean, 4), "interval": [round(max(mean - half, -1.0), 4), round(min(mean + half, 1.0), 4)]}


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
