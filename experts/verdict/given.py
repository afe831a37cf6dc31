"""Imported actions: replay them in this engine, and label their levels by the result."""

import warnings

import jax
import numpy as np
from jaxtyping import Int

from levelproof.experts.labels import Label, Source, Verdict, untrained
from levelproof.experts.verdict.before import decide
from levelproof.experts.verdict.judge import repeated
from levelproof.experts.witness.witness import Record, replay, steps_to_goal, succeeds
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams

AGAIN = "the actions of the first imported episode, repeated, reach the goal"
WHOLE = "the imported actions reach the goal in all {} of their finished episodes"
MISSED = "the imported actions do not reach the goal when replayed: {}"


def label_given(
    levels: Level, action: Int[np.ndarray, "256 6 level"], rules: TaskParams
) -> tuple[Record, list[Verdict]]:
    """Replay the actions; return the record and the verdicts.

    If the first episode reaches the goal but a later one does not, the first episode, repeated, is the witness.
    Levels that need no expert are judged as always: the witness of a trivial one does nothing.
    A replayed witness overrules a proof that there is none, with a warning, because the proof must be wrong.
    """
    before, failed = decide(levels, rules)
    record = replay(levels, action, rules)
    whole, done, steps = succeeds(record.done, record.goal), np.asarray(record.done), steps_to_goal(record.done)
    at_first = np.take_along_axis(np.asarray(record.goal), steps[None] - 1, 0)[0]
    ends = done[steps - 1, np.arange(len(steps))]  # whether any episode ends
    beaten = np.array([v is not None and v.label == Label.UNSOLVABLE for v in before]) & (whole | at_first)
    if beaten.any():
        reason = next(v.label_reason for v, wins in zip(before, beaten, strict=True) if v and wins)
        warnings.warn(
            f"Imported actions solve {beaten.sum()} of {len(before)} levels that are proved unsolvable: {reason}",
            stacklevel=2,
        )
    before = [None if wins else v for v, wins in zip(before, beaten, strict=True)]
    new = action.copy()
    for i, verdict in enumerate(before):
        if verdict is not None:
            new[..., i] = 0
        elif at_first[i] and not whole[i]:
            new[..., i] = repeated(action[..., i], int(steps[i]))
    changed = np.flatnonzero((new != action).any((0, 1)))
    if len(changed):
        again = replay(take(levels, changed), new[..., changed], rules)
        for ours, theirs in zip(jax.tree.leaves(record), jax.tree.leaves(again), strict=True):
            ours[..., changed] = theirs
    solved, episodes = succeeds(record.done, record.goal), np.asarray(record.done).sum(0)
    verdicts = []
    for i, verdict in enumerate(before):
        if verdict is None and solved[i]:
            reason = WHOLE.format(episodes[i]) if whole[i] else AGAIN
            verdict = untrained(Label.SOLVED, reason, bool(failed[i]), Source.IMPORT, int(steps[i]))
        elif verdict is None:
            reason = MISSED.format("the first episode ends without it" if ends[i] else "no episode ends")
            verdict = untrained(Label.UNSOLVED, reason, bool(failed[i]))
        verdicts.append(verdict)
    return record, verdicts
