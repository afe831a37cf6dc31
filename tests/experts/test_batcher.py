"""Levels enter empty slots in order of arrival, and touch no other slot."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.batcher import Batcher, Entrant, Submission, entered

WIDTH = 3


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Counters:
    """Slots that count."""

    levels: Any
    level_ids: Any
    count: Any


def begin(levels: Any, level_ids: np.ndarray, entrants: list[Entrant]) -> Counters:
    assert [entrant.submission.level_ids[entrant.position] for entrant in entrants] == level_ids.tolist()
    return Counters(levels, level_ids, np.zeros(len(level_ids), np.int32))


def submitted(slots: Batcher, level_ids: range) -> Submission:
    ids = np.array(level_ids, np.int32)
    submission = Submission({"mass": 10.0 + np.tile(ids, (2, 1)).astype(np.float32)}, ids)  # pyright: ignore
    slots.submit(submission)
    return submission


def counted(slots: Batcher) -> list[tuple[int, int]]:
    """Return the id and the count of each slot; every level is that of its id."""
    rows = jax.device_get(slots.rows)
    for slot, entrant in slots.busy():
        assert rows.level_ids[slot] == entrant.submission.level_ids[entrant.position]
        np.testing.assert_array_equal(rows.levels["mass"][:, slot], 10 + rows.level_ids[slot])
    return list(zip(rows.level_ids.tolist(), rows.count.tolist(), strict=True))


@pytest.mark.parametrize("group", [1, 2, 16])
def test_levels_enter_empty_slots_in_order(group: int) -> None:
    slots = Batcher(WIDTH, group)
    first, second = submitted(slots, range(4)), submitted(slots, range(4, 6))
    slots.fill(begin)
    assert counted(slots) == [(0, 0), (1, 0), (2, 0)]
    assert (slots.waiting_of(first), slots.waiting_of(second), slots.present) == ([3], [0, 1], 6)
    slots.rows = replace(slots.rows, count=np.array([1, 2, 3], np.int32))
    del slots.at[2], slots.at[0]
    slots.fill(begin)
    assert counted(slots) == [(3, 0), (1, 2), (4, 0)]
    slots.fill(begin)
    assert counted(slots) == [(3, 0), (1, 2), (4, 0)]


def test_slots_that_no_level_has_entered_are_zero() -> None:
    slots = Batcher(WIDTH, 4)
    submitted(slots, range(7, 8))
    slots.fill(begin)
    assert counted(slots) == [(7, 0), (0, 0), (0, 0)]
    assert not np.asarray(slots.rows.levels["mass"])[:, 1:].any()


def test_withdraw_removes_waiting_levels_of_one_submission() -> None:
    """Waiting levels are removed even if `begin` has already run for them, together with earlier levels."""
    slots = Batcher(WIDTH, 16)
    first, second = submitted(slots, range(5)), submitted(slots, range(5, 10))
    slots.fill(begin)
    slots.withdraw(first, [3])
    assert (slots.waiting_of(first), first.under_way) == ([4], {0, 1, 2, 4})
    assert (slots.waiting_of(second), second.under_way) == ([*range(5)], {*range(5)})
    del slots.at[0], slots.at[1]
    slots.fill(begin)
    assert counted(slots) == [(4, 0), (5, 0), (2, 0)]


def test_every_level_begins_once() -> None:
    slots, calls = Batcher(WIDTH, 4), []

    def begin_and_count(levels: Any, level_ids: np.ndarray, entrants: list[Entrant]) -> Counters:
        calls.append(level_ids.tolist())
        return begin(levels, level_ids, entrants)

    submitted(slots, range(6))
    while slots.waiting:
        slots.at.clear()
        slots.fill(begin_and_count)
    assert calls == [[0, 1, 2, 3], [4, 5, 5, 5]]


def test_accelerators_copy_the_same_rows_into_slots(monkeypatch: pytest.MonkeyPatch) -> None:
    ids = jnp.arange(4, dtype=jnp.int32)
    rows = lambda: Counters({"mass": jnp.zeros((2, WIDTH))}, jnp.zeros(WIDTH, jnp.int32), jnp.full(WIDTH, 5))
    fresh = Counters({"mass": jnp.tile(10.0 + ids, (2, 1))}, ids, jnp.zeros(4, jnp.int32))
    sources, slots = np.array([2, 3, 0, 0]), np.array([1, 0, WIDTH, WIDTH])
    on_cpu = entered(rows(), fresh, sources, slots)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    elsewhere = entered.function(rows(), fresh, sources, slots)
    jax.tree.map(np.testing.assert_array_equal, on_cpu, elsewhere)
    assert on_cpu.level_ids.tolist() == [3, 2, 0]
    assert on_cpu.count.tolist() == [0, 0, 5]
