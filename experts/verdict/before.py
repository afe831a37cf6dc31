"""Levels that need no expert: doing nothing solves them, or a proof says that they are unsolvable."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import Label, Source, Verdict, trivial_reason, unsolvable_reason, untrained
from levelproof.experts.search.play import most_steps
from levelproof.experts.witness.witness import replay, steps_to_goal, succeeds
from levelproof.levelgen.batching import by_blocks, take
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.proofs import Facts, Proof, examine
from levelproof.levelgen.task.rules import TaskParams


class PriorVerdicts(NamedTuple):
    """Verdicts without training."""

    verdicts: list[Verdict | None]  # None: the level needs an expert
    failed_by_noop: Bool[np.ndarray, " level"]


def decide(levels: Level, rules: TaskParams) -> PriorVerdicts:
    """Judge levels that need no expert, in blocks of one compiled program; lanes are independent."""
    count = levels.role.shape[-1]
    facts = facts_of(levels, rules)
    verdicts: list[Verdict | None] = [None] * count
    reaching = np.flatnonzero(facts.reaches)
    if len(reaching):
        idle = replay(take(levels, reaching), np.zeros((RECORD_STEPS, ACTIONS, len(reaching)), np.int32), rules)
        for i, solved, steps in zip(reaching, succeeds(idle.done, idle.goal), steps_to_goal(idle.done), strict=True):
            if solved:
                verdicts[i] = untrained(Label.TRIVIAL, trivial_reason(int(steps)), False, Source.NOTHING, int(steps))
    for i in np.flatnonzero(facts.proof != Proof.NONE):
        fails = bool(facts.fails[i])
        verdicts[i] = untrained(Label.UNSOLVABLE, unsolvable_reason(Proof(int(facts.proof[i])), fails), fails)
    return PriorVerdicts(verdicts, np.asarray(facts.fails))


def facts_of(levels: Level, rules: TaskParams) -> Facts:
    """Run `levelgen.proofs.examine` on any number of levels, for one record's length; return its facts on the host."""
    return by_blocks(lambda lanes: examine(take(levels, lanes), rules, most_steps(rules)), levels.role.shape[-1])
