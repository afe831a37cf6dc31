"""Witnesses reworked before they count: polished, where that is asked for, and made steady, where replays fail."""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import BY_EXPERT, Source
from levelproof.experts.pool.steady import KEPT, STARTS, steady
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.polish import LANES, polish
from levelproof.experts.search.shorten import Shortened
from levelproof.experts.verdict.judge import Witness, repeating
from levelproof.experts.verdict.portability import PORTABLE, choose
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import at_once, blocks, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams

OWN = 0.5  # share of replays of an expert's own witness; only where fewer survive, a search's may stand in
IN_CACHE = 256  # lanes: their physics fits the cache of a core
Program = Callable[[Level, Int[np.ndarray, " level"], Success], Shortened]


def rework(
    levels: Level,
    level_ids: Int[np.ndarray, " level"],
    chosen: Sequence[Witness | None],
    procedure: Procedure,
    rules: TaskParams,
) -> tuple[list[Witness | None], Int[np.ndarray, " level"]]:
    """Each level's witness, or a better one that search around it finds; and the env steps of that.

    Better is what survives more replays from moved starts, and of equals the shorter one.

    Args:
        levels: on the host.
        level_ids: their ids, the seeds of all randomness.
        chosen: the witness of each, if it has one. One that does nothing stays.
        procedure: how long to search, and how many replays.
        rules: of the task.
    """
    search, replays = procedure.search, procedure.expert.replays
    witnesses, env_steps = list(chosen), np.zeros(len(chosen), np.int64)

    def improve(some: Sequence[int], lanes: int, program: Program) -> None:
        """Let a program look for better ones, of a few levels at once; so many lanes each."""
        now = {i: witness for i in some if (witness := witnesses[i]) and witness.source != Source.NOTHING}
        candidates = {}
        for block in blocks(len(now), at_once(lanes, IN_CACHE)):
            at = np.array(list(now))[block]
            found = jax.device_get(program(take(levels, at), level_ids[at], successes([now[i] for i in at.tolist()])))
            env_steps[at] += found.env_steps  # once for a level that fills up its block
            for i, *success in zip(at.tolist(), *found.success, strict=True):
                new = repeating(Success(*success), Source.SEARCH)
                candidates[i] = sorted([now[i], *new], key=lambda witness: witness.steps)
        at = np.array(list(candidates), int)
        better = choose(take(levels, at), level_ids[at], list(candidates.values()), replays, rules)
        for i, witness in zip(candidates, better, strict=True):
            witnesses[i] = witness

    if search.polish:
        improve(range(len(witnesses)), LANES, lambda *of: polish(*of, search.polish, rules))
    if search.steady and replays:
        enough = lambda of: OWN if of.source in BY_EXPERT else PORTABLE
        fragile = [i for i, of in enumerate(witnesses) if of and (of.portability or 0) < enough(of)]
        improve(fragile, KEPT * STARTS, lambda *of: steady(*of, search.steady, rules))
    return witnesses, env_steps


def successes(witnesses: Sequence[Witness]) -> Success:
    """Their first episodes, level first."""
    steps = np.array([witness.steps for witness in witnesses], np.int32)
    action = np.stack([witness.action for witness in witnesses])
    inside = np.arange(RECORD_STEPS) < steps[:, None]
    return Success(np.where(inside[:, :, None], action, 0).astype(np.int8), steps)  # pyright: ignore[reportArgumentType]
