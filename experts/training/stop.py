"""When a level leaves its slot: rules on what training and evaluation of that level alone have shown."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.experts.config import MAX_DOUBLINGS, RECORD_STEPS, ExpertConfig, Rule, StopConfig
from levelproof.experts.labels import Cause
from levelproof.experts.training.progress import NEVER, Progress

LAST = np.int32(2**31 - 1)  # update, that nobody reaches


class StopRules(NamedTuple):
    """A StopConfig as data of a compiled program: one program serves all."""

    evaluates: np.bool_  # success of training asks for an evaluation
    halves: np.bool_  # there are rungs
    enough: np.int32  # attempts that have to succeed
    share: np.float32  # of finished episodes that must reach the goal before an evaluation
    wait: np.int32  # updates between an evaluation that failed and the next; doubles each time
    polish: np.int32  # updates after the level is solved
    steady: np.int32  # updates after it is solved by witnesses that few replays survive
    first_rung: np.int32  # updates
    gain: np.float32  # of the best return between rungs
    fruitless: np.int32  # updates


def rules_of(stopping: StopConfig, config: ExpertConfig) -> StopRules:
    """The rules for experts of this configuration."""
    return StopRules(
        evaluates=np.bool_(stopping.rule != Rule.BUDGET),
        halves=np.bool_(stopping.rule == Rule.HALVING),
        enough=np.int32(min(stopping.successes, config.attempts)),
        share=np.float32(stopping.share),
        wait=np.int32(config.updates_in(stopping.wait)),
        polish=np.int32(config.updates_in(stopping.polish) if stopping.polish else 0),
        steady=np.int32(config.updates_in(stopping.steady) if stopping.steady else 0),
        first_rung=np.int32(config.updates_in(stopping.first_rung)),
        gain=np.float32(stopping.gain),
        fruitless=np.int32(config.updates_in(stopping.fruitless) if stopping.fruitless else LAST),
    )


class Course(NamedTuple):
    """How far an expert is, and what comes next."""

    updates: Int[Array, ""]  # done
    next_evaluation: Int[Array, ""]  # updates before which none is worth it
    failed: Int[Array, ""]  # evaluations after which it trained on
    solved: Bool[Array, ""]  # by an evaluation
    rung_return: Float[Array, ""]  # the best return at the last rung
    over: Int[Array, ""]  # the Cause for which training stopped for good: more budget would change nothing


def begin() -> Course:
    zero = jnp.int32(0)
    return Course(zero, zero, zero, jnp.bool_(False), jnp.float32(-jnp.inf), jnp.int8(Cause.NONE))


def after_update(
    course: Course,
    progress: Progress,
    usable: Bool[Array, ""],
    share: Float[Array, ""],
    deadline: Int[Array, ""],
    rules: StopRules,
) -> tuple[Course, Bool[Array, ""], Bool[Array, ""]]:
    """What one more update means.

    Args:
        course: before the update.
        progress: after it.
        usable: whether there is a success to rehearse.
        share: of the update's finished episodes that reached the goal.
        deadline: updates after which the last evaluation comes.
        rules: when a level leaves.

    Returns:
        The course, whether an evaluation is due, and whether the level leaves after one, due or not.
    """
    updates = course.updates + 1
    worth_it = (share >= rules.share) & (updates >= course.next_evaluation)
    evaluate = rules.evaluates & worth_it
    at_rung = rules.halves & is_rung(updates, rules.first_rung)
    reached = progress.first_success != NEVER
    moves = usable | reached | (progress.best_return >= course.rung_return + rules.gain)
    fruitless = rules.halves & ~reached & (updates >= rules.fruitless)
    stopped = [progress.diverged != NEVER, at_rung & ~moves, fruitless]
    over = jnp.select(stopped, [jnp.int8(x) for x in (Cause.DIVERGED, Cause.RUNG, Cause.FRUITLESS)], jnp.int8(0))
    rung_return = jnp.where(at_rung, progress.best_return, course.rung_return)
    course = course._replace(updates=updates, rung_return=rung_return, over=over)
    return course, evaluate, (over != Cause.NONE) | (updates >= deadline)


def after_evaluation(
    course: Course,
    solved: Bool[Array, ""],
    due: Bool[Array, ""],
    final: Bool[Array, ""],
    deadline: Int[Array, ""],
    rules: StopRules,
) -> tuple[Course, Bool[Array, ""], Int[Array, ""]]:
    """The course, whether the level leaves, and its deadline."""
    polished = solved & (rules.polish > 0)
    leaves = final | (solved & ~polished)
    deadline = jnp.where(polished & ~final, jnp.minimum(deadline, course.updates + rules.polish), deadline)
    tried = course._replace(
        next_evaluation=jnp.where(solved, LAST, course.updates + _wait(course, rules)),
        failed=course.failed + ~solved,
        solved=course.solved | solved,
    )
    # one that only the deadline asked for leaves no trace: an expert that goes on later goes on as if it had not been
    course = Course(*(jnp.where(due, new, old) for old, new in zip(course, tried, strict=True)))
    return course, leaves, deadline


def steady_on(course: Course, deadline: Int[Array, "..."], rules: StopRules) -> tuple[Course, Int[Array, "..."]]:
    """The course and the deadline of a level that would leave, being solved, but trains on for a steadier witness."""
    course = course._replace(next_evaluation=course.updates + _wait(course, rules), failed=course.failed + 1)
    return course, jnp.minimum(deadline, course.updates + rules.steady)


def _wait(course: Course, rules: StopRules) -> Int[Array, "..."]:
    """Updates before another evaluation is worth it."""
    return rules.wait << jnp.minimum(course.failed, MAX_DOUBLINGS)


def solves(
    done: Bool[Array, "... time environment"],
    goal: Bool[Array, "... time environment"],
    rules: StopRules,
    config: ExpertConfig,
) -> Bool[Array, "..."]:
    """Whether enough attempts succeed: every episode that ended, ended in the goal."""
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
    """Whether an evaluation can no longer solve its level, after so many steps: too many attempts have failed."""
    done, goal = (x[:RECORD_STEPS, : config.attempts] for x in (done, goal))
    failed = (done & ~goal & (jnp.arange(len(done)) < steps)[:, None]).any(0)
    return config.attempts - failed.sum() < rules.enough


def is_rung(updates: Int[Array, ""], first: int | np.int32) -> Bool[Array, ""]:
    """Whether it is `first` times a power of two."""
    times = updates // first
    return (updates % first == 0) & (times > 0) & ((times & (times - 1)) == 0)
