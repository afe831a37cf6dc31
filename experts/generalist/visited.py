"""States that a policy visits in its own episodes, among them those that teachers are asked about."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.rules import TaskParams, TaskState


@partial(jax.jit, static_argnames="rules")
def state_at(level: Level, action: Int[Array, "256 6 lane"], at: Int[Array, " lane"], rules: TaskParams) -> TaskState:
    """Replay the actions of episodes up to one state of each.

    Args:
        level: each lane's level, with its first state.
        action: the actions; those from `at` on mean nothing.
        at: env step before which each state is returned, at most RECORD_STEPS.
        rules: the task's rules.
    """

    def act(step: Array, now: TaskState) -> TaskState:
        after, _ = task.advance(level, now, action[step].astype(jnp.int32), rules)
        return jax.tree.map(lambda new, old: jnp.where(step < at, new, old), after, now)

    return jax.lax.fori_loop(0, at.max(), act, task.reset(level))


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
