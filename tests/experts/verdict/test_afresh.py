"""Success rates come from attempts that decide nothing, and do not depend on neighbours."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.policy import network_of
from levelproof.experts.pool.pool import Pool
from levelproof.experts.pool.run import TrainingRun, UnitResult
from levelproof.experts.training.rollout import Acting, ActionRule, rollout, start
from levelproof.experts.verdict.afresh import PART, attempt
from levelproof.experts.verdict.judge import shares
from levelproof.levelgen.batching import repeat, take
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from tests.experts.small import CONFIG, untouched
from tests.experts.training.test_slots import SOLVED
from tests.quick import jit_once

IDS = np.arange(100, 124)
ALL = replace(SOLVED, successes=CONFIG.attempts)  # a level is solved when every attempt of an evaluation succeeds


@pytest.fixture(scope="module")
def levels() -> Level:
    return jax.tree.map(np.asarray, sample_levels(IDS, SIZES["s"]))


@pytest.fixture(scope="module")
def run(levels: Level) -> TrainingRun:
    pool = Pool(24 * CONFIG.steps_per_update, untouched(ALL), DEFAULT_RULES)
    run = TrainingRun(pool, levels, IDS)
    while not pool.step():
        run.submit_searched()
    return run


@pytest.fixture(scope="module")
def result(run: TrainingRun) -> UnitResult:
    return run.finish()


@pytest.mark.slow
def test_success_rate_differs_from_that_of_the_last_evaluation(run: TrainingRun, result: UnitResult) -> None:
    """If all attempts of the last evaluation succeeded, others may still fail."""
    assert run.submission
    ended = zip(run.left, run.submission.trained(CONFIG), strict=True)
    lucky = [index for index, level in ended if shares(level.evaluations[-1], CONFIG)[0] == 1]
    rates = np.array([result.verdicts[index].success_rate for index in lucky])
    assert len(rates) > 4
    assert 0.5 < rates.mean() < 1


@pytest.mark.slow
def test_attempts_add_their_env_steps(run: TrainingRun, result: UnitResult) -> None:
    assert run.submission
    for index, level in zip(run.left, run.submission.trained(CONFIG), strict=True):
        more = result.verdicts[index].evaluation_steps - level.evaluation_steps
        assert CONFIG.attempts <= more <= CONFIG.attempts * RECORD_STEPS
    assert result.spent.evaluated == sum(level.evaluation_steps for level in result.verdicts)
    assert result.ledger
    seconds = [result.ledger.seconds_of(int(index)).evaluation for index in run.left]
    assert min(seconds) > 0


@pytest.mark.slow
def test_attempts_count_first_episodes_alone(levels: Level, run: TrainingRun) -> None:
    """An expert without preferences fires thrusters at random. Some attempts reach the goal in a later episode only."""
    loose = replace(levels, model=replace(levels.model, joint_active=np.zeros_like(levels.model.joint_active)))
    assert run.submission
    even = jax.tree.map(np.zeros_like, run.submission.trained(CONFIG)[0].policy)
    result = attempt(loose, IDS, [even] * len(IDS), CONFIG, DEFAULT_RULES)  # pyright: ignore

    @jit_once
    def played() -> tuple:
        params = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(IDS), *x.shape)), even)
        keys = jax.vmap(lambda level_id: key_for(level_id, Stream.SUCCESS_RATE))(IDS)
        manner = ActionRule.sampling(len(IDS) * CONFIG.attempts, len(IDS))

        def play(acting: Acting, part: jax.Array) -> tuple:
            key = jax.vmap(jax.random.fold_in, (0, None))(keys, part)
            network = network_of(loose.size, CONFIG)
            acting, trajectory, _ = rollout(network, params, loose, acting, key, manner, PART, DEFAULT_RULES)
            return acting, (trajectory.done, trajectory.goal)

        return jax.lax.scan(play, start(repeat(loose, CONFIG.attempts)), jnp.arange(RECORD_STEPS // PART))[1]

    done, goal = (np.asarray(x).reshape(RECORD_STEPS, len(IDS), CONFIG.attempts) for x in played())
    assert done.any(0).all()
    ends = done.argmax(0)
    reached = np.take_along_axis(goal, ends[None], 0)[0]
    assert (goal.any(0) & ~reached).any()
    np.testing.assert_array_equal(result.success_rate, reached.mean(1, dtype=np.float32))
    np.testing.assert_array_equal(result.env_steps, (ends + 1).sum(1))


def test_success_rate_depends_on_the_level_alone(levels: Level, run: TrainingRun, result: UnitResult) -> None:
    assert run.submission
    trained, some = run.submission.trained(CONFIG), [7, 2, 5]
    policies = [trained[i].policy for i in some]
    results = attempt(take(levels, run.left[some]), IDS[run.left[some]], policies, CONFIG, DEFAULT_RULES)  # pyright: ignore
    np.testing.assert_array_equal(results.success_rate, [result.verdicts[i].success_rate for i in run.left[some]])
