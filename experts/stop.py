"""When a level leaves its slot: rules on what training and evaluation of that level alone have shown."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from experts.config import MOST_DOUBLINGS, RECORD_STEPS, ExpertConfig, Rule, StopConfig
from experts.progress import NEVER, Progress


class Course(NamedTuple):
    """How far an expert is, and what comes next."""

    updates: Int[Array, ""]  # done
    next_evaluation: Int[Array, ""]  # updates before which none is worth it
    failed: Int[Array, ""]  # evaluations that did not solve the level
    solved: Bool[Array, ""]  # by an evaluation
    rung_return: Float[Array, ""]  # the best return at the last rung
    over: Bool[Array, ""]  # for good: more budget would change nothing


def begin() -> Course:
    return Course(jnp.int32(0), jnp.int32(0), jnp.int32(0), jnp.bool_(False), jnp.float32(-jnp.inf), jnp.bool_(False))


def after_update(
    course: Course,
    progress: Progress,
    usable: Bool[Array, ""],
    share: Float[Array, ""],
    deadline: Int[Array, ""],
    config: ExpertConfig,
    stopping: StopConfig,
) -> tuple[Course, Bool[Array, ""], Bool[Array, ""]]:
    """What one more update means.

    Args:
        course: before the update.
        progress: after it.
        usable: whether there is a success of training that a record can hold.
        share: of the update's finished episodes that reached the goal.
        deadline: updates after which the last evaluation comes.
        config: what an expert is.
        stopping: when a level leaves.

    Returns:
        The course, whether an evaluation is due, and whether the level leaves after one, due or not.
    """
    updates = course.updates + 1
    over = progress.diverged != NEVER
    evaluate = jnp.bool_(False)
    rung_return = course.rung_return
    if stopping.rule != Rule.BUDGET:
        evaluate = (share >= stopping.share) & (updates >= course.next_evaluation) & ~course.solved
        over |= jnp.bool_(config.exploration) & usable
    if stopping.rule == Rule.HALVING:
        at_rung = is_rung(updates, config.updates_in(stopping.first_rung))
        moves = (progress.first_success != NEVER) | (progress.best_return >= rung_return + stopping.gain)
        over |= at_rung & ~moves
        rung_return = jnp.where(at_rung, progress.best_return, rung_return)
    course = course._replace(updates=updates, rung_return=rung_return, over=over)
    return course, evaluate, over | (updates >= deadline)


def after_evaluation(
    course: Course,
    solved: Bool[Array, ""],
    due: Bool[Array, ""],
    final: Bool[Array, ""],
    deadline: Int[Array, ""],
    config: ExpertConfig,
    stopping: StopConfig,
) -> tuple[Course, Bool[Array, ""], Int[Array, ""]]:
    """The course, whether the level leaves, and its deadline."""
    polish = config.updates_in(stopping.polish) if stopping.polish else 0
    leaves = final | solved if not polish else final
    deadline = jnp.where(solved & ~final, jnp.minimum(deadline, course.updates + polish), deadline)
    wait = config.updates_in(stopping.wait) << jnp.minimum(course.failed, MOST_DOUBLINGS)
    tried = course._replace(
        next_evaluation=course.updates + wait,
        failed=course.failed + ~solved,
        solved=solved,
    )
    # one that only the deadline asked for leaves no trace: an expert that goes on later goes on as if it had not been
    course = Course(*(jnp.where(due, new, old) for old, new in zip(course, tried, strict=True)))
    return course, leaves, deadline


def solves(
    done: Bool[Array, "... time environment"],
    goal: Bool[Array, "... time environment"],
    stopping: StopConfig,
    config: ExpertConfig,
) -> Bool[Array, "..."]:
    """Whether enough attempts succeed: every episode that ended, ended in the goal."""
    done, goal = (x[..., :RECORD_STEPS, : config.attempts] for x in (done, goal))
    succeed = done.any(-2) & (goal | ~done).all(-2)
    return succeed.sum(-1) >= enough(stopping, config)


def fails(
    done: Bool[Array, "time environment"],
    goal: Bool[Array, "time environment"],
    steps: Int[Array, ""],
    stopping: StopConfig,
    config: ExpertConfig,
) -> Bool[Array, ""]:
    """Whether an evaluation can no longer solve its level, after so many steps: too many attempts have failed."""
    failed = (done & ~goal & (jnp.arange(len(done)) < steps)[:, None])[:, : config.attempts].any(0)
    return config.attempts - failed.sum() < enough(stopping, config)


def enough(stopping: StopConfig, config: ExpertConfig) -> int:
    """How many attempts have to succeed."""
    return min(stopping.successes, config.attempts)


def is_rung(updates: Int[Array, ""], first: int) -> Bool[Array, ""]:
    """Whether it is `first` times a power of two."""
    times = updates // first
    return (updates % first == 0) & (times > 0) & ((times & (times - 1)) == 0)
