"""A policy that plays levels on pages that show its attempts."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from levelproof.experts.evaluation import first_attempts, play_sampled
from levelproof.experts.networks.saved import Policy
from levelproof.experts.witness.witness import Record, replay
from levelproof.levelgen.batching import blocks, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams

SOLVES, FAILS = "solves", "fails"  # values of the gallery's column `policy`


class PolicyAttempt(NamedTuple):
    """One level's attempt."""

    record: Record  # no lane axis
    steps: int  # env steps of its episode
    solved: bool


class Contender:
    """A policy that plays the levels of a page, with its compiled program."""

    def __init__(self, policy: Policy, lanes: int) -> None:
        """Play `lanes` levels at a time with this policy."""
        self.policy, self._player, self._lanes = policy, play_sampled(policy.network), lanes

    def attempts(
        self, levels: Level, level_ids: Int[np.ndarray, " level"], rules: TaskParams, seed: int = 0
    ) -> list[PolicyAttempt]:
        """Play at most `lanes` levels, as `levelproof evaluate` with this seed does in its first sampled attempts."""
        (padded,) = blocks(len(level_ids), self._lanes)
        chosen = take(levels, padded), level_ids[padded]
        actions = first_attempts(self._player, self.policy.params, *chosen, seed, rules).action
        record = replay(levels, actions[..., : len(level_ids)], rules)
        return [_attempt(jax.tree.map(lambda x, lane=lane: x[..., lane], record)) for lane in range(len(level_ids))]


def _attempt(record: Record) -> PolicyAttempt:
    done = np.asarray(record.done)
    steps = int(done.argmax()) + 1 if done.any() else len(done)
    return PolicyAttempt(record, steps, bool(record.goal[steps - 1]))
