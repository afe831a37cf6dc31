"""Experts under way on the disk: what is kept comes back bit for bit, and what is damaged or of others is nothing."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.found import nothing_found
from levelproof.experts.judge import Evaluation, Kept
from levelproof.experts.labels import Source
from levelproof.experts.paused import Paused
from levelproof.experts.slots import Pending
from levelproof.pipeline.store import paused as store
from levelproof.pipeline.store.checkpoints import begun_like
from levelproof.pipeline.store.layout import checkpoint_path, unit_name
from levelproof.pipeline.store.paused import drop_paused, load_paused, prune_paused, save_paused
from tests.pipeline.made import made_job

JOB = made_job("data", "budget=5k")
UNIT = unit_name(3, 7)


@pytest.fixture(scope="module")
def kept() -> dict[int, Paused]:
    """Experts of two levels; the second has solved its level twice."""
    rng = np.random.default_rng(0)
    like = begun_like(JOB)
    action = np.zeros((RECORD_STEPS, like.training.recent.shape[1], JOB.expert.attempts), np.int32)
    flags = np.zeros((RECORD_STEPS, JOB.expert.environments), bool)
    shown = Evaluation(action, flags, flags, like.training.progress, like.training.success)
    filled = lambda tree: jax.tree.map(lambda x: rng.integers(0, 2, x.shape).astype(x.dtype), tree)

    def one(updates: int, evaluations: int) -> Paused:
        begun = filled(like)
        course = begun.training.course._replace(updates=np.asarray(updates, np.int32))
        begun = begun._replace(training=begun.training._replace(course=course))
        found = nothing_found(1)._replace(source=[Source.SEARCH], scout_steps=np.array([5]))
        pending = Pending(np.bool_(True), np.bool_(False), np.int32(9))
        return Paused(Kept(begun, [0.5] * updates), pending, 3, [filled(shown) for _ in range(evaluations)], found)

    return {3: one(2, 0), 7: one(5, 2)}


@pytest.fixture
def split(tmp_path: Path, kept: dict[int, Paused]) -> Path:
    save_paused(tmp_path, UNIT, kept, JOB)
    return tmp_path


def same(one: dict[int, Paused], two: dict[int, Paused]) -> None:
    assert one.keys() == two.keys()
    for a, b in zip(one.values(), two.values(), strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)


def test_what_is_kept_comes_back(split: Path, kept: dict[int, Paused]) -> None:
    same(load_paused(split, range(8), JOB), kept)
    same(load_paused(split, [7, 9], JOB), {7: kept[7]})
    assert load_paused(split, [5, 8], JOB) == {}
    drop_paused(split, UNIT)
    assert load_paused(split, range(8), JOB) == {}
    drop_paused(split, UNIT)


def test_of_two_the_one_that_came_further_counts(split: Path, kept: dict[int, Paused]) -> None:
    save_paused(split, unit_name(0, 4), {3: kept[7]}, JOB)
    same(load_paused(split, range(8), JOB), {3: kept[7], 7: kept[7]})


def test_of_other_settings_or_versions_none_goes_on(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_paused(split, range(8), replace(JOB, budget="8k")) == {}
    monkeypatch.setattr(store, "versions", lambda: {"jax": "another"})
    assert load_paused(split, range(8), JOB) == {}


def test_what_is_damaged_is_nothing(split: Path) -> None:
    path = checkpoint_path(split, UNIT)
    whole = path.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], whole.replace(b"level_id", b"level_di"), b"x" * 100):
        path.write_bytes(damaged)
        assert load_paused(split, range(8), JOB) == {}


def test_what_no_level_needs_goes(split: Path) -> None:
    path = checkpoint_path(split, UNIT)
    (split / "checkpoints" / f".{path.name}.17").touch()
    prune_paused(split, np.array([7]))
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    prune_paused(split, np.array([3, 7, 8]))
    assert not list(path.parent.iterdir())
