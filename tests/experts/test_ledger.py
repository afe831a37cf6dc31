"""The ledger loses no seconds, counts none twice, and gives each level its share."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.ledger import Lap, Ledger, StepCosts, lap


def test_lap_separates_compiling_from_work() -> None:
    inner = jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x))  # traced within the other
    program = jax.jit(lambda x: inner(x) + inner(x.T))
    matrix = np.ones((64, 64), np.float32)
    start = time.perf_counter()
    with lap() as first:
        jax.block_until_ready(program(matrix))
        time.sleep(0.05)
    whole = time.perf_counter() - start
    with lap() as second:
        jax.block_until_ready(program(matrix))
    assert 0 < first.compiling < whole - 0.05
    assert 0.05 <= first.seconds <= whole - first.compiling + 1e-3
    assert second.compiling == 0


def test_ledger_splits_seconds_between_levels() -> None:
    ledger = Ledger(4)
    ledger.add("search", Lap(8.0))
    ledger.share("search", np.array([0, 10, 30, 0]))
    ledger.add("replay", Lap(2.0))
    theirs = Ledger(2)
    theirs.put("training", 0, 3.0)
    ledger.take(theirs, np.array([1, 3]))
    assert [ledger.seconds_of(i).search for i in range(4)] == [0, 2, 6, 0]
    assert [ledger.seconds_of(i).replay for i in range(4)] == [0.5] * 4
    assert [ledger.seconds_of(i).training for i in range(4)] == [0, 3, 0, 0]
    assert sum(ledger.total()) == 13.0
    some = ledger.only(np.array([0, 1]))  # others label the rest
    assert [some.seconds_of(i).search for i in range(2)] == [3, 5]
    assert sum(some.total()) == 13.0


@pytest.mark.parametrize("update", [0.0, 0.3])  # a GPU's slots cost the same, whatever they do
def test_split_separates_updates_from_play(update: float) -> None:
    rng, steps, slots = np.random.default_rng(0), StepCosts(), 4
    for _ in range(200):
        training = int(rng.integers(0, slots + 1))
        seconds = 0.4 + training * update + rng.normal(0, 0.005)
        train, play = steps.split(seconds, training, slots)
        assert training * train + (slots - training) * play == pytest.approx(seconds)
    train, play = steps.split(0.4 + 2 * update, 2, slots)
    assert train - play == pytest.approx(update, abs=0.01)
    assert steps.split(1.0, 0, slots)[1] == pytest.approx(0.25)
