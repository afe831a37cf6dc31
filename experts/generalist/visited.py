"""States that a policy visits in its own episodes, among them those that teachers are asked about."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.rules import TaskParams, TaskState


class Visited(NamedTuple):
    """First episodes, and one state of each."""

    now: TaskState  # before env step `at`
    steps: Int[Array, " lane"]  # of the episode
    solved: Bool[Array, " lane"]


@partial(jax.jit, static_argnames="rules")
def visit(level: Level, action: Int[Array, "256 6 lane"], at: Int[Array, " lane"], rules: TaskParams) -> Visited:
    """Replay the actions of first episodes.

    Args:
        level: each lane's level, with its first state.
        action: the actions; those after the episode's end mean nothing.
        at: env step of each episode whose state is returned, below RECORD_STEPS.
        rules: the task's rules.
    """

    def act(step: Array, carry: tuple[TaskState, Visited]) -> tuple[TaskState, Visited]:
        now, (kept, steps, solved) = carry
        kept = jax.tree.map(lambda x, y: jnp.where(step == at, x, y), now, kept)
        after, result = task.advance(level, now, action[step].astype(jnp.int32), rules)
        ends = (steps == 0) & (result.done | (step == RECORD_STEPS - 1))
        return after, Visited(kept, jnp.where(ends, step + 1, steps), solved | (ends & result.goal))

    start, lanes = task.reset(level), len(at)
    begun = Visited(start, jnp.zeros(lanes, jnp.int32), jnp.zeros(lanes, bool))
    return jax.lax.fori_loop(0, RECORD_STEPS, act, (start, begun))[1]


def draw_states(
    rng: np.random.Generator,
    steps: Int[np.ndarray, " episode"],
    solved: Bool[np.ndarray, " episode"],
    count: int,
    failed: float,
) -> tuple[Int[np.ndarray, " state"], Int[np.ndarray, " state"]]:
    """Draw states of episodes: return the episode and the env step of each.

    Args:
        rng: consumed.
        steps: env steps of the episodes.
        solved: whether they reached the goal.
        count: states to draw; several may be of one episode.
        failed: share of states from episodes that did not reach the goal, if there are both kinds of episodes.
    """
    kinds = np.flatnonzero(~solved), np.flatnonzero(solved)
    share = failed if all(map(len, kinds)) else float(len(kinds[0]) > 0)
    counts = round(count * share), count - round(count * share)
    episode = np.concatenate([rng.choice(kind, n) for kind, n in zip(kinds, counts, strict=True) if n])
    return episode, (rng.random(count) * steps[episode]).astype(np.int32)
