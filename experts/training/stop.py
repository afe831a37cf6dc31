"""When a level leaves its slot: rules that depend on the training and evaluation of that level alone."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.experts.config import MAX_DOUBLINGS, RECORD_STEPS, ExpertConfig, Rule, StopConfig
from levelproof.experts.labels import Cause
from levelproof.experts.training.progress import NEVER, Progress

LAST = np.int32(2**31 - 1)  # an update count that no expert reaches


class StopRules(NamedTuple):
    """A StopConfig as arrays, so that one compiled program serves all."""

    evaluates: np.bool_  # successes in training trigger an evaluation
    halves: np.bool_  # there are rungs
    enough: np.int32  # attempts that must succeed
    share: np.float32  # share of finished episodes that must reach the goal to trigger an evaluation
    wait: np.int32  # updates between a failed evaluation and the next; doubles up to six times
    polish: np.int32  # updates after the level is solved
    robustness: np.int32  # updates after the level is solved by fragile witnesses
    first_rung: np.int32  # updates at the first rung
    gain: np.float32  # minimum growth of the best return between rungs
    fruitless: np.int32  # updates after which an expert without a success leaves


def rules_of(stopping: StopConfig, config: ExpertConfig) -> StopRules:
    """Convert settings of stopping to rules, in updates."""
    return StopRules(
        evaluates=np.bool_(stopping.rule != Rule.BUDGET),
        halves=np.bool_(stopping.rule == Rule.HALVING),
        enough=np.int32(min(stopping.successes, config.attempts)),
        share=np.float32(stopping.share),
        wait=np.int32(config.updates_in(stopping.wait)),
        polish=np.int32(config.updates_in(stopping.polish) if stopping.polish else 0),
        robustness=np.int32(config.updates_in(stopping.robustness) if stopping.robustness else 0),
        first_rung=np.int32(config.updates_in(stopping.first_rung)),
        gain=np.float32(stopping.gain),
        fruitless=np.int32(min(config.updates_in(stopping.fruitless), LAST) if stopping.fruitless else LAST),
    )


class StopState(NamedTuple):
    """Progress of an expert through the stopping rules."""

    updates: Int[Array, ""]  # done
    next_evaluation: Int[Array, ""]  # no evaluation before this many updates
    failed: Int[Array, ""]  # evaluations after which training continued
    solved: Bool[Array, ""]  # an evaluation solved the level
    rung_return: Float[Array, ""]  # the best return at the last rung
    over: Int[Array, ""]  # Cause why training stopped for good: a larger budget would change nothing


def begin() -> StopState:
    zero = jnp.int32(0)
    return StopState(zero, zero, zero, jnp.bool_(False), jnp.float32(-jnp.inf), jnp.int8(Cause.NONE))


def after_update(
    course: StopState,
    progress: Progress,
    usable: Bool[Array, ""],
    share: Float[Array, ""],
    deadline: Int[Array, ""],
    rules: StopRules,
) -> tuple[StopState, Bool[Array, ""], Bool[Array, ""]]:
    """Advance the stopping rules by one update.

    Args:
        course: state before the update.
        progress: totals after the update.
        usable: whether there is a success to rehearse.
        share: share of the update's finished episodes that reached the goal.
        deadline: updates before the final evaluation.
        rules: the stopping rules.

    Returns:
        The new state, whether training triggers an evaluation, and whether a final evaluation comes now.
    """
    updates = course.updates + 1
    worth_it = (share >= rules.share) & (updates >= course.next_evaluation)
    evaluate = rules.evaluates & worth_it
    at_rung = rules.halves & is_rung(updates, rules.first_rung)
    reached = progress.first_success != NEVER
    promising = usable | reached | (progress.best_return >= course.rung_return + rules.gain)
    fruitless = rules.halves & ~reached & (updates >= rules.fruitless)
    stopped = [progress.diverged != NEVER, at_rung & ~promising, fruitless]
    over = jnp.select(stopped, [jnp.int8(x) for x in (Cause.DIVERGED, Cause.RUNG, Cause.FRUITLESS)], jnp.int8(0))
    rung_return = jnp.where(at_rung, progress.best_return, course.rung_return)
    course = course._replace(updates=updates, rung_return=rung_return, over=over)
    return course, evaluate, (over != Cause.NONE) | (updates >= deadline)


def after_evaluation(
    course: StopState,
    solved: Bool[Array, ""],
    due: Bool[Array, ""],
    final: Bool[Array, ""],
    deadline: Int[Array, ""],
    rules: StopRules,
) -> tuple[StopState, Bool[Array, ""], Int[Array, ""]]:
    """Return the state after an evaluation, whether the level leaves, and its deadline."""
    polished = solved & (rules.polish > 0)
    leaves = final | (solved & ~polished)
    deadline = jnp.where(polished & ~final, jnp.minimum(deadline, course.updates + rules.polish), deadline)
    tried = course._replace(
        next_evaluation=jnp.where(solved, LAST, course.updates + _wait(course, rules)),
        failed=course.failed + ~solved,
        solved=course.solved | solved,
    )
    # an evaluation that only the deadline triggered leaves no trace, so that a larger budget continues without it
    course = StopState(*(jnp.where(due, new, old) for old, new in zip(course, tried, strict=True)))
    return course, leaves, deadline


def train_on(course: StopState, deadline: Int[Array, "..."], rules: StopRules) -> tuple[StopState, Int[Array, "..."]]:
    """Return state and deadline of a solved level that trains on for a more robust witness."""
    course = course._replace(next_evaluation=course.updates + _wait(course, rules), failed=course.failed + 1)
    return course, jnp.minimum(deadline, course.updates + rules.robustness)


def _wait(course: StopState, rules: StopRules) -> Int[Array, "..."]:
    """Return the number of updates before the next evaluation."""
    return rules.wait << jnp.minimum(course.failed, MAX_DOUBLINGS)


def solves(
    done: Bool[Array, "... time environment"],
    goal: Bool[Array, "... time environment"],
    rules: StopRules,
    config: ExpertConfig,
) -> Bool[Array, "..."]:
    """Return whether enough attempts succeed: every finished episode reached the goal."""
    done, goal = (x[..., :RECORD_STEPS, : config.attempts] for x in (done, goal))
    succeed = done.any(-2) & (goal | ~done).all(-2)
    return succeed.sum(-1) >= rules.enough


def fails(
    done: Bool[Array, "time environment"],
    goal: Bool[Array, "time environment"],
    steps: Int[Array, ""],
    rules: StopRules,
    config: ExpertConfig,
) -> Bool[Array, ""]:
    """Return whether, after `steps` env steps, too many attempts have failed for the evaluation to solve its level."""
    done, goal = (x[:RECORD_STEPS, : config.attempts] for x in (done, goal))
    failed = (done & ~goal & (jnp.arange(len(done)) < steps)[:, None]).any(0)
    return config.attempts - failed.sum() < rules.enough


def is_rung(updates: Int[Array, ""], first: int | np.int32) -> Bool[Array, ""]:
    """Return whether `updates` is `first` times a power of two."""
    times = updates // first
    return (updates % first == 0) & (times > 0) & ((times & (times - 1)) == 0)
