"""Minari exports: opened by Minari, and equal to what the environment returns."""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import minari
import numpy as np
import pytest

import levelproof
from levelproof.experts.witness.witness import Record
from levelproof.levelgen.task.actions import CHOICES, continuous_controls, controls
from levelproof.levelgen.task.observe.flat import symbolic_flat
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.exchange.minari.episodes import ActionKind, encode_actions, episodes_of
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import read_manifest
from tests.pipeline.made import honest_split, made_job

pytestmark = pytest.mark.slow
MANY = 16  # levels with ids below this are compared
EVERY = np.stack(np.unravel_index(np.arange(np.prod(CHOICES)), CHOICES), -1)  # actions that exist


@pytest.fixture(scope="module")
def stored(split: Path) -> dict[int, Any]:
    """Stored arrays of the solved levels below MANY, by id."""
    rows = read_manifest(split).table.to_pylist()
    solved = [row for row in rows if row["label"] == "solved" and row["level_id"] < MANY]
    return {row["level_id"]: levelproof.Shard(split / row["shard"]).read([row["row"]]) for row in solved}


def export_and_load(split: Path, out: Path, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> Any:
    assert main(["export", str(split), "--format", "minari", "-o", str(out), *arguments]) == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(out))
    (name,) = minari.list_local_datasets()
    return minari.load_dataset(name)


@jax.jit
def observe(level: levelproof.Level, states: Any, step: int) -> Any:
    return symbolic_flat(level, jax.tree.map(lambda x: jnp.asarray(x)[step], states))


def test_export_minari_writes_every_step_once_in_order(
    split: Path, stored: dict[int, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Observations are those of the stored states."""
    data = export_and_load(split, tmp_path / "out", monkeypatch, "--where", f"label = 'solved' AND level_id < {MANY}")
    assert data.id == "levelproof/128k/s-v0"
    assert data.total_steps == 256 * len(stored)
    position = dict.fromkeys(stored, 0)
    for episode in data.iterate_episodes():
        (level_id,) = set(episode.infos["level_id"].tolist())
        fields, first = stored[level_id], position[level_id]
        rows, position[level_id] = slice(first, first + len(episode)), first + len(episode)
        level = tree_of(levelproof.Level, fields, "level/")
        record = tree_of(Record, fields, "record/")
        np.testing.assert_array_equal(episode.actions, record.action[rows, :, 0])
        np.testing.assert_array_equal(episode.rewards, record.reward[rows, 0])
        np.testing.assert_array_equal(episode.terminations, record.done[rows, 0])
        assert episode.truncations[-1] == (not record.done[rows, 0][-1])
        assert not episode.truncations[:-1].any()
        np.testing.assert_array_equal(episode.infos["success"], [False, *record.goal[rows, 0]])
        assert all(map(data.action_space.contains, episode.actions))
        assert all(map(data.observation_space.contains, episode.observations))
        np.testing.assert_array_equal(episode.observations[0], observe(level, record.state, first)[:, 0])
    assert set(position.values()) == {256}


def test_last_observation_of_an_episode_is_that_of_its_next_state(stored: dict[int, Any]) -> None:
    """If a record is cut within an episode, the recomputed step must give the next row of the record."""
    fields = next(iter(stored.values()))
    level, record = tree_of(levelproof.Level, fields, "level/"), tree_of(Record, fields, "record/")
    first = lambda record: next(episodes_of(np.array([0]), level, record, TaskParams(), ActionKind.COMBINED))
    cut = record.done.copy()
    cut[5] = True
    shorter = Record(**vars(record) | {"done": cut})
    assert len(first(record).rewards) > 6
    np.testing.assert_array_equal(first(shorter).observations, first(record).observations[:7])


def test_episodes_of_truncates_at_the_time_limit_and_terminates_on_failure(stored: dict[int, Any]) -> None:
    fields = next(iter(stored.values()))
    level, record = tree_of(levelproof.Level, fields, "level/"), tree_of(Record, fields, "record/")
    done, goal = np.zeros((256, 1), bool), np.zeros((256, 1), bool)
    done[[9, 19]] = True
    timestep = np.arange(256, dtype=np.int32)[:, None] % 10
    never = Record(**vars(record) | {"done": done, "goal": goal, "timestep": timestep})
    first, second, rest = episodes_of(np.array([7]), level, never, TaskParams(max_timesteps=10), ActionKind.COMBINED)
    assert first.truncations.tolist() == second.truncations.tolist() == [False] * 9 + [True]
    assert not first.terminations.any()
    assert (len(rest.rewards), rest.truncations.sum(), rest.truncations[-1]) == (236, 1, True)
    failed, *_ = episodes_of(np.array([7]), level, never, TaskParams(), ActionKind.COMBINED)
    assert failed.terminations.tolist() == [False] * 9 + [True]
    assert not failed.truncations.any()


@pytest.mark.parametrize("kind", ["combined", "continuous"])
def test_combined_and_continuous_actions_equal_the_stored_ones(
    kind: str, split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = export_and_load(split, tmp_path / "out", monkeypatch, "--actions", kind, "--where", "level_id < 4")
    assert data.id == f"levelproof/128k/s-{kind}-v0"
    theirs = encode_actions(EVERY, ActionKind(kind))
    assert all(data.action_space.contains(action) for action in theirs)
    assert all(data.action_space.contains(action) for action in data[0].actions)
    if kind == "combined":
        np.testing.assert_array_equal(np.stack(np.unravel_index(theirs, CHOICES), -1), EVERY)
        assert data.action_space.n == len(EVERY)
    else:
        levels = levelproof.sample_levels(np.arange(len(EVERY)), levelproof.SIZES["s"], made_job().distribution)
        ours = controls(levels, jnp.asarray(EVERY.T))
        jax.tree.map(np.testing.assert_array_equal, ours, continuous_controls(levels, jnp.asarray(theirs.T)))


def test_export_minari_rejects_invalid_arguments(
    split: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["export", str(split), "-o", str(tmp_path / "out"), "--format"]
    assert main([*command, "minari", "--where", "level_id < 0"]) == 2
    assert main([*command, "parquet", "--actions", "combined"]) == 2
    monkeypatch.setitem(sys.modules, "minari", None)
    assert main([*command, "minari"]) == 2
    nothing, actions, missing = capsys.readouterr().err.splitlines()
    assert "for which level_id < 0 holds has a witness" in nothing
    assert "--actions is for --format minari" in actions
    assert missing.endswith('run `pip install "minari[hdf5]"`.')
    assert not (tmp_path / "out").exists()


def test_dataset_names_a_budget_with_a_decimal_point_and_its_rules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    split = honest_split(tmp_path / "data", 8, 1, "budget=11.5M", "task.dense_reward_scale=0.5")
    assert split.parent.name == "11.5M"
    data = export_and_load(split, tmp_path / "out", monkeypatch)
    assert data.id == "levelproof/11_5M/s-v0"
    rules = "The rules differ from the defaults: task.dense_reward_scale=0.5."
    assert capsys.readouterr().out.startswith(f"{rules}\n")
    assert rules in data.storage.metadata["description"]
