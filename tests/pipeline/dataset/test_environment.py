"""`levelproof.make` on the levels of a split."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest

import levelproof
from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.seed import rows
from tests.pipeline.command import ROOT
from tests.trees import assert_same


def test_make_uses_all_levels_and_the_rules_of_a_split(split: Path) -> None:
    env, params = levelproof.make(split=split, auto_reset=False)
    table = read_manifest(split).table
    ids = table["level_id"].to_numpy()
    np.testing.assert_array_equal(env.level_ids, ids)
    assert not table["shard"].is_valid().to_numpy().all(), "the split has no level without a witness: choose another"
    assert_same(params.levels, levelproof.sample_levels(ids, "s"))
    assert env.rules == levelproof.open(split).rules


def test_make_leaves_the_settings_of_the_callers_process(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command limits JAX and NumPy to a thread; a program that calls `make` may train on all cores."""
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    jax.config.update("jax_default_matmul_precision", "highest")
    try:
        levelproof.make(split=split, where="shard IS NULL")
        assert os.environ["OMP_NUM_THREADS"] == "7"
        assert jax.config.values["jax_default_matmul_precision"] == "highest"
    finally:
        jax.config.update("jax_default_matmul_precision", None)


def test_make_selects_levels_by_a_condition(split: Path) -> None:
    env, params = levelproof.make(split=str(split), where="shard IS NOT NULL", action_type="discrete")
    data = levelproof.open(split)
    np.testing.assert_array_equal(env.level_ids, data.manifest["level_id"])
    assert_same(params.levels, data.levels(np.arange(len(data))))
    _, state = jax.eval_shape(env.reset, jax.random.key(0), params)
    assert state.level_index.shape == ()


def test_make_hashes_only_the_selected_levels_of_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    hashed = list[int]()
    counted = lambda level: hashed.append(level.role.shape[-1]) or content_hashes(level)
    monkeypatch.setattr(rows, "content_hashes", counted)
    env, _ = levelproof.make(split=ROOT / "manifests/256k/s", where="level_id < 10")
    assert env.level_ids is not None
    assert env.level_ids.tolist() == [*range(10)]
    assert sum(hashed) <= 16


def test_make_rejects_invalid_arguments(split: Path, tmp_path: Path) -> None:
    levels = levelproof.sample_levels(np.arange(2), "s")
    assert levelproof.make(levels)[0].rules == DEFAULT_RULES
    for arguments in {}, {"levels": levels, "split": split}:
        with pytest.raises(levelproof.UserError, match="make takes either levels or split="):
            levelproof.make(**arguments)
    with pytest.raises(levelproof.UserError, match="where= is a condition on the levels of a split"):
        levelproof.make(levels, where="label = 'solved'")
    with pytest.raises(levelproof.UserError, match="has no level for which level_id < 0"):
        levelproof.make(split=split, where="level_id < 0")
    with pytest.raises(levelproof.UserError, match="There is no split at"):
        levelproof.make(split=tmp_path / "none")
