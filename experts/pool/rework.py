"""Rework of witnesses before they count: polish them if configured, and strengthen them if replays fail."""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import BY_EXPERT, Source
from levelproof.experts.pool.strengthen import KEPT, STARTS, strengthen
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.shorten import LANES, Shortened, polish
from levelproof.experts.verdict.judge import Witness, repeating
from levelproof.experts.verdict.portability import PORTABLE, choose
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import at_once, blocks, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams

OWN = 0.5  # portability below which a witness of the search may replace an expert's own
IN_CACHE = 256  # lanes: their physics fits the cache of a core
SearchAround = Callable[[Level, Int[np.ndarray, " level"], Success], Shortened]


def rework(
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    chosen: Sequence[Witness | None],
    procedure: Procedure,
    rules: TaskParams,
) -> tuple[list[Witness | None], Int[np.ndarray, " level"]]:
    """Search around each witness for a better one; return the witnesses and the env steps.

    The better witness survives more replays from perturbed starts; if several survive equally many, it is the shortest.

    Args:
        levels: the levels, on the host.
        level_ids: their ids, the seeds of all randomness.
        chosen: witness of each level, if any. One that does nothing stays.
        procedure: its settings say how long to search, and how often to replay.
        rules: the task's rules.
    """
    search, replays = procedure.search, procedure.expert.replays
    witnesses, env_steps = list(chosen), np.zeros(len(chosen), np.int64)

    def improve(some: Sequence[int], lanes: int, search_around: SearchAround) -> None:
        """Search around the witnesses of a few levels at once, in `lanes` lanes each."""
        now = {i: witness for i in some if (witness := witnesses[i]) and witness.source != Source.NOTHING}
        candidates = {}
        for block in blocks(len(now), at_once(lanes, IN_CACHE)):
            at = np.array(list(now))[block]
            given = take(levels, at), level_ids[at], successes([now[i] for i in at.tolist()])
            result = jax.device_get(search_around(*given))
            env_steps[at] += result.env_steps  # a level that pads its block counts once
            for i, *success in zip(at.tolist(), *result.success, strict=True):
                new = repeating(Success(*success), Source.SEARCH)
                candidates[i] = sorted([now[i], *new], key=lambda witness: witness.steps)
        at = np.array(list(candidates), int)
        better = choose(take(levels, at), level_ids[at], list(candidates.values()), replays, rules)
        for i, witness in zip(candidates, better, strict=True):
            witnesses[i] = witness

    if search.polish:
        improve(range(len(witnesses)), LANES, lambda *args: polish(*args, search.polish, rules))
    if search.robustness and replays:
        enough = lambda witness: OWN if witness.source in BY_EXPERT else PORTABLE
        fragile = [i for i, witness in enumerate(witnesses) if witness and (witness.portability or 0) < enough(witness)]
        improve(fragile, KEPT * STARTS, lambda *args: strengthen(*args, search.robustness, rules))
    return witnesses, env_steps


def successes(witnesses: Sequence[Witness]) -> Success:
    """Return the witnesses' first episodes, level first."""
    steps = np.array([witness.steps for witness in witnesses], np.int32)
    action = np.stack([witness.action for witness in witnesses])
    inside = np.arange(RECORD_STEPS) < steps[:, None]
    return Success(np.where(inside[:, :, None], action, 0).astype(np.int8), steps)  # pyright: ignore[reportArgumentType]
